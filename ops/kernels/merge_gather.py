"""numba kernels of the adjoint of `splat_merged` for CPU float32.

The passes of the forward kernels, backwards: the gradient of the picture goes down to every level (the transpose of
the interpolation) and is summed along x from the right (that of the running sum); every cell gathers its gradient;
every pixel gathers its own on the lowest level and takes its share of those of its cells.
"""

import math
from functools import partial

import numba as nb
import numpy as np
import torch
from torch import Tensor

from torchbokeh.ops.composite import TINY
from torchbokeh.ops.kernels.merge import bank_for, cell_radius, wide_psfs
from torchbokeh.ops.kernels.merge_collect import RECORD, Lanes, Levels, Picture, bands, classify, collect, row_shares
from torchbokeh.ops.kernels.outline import at_rows, clamped, draw_arc, rows_to_draw
from torchbokeh.ops.kernels.radius_bank import RadiusBank, number_of, rounded
from torchbokeh.ops.kernels.rows import gather_points, rows_above, rows_within
from torchbokeh.ops.merge import MARGIN, Merging
from torchbokeh.ops.spans import Profile
from torchbokeh.ops.system.threads import run_all


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _interleave(grad, out, first, lanes, y0, y1):  # type: ignore[no-untyped-def]
    """Gradient of the sums, rows ``y0 .. y1-1``, four channels from ``first`` on: ``lanes (H, W, 4)``.

    Where ``out`` holds anything, its channels but the last are quotients by the last.
    """
    channels, _, width = grad.shape
    divided = out.shape[0] > 0
    for y in range(y0, y1):
        for k in range(4):
            channel = first + k
            if channel >= channels:
                lanes[y, :, k] = 0.0
            elif not divided:
                lanes[y, :, k] = grad[channel, y]
            elif channel < channels - 1:
                for x in range(width):
                    lanes[y, x, k] = grad[channel, y, x] / max(out[-1, y, x], np.float32(TINY))
            else:
                for x in range(width):
                    total = np.float32(0.0)
                    for other in range(channels - 1):
                        total += grad[other, y, x] * out[other, y, x]
                    cover = out[-1, y, x]
                    lanes[y, x, k] = grad[channel, y, x] - (total / cover if cover > TINY else np.float32(0.0))


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _sum_back(lanes, pad, sums, y0, y1):  # type: ignore[no-untyped-def]
    """``sums (H, W + 2 pad, 4)``: what ``lanes (H, W, 4)`` hold from each column on, rows ``y0 .. y1-1``."""
    width = lanes.shape[1]
    for y in range(y0, y1):
        s0 = s1 = s2 = s3 = 0.0
        sums[y, pad + width :] = 0.0
        for x in range(width - 1, -1, -1):
            s0 += lanes[y, x, 0]
            s1 += lanes[y, x, 1]
            s2 += lanes[y, x, 2]
            s3 += lanes[y, x, 3]
            sums[y, pad + x, 0], sums[y, pad + x, 1], sums[y, pad + x, 2], sums[y, pad + x, 3] = s0, s1, s2, s3
        for x in range(pad):
            sums[y, x, 0], sums[y, x, 1], sums[y, x, 2], sums[y, x, 3] = s0, s1, s2, s3


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _across(fine, y, margin, out):  # type: ignore[no-untyped-def]
    """Row ``y`` of ``fine`` (counted within the picture) to cells along x, ``out (w, 4)``; 0 outside."""
    out[:] = 0.0
    width = fine.shape[1]
    if y < -margin or y >= fine.shape[0] - margin:
        return
    row = fine[y + margin]
    cells = out.shape[0]
    for i in range(cells):
        x = 2 * (i - MARGIN) + margin
        for side in range(2):
            if 0 <= x + side < width:
                beside = i + 1 if side else i - 1
                for k in range(4):
                    v = row[x + side, k]
                    out[i, k] += np.float32(0.75) * v
                    if 0 <= beside < cells:
                        out[beside, k] += np.float32(0.25) * v


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _down(fine, margin, coarse, y0, y1):  # type: ignore[no-untyped-def]
    """Rows ``y0 .. y1-1`` of the transpose of ``upsample / 4``: ``fine`` with its margin to ``coarse``."""
    width = coarse.shape[1]
    row = np.empty((width, 4), np.float32)
    for y in range(y0, y1):
        coarse[y] = 0.0
        first = 2 * (y - MARGIN)
        for k, share in ((-1, 0.25), (0, 0.75), (1, 0.75), (2, 0.25)):
            _across(fine, first + k, margin, row)
            coarse[y] += np.float32(0.25 * share) * row


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _gather_wide(sums, pad, x, y, coc, wide, found):  # type: ignore[no-untyped-def]
    """`gather_kept` for a PSF that is not in the bank, centred on the cell ``(x, y)``."""
    (shape, starts, points, room), (height, width), c = wide, sums.shape[:2], clamped(coc)
    first, n = rows_to_draw(c, y, 0, height, shape.ends, shape.level)
    n = max(n, 0)
    found[:] = 0.0
    at_rows(c, (first, n), room)
    for arc in range(2 if shape.even else 0, 4):
        k, m = draw_arc(arc, c, (x, first, n), (0, width - 2 * pad), room, True)
        k += first
        if m > 0:
            i, j = rows_within(y + k, m, 0, height)
            stride, o = 4 * width, 4 * ((y + k) * width + pad)
            gather_points(sums, o, stride, points, (starts[i], starts[j]), shape.even, found)
            if shape.level:
                i, j = rows_above(k, y, m, 0, height)
                o = 4 * ((y - k) * width + pad)
                gather_points(sums, o, -stride, points, (starts[i], starts[j]), shape.even, found)


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _gather_cells(levels, level, sums, bank, grads, y0, y1):  # type: ignore[no-untyped-def]
    """Gradients of the cells of rows ``y0 .. y1-1``: of the lanes, and of each unit of share times radius (px).

    ``sums (H, W + 2 pad, 4)`` is the gradient of the differences of the level.
    """
    shape, mirrored, pad, firsts, ends, starts, points = bank
    even, level_shape = shape.even, shape.level
    cells, across, first_cell = levels.cells, levels.sizes[level, 1], levels.sizes[level, 2]
    in_bank = mirrored if mirrored else len(firsts)
    height, stride = sums.shape[0], 4 * sums.shape[1]
    wide = wide_psfs(shape, height, sums.shape[1] - 2 * pad)
    scale = 1.0 / (1 << level)
    found = np.empty(8, np.float64)
    for j in range(y0, y1):
        y = j + MARGIN
        for i in range(across):
            p = RECORD * (first_cell + j * across + i)
            if cells[p + 4] == 0.0:
                continue
            smaller = cell_radius(cells, p, scale)
            number = number_of(smaller)
            if number < in_bank:
                k = int(number)
                if cells[p + 6] < 0.0:
                    k += mirrored
                first, begin = firsts[k], ends[k]
                n, o = ends[k + 1] - 1 - begin, 4 * (pad + MARGIN + i)
                found[:] = 0.0
                for up in range(2 if level_shape else 1):
                    u, v = rows_above(first, y, n, 0, height) if up else rows_within(y + first, n, 0, height)
                    span, at = (starts[begin + u], starts[begin + v]), y - first if up else y + first
                    gather_points(sums, at * stride + o, -stride if up else stride, points, span, even, found)
            else:
                coc = rounded(math.copysign(smaller, cells[p + 6]))
                _gather_wide(sums, pad, i + MARGIN, y, coc, wide, found)
            slope = 0.0
            for k in range(4):
                grads[p + k] = found[k]
                slope += found[4 + k] * cells[p + k]
            # By the mean radius, which is larger, and by each unit of its sum.
            grads[p + 4] = slope * (scale * (cells[p + 5] / cells[p + 4]) / smaller) * scale / cells[p + 4]


@nb.njit(inline="always")
def _lowest_share(level, share, lit):  # type: ignore[no-untyped-def]
    """What a pixel has on the lowest level and as a highlight, from what `classify` says of it."""
    one = np.float32(1.0)
    if level <= 0:
        return np.float32(1.0 if level == 0 else 0.0)
    return lit + (one - lit) * (one - share) if level == 1 else lit


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _gather_pixels(picture, lanes, levels, sums, bank, grads, y0, y1):  # type: ignore[no-untyped-def]
    """Gradients of rows ``y0 .. y1-1`` of the picture: from its lowest level and from its cells.

    ``sums (H, W + 2 pad, 4)`` is the gradient of the differences of the lowest level, and the cells of ``levels``
    hold their own gradients. Only numbers are handed on within
    the loop: numba counts references to arrays that are, for each pixel.
    """
    values, coc, weight = picture
    grad_values, grad_coc, grad_weight = grads
    channel, constant = lanes.channel, lanes.constant
    thresholds, sizes, cells = levels.thresholds, levels.sizes, levels.cells
    shape, mirrored, pad, firsts, ends, starts, points = bank
    even, level_shape = shape.even, shape.level
    in_bank = mirrored if mirrored else len(firsts)
    height, width = coc.shape
    stride = 4 * sums.shape[1]
    wide = wide_psfs(shape, height, sums.shape[1] - 2 * pad)
    row = row_shares(width)
    numbers, shares, lit = row
    found, grad = np.empty(8, np.float64), np.empty(5, np.float64)
    for y in range(y0, y1):
        classify(picture, thresholds, y, row)
        for x in range(width):
            level, share, merged = int(numbers[x]), shares[x], np.float32(1.0) - lit[x]
            signed = np.float64(coc[y, x])
            whole = weight[y, x] if weight.shape[0] > 0 else np.float32(1.0)
            grad[:] = 0.0
            for here, w in ((level, merged * share), (level - 1, merged * (np.float32(1.0) - share))):
                if here > 0 and w > 0.0:
                    p = RECORD * (sizes[here, 2] + (y >> here) * sizes[here, 1] + (x >> here))
                    for k in range(4):
                        grad[k] += w * cells[p + k]
                    grad[4] += w * whole * cells[p + 4]
            lowest = _lowest_share(level, share, lit[x])
            if lowest > 0.0:
                number = number_of(abs(signed))
                if number < in_bank:
                    k = int(number)
                    if signed < 0.0:
                        k += mirrored
                    first, begin = firsts[k], ends[k]
                    n, o = ends[k + 1] - 1 - begin, 4 * (pad + x)
                    found[:] = 0.0
                    for up in range(2 if level_shape else 1):
                        u, v = rows_above(first, y, n, 0, height) if up else rows_within(y + first, n, 0, height)
                        span, at = (starts[begin + u], starts[begin + v]), y - first if up else y + first
                        gather_points(sums, at * stride + o, -stride if up else stride, points, span, even, found)
                else:
                    _gather_wide(sums, pad, x, y, rounded(signed), wide, found)
                moves = number > 0.0
                for k in range(4):
                    grad[k] += lowest * found[k]
                    if moves:
                        value = values[channel[k], y, x] if channel[k] >= 0 else constant[k]
                        grad[4] += found[4 + k] * lowest * whole * value
            by_weight = 0.0
            for k in range(4):
                if channel[k] >= 0:
                    grad_values[channel[k], y, x] = whole * grad[k]
                    if level != -2:
                        by_weight += values[channel[k], y, x] * grad[k]
                else:
                    by_weight += constant[k] * grad[k]
            if weight.shape[0] > 0:
                grad_weight[y, x] = by_weight if channel[0] == 0 else grad_weight[y, x] + by_weight
            slope = grad[4] if signed > 0.0 else -grad[4]
            grad_coc[y, x] = slope if channel[0] == 0 else grad_coc[y, x] + slope


def gather_merged(
    grad: Tensor,
    out: Tensor | None,
    values: Tensor,
    coc: Tensor,
    weight: Tensor | None,
    profile: Profile,
    merging: Merging,
    highest: int,
) -> tuple[Tensor, Tensor, Tensor]:
    """Gradients of ``values``, ``coc`` and ``weight`` (empty without one).

    ``out`` is what the forward pass gave if it was normalised.
    """
    b, channels, h, w = values.shape
    ones = grad.shape[1] > channels
    bank = bank_for(profile, merging, slopes=True)
    size = (0, 0) if weight is None else (h, w)
    results = [torch.empty(b, *rest, dtype=torch.float32) for rest in ((channels, h, w), (1, h, w), (1, *size))]
    pictures, grads = Picture.each(values, coc, weight), Picture.each(*results)
    arriving = grad.contiguous().numpy()
    divided = np.empty((b, 0, h, w), np.float32) if out is None else out.contiguous().numpy()
    for n, picture in enumerate(pictures):
        for group in range(-(-grad.shape[1] // 4)):
            lanes = Lanes.of(group, channels, ones)
            levels = collect(picture, lanes, merging, highest)
            incoming = np.empty((h, w, 4), np.float32)
            interleave = partial(_interleave, arriving[n], divided[n], lanes.first, incoming)
            run_all(interleave, bands(h), "gradient of the picture")
            cells = _gather_levels(levels, incoming, bank)
            sums = _summed(incoming, bank.reach)
            kernel = partial(_gather_pixels, picture, lanes, levels._replace(cells=cells), sums, bank, grads[n])
            run_all(kernel, bands(h), "gather pixels")
    by_values, by_coc, by_weight = results
    return by_values, by_coc, by_weight


def _summed(lanes: np.ndarray, pad: int) -> np.ndarray:
    h, w, _ = lanes.shape
    sums = np.empty((h, w + 2 * pad, 4), np.float64)
    run_all(partial(_sum_back, lanes, pad, sums), bands(h), "sums")
    return sums


def _gather_levels(levels: Levels, fine: np.ndarray, bank: RadiusBank) -> np.ndarray:
    """Gradients of all cells, in records like theirs, from the gradient ``fine (H, W, 4)`` of the picture."""
    grads = np.empty_like(levels.cells)
    margin = 0
    for level in range(1, levels.thresholds.highest + 1):
        rows, across, _ = levels.sizes[level]
        coarse = np.empty((rows + 2 * MARGIN, across + 2 * MARGIN, 4), np.float32)
        run_all(partial(_down, fine, margin, coarse), bands(len(coarse)), "levels")
        sums = _summed(coarse, bank.reach)
        run_all(partial(_gather_cells, levels, level, sums, bank, grads), bands(rows), "gather cells")
        fine, margin = coarse, MARGIN
    return grads
