"""Worker processes that are gone when their parent ends, however it ends."""

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def ending_children() -> Iterator[None]:
    """Terminate the processes that were started in the block when it ends by an error: their work may take long."""
    others = multiprocessing.active_children()
    try:
        yield
    except BaseException:
        for child in set(multiprocessing.active_children()).difference(others):
            child.terminate()
        raise


@contextmanager
def starting_children() -> Iterator[None]:
    """Hold Ctrl-C and SIGTERM back while the block starts processes, and keep Ctrl-C from these for good.

    One that is half started when an exception comes is not known yet, and nobody ends it. A terminal sends Ctrl-C to
    the children too, but it is their parent that ends them, without a traceback of each.
    """
    came: list[int] = []
    handlers = {}
    if threading.current_thread() is threading.main_thread():
        for number in (signal.SIGINT, signal.SIGTERM):
            if callable(signal.getsignal(number)):  # else nothing is raised
                # Blocking it would not do: any other thread of the process may take it.
                handlers[number] = signal.signal(number, lambda number, frame: came.append(number))
    has_masks = hasattr(signal, "pthread_sigmask")  # not on Windows
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT}) if has_masks else set()  # children inherit it
    try:
        yield
    finally:
        if has_masks:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        for number, handler in handlers.items():
            signal.signal(number, handler)
        for one in came:
            signal.raise_signal(one)


def end_with_parent() -> None:
    """Run in a worker: end it where its parent is killed. It would wait for ever to be given jobs or rid of results."""
    parent = multiprocessing.parent_process()

    def wait() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
