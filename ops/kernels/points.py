"""numba kernels of `splat_points` for CPU float32: the same numbers as the torch definition, faster.

There are two pairs: one for any target, and one, four times as fast, for whole targets that cannot miss the buffer.
Source rows are cut into bands whose number depends on the height of the image only. Each band adds to a double
buffer of its own, and the buffers are added in order: the result has the same bits for every thread count.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numba as nb
import numpy as np
import torch
from torch import Tensor

from torchbokeh.ops.kernels.interleave import add_one, add_pair, interleave, separate
from torchbokeh.ops.points import Placement
from torchbokeh.ops.system.threads import row_bands, run_all

BANDS = 16
MIN_ROWS = 8
"""Bands of an image and the least number of rows in one: each band's buffer is higher than it by the PSFs' reach."""


class Placed(NamedTuple):
    """The PSFs of one picture: ``psfs (H, W)``, which one each pixel takes; ``counts (K+1,)`` as in a `PointTable`;
    ``points (P, 3)``, that is dx, dy and weight; and the `Placement`, whose maps ``(2, 2, H, W)`` and ``(2, H, W)`` are
    empty if not given.
    """

    psfs: np.ndarray
    counts: np.ndarray
    points: np.ndarray
    rotation: np.ndarray
    position: np.ndarray
    pad: int


class PlacedWhole(NamedTuple):
    """`Placed` where all targets are pixels: each point lies ``steps (P,)`` numbers further on in the buffer."""

    psfs: np.ndarray
    counts: np.ndarray
    steps: np.ndarray
    weights: np.ndarray
    pad: int


@nb.njit(inline="always")
def _frame(rotation, position, y, x):  # type: ignore[no-untyped-def]
    """Centre and matrix of the PSF of pixel (y, x). Arrays that were not given are empty."""
    u, v = np.float64(x), np.float64(y)
    if position.size > 0:
        u, v = position[0, y, x], position[1, y, x]
    if rotation.size > 0:
        return u, v, rotation[0, 0, y, x], rotation[0, 1, y, x], rotation[1, 0, y, x], rotation[1, 1, y, x]
    return u, v, 1.0, 0.0, 0.0, 1.0


@nb.njit(inline="always")
def _corners(frame, dx, dy, weight, rows, stride):  # type: ignore[no-untyped-def]
    """Where in a buffer the first of four corners of a point lies, -1 for outside, and what each of them gets."""
    u0, v0, xx, xy, yx, yy = frame
    u = u0 + xx * dx + xy * dy
    v = v0 + yx * dx + yy * dy
    if not (0.0 <= u < stride - 1 and 0.0 <= v < rows - 1):
        return -1, 0.0, 0.0, 0.0, 0.0
    i, j = int(u), int(v)
    f, g = u - i, v - j
    upper, lower = weight * (1.0 - g), weight * g
    return 4 * (j * stride + i), upper * (1.0 - f), upper * f, lower * (1.0 - f), lower * f


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _splat_between(src, placed, y0, y1, first, out):  # type: ignore[no-untyped-def]
    """Splat source rows ``y0 .. y1-1`` into ``out (N+2, Wp+2, 4)``.

    Its inner rows are the rows ``first .. first+N-1`` of the padded buffer. The border of one catches the corners
    that stick out.
    """
    psfs, counts, points, rotation, position, pad = placed
    width = psfs.shape[1]
    rows, stride = out.shape[0], out.shape[1]
    flat = out.reshape(-1)
    for y in range(y0, y1):
        for x in range(width):
            p = 4 * (y * width + x)
            if src[p] == 0.0 and src[p + 1] == 0.0 and src[p + 2] == 0.0 and src[p + 3] == 0.0:
                continue
            u0, v0, xx, xy, yx, yy = _frame(rotation, position, y, x)
            frame = u0 + (pad + 1), v0 + (pad + 1 - first), xx, xy, yx, yy
            psf = psfs[y, x]
            for k in range(counts[psf], counts[psf + 1]):
                o, a, b, c, d = _corners(frame, points[k, 0], points[k, 1], points[k, 2], rows, stride)
                if o >= 0:
                    add_pair(flat, o, src, p, a, b)
                    add_pair(flat, o + 4 * stride, src, p, c, d)


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _splat_whole(src, placed, y0, y1, first, out):  # type: ignore[no-untyped-def]
    """`_splat_between` for `PlacedWhole`."""
    psfs, counts, steps, weights, pad = placed
    width = psfs.shape[1]
    stride = out.shape[1]
    flat = out.reshape(-1)
    for y in range(y0, y1):
        for x in range(width):
            p = 4 * (y * width + x)
            if src[p] == 0.0 and src[p + 1] == 0.0 and src[p + 2] == 0.0 and src[p + 3] == 0.0:
                continue
            o = 4 * ((y + pad + 1 - first) * stride + x + pad + 1)
            psf = psfs[y, x]
            for k in range(counts[psf], counts[psf + 1]):
                add_one(flat, o + steps[k], src, p, weights[k])


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _gather_between(grad, placed, y0, y1, out):  # type: ignore[no-untyped-def]
    """Adjoint for the source rows ``y0 .. y1-1`` of ``out (H, W, 4)``; ``grad (Hp+2, Wp+2, 4)`` has a border of 0."""
    psfs, counts, points, rotation, position, pad = placed
    width = psfs.shape[1]
    rows, stride = grad.shape[0], grad.shape[1]
    flat = grad.reshape(-1)
    for y in range(y0, y1):
        for x in range(width):
            u0, v0, xx, xy, yx, yy = _frame(rotation, position, y, x)
            frame = u0 + (pad + 1), v0 + (pad + 1), xx, xy, yx, yy
            psf = psfs[y, x]
            s0 = s1 = s2 = s3 = 0.0
            for k in range(counts[psf], counts[psf + 1]):
                o, a, b, c, d = _corners(frame, points[k, 0], points[k, 1], points[k, 2], rows, stride)
                if o < 0:
                    continue
                q = o + 4 * stride
                s0 += a * flat[o] + b * flat[o + 4] + c * flat[q] + d * flat[q + 4]
                s1 += a * flat[o + 1] + b * flat[o + 5] + c * flat[q + 1] + d * flat[q + 5]
                s2 += a * flat[o + 2] + b * flat[o + 6] + c * flat[q + 2] + d * flat[q + 6]
                s3 += a * flat[o + 3] + b * flat[o + 7] + c * flat[q + 3] + d * flat[q + 7]
            out[y, x, 0], out[y, x, 1], out[y, x, 2], out[y, x, 3] = s0, s1, s2, s3


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _gather_whole(grad, placed, y0, y1, out):  # type: ignore[no-untyped-def]
    """`_gather_between` for `PlacedWhole`."""
    psfs, counts, steps, weights, pad = placed
    width = psfs.shape[1]
    stride = grad.shape[1]
    flat = grad.reshape(-1)
    for y in range(y0, y1):
        for x in range(width):
            o = 4 * ((y + pad + 1) * stride + x + pad + 1)
            psf = psfs[y, x]
            s0 = s1 = s2 = s3 = 0.0
            for k in range(counts[psf], counts[psf + 1]):
                i, w = o + steps[k], weights[k]
                s0 += w * flat[i]
                s1 += w * flat[i + 1]
                s2 += w * flat[i + 2]
                s3 += w * flat[i + 3]
            out[y, x, 0], out[y, x, 1], out[y, x, 2], out[y, x, 3] = s0, s1, s2, s3


def _bands(height: int) -> list[tuple[int, int]]:
    return row_bands(height, max(MIN_ROWS, -(-height // BANDS)))


def _reaches(points: Tensor, counts: Tensor, turned: bool) -> Tensor:
    """How far each PSF ``(K,)`` of a table reaches: in rows, or in any direction if it is turned."""
    x, y = points[:, 0], points[:, 1]
    far = (x * x + y * y).sqrt() if turned else y.abs()
    owner = torch.arange(len(counts) - 1).repeat_interleave(counts.diff())
    return far.new_zeros(len(counts) - 1).scatter_reduce(0, owner, far, "amax")


def _row_range(low: float, high: float, far: Tensor, placement: Placement) -> tuple[int, int]:
    """First row that source rows ``low .. high`` of one image reach and one past the last, in the unpadded image.

    ``far`` is what `_reaches` says of the PSFs of their pixels, and ``placement`` where these go.
    """
    reach = float(far.max())
    if placement.rotation is not None:
        across, down = placement.rotation[1]
        reach *= math.sqrt(float((across * across + down * down).max()))
    if placement.position is not None:
        low, high = placement.position[1].min().item(), placement.position[1].max().item()
    return math.floor(low - reach), math.floor(high + reach) + 2


def _is_whole(points: Tensor, placement: Placement) -> bool:
    """Whether all targets are pixels of the padded buffer."""
    if placement.rotation is not None or placement.position is not None:
        return False
    offsets = points[:, :2]
    return bool(((offsets == offsets.round()) & (offsets.abs() <= placement.pad)).all())


def _placed(
    index: Tensor, points: Tensor, counts: Tensor, placement: Placement, columns: int
) -> Sequence[Placed | PlacedWhole]:
    """The PSFs of each picture, for a padded buffer of so many columns."""
    rotation, position, pad = placement
    b, sums = len(index), counts.contiguous().numpy()
    psfs = index.contiguous()[:, 0].numpy()
    if _is_whole(points, placement):
        steps = (4 * (points[:, 1] * (columns + 2) + points[:, 0])).long().numpy()
        weights = points[:, 2].contiguous().numpy()
        return [PlacedWhole(psf, sums, steps, weights, pad) for psf in psfs]
    turns = points.new_empty(b, 2, 2, 0, 0) if rotation is None else rotation.contiguous()
    places = points.new_empty(b, 2, 0, 0) if position is None else position.contiguous()
    table = points.contiguous().numpy()
    maps = zip(psfs, turns.numpy(), places.numpy(), strict=True)
    return [Placed(psf, sums, table, turn, place, pad) for psf, turn, place in maps]


def splat_points(
    values: Tensor, index: Tensor, points: Tensor, counts: Tensor, placement: Placement, size: Sequence[int]
) -> Tensor:
    """`torchbokeh.ops.points.splat_points` for CPU float32; points are ``(P, 3)``: dx, dy, weight."""
    b, c, h, _ = values.shape
    rotation, position, pad = placement
    rows, columns = (n + 2 * pad for n in size)
    groups = -(-c // 4)
    src = interleave(values).flatten(1).numpy()
    pictures = _placed(index, points, counts, placement, columns)
    kernel = _splat_whole if _is_whole(points, placement) else _splat_between
    reaches = _reaches(points, counts, rotation is not None)
    out = torch.empty(b * groups, 4, rows, columns, dtype=torch.float32)
    for k in range(b * groups):
        n = k // groups
        pieces = []
        for y0, y1 in _bands(h):
            turn, place = (None if t is None else t[n, ..., y0:y1, :] for t in (rotation, position))
            far = reaches[index[n, 0, y0:y1]]
            ends = _row_range(y0, y1 - 1, far, Placement(turn, place, pad))
            first, end = (min(max(y + pad, 0), rows) for y in ends)
            pieces.append((src[k], pictures[n], y0, y1, first, np.zeros((end - first + 2, columns + 2, 4))))
        run_all(kernel, pieces)
        total = torch.zeros(rows, columns, 4, dtype=torch.float64)
        for *_, first, buffer in pieces:
            total[first : first + len(buffer) - 2] += torch.from_numpy(buffer[1:-1, 1:-1])
        out[k] = total.permute(2, 0, 1)
    return out.reshape(b, 4 * groups, rows, columns)[:, :c].contiguous()


def gather_points(grad: Tensor, index: Tensor, points: Tensor, counts: Tensor, placement: Placement) -> Tensor:
    """Adjoint: gradient ``(B, C, Hp, Wp)`` of the buffer to that of the values ``(B, C, H, W)``."""
    b, c = grad.shape[:2]
    h, w = index.shape[-2:]
    groups = -(-c // 4)
    buffer = torch.nn.functional.pad(interleave(grad.double()), (0, 0, 1, 1, 1, 1)).numpy()
    pictures = _placed(index, points, counts, placement, grad.shape[3])
    kernel = _gather_whole if _is_whole(points, placement) else _gather_between
    out = torch.empty(b * groups, h, w, 4, dtype=torch.float32)
    pieces = [
        (buffer[k], pictures[k // groups], y0, y1, out[k].numpy()) for k in range(b * groups) for y0, y1 in _bands(h)
    ]
    run_all(kernel, pieces)
    return separate(out, c)
