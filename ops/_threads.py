"""Run independent pieces of work on as many threads as torch uses."""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import torch


def run_all(work: Callable[..., None], pieces: Iterable[tuple[Any, ...]]) -> None:
    """Call ``work(*piece)`` for every piece, on ``torch.get_num_threads()`` threads.

    The pool lives for one call only, so nothing is left behind that a forked process could trip over; a
    ``DataLoader`` worker has one thread and runs the pieces itself. The pieces must not depend on each other.
    """
    threads = torch.get_num_threads()
    if threads == 1:
        for piece in pieces:
            work(*piece)
        return
    with ThreadPoolExecutor(threads) as pool:
        for done in [pool.submit(work, *piece) for piece in pieces]:
            done.result()
