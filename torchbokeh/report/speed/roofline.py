"""The least time that the stages of a merged splat can take: what must be moved and stored, at measured rates.

Two rates are measured on the machine, in the same run: bytes per second of a plain copy, and points per second of the
loop that adds pixels to a buffer in the cache. The bound of a stage is what it must read and write once, over the first
rate, plus the points that it must add, over the second. Sums, interpolation and the choice of levels count as free.
"""

import math
import time
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import torch
from torch import Tensor

from torchbokeh.ops.merge import highest_level, level_shares, merge_cells
from torchbokeh.ops.spans import MIN_RADIUS
from torchbokeh.report.internals import QUALITIES

RECORD_BYTES, LANE_BYTES = 32, 16
"""Of a cell with its sums, and of a pixel of four float32 lanes."""


class Rates(NamedTuple):
    """What the machine can do on all threads: bytes per second, and points (a pixel added to two columns)."""

    bytes: float
    points: float


def measured_rates(seconds: float = 0.2) -> Rates:
    """Measure both rates, the best of many short runs each, on ``torch.get_num_threads()`` threads."""
    source = torch.ones(1 << 24)
    target = torch.empty_like(source)
    copied = 2 * source.numel() * 4 / _best(lambda: target.copy_(source), seconds)
    return Rates(copied, _points_per_second(seconds))


def _points_per_second(seconds: float) -> float:
    import numba as nb
    import numpy as np

    from torchbokeh.ops.kernels.rows import PsfRows, draw_rows

    rows, width = 16, 1000
    stride = 4 * (width + 40)

    @nb.njit(nogil=True)
    def draw(band, pixels, psf):  # type: ignore[no-untyped-def]
        for x in range(width):
            draw_rows(band, 4 * (x + 20), stride, pixels, 4 * x, psf, (0, rows))

    half = np.sqrt((rows / 2) ** 2 - (np.arange(rows) - (rows - 1) / 2) ** 2)
    columns = np.floor(np.stack([0.5 - half, 0.5 + half], 1)).astype(np.int64)
    psf, pixels = PsfRows(columns, np.ones((rows, 4)), np.empty((0, 4))), np.ones(4 * width, np.float32)
    threads = torch.get_num_threads()
    bands = [np.zeros(stride * rows) for _ in range(threads)]

    def all_threads() -> None:
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(lambda band: [draw(band, pixels, psf) for _ in range(20)], bands))

    return threads * 20 * width * rows * 2 / _best(all_threads, seconds)


def _best(work, seconds: float) -> float:  # type: ignore[no-untyped-def]
    work()
    best, stop = math.inf, time.perf_counter() + seconds
    while time.perf_counter() < stop:
        start = time.perf_counter()
        work()
        best = min(best, time.perf_counter() - start)
    return best


def least_seconds(image: Tensor, coc: Tensor, quality: str, rates: Rates) -> dict[str, float]:
    """Lower bounds by stage, under the names that the kernels record; empty for the exact quality.

    Args:
        image: ``(B, C, H, W)`` with up to three channels.
        coc: ``(B, 1, H, W)``.
        quality: an operating point.
        rates: those of `measured_rates`.
    """
    merging = next(q.merging for q in QUALITIES if q.name == quality)
    if merging is None:
        return {}
    size = (coc.shape[2], coc.shape[3])
    highest = highest_level(coc.abs().max().item(), size, merging)
    shares = level_shares(image, coc, merging, highest)
    points, cells = [], 0
    for level, (values, radius) in enumerate(merge_cells(image, coc, shares)):
        alive = (values != 0).any(1, keepdim=True)
        rows = 2 * (radius.abs().clamp_min(MIN_RADIUS) + 0.499).floor() + 1
        points.append(2 * rows.clamp(max=values.shape[2])[alive].sum().item())
        cells += radius.numel() if level else 0
    planes = image.numel() + coc.numel()
    need = {
        "mean": 4 * image.numel() / rates.bytes,
        "collect": (4 * planes + RECORD_BYTES * cells) / rates.bytes,
        "levels": (RECORD_BYTES + LANE_BYTES) * cells / rates.bytes + sum(points[1:]) / rates.points,
        "picture": (8 * planes + LANE_BYTES * cells) / rates.bytes + points[0] / rates.points,
    }
    return need if highest else {name: need[name] for name in ("mean", "collect", "picture")}
