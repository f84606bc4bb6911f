"""numba kernels of `blur_surface` for CPU float32 without gradients: bins are mixed while they are in the cache."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numba as nb
import numpy as np
import torch
from torch import Tensor

from torchbokeh.ops.composite import TINY
from torchbokeh.ops.kernels.merge import (
    Band,
    bank_for,
    buffered,
    coarse_picture,
    draw_pixels,
    finish_row,
    interpolation_rows,
)
from torchbokeh.ops.kernels.merge_collect import Lanes, Levels, Picture, bands, collect
from torchbokeh.ops.merge import MARGIN, Merging
from torchbokeh.ops.spans import Profile
from torchbokeh.ops.system.threads import run_all


class Filled(NamedTuple):
    """A picture that bins fill front to back: ``mixed (C, H, W)``, the sum of their colours as far as they count; the
    coverage ``taken (H, W)`` that is used up; and the ``total (H, W)`` of all coverages.
    """

    mixed: np.ndarray
    taken: np.ndarray
    total: np.ndarray


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _bin_band(picture, lanes, levels, bank, coarse, filled, band):  # type: ignore[no-untyped-def]
    """Add one bin to a band of what the bins in front of it have left free."""
    draw_pixels(picture, lanes, levels, bank, band)
    mixed, taken, total = filled
    channels, _, width = mixed.shape
    zero, one, tiny = np.float32(0.0), np.float32(1.0), np.float32(TINY)
    pixels, share = np.empty(4 * width, np.float32), np.empty(width, np.float32)
    scratch = interpolation_rows(coarse, width)
    for y in range(band.y0, band.y1):
        finish_row(band, bank.reach, coarse, y, 0, scratch, pixels)
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
    bank = bank_for(profile, merging)
    colour, coc = colour.contiguous(), coc.contiguous()
    bins = [Picture.each(colour, coc, weight) for weight in weights]
    mixed, taken, total = (torch.zeros(b, c, h, w, dtype=torch.float32) for c in (channels, 1, 1))
    lanes = Lanes.of(0, channels, True)
    buffers: list[np.ndarray] = []
    for n in range(b):
        kernels: list[tuple[tuple[float, float], Callable[[Band], None]]] = []
        filled = Filled(mixed[n].numpy(), taken[n, 0].numpy(), total[n, 0].numpy())
        for pictures in bins:
            levels = collect(pictures[n], lanes, merging, highest)
            rows = _rows_of(levels, pictures[n].coc)
            if rows[0] > rows[1]:
                continue
            coarse = coarse_picture(levels, bank, buffers)
            kernels.append((rows, partial(_bin_band, pictures[n], lanes, levels, bank, coarse, filled)))
        work = buffered(partial(_all_bins, kernels, filled), w + 2 * bank.reach, buffers)
        run_all(work, bands(h), "picture")
    return mixed, total


def _all_bins(
    kernels: Sequence[tuple[tuple[float, float], Callable[[Band], None]]], filled: Filled, band: Band
) -> None:
    for (low, high), kernel in kernels:
        if low < band.y1 and high >= band.y0:
            kernel(band)
    _divide(filled.mixed, filled.taken, band.y0, band.y1)
