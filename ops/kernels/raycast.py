"""numba kernel of `subsample_blur` for CPU float32: the same numbers as the torch definition, faster.

Geometry is computed in double with the operations of the definition in the same order, so that both take the same
decision at every silhouette. Pixels do not depend on each other: the result has the same bits for every thread count.
"""

import math
from typing import NamedTuple

import numba as nb
import numpy as np
import torch
from torch import Tensor

from torchbokeh.ops.kernels.interleave import add_one, interleave, separate
from torchbokeh.ops.nbuffers import NBuffers
from torchbokeh.ops.raycast import window
from torchbokeh.ops.system.threads import row_bands, run_all

BAND = 16
"""Rows of a band: few enough that threads which meet long rays are not the last to finish."""


class Frame(NamedTuple):
    """A picture that is looked at from elsewhere: ``colour``, and ``missed``, what rays see that hit nothing, both
    flat, four to a pixel; ``cocs (1 or S, H*W)``, one field for all views or one for each, cut at the limit of
    `_add_view`; the ``bounds (2, H, W)`` of the CoC that rays can meet; and settings of
    `torchbokeh.ops.raycast.subsample_blur`.
    """

    colour: np.ndarray
    missed: np.ndarray
    cocs: np.ndarray
    bounds: np.ndarray
    far: float
    tolerance: float


class Rays(NamedTuple):
    """Where the rays of views ``(S, 2)`` are after j steps, for all j that the bounds of the image allow.

    From the ``first (S,)`` j on, ``steps (S, K, 2)`` leads to a pixel, relative to the output pixel, and the ray is the
    ``shares (S, K)`` away from it, towards the next one.
    """

    views: np.ndarray
    first: np.ndarray
    steps: np.ndarray
    shares: np.ndarray


@nb.njit(inline="always")
def _inside(x, n):  # type: ignore[no-untyped-def]
    return min(max(x, 0), n - 1)


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _window_bounds(low, high, y, x, half):  # type: ignore[no-untyped-def]
    """`NBuffers.square` for one pixel; ``low`` and ``high`` are ``(L, H, W)``."""
    levels, h, w = low.shape
    x0, x1, y0, y1 = max(x - half, 0), min(x + half, w - 1), max(y - half, 0), min(y + half, h - 1)
    wide = w + h if x1 == w - 1 else x1 - x0 + 1
    tall = w + h if y1 == h - 1 else y1 - y0 + 1
    level = 0
    while level < levels - 1 and (2 << level) <= min(wide, tall):
        level += 1
    side = 1 << level
    last_x, last_y = max(x1 - side + 1, x0), max(y1 - side + 1, y0)
    a, z = low[level, y0, x0], high[level, y0, x0]
    j = y0
    while True:
        i = x0
        while True:
            a = min(a, low[level, j, i])
            z = max(z, high[level, j, i])
            if i == last_x:
                break
            i = min(i + side, last_x)
        if j == last_y:
            break
        j = min(j + side, last_y)
    return a, z


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _bounds_band(low, high, extent, reach, iterations, y0, y1, bounds):  # type: ignore[no-untyped-def]
    """`coc_bounds` for rows ``y0 .. y1-1`` of ``bounds (2, H, W)``, from the ``extent`` of the image."""
    _, h, w = bounds.shape
    longest = np.float64(max(h, w))
    for y in range(y0, y1):
        for x in range(w):
            a, z = extent
            before = -1
            for _ in range(iterations):
                half = math.ceil(min(max(abs(a), abs(z)) * reach, longest))
                if half == before:  # the same window again
                    break
                before = half
                c, d = _window_bounds(low, high, y, x, half)
                a, z = np.float64(c), np.float64(d)
            bounds[0, y, x], bounds[1, y, x] = a, z


@nb.njit(inline="always")
def _pace(ux, uy, w, h):  # type: ignore[no-untyped-def]
    """Whether the rays of a view step along x, pixels per CoC and CoC per pixel, and the CoC that leads to the border.

    Shifts by more than the picture are all the same: everything is beyond the border.
    """
    along_x = abs(ux) >= abs(uy)
    scale, length = (abs(ux), w) if along_x else (abs(uy), h)
    return along_x, scale, 1.0 / scale, length / scale


@nb.njit(inline="always")
def _corners(u, v):  # type: ignore[no-untyped-def]
    """Weights of four pixels for a place that lies ``(u, v)`` from the first one."""
    return (1.0 - v) * (1.0 - u), (1.0 - v) * u, v * (1.0 - u), v * u


@nb.njit(inline="always")
def _of_one(a, b, c, d):  # type: ignore[no-untyped-def]
    """Weights divided by their sum; without any, that of the first pixel.

    They add up to 1 but for 1e-16, which no float32 keeps: a constant picture stays constant.
    """
    weight = a + b + c + d
    a, inverse = (a, 1.0 / weight) if weight > 0.0 else (1.0, 1.0)
    return a * inverse, b * inverse, c * inverse, d * inverse


@nb.njit(inline="always")
def _between(a, b, share, step):  # type: ignore[no-untyped-def]
    """`raycast._sample`: the height field between two pixels, or that of the nearest if they are two surfaces."""
    nearest = a if share < 0.5 else b
    return a + (b - a) * share if abs(a - b) <= step else nearest


@nb.njit(inline="always")
def _hit(j, px, scale, step, before, after, in_front, ahead):  # type: ignore[no-untyped-def]
    """`raycast._cast`: the CoC at which a ray hits the field between the samples ``j-1`` and ``j``, NaN for nowhere.

    The field is ``before`` and ``after`` there, and the ray ``in_front`` and ``ahead`` of it.
    """
    if abs(after - before) <= step:
        if (ahead <= 0.0) if in_front >= 0.0 else (ahead >= 0.0):
            share = in_front / (in_front - ahead) if in_front != ahead else 0.0
            return (j - 1 + share) * px
    elif in_front >= 0.0 and in_front * scale <= 0.5:
        return before
    elif ahead <= 0.0 and ahead * scale >= -0.5:
        return after
    return np.nan


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _add_view(total, frame, rays, s, y):  # type: ignore[no-untyped-def]
    """Add to ``total (W*4)`` what view ``s`` sees in row y, less the frame.

    Only numbers are handed on: numba counts references to arrays that are handed on within loops, which took two thirds
    of the time.
    """
    colour, missed, cocs, bounds, far, tolerance = frame
    coc, low, high = cocs[min(s, len(cocs) - 1)], bounds[0, y], bounds[1, y]
    first_step, steps, shares = rays.first[s], rays.steps[s], rays.shares[s]
    w = len(low)
    h = len(coc) // w
    ux, uy = rays.views[s, 0], rays.views[s, 1]
    along_x, scale, px, limit = _pace(ux, uy, w, h)
    step = tolerance / scale
    beside = np.uintp(w if along_x else 1)
    for x in range(w):
        near, away = np.float64(low[x]), np.float64(high[x])
        if near == 0.0 and away == 0.0:  # in focus, as all around: seen where the frame sees it
            continue
        out, here = 4 * x, 4 * (y * w + x)
        near, behind = min(max(near, -limit), limit), min(max(away, -limit), limit)
        r = near if near == behind else np.nan
        if near != behind:  # `raycast._cast`
            first, last = math.floor(near * scale), math.ceil(behind * scale)
            reach = max(abs(first), abs(last)) + 1
            inside = x >= reach and y >= reach and x + reach < w and y + reach < h
            before = in_front = 0.0
            for j in range(first, last + 1):
                k = np.uintp(j - first_step)
                i, n = x + steps[k, 0], y + steps[k, 1]
                if inside:
                    p = np.uintp(n * w + i)
                    a, b = np.float64(coc[p]), np.float64(coc[p + beside])
                else:
                    q, m = (i, n + 1) if along_x else (i + 1, n)
                    a = np.float64(coc[np.uintp(_inside(n, h) * w + _inside(i, w))])
                    b = np.float64(coc[np.uintp(_inside(m, h) * w + _inside(q, w))])
                after = _between(a, b, shares[k], step)
                ahead = after - j * px
                if j > first:
                    r = _hit(j, px, scale, step, before, after, in_front, ahead)
                    if not math.isnan(r):
                        break
                before, in_front = after, ahead
            if math.isnan(r):
                if away >= far:
                    add_one(total, out, missed, here, 1.0)
                    add_one(total, out, colour, here, -1.0)
                continue
        # `raycast._look_up`
        u, v = min(max(x - r * ux, 0.0), w - 1.0), min(max(y - r * uy, 0.0), h - 1.0)
        i, n = int(u), int(v)
        p = np.uintp(n * w + i)
        right, below = np.uintp(1 if i + 1 < w else 0), np.uintp(w if n + 1 < h else 0)
        wa, wb, wc, wd = _corners(u - i, v - n)
        if behind - near > 0.5 * step:  # or else there is only one surface within reach
            wa = wa if abs(coc[p] - r) <= step else 0.0
            wb = wb if abs(coc[p + right] - r) <= step else 0.0
            wc = wc if abs(coc[p + below] - r) <= step else 0.0
            wd = wd if abs(coc[p + right + below] - r) <= step else 0.0
        wa, wb, wc, wd = _of_one(wa, wb, wc, wd)
        add_one(total, out, colour, np.int64(p) << 2, wa)
        add_one(total, out, colour, np.int64(p + right) << 2, wb)
        add_one(total, out, colour, np.int64(p + below) << 2, wc)
        add_one(total, out, colour, np.int64(p + right + below) << 2, wd)
        add_one(total, out, colour, here, -1.0)


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _blur_band(frame, rays, y0, y1, out):  # type: ignore[no-untyped-def]
    """The mean of all views for rows ``y0 .. y1-1``; ``out`` is flat, four to a pixel."""
    colour, views = frame.colour, rays.views
    w = frame.bounds.shape[2]
    count = len(views)
    total = np.empty(4 * w, np.float64)
    for y in range(y0, y1):
        total[:] = 0.0
        for s in range(count):
            if views[s, 0] != 0.0 or views[s, 1] != 0.0:
                _add_view(total, frame, rays, s, y)
        row = 4 * y * w
        for n in range(4 * w):
            out[row + n] = colour[row + n] + total[n] / (count + 1)


def _rays(views: np.ndarray, least: float, most: float, size: tuple[int, int]) -> Rays:
    """The rays of views ``(S, 2)`` in a picture of ``(H, W)`` whose CoC lies between ``least`` and ``most``."""
    ranges, positions = [], []
    for ux, uy in views.tolist():
        along_x = abs(ux) >= abs(uy)
        major, minor, n = (ux, uy, size[1]) if along_x else (uy, ux, size[0])
        if major == 0:
            ranges.append(np.zeros(1))
            positions.append(np.zeros((1, 3)))
            continue
        scale, limit = abs(major), n / abs(major)
        first, last = (min(max(r, -limit), limit) * scale for r in (least, most))
        j = np.arange(math.floor(first), math.ceil(last) + 1)
        aside = -j * (minor / scale)
        whole = np.floor(aside)
        ahead = -j * math.copysign(1.0, major)
        ranges.append(j)
        positions.append(np.stack([ahead, whole, aside - whole] if along_x else [whole, ahead, aside - whole], 1))
    length = max(map(len, ranges))
    steps = np.stack([np.pad(p, ((0, length - len(p)), (0, 0))) for p in positions])
    first = np.array([j[0] for j in ranges], np.int64)
    return Rays(views, first, steps[..., :2].astype(np.int64), steps[..., 2].copy())


def subsample_blur(
    colour: Tensor,
    coc: Tensor,
    views: list[list[float]],
    far: float,
    background: Tensor | None,
    iterations: int,
    tolerance: float,
) -> Tensor:
    """`torchbokeh.ops.raycast.subsample_blur` for CPU float32 and arguments that are checked."""
    b, c, h, w = colour.shape
    points = np.array(views, np.float64)
    reach = float(np.abs(points).max())
    ranges = [t.tolist() for t in torch.aminmax(coc.flatten(1), dim=1)]
    least, most = min(ranges[0]), max(ranges[1])
    largest = 2 * window(max(abs(least), abs(most)), reach, coc.shape) + 1
    buffers = NBuffers.build(coc, largest if iterations else 1)
    low, high = buffers.low[:, :, 0].numpy(), buffers.high[:, :, 0].numpy()
    bounds = np.empty((b, 2, h, w), np.float32)

    def find_bounds(n: int, y0: int, y1: int) -> None:
        extent = ranges[0][n], ranges[1][n]
        _bounds_band(low[:, n], high[:, n], extent, reach, iterations, y0, y1, bounds[n])

    bands = row_bands(h, BAND)
    run_all(find_bounds, [(n, *band) for n in range(b) for band in bands])

    groups = -(-c // 4)
    source = interleave(colour.detach()).numpy().reshape(b * groups, -1)
    missed = source if background is None else interleave(background.detach()).numpy().reshape(b * groups, -1)
    field = coc.contiguous().numpy().reshape(b, 1, -1)
    limits = np.array([(w if abs(x) >= abs(y) else h) / max(abs(x), abs(y), 1e-300) for x, y in views])
    if max(abs(least), abs(most)) > limits.min():
        field = np.clip(field, -limits[:, None], limits[:, None]).astype(np.float64)
    rays = _rays(points, least, most, (h, w))
    out = torch.empty(b * groups, h, w, 4)
    result = out.numpy().reshape(b * groups, -1)

    def blur(k: int, y0: int, y1: int) -> None:
        n = k // groups
        frame = Frame(source[k], missed[k], field[n], bounds[n], far, tolerance)
        _blur_band(frame, rays, y0, y1, result[k])

    run_all(blur, [(k, *band) for k in range(b * groups) for band in bands])
    return separate(out, c)
