"""numba kernels of `splat_merged` for CPU float32: the same numbers as the torch definition in a few fused passes.

First one pass over the picture sums the pixels of every level above the lowest into the cells of that level, and notes
the highlights. Then, from the coarsest level to the finest, bands of rows are splatted, summed along x, and what the
coarser level holds is interpolated and added. The lowest level reads the picture itself, and writes the result: nothing
is copied. PSFs come from a `Bank`; only the few that are wider than it are drawn one by one.

Work is cut into pieces that do not depend on the number of threads, and sums run in a fixed order: the result has the
same bits for every thread count.
"""

import math
from collections.abc import Callable
from functools import partial

import numba as nb
import numpy as np
import torch
from torch import Tensor

from torchbokeh.ops.composite import TINY
from torchbokeh.ops.kernels.merge_collect import BAND, RECORD, Lanes, Levels, bands, classify, collect
from torchbokeh.ops.kernels.psf_bank import Bank, draw_psf, psf_bank
from torchbokeh.ops.kernels.rows import draw_rows, running_sum
from torchbokeh.ops.kernels.splat import shape_tables
from torchbokeh.ops.merge import FADE, MARGIN, SPREAD, STEPS, Merging
from torchbokeh.ops.spans import MIN_RADIUS, Profile
from torchbokeh.ops.system.threads import run_all, stage

WIDEST = 32.0
"""Radius in cells up to which PSFs are kept: their number of points grows with its square."""


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _draw_wide(band, stride, pad, width, src, p, x, y, coc, shapes, bulge, inv_area, y0, y1, rows, columns, weights):  # type: ignore[no-untyped-def]
    """Add one PSF that is not in the bank, centred on the cell ``(x, y)``, to the rows ``y0 .. y1-1``."""
    s = 1 if coc < 0.0 else 0
    r = max(abs(coc), MIN_RADIUS)
    first = max(y0 - y, math.ceil(max(r * shapes[s, 0, 0] - 0.5, -1e9)))
    n = min(y1 - 1 - y, math.floor(min(r * shapes[s, -1, 0] + 0.5, 1e9))) - first + 1
    if n > 0:
        border = np.float64(width)
        draw_psf(r, x + 0.5, first, n, 0.0, border, shapes, s, bulge, inv_area, rows, columns, weights)
        draw_rows(band, (y + first - y0) * stride + 4 * pad, stride, src, p, columns, weights, 0, n)


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
def _cell_band(cells, reach, rows, level, bank, shape, coarse, out, band, y0, y1):  # type: ignore[no-untyped-def]
    """Rows ``y0 .. y1-1`` of a level above the lowest: ``out (rows + 2*MARGIN, columns + 2*MARGIN, 4)``."""
    bank_steps, mirrored, pad, firsts, ends, columns, weights, _ = bank
    shapes, bulge, inv_area = shape
    width = out.shape[1]
    across = width - 2 * MARGIN
    stride = 4 * (width + 2 * pad)
    band[: (y1 - y0) * stride] = 0.0
    drawn, near, shares = np.empty((4, BAND + 1)), np.empty((BAND, 2), np.int64), np.empty((BAND, 4))
    scale = 1.0 / (1 << level)
    in_bank = mirrored if mirrored else len(firsts)
    for j in range(rows):
        y = j + MARGIN
        r = reach[j] * scale
        if r == 0.0 or y + r + 1.0 < y0 or y - r > y1:
            continue
        p = RECORD * j * across
        for i in range(across):
            if cells[p] != 0.0 or cells[p + 1] != 0.0 or cells[p + 2] != 0.0 or cells[p + 3] != 0.0:
                radius = np.rint(bank_steps * cell_radius(cells, p, scale))
                if radius < in_bank:
                    k = int(radius)
                    if cells[p + 6] < 0.0:
                        k += mirrored
                    first = y + firsts[k]
                    begin = max(y0 - first, 0)
                    stop = min(y1 - first, ends[k + 1] - ends[k])
                    o = (first + begin - y0) * stride + 4 * (pad + MARGIN + i)
                    draw_rows(band, o, stride, cells, p, columns, weights, ends[k] + begin, ends[k] + stop)
                else:
                    coc = math.copysign(radius / bank_steps, cells[p + 6])
                    _draw_wide(
                        *(band, stride, pad, width, cells, p, i + MARGIN, y, coc, shapes, bulge, inv_area, y0, y1),
                        *(drawn, near, shares),
                    )
            p += RECORD
    line = np.empty(4 * coarse.shape[1], np.float32)
    fine = np.zeros(8 * ((width + 1) >> 1), np.float32)
    for y in range(y0, y1):
        if coarse.shape[0] > 0:
            coarser(coarse, y - MARGIN, MARGIN, line, fine)
        running_sum(band, (y - y0) * stride, pad, fine, out[y].reshape(-1), width)


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _lowest(values, coc, weight, y, channel, constant, levels, shares, bank_steps, in_bank, pixels, energy, radii):  # type: ignore[no-untyped-def]
    """What row ``y`` has on the lowest level: interleaved ``pixels``, and ``radii`` in steps of the bank.

    -1 stands for a pixel that has nothing there. ``shares`` and ``energy`` are used up.
    """
    zero, one = np.float32(0.0), np.float32(1.0)
    for x in range(len(levels)):
        level = levels[x]
        shares[x] = one if level == zero else (one - shares[x] if level == one else zero)
        energy[x] = zero
    if weight.shape[0] > 0:
        weights = weight[y]
        for x in range(len(weights)):
            shares[x] *= weights[x]
    for k in range(4):
        lane = pixels[k:]
        if channel[k] >= 0:
            plane = values[channel[k], y]
            for x in range(len(plane)):
                # What has no share may be anything, NaN as well.
                value = shares[x] * plane[x] if shares[x] != zero else zero
                lane[4 * x] = value
                energy[x] += abs(value)
        else:
            value = constant[k]
            for x in range(len(shares)):
                lane[4 * x] = shares[x] * value
                energy[x] += shares[x] * value
    steps, most = np.float32(bank_steps), np.float32(in_bank)
    row = coc[y]
    for x in range(len(row)):
        radius = min(np.rint(steps * abs(row[x])), most)
        radii[x] = np.int32(-one if energy[x] == zero else radius)


@nb.njit(cache=True, nogil=True, error_model="numpy")
def draw_pixels(  # type: ignore[no-untyped-def]
    values, coc, weight, channel, constant, merging, highest, bounds, reach, marks, bank, shape, band, y0, y1
):
    """Draw the lowest level and the highlights into the rows ``y0 .. y1-1`` of ``band``."""
    bank_steps, mirrored, pad, firsts, ends, columns, weights, _ = bank
    shapes, bulge, inv_area = shape
    height, width = coc.shape
    stride = 4 * (width + 2 * pad)
    band[: (y1 - y0) * stride] = 0.0
    drawn, near, shares = np.empty((4, BAND + 1)), np.empty((BAND, 2), np.int64), np.empty((BAND, 4))
    in_bank = mirrored if mirrored else len(firsts)
    levels, rest, radii = np.empty(width, np.float32), np.empty(width, np.float32), np.empty(width, np.int32)
    pixels, energy = np.empty(4 * width, np.float32), np.empty(width, np.float32)
    for y in range(height):
        r = reach[y]
        if r < 0.0 or y + r + 1.0 < y0 or y - r > y1:
            continue
        begin, end = classify(values, coc, weight, y, merging, bounds, highest, levels, rest)
        _lowest(values, coc, weight, y, channel, constant, levels, rest, bank_steps, in_bank, pixels, energy, radii)
        for x in range(begin, end):
            p = 4 * x
            k = int(radii[x])
            if k < 0:
                continue
            if k < in_bank:
                if coc[y, x] < 0.0:
                    k += mirrored
                first = y + firsts[k]
                start = max(y0 - first, 0)
                stop = min(y1 - first, ends[k + 1] - ends[k])
                o = (first + start - y0) * stride + 4 * (pad + x)
                draw_rows(band, o, stride, pixels, p, columns, weights, ends[k] + start, ends[k] + stop)
            else:
                here = np.float64(coc[y, x])
                signed = math.copysign(np.rint(bank_steps * abs(here)) / bank_steps, here)
                _draw_wide(
                    *(band, stride, pad, width, pixels, p, x, y, signed, shapes, bulge, inv_area, y0, y1),
                    *(drawn, near, shares),
                )
    for mark in marks:
        y, x = mark // width, mark % width
        here = np.float64(coc[y, x])
        pixels[:4] = constant
        for lane in range(4):
            if channel[lane] >= 0:
                pixels[lane] = values[channel[lane], y, x]
            if weight.shape[0] > 0:
                pixels[lane] *= weight[y, x]
        signed = math.copysign(np.rint(bank_steps * abs(here)) / bank_steps, here)
        _draw_wide(
            *(band, stride, pad, width, pixels, 0, x, y, signed, shapes, bulge, inv_area, y0, y1),
            *(drawn, near, shares),
        )


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _pixel_band(  # type: ignore[no-untyped-def]
    values, coc, weight, channel, constant, merging, highest, bounds, reach, marks,
    bank, shape, coarse, first_out, last, out, band, y0, y1
):  # fmt: skip
    """Rows ``y0 .. y1-1`` of the picture ``out``: the lowest level, the highlights, and all that is coarser.

    The lanes go to the channels from ``first_out`` on. Where ``last >= 0``, they are divided by lane ``last``.
    """
    draw_pixels(
        *(values, coc, weight, channel, constant, merging, highest, bounds, reach, marks, bank, shape, band, y0, y1)
    )
    pad, width = bank[2], coc.shape[1]
    pixels, rest = np.empty(4 * width, np.float32), np.empty(width, np.float32)
    line = np.empty(4 * coarse.shape[1], np.float32)
    fine = np.zeros(8 * ((width + 1) >> 1), np.float32)
    for y in range(y0, y1):
        if coarse.shape[0] > 0:
            coarser(coarse, y, 0, line, fine)
        running_sum(band, 4 * (y - y0) * (width + 2 * pad), pad, fine, pixels, width)
        rest[:] = np.float32(1.0)
        if last >= 0:
            lanes = pixels[last:]
            for x in range(width):
                rest[x] = np.float32(1.0) / max(lanes[4 * x], np.float32(TINY))
        for number in range(min(4, out.shape[0] - first_out)):
            plane, lanes = out[first_out + number, y], pixels[number:]
            if number == last:
                rest[:] = np.float32(1.0)
            for x in range(width):
                plane[x] = lanes[4 * x] * rest[x]


def bank_of(merging: Merging, shape: tuple[np.ndarray, float, float], *, slopes: bool = False) -> Bank:
    """The PSFs of every cell but those that are wider than the levels would have them, or than `WIDEST`."""
    return psf_bank(min(2.0 * merging.cells * (1 + FADE), WIDEST), STEPS, *shape, slopes=slopes)


def planes_of(weight: Tensor | None, batch: int) -> list[np.ndarray]:
    """The weight ``(H, W)`` of every picture; of no rows where there is none."""
    if weight is None:
        return [np.empty((0, 0), np.float32)] * batch
    return list(weight.detach().contiguous()[:, 0].numpy())


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
        shape = shape_tables(profile)
        bank = bank_of(merging, shape)
    source, radii = values.detach().contiguous(), coc.detach().contiguous().numpy()
    weights = planes_of(weight, b)
    out = torch.empty(b, channels + ones, h, w, dtype=torch.float32)
    groups = -(-(channels + ones) // 4)
    last = channels + ones - 1 if normalise and groups == 1 else -1
    buffers: list[np.ndarray] = []
    for n in range(b):
        for group in range(groups):
            scene = source[n].numpy(), radii[n, 0], weights[n]
            lanes = Lanes.of(group, channels, ones)
            levels = collect(*scene, lanes, merging, highest)
            coarse = coarse_picture(levels, bank, shape, buffers)
            kernel = partial(
                _pixel_band,
                *(*scene, *lanes, merging, highest, levels.bounds, levels.reach[0]),
                *(levels.marks, bank, shape, coarse, 4 * group, last, out[n].numpy()),
            )
            run_all(buffered(kernel, w + 2 * bank.reach, buffers), bands(h), "picture")
    if normalise and groups > 1:
        out[:, :-1] /= out[:, -1:].clamp_min(TINY)
    return out


def coarse_picture(
    levels: Levels, bank: Bank, shape: tuple[np.ndarray, float, float], buffers: list[np.ndarray]
) -> np.ndarray:
    """The picture ``(h + 2 MARGIN, w + 2 MARGIN, 4)`` of level 1 and all above it; of no rows if there are none."""
    coarse = np.empty((0, 0, 4), np.float32)
    for level in range(len(levels.sizes) - 1, 0, -1):
        rows, across, first = levels.sizes[level]
        fine = np.empty((rows + 2 * MARGIN, across + 2 * MARGIN, 4), np.float32)
        cells, reach = levels.cells[RECORD * first :], levels.reach[level]
        kernel = partial(_cell_band, cells, reach, rows, level, bank, shape, coarse, fine)
        run_all(buffered(kernel, fine.shape[1] + 2 * bank.reach, buffers), bands(len(fine)), "levels")
        coarse = fine
    return coarse


def buffered(kernel: Callable[..., None], columns: int, free: list[np.ndarray]) -> Callable[[int, int], None]:
    """Call ``kernel(buffer, y0, y1)`` with a buffer for a band that no other thread has.

    The buffers are used again: a fresh one for every band would cost more than what is drawn into it.
    """
    size = 4 * BAND * columns

    def work(y0: int, y1: int) -> None:
        buffer = free.pop() if free else np.empty(0, np.float64)
        if len(buffer) < size:
            buffer = np.empty(size, np.float64)
        kernel(buffer, y0, y1)
        free.append(buffer)

    return work
