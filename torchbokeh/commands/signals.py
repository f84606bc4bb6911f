"""How a command ends on Ctrl-C and on SIGTERM: with one line, without its workers and its temporary files."""

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


class Terminated(BaseException):
    """SIGTERM came; what is at work unwinds as it does on Ctrl-C."""


def end_while_importing() -> None:
    """End without a traceback on Ctrl-C, until `stoppable` sees to it: importing torch takes a while."""
    if _is_main_thread() and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _end)


@contextmanager
def stoppable() -> Iterator[None]:
    """Raise KeyboardInterrupt in the block on Ctrl-C, and :class:`Terminated` on SIGTERM, unless others handle them."""
    errors: dict[int, type[BaseException]] = {signal.SIGINT: KeyboardInterrupt, signal.SIGTERM: Terminated}
    came: list[int] = []

    def stop(number: int, frame: FrameType | None) -> None:
        came.append(number)
        raise errors[number]

    before = {}
    if _is_main_thread():
        for number in errors:
            if signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler, _end):
                before[number] = signal.signal(number, stop)
    try:
        yield
    except Exception as error:
        if came:  # compiled code that a signal comes in the middle of may make another error of it
            raise errors[came[0]] from error
        raise
    finally:
        for number, earlier in before.items():
            signal.signal(number, earlier)


def _is_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()


def _end(number: int, frame: FrameType | None) -> None:
    os.write(2, b"torchbokeh: interrupted\n")
    os._exit(130)
