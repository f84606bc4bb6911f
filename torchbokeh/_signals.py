"""How a command ends on Ctrl-C and on SIGTERM: with one line, without its workers and its temporary files."""

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType


class Terminated(BaseException):
    """SIGTERM came; what is at work unwinds as it does on Ctrl-C."""


def is_command() -> bool:
    """Whether this process is the command line, a console script or by ``-m``, and not only uses the library."""
    program, *flags = getattr(sys, "argv", None) or [""]
    if program == "-m":  # a package that -m names is imported before its name takes this place
        return sys.orig_argv[: len(sys.orig_argv) - len(flags)][-1] == "torchbokeh"
    return Path(program).stem == "torchbokeh"


def end_while_importing() -> None:
    """End without a traceback on Ctrl-C, until `stoppable` sees to it: importing torch takes a while."""
    if _is_main_thread() and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _end)


@contextmanager
def stoppable() -> Iterator[None]:
    """Raise KeyboardInterrupt in the block on Ctrl-C, and :class:`Terminated` on SIGTERM, unless others handle them."""
    handlers = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: _terminate}
    before = {}
    if _is_main_thread():
        for number, handler in handlers.items():
            if signal.getsignal(number) in (signal.SIG_DFL, _end):
                before[number] = signal.signal(number, handler)
    try:
        yield
    finally:
        for number, earlier in before.items():
            signal.signal(number, earlier)


def _is_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()


def _end(number: int, frame: FrameType | None) -> None:
    os.write(2, b"torchbokeh: interrupted\n")
    os._exit(130)


def _terminate(number: int, frame: FrameType | None) -> None:
    raise Terminated
