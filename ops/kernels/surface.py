"""numba kernels of `blur_surface` for CPU float32 without gradients: bins are mixed while they are in the cache."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import numba as nb
import numpy as np
import torch
from torch import Tensor

from torchbokeh.ops.composite import TINY
from torchbokeh.ops.kernels.merge import bank_of, buffered, coarse_picture, coarser, draw_pixels, planes_of
from torchbokeh.ops.kernels.merge_collect import Lanes, Levels, bands, collect
from torchbokeh.ops.kernels.rows import running_sum
from torchbokeh.ops.kernels.splat import shape_tables
from torchbokeh.ops.merge import MARGIN, Merging
from torchbokeh.ops.spans import Profile
from torchbokeh.ops.system.threads import run_all


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _fill(band, coarse, pad, mixed, taken, total, y0, y1):  # type: ignore[no-untyped-def]
    """Add one bin to the rows ``y0 .. y1-1`` of what the bins in front of it have left free."""
    channels, _, width = mixed.shape
    zero, one, tiny = np.float32(0.0), np.float32(1.0), np.float32(TINY)
    pixels, share = np.empty(4 * width, np.float32), np.empty(width, np.float32)
    line = np.empty(4 * coarse.shape[1], np.float32)
    fine = np.zeros(8 * ((width + 1) >> 1), np.float32)
    for y in range(y0, y1):
        if coarse.shape[0] > 0:
            coarser(coarse, y, 0, line, fine)
        running_sum(band, 4 * (y - y0) * (width + 2 * pad), pad, fine, pixels, width)
        lane, used, covered = pixels[channels:], taken[y], total[y]
        for x in range(width):
            coverage = max(lane[4 * x], zero)
            counts = min(coverage, max(one - used[x], zero))
            share[x] = counts / max(coverage, tiny)
            used[x] += counts
            covered[x] += coverage
        for k in range(channels):
            plane, lane = mixed[k, y], pixels[k:]
            for x in range(width):
                plane[x] += lane[4 * x] * share[x]


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _bin_band(  # type: ignore[no-untyped-def]
    values, coc, weight, channel, constant, merging, highest, bounds, reach, marks,
    bank, shape, coarse, mixed, taken, total, band, y0, y1
):  # fmt: skip
    draw_pixels(
        *(values, coc, weight, channel, constant, merging, highest, bounds, reach, marks, bank, shape, band, y0, y1)
    )
    _fill(band, coarse, bank[2], mixed, taken, total, y0, y1)


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _divide(mixed, taken, y0, y1):  # type: ignore[no-untyped-def]
    for y in range(y0, y1):
        for k in range(mixed.shape[0]):
            plane, used = mixed[k, y], taken[y]
            for x in range(len(used)):
                plane[x] /= max(used[x], np.float32(TINY))


def _rows_of(levels: Levels, coc: np.ndarray) -> tuple[float, float]:
    """First and last row that a bin can reach."""
    height, width = coc.shape
    low, high = np.inf, -np.inf
    for level, reach in enumerate(levels.reach):
        rows = np.flatnonzero(reach[: -(-height >> level)] > (0 if level else -0.5))
        if len(rows):
            size = 1 << level
            around = reach[rows] + size * (2 * MARGIN if level else 1)
            low = min(low, (rows * size - around).min())
            high = max(high, ((rows + 1) * size + around).max())
    if len(levels.marks):
        radius = np.abs(coc.reshape(-1)[levels.marks]) + 1
        low = min(low, (levels.marks // width - radius).min())
        high = max(high, (levels.marks // width + radius).max())
    return low, high


def blur_surface(
    colour: Tensor, coc: Tensor, weights: Sequence[Tensor | None], profile: Profile, merging: Merging, highest: int
) -> tuple[Tensor, Tensor]:
    """`torchbokeh.ops.surface.blur_surface` for CPU float32, for the weights of all bins."""
    b, channels, h, w = colour.shape
    shape = shape_tables(profile)
    bank = bank_of(merging, shape)
    source, radii = colour.detach().contiguous(), coc.detach().contiguous()
    planes = [planes_of(weight, b) for weight in weights]
    mixed, total = (torch.zeros(b, c, h, w, dtype=torch.float32) for c in (channels, 1))
    taken = np.zeros((b, h, w), np.float32)
    lanes = Lanes.of(0, channels, True)
    buffers: list[np.ndarray] = []
    for n in range(b):
        kernels: list[tuple[tuple[float, float], Any]] = []
        target = mixed[n].numpy(), taken[n], total[n, 0].numpy()
        for plane in planes:
            scene = source[n].numpy(), radii[n, 0].numpy(), plane[n]
            levels = collect(*scene, lanes, merging, highest)
            rows = _rows_of(levels, scene[1])
            if rows[0] > rows[1]:
                continue
            coarse = coarse_picture(levels, bank, shape, buffers)
            settings = (*lanes, merging, highest, levels.bounds, levels.reach[0], levels.marks, bank, shape)
            kernels.append((rows, partial(_bin_band, *scene, *settings, coarse, *target)))
        work = buffered(partial(_all_bins, kernels, target[0], target[1]), w + 2 * bank.reach, buffers)
        run_all(work, bands(h), "picture")
    return mixed, total


def _all_bins(
    kernels: Sequence[tuple[tuple[float, float], Any]],
    mixed: np.ndarray,
    taken: np.ndarray,
    band: np.ndarray,
    y0: int,
    y1: int,
) -> None:
    for (low, high), kernel in kernels:
        if low < y1 and high >= y0:
            kernel(band, y0, y1)
    _divide(mixed, taken, y0, y1)
