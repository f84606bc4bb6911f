"""Run independent pieces of work on as many threads as torch uses, and on request take the time of each stage."""

import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import torch

_recorded: dict[str, float] | None = None


@contextmanager
def recorded() -> Iterator[dict[str, float]]:
    """Seconds that each named stage of the kernels takes within the block. For one thread that calls kernels."""
    global _recorded
    before, _recorded = _recorded, {}
    try:
        yield _recorded
    finally:
        _recorded = before


@contextmanager
def stage(name: str) -> Iterator[None]:
    """Count the time of the block as that of the stage ``name``, if anyone records."""
    seconds = _recorded
    if seconds is None:
        yield
        return
    start = time.perf_counter()
    yield
    seconds[name] = seconds.get(name, 0.0) + time.perf_counter() - start


def run_all(work: Callable[..., None], pieces: Iterable[tuple[Any, ...]], name: str = "other") -> None:
    """Call ``work(*piece)`` for every piece, on ``torch.get_num_threads()`` threads.

    The calling thread takes part; the others live for one call only, so nothing is left behind that a forked process
    could trip over. The pieces must not depend on each other.

    The number is looked up at every call, and is all that limits the kernels: one in a worker of a ``DataLoader``,
    which tells torch so, and in the processes of ``torchrun`` unless ``OMP_NUM_THREADS`` says more. Processes that are
    started otherwise take all cores each, until `torch.set_num_threads` shares these out.

    Args:
        work: the function.
        pieces: its arguments, one tuple for each call.
        name: the stage that the time counts for, see `recorded`.
    """
    pieces = list(pieces)
    queue = iter(pieces)  # a list's iterator gives every piece to one thread only
    errors: list[BaseException] = []

    def take() -> None:
        try:
            while not errors and (piece := next(queue, None)) is not None:
                work(*piece)
        except BaseException as error:
            errors.append(error)

    with stage(name):
        helpers = [threading.Thread(target=take) for _ in range(min(torch.get_num_threads(), len(pieces)) - 1)]
        try:
            with suppress(RuntimeError):  # the system has no more threads: those that there are do all the work
                for helper in helpers:
                    helper.start()
            take()
            _join(helpers)
        except BaseException as error:  # Ctrl-C: the helpers stop after the piece that they are at
            errors.append(error)
            _join(helpers)
    if errors:
        raise errors[0]


def row_bands(height: int, rows: int) -> list[tuple[int, int]]:
    """Pieces of work: a picture of that height in bands of so many rows, first and one past the last of each."""
    return [(y, min(y + rows, height)) for y in range(0, height, rows)]


def _join(threads: list[threading.Thread]) -> None:
    for thread in threads:
        if thread.is_alive():  # one that could not be started is not
            thread.join()
