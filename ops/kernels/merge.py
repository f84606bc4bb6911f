"""numba kernels of `splat_merged` for CPU float32: the same numbers as the torch definition in a few fused passes.

First one pass over the picture sums the pixels of every level above the lowest into the cells of that level, and notes
the highlights. Then, from the coarsest level to the finest, bands of rows are splatted, summed along x, and what the
coarser level holds is interpolated and added. The lowest level reads the picture itself, and writes the result: nothing
is copied. PSFs come from a `RadiusBank`; only the few that are wider than it are drawn one by one.

Work is cut into pieces that do not depend on the number of threads, and sums run in a fixed order: the result has the
same bits for every thread count.
"""

import math
from collections.abc import Callable
from functools import lru_cache, partial
from typing import NamedTuple

import numba as nb
import numpy as np
import torch
from torch import Tensor

from torchbokeh.ops.composite import TINY
from torchbokeh.ops.kernels.merge_collect import (
    BAND,
    RECORD,
    Lanes,
    Levels,
    Picture,
    Shares,
    bands,
    classify,
    collect,
    row_shares,
)
from torchbokeh.ops.kernels.outline import at_rows, clamped, draw_arc, psf_buffer, psf_room, rows_to_draw, shape_of
from torchbokeh.ops.kernels.radius_bank import RadiusBank, number_of, radius_bank, rounded
from torchbokeh.ops.kernels.rows import draw_points, rows_above, rows_within, running_sum
from torchbokeh.ops.merge import FADE, MARGIN, SPREAD, Merging
from torchbokeh.ops.spans import MIN_RADIUS, Profile
from torchbokeh.ops.system.threads import run_all, stage

WIDEST = 32.0
"""Radius in cells up to which PSFs are kept: their number of points grows with its square."""


class Band(NamedTuple):
    """Rows ``y0 .. y1-1`` that are being drawn: ``sums`` of differences along x, flat, ``stride`` numbers to a row."""

    sums: np.ndarray
    stride: int
    y0: int
    y1: int


class Row(NamedTuple):
    """What a row of ``W`` pixels holds on the lowest level.

    Beside the ``shares`` of `classify`, and ``energy (W,)`` as scratch: the interleaved ``pixels (4 W,)``, and
    ``numbers (W,)`` of PSFs in the bank, -1 for a pixel that has nothing there.
    """

    shares: Shares
    energy: np.ndarray
    pixels: np.ndarray
    numbers: np.ndarray


@nb.njit(inline="always")
def wide_psfs(shape, n, columns):  # type: ignore[no-untyped-def]
    """A shape, and room for PSFs of it that are not in the bank: ``starts``, ``points``, and all as `psf_room`."""
    buffer = psf_buffer(n, columns)
    return shape, buffer.starts, buffer.points, psf_room(shape, buffer)


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _draw_wide(band, pad, src, p, x, y, coc, wide):  # type: ignore[no-untyped-def]
    """Add one PSF that is not in the bank, centred on the cell ``(x, y)``; ``wide`` is from `wide_psfs`."""
    (sums, stride, y0, y1), (shape, starts, points, room) = band, wide
    c = clamped(coc)
    first, n = rows_to_draw(c, y, y0, y1, shape.ends, shape.level)
    if n > 0:
        at_rows(c, (first, n), room)
        for arc in range(2 if shape.even else 0, 4):
            k, m = draw_arc(arc, c, (x, first, n), (0, (stride >> 2) - 2 * pad), room, False)
            k += first
            if m > 0:
                i, j = rows_within(y + k, m, y0, y1)
                o = (y + k - y0) * stride + 4 * pad
                draw_points(sums, (o, -1), stride, (src, p), points, (starts[i], starts[j]), shape.even)
                if shape.level:
                    i, j = rows_above(k, y, m, y0, y1)
                    o = (y - k - y0) * stride + 4 * pad
                    draw_points(sums, (o, -1), -stride, (src, p), points, (starts[i], starts[j]), shape.even)


@nb.njit(cache=True, nogil=True, error_model="numpy")
def coarser(coarse, y, margin, line, fine):  # type: ignore[no-untyped-def]
    """Row ``y`` of the finer level, interpolated as in `merge.upsample` from ``coarse (H, W, 4)`` and its margin.

    ``fine`` starts ``margin`` columns left of the picture.
    """
    row = (y >> 1) + MARGIN
    here, beside = coarse[row].reshape(-1), coarse[row + 1 if y & 1 else row - 1].reshape(-1)
    more, less = np.float32(0.75 * 0.25), np.float32(0.25 * 0.25)  # a pixel is a quarter of a cell
    for i in range(len(line)):
        line[i] = more * here[i] + less * beside[i]
    first = 4 * (MARGIN - (margin >> 1))
    before, middle, after = line[first - 4 :], line[first:], line[first + 4 :]
    more, less = np.float32(0.75), np.float32(0.25)
    for column in range(len(fine) >> 3):
        for k in range(4):
            i = 4 * column + k
            fine[2 * i - k] = more * middle[i] + less * before[i]
            fine[2 * i - k + 4] = more * middle[i] + less * after[i]


@nb.njit(cache=True, nogil=True, error_model="numpy")
def cell_radius(cells, p, scale):  # type: ignore[no-untyped-def]
    """Mean radius of a cell in cells of its level, less what interpolation will add."""
    mean = scale * (cells[p + 5] / cells[p + 4])
    return math.sqrt(max(mean * mean - SPREAD, MIN_RADIUS * MIN_RADIUS))


@nb.njit(cache=True, nogil=True, error_model="numpy")
def interpolation_rows(coarse, width):  # type: ignore[no-untyped-def]
    """Scratch of `finish_row`: a row of the coarser level, and a row of ``width`` pixels, in which it adds nothing."""
    return np.empty(4 * coarse.shape[1], np.float32), np.zeros(8 * ((width + 1) >> 1), np.float32)


@nb.njit(cache=True, nogil=True, error_model="numpy")
def finish_row(band, pad, coarse, y, margin, scratch, row):  # type: ignore[no-untyped-def]
    """Row ``y`` of a level with ``margin`` rows around: its differences, summed, and what the coarser level adds."""
    line, fine = scratch
    if coarse.shape[0] > 0:
        coarser(coarse, y - margin, margin, line, fine)
    running_sum(band.sums, (y - band.y0) * band.stride, pad, fine, row, (band.stride >> 2) - 2 * pad)


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _cell_band(levels, level, bank, coarse, out, band):  # type: ignore[no-untyped-def]
    """A band of a level above the lowest: ``out (rows + 2*MARGIN, columns + 2*MARGIN, 4)``."""
    shape, mirrored, pad, firsts, ends, starts, points = bank
    even, level_shape = shape.even, shape.level
    sums, stride, y0, y1 = band
    cells, reach = levels.cells, levels.reach[level]
    rows, across, first_cell = levels.sizes[level, 0], levels.sizes[level, 1], levels.sizes[level, 2]
    sums[: (y1 - y0) * stride] = 0.0
    wide = wide_psfs(shape, BAND, (stride >> 2) - 2 * pad)
    scale = 1.0 / (1 << level)
    in_bank = mirrored if mirrored else len(firsts)
    for j in range(rows):
        y = j + MARGIN
        r = reach[j] * scale
        if r == 0.0 or y + r + 1.0 < y0 or y - r > y1:
            continue
        p = RECORD * (first_cell + j * across)
        for i in range(across):
            if cells[p] != 0.0 or cells[p + 1] != 0.0 or cells[p + 2] != 0.0 or cells[p + 3] != 0.0:
                radius = cell_radius(cells, p, scale)
                number = number_of(radius)
                if number < in_bank:
                    k = int(number)
                    if cells[p + 6] < 0.0:
                        k += mirrored
                    first, begin = firsts[k], ends[k]
                    n, o = ends[k + 1] - 1 - begin, (y - y0) * stride + 4 * (pad + MARGIN + i)
                    if level_shape and y - n >= y0 and y + n <= y1:
                        span = starts[begin], starts[begin + 1]
                        draw_points(sums, (o, -1), stride, (cells, p), points, span, even)
                        span = starts[begin + 1], starts[begin + n]
                        draw_points(sums, (o, o), stride, (cells, p), points, span, even)
                    else:
                        u, v = rows_within(y + first, n, y0, y1)
                        span = starts[begin + u], starts[begin + v]
                        draw_points(sums, (o + first * stride, -1), stride, (cells, p), points, span, even)
                        if level_shape:
                            u, v = rows_above(first, y, n, y0, y1)
                            span = starts[begin + u], starts[begin + v]
                            draw_points(sums, (o - first * stride, -1), -stride, (cells, p), points, span, even)
                else:
                    coc = rounded(math.copysign(radius, cells[p + 6]))
                    _draw_wide(band, pad, cells, p, i + MARGIN, y, coc, wide)
            p += RECORD
    scratch = interpolation_rows(coarse, out.shape[1])
    for y in range(y0, y1):
        finish_row(band, pad, coarse, y, MARGIN, scratch, out[y].reshape(-1))


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _lowest(picture, lanes, y, in_bank, row):  # type: ignore[no-untyped-def]
    """Fill ``row`` from row ``y`` of the picture, once `classify` has filled its levels and shares."""
    values, coc, weight = picture
    (levels, shares, lit), energy, pixels, numbers = row
    zero, one = np.float32(0.0), np.float32(1.0)
    for x in range(len(levels)):
        level = levels[x]
        shares[x] = one if level == zero else ((one - shares[x]) * (one - lit[x]) if level == one else zero)
        energy[x] = zero
    if weight.shape[0] > 0:
        weights = weight[y]
        for x in range(len(weights)):
            shares[x] *= weights[x]
    for k in range(4):
        lane, channel = pixels[k:], lanes.channel[k]
        if channel >= 0:
            plane = values[channel, y]
            for x in range(len(plane)):
                # What has no share may be anything, NaN as well.
                value = shares[x] * plane[x] if shares[x] != zero else zero
                lane[4 * x] = value
                energy[x] += abs(value)
        else:
            value = lanes.constant[k]
            for x in range(len(shares)):
                lane[4 * x] = shares[x] * value
                energy[x] += shares[x] * value
    signed = coc[y]
    for x in range(len(signed)):
        number = min(number_of(abs(signed[x])), in_bank)
        numbers[x] = np.int32(-1 if energy[x] == zero else number)


@nb.njit(cache=True, nogil=True, error_model="numpy")
def draw_pixels(picture, lanes, levels, bank, band):  # type: ignore[no-untyped-def]
    """Draw the lowest level and the highlights into a band."""
    values, coc, weight = picture
    shape, mirrored, pad, firsts, ends, starts, points = bank
    even, level_shape = shape.even, shape.level
    sums, stride, y0, y1 = band
    height, width = coc.shape
    sums[: (y1 - y0) * stride] = 0.0
    wide = wide_psfs(shape, BAND, (stride >> 2) - 2 * pad)
    in_bank = mirrored if mirrored else len(firsts)
    pixels, numbers = np.empty(4 * width, np.float32), np.empty(width, np.int32)
    row = Row(row_shares(width), np.empty(width, np.float32), pixels, numbers)
    reach = levels.reach[0]
    for y in range(height):
        r = reach[y]
        if r < 0.0 or y + r + 1.0 < y0 or y - r > y1:
            continue
        begin, end = classify(picture, levels.thresholds, y, row.shares)
        _lowest(picture, lanes, y, in_bank, row)
        for x in range(begin, end):
            p = 4 * x
            k = int(numbers[x])
            if k < 0:
                continue
            if k < in_bank:
                if coc[y, x] < 0.0:
                    k += mirrored
                first, start = firsts[k], ends[k]
                n, o = ends[k + 1] - 1 - start, (y - y0) * stride + 4 * (pad + x)
                if level_shape and y - n >= y0 and y + n <= y1:
                    span = starts[start], starts[start + 1]
                    draw_points(sums, (o, -1), stride, (pixels, p), points, span, even)
                    span = starts[start + 1], starts[start + n]
                    draw_points(sums, (o, o), stride, (pixels, p), points, span, even)
                    continue
                u, v = rows_within(y + first, n, y0, y1)
                span = starts[start + u], starts[start + v]
                draw_points(sums, (o + first * stride, -1), stride, (pixels, p), points, span, even)
                if level_shape:
                    u, v = rows_above(first, y, n, y0, y1)
                    span = starts[start + u], starts[start + v]
                    draw_points(sums, (o - first * stride, -1), -stride, (pixels, p), points, span, even)
            else:
                _draw_wide(band, pad, pixels, p, x, y, rounded(np.float64(coc[y, x])), wide)
    for mark, lit in zip(levels.marks, levels.lit):  # noqa: B905 (numba knows no `strict`)
        y, x = mark // width, mark % width
        for k in range(4):
            pixels[k] = lit * (values[lanes.channel[k], y, x] if lanes.channel[k] >= 0 else lanes.constant[k])
            if weight.shape[0] > 0:
                pixels[k] *= weight[y, x]
        _draw_wide(band, pad, pixels, 0, x, y, rounded(np.float64(coc[y, x])), wide)


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _pixel_band(picture, lanes, levels, bank, coarse, last, out, band):  # type: ignore[no-untyped-def]
    """A band of the picture ``out``: the lowest level, the highlights, and all that is coarser.

    Where ``last >= 0``, the lanes are divided by lane ``last``.
    """
    draw_pixels(picture, lanes, levels, bank, band)
    width, first = out.shape[2], lanes.first
    pixels, rest = np.empty(4 * width, np.float32), np.empty(width, np.float32)
    scratch = interpolation_rows(coarse, width)
    for y in range(band.y0, band.y1):
        finish_row(band, bank.reach, coarse, y, 0, scratch, pixels)
        rest[:] = np.float32(1.0)
        if last >= 0:
            lane = pixels[last:]
            for x in range(width):
                rest[x] = np.float32(1.0) / max(lane[4 * x], np.float32(TINY))
        for number in range(min(4, out.shape[0] - first)):
            plane, lane = out[first + number, y], pixels[number:]
            if number == last:
                rest[:] = np.float32(1.0)
            for x in range(width):
                plane[x] = lane[4 * x] * rest[x]


def bank_for(profile: Profile, merging: Merging, *, slopes: bool = False) -> RadiusBank:
    """The PSFs of every cell but those that are wider than the levels would have them, or than `WIDEST`."""
    largest = min(2.0 * merging.cells * (1 + FADE), WIDEST)
    knots = profile.knots.detach().double()
    return _kept_bank(tuple(knots.flatten().tolist()), float(profile.bulge), largest, slopes)


@lru_cache(maxsize=4)
def _kept_bank(knots: tuple[float, ...], bulge: float, largest: float, slopes: bool) -> RadiusBank:
    """Drawn once for the pictures of a sequence; a few megabytes."""
    sizes = torch.tensor(knots, dtype=torch.float64).reshape(-1, 3), torch.tensor(bulge, dtype=torch.float64)
    return radius_bank(largest, shape_of(Profile(*sizes)), slopes=slopes)


def splat_merged(
    values: Tensor,
    coc: Tensor,
    weight: Tensor | None,
    profile: Profile,
    merging: Merging,
    highest: int,
    ones: bool,
    normalise: bool,
) -> Tensor:
    """`torchbokeh.ops.merge.splat_merged` for CPU float32."""
    b, channels, h, w = values.shape
    with stage("bank"):
        bank = bank_for(profile, merging)
    out = torch.empty(b, channels + ones, h, w, dtype=torch.float32)
    groups = -(-(channels + ones) // 4)
    last = channels + ones - 1 if normalise and groups == 1 else -1
    buffers: list[np.ndarray] = []
    for picture, target in zip(Picture.each(values, coc, weight), out.numpy(), strict=True):
        for group in range(groups):
            lanes = Lanes.of(group, channels, ones)
            levels = collect(picture, lanes, merging, highest)
            coarse = coarse_picture(levels, bank, buffers)
            kernel = partial(_pixel_band, picture, lanes, levels, bank, coarse, last, target)
            run_all(buffered(kernel, w + 2 * bank.reach, buffers), bands(h), "picture")
    if normalise and groups > 1:
        out[:, :-1] /= out[:, -1:].clamp_min(TINY)
    return out


def coarse_picture(levels: Levels, bank: RadiusBank, buffers: list[np.ndarray]) -> np.ndarray:
    """The picture ``(h + 2 MARGIN, w + 2 MARGIN, 4)`` of level 1 and all above it; of no rows if there are none."""
    coarse = np.empty((0, 0, 4), np.float32)
    for level in range(levels.thresholds.highest, 0, -1):
        rows, across, _ = levels.sizes[level]
        fine = np.empty((rows + 2 * MARGIN, across + 2 * MARGIN, 4), np.float32)
        kernel = partial(_cell_band, levels, level, bank, coarse, fine)
        run_all(buffered(kernel, fine.shape[1] + 2 * bank.reach, buffers), bands(len(fine)), "levels")
        coarse = fine
    return coarse


def buffered(kernel: Callable[[Band], None], columns: int, free: list[np.ndarray]) -> Callable[[int, int], None]:
    """Call ``kernel(band)`` for the rows ``y0 .. y1-1`` with a buffer that no other thread has.

    The buffers are used again: a fresh one for every band would cost more than what is drawn into it.
    """
    size = 4 * BAND * columns

    def work(y0: int, y1: int) -> None:
        buffer = free.pop() if free else np.empty(0, np.float64)
        if len(buffer) < size:
            buffer = np.empty(size, np.float64)
        kernel(Band(buffer, 4 * columns, y0, y1))
        free.append(buffer)

    return work
