"""numba kernels of `splat_spans` for CPU float32: the same numbers as the torch definition, faster.

Pixels are interleaved in fours (RGB and coverage, say), so that one vector operation adds a pixel to two
neighbouring columns. Weights and sums are double: bright pixels leave nothing behind on their row. Work is cut into
bands of output rows whose height does not depend on the number of threads, and each band visits its pixels in
the same order: the result has the same bits for every thread count.
"""

import math
from typing import NamedTuple

import numba as nb
import numpy as np
import torch
from torch import Tensor

from torchbokeh.ops.kernels.interleave import add_pair, interleave, separate
from torchbokeh.ops.spans import MIN_RADIUS, Profile, area, knot_integrals
from torchbokeh.ops.system.threads import row_bands, run_all

BAND = 64
"""Rows of a band: 64 rows of 1024 interleaved double pixels fill the second-level cache of common processors."""


class Shape(NamedTuple):
    """The unit shape of a `Profile`: ``inverse_area`` is 1 / area.

    ``tables (2, K, 7)`` has for each knot of the upright and of the point-mirrored shape: y, left, right, integral of
    left, integral of right, slope of left and right.
    """

    tables: np.ndarray
    bulge: float
    inverse_area: float


@nb.njit(inline="always")
def clamped(coc):  # type: ignore[no-untyped-def]
    """`torchbokeh.ops.spans.clamp_radius` for one pixel."""
    r = max(abs(coc), MIN_RADIUS)
    return -r if coc < 0.0 else r


@nb.njit(inline="always")
def _semicircle(t):  # type: ignore[no-untyped-def]
    """``∫_0^t sqrt(1 - u²) du``, with t clamped to [-1, 1].

    What is missing to a quarter of the disc is ``(1-t)^1.5 Q(t)``; Q is a Chebyshev fit with an error of 6e-12.
    """
    a = min(abs(t), 1.0)
    q = -1.674431816358481e-05 * a + 0.00011598529376309666
    q = (q * a - 0.0003860216674655534) * a + 0.0008607249390741488
    q = (q * a - 0.0015508409618942476) * a + 0.002621160264232852
    q = (q * a - 0.00467646847299498) * a + 0.00972422556007743
    q = (q * a - 0.02737838614246099) * a + 0.17809724368127833
    q = q * a + 0.7853981634032768
    rest = 1.0 - a
    return math.copysign(0.25 * math.pi - rest * math.sqrt(rest) * q, t)


@nb.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def row_table(coc, first, n, shape, rows):  # type: ignore[no-untyped-def]
    """Fill ``rows (>= 4, > n)`` for the rows ``first .. first+n-1`` from the centre of a PSF of the radius ``coc``.

    They take the left ends, the right ends, the weights and scratch. ``first`` need not be whole. ``coc`` is signed,
    and not 0.
    """
    shapes, bulge, inv_area = shape
    s, r = 1 if coc < 0.0 else 0, abs(coc)
    left, right, weight, arcs = rows[0], rows[1], rows[2], rows[3]
    knots = shapes.shape[1]
    bottom, top = shapes[s, 0, 0], shapes[s, knots - 1, 0]
    inv = 1.0 / r
    scale = inv * inv_area
    if bulge > 0.0:
        # In units of the half height, from the middle. An ellipse has two knots: its centre line is straight,
        # so the mean of the line is its value half way.
        half = 0.5 * (top - bottom)
        step = inv / half
        start = (first - 0.5) * step - 0.5 * (top + bottom) / half
        centre = 0.5 * r * (shapes[s, 0, 1] + shapes[s, 1, 1])
        shear = 0.5 * r * shapes[s, 0, 5] * half
        width = r * bulge
        scale *= half
        for k in range(n + 1):
            arcs[k] = _semicircle(start + k * step)
        for k in range(n):
            low = max(start + k * step, -1.0)
            high = min(start + (k + 1) * step, 1.0)
            height = high - low
            arc = width * (arcs[k + 1] - arcs[k]) / max(height, 1e-12)
            middle = centre + shear * (low + high)
            left[k] = middle - arc
            right[k] = middle + arc
            weight[k] = max(height, 0.0) * scale
        return
    piece = 0
    low = min(max((first - 0.5) * inv, bottom), top)
    while piece < knots - 2 and shapes[s, piece + 1, 0] <= low:
        piece += 1
    dy = low - shapes[s, piece, 0]
    old_left = shapes[s, piece, 3] + dy * (shapes[s, piece, 1] + 0.5 * shapes[s, piece, 5] * dy)
    old_right = shapes[s, piece, 4] + dy * (shapes[s, piece, 2] + 0.5 * shapes[s, piece, 6] * dy)
    for k in range(n):
        high = min(max((first + k + 0.5) * inv, bottom), top)
        while piece < knots - 2 and shapes[s, piece + 1, 0] <= high:
            piece += 1
        dy = high - shapes[s, piece, 0]
        new_left = shapes[s, piece, 3] + dy * (shapes[s, piece, 1] + 0.5 * shapes[s, piece, 5] * dy)
        new_right = shapes[s, piece, 4] + dy * (shapes[s, piece, 2] + 0.5 * shapes[s, piece, 6] * dy)
        height = high - low
        safe = max(height, 1e-12)
        left[k] = r * (new_left - old_left) / safe
        right[k] = r * (new_right - old_right) / safe
        weight[k] = height * scale
        low, old_left, old_right = high, new_left, new_right


@nb.njit(inline="always")
def row_range(r, y, bottom, top, y0, y1):  # type: ignore[no-untyped-def]
    """First row and number of rows that a PSF of radius ``r`` at row ``y`` reaches within ``y0 .. y1-1``.

    The unit shape runs from ``bottom`` to ``top``. The number is 0 or less where the PSF stays outside.
    """
    first = max(y0 - y, math.ceil(max(r * bottom - 0.5, -1e9)))
    last = min(y1 - 1 - y, math.floor(min(r * top + 0.5, 1e9)))
    return first, last - first + 1


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _splat_band(src, coc, reach, shape, integrate, y0, y1, out):  # type: ignore[no-untyped-def]
    """Splat every pixel that reaches rows ``y0 .. y1-1``; write the band of ``out (4, H, W)``."""
    shapes = shape.tables
    height, width = coc.shape
    stride = 4 * (width + 2)
    band = np.zeros((y1 - y0) * stride, np.float64)
    rows = np.empty((4, y1 - y0 + 1), np.float64)
    lefts, rights, weights = rows[0], rows[1], rows[2]
    right_border = np.float64(width)
    for y in range(height):
        if y + reach[y] + 1.0 < y0 or y - reach[y] - 1.0 > y1:
            continue
        for x in range(width):
            p = 4 * (y * width + x)
            if src[p] == 0.0 and src[p + 1] == 0.0 and src[p + 2] == 0.0 and src[p + 3] == 0.0:
                continue
            c = clamped(np.float64(coc[y, x]))
            s = 1 if c < 0.0 else 0
            first, n = row_range(abs(c), y, shapes[s, 0, 0], shapes[s, -1, 0], y0, y1)
            if n <= 0:
                continue
            row_table(c, first, n, shape, rows)
            o = (y + first - y0) * stride
            for k in range(n):
                # What starts left of the image starts at its border; what ends right of it never ends.
                left = min(max(x + 0.5 + lefts[k], 0.0), right_border)
                right = min(max(x + 0.5 + rights[k], 0.0), right_border)
                w = weights[k]
                i = int(left)
                f = left - i
                add_pair(band, o + 4 * i, src, p, w * (1.0 - f), w * f)
                i = int(right)
                f = right - i
                add_pair(band, o + 4 * i, src, p, -w * (1.0 - f), -w * f)
                o += stride
    for y in range(y0, y1):
        o = (y - y0) * stride
        s0 = s1 = s2 = s3 = 0.0
        for x in range(width):
            if integrate:
                s0 += band[o]
                s1 += band[o + 1]
                s2 += band[o + 2]
                s3 += band[o + 3]
            else:
                s0, s1, s2, s3 = band[o], band[o + 1], band[o + 2], band[o + 3]
            out[0, y, x], out[1, y, x], out[2, y, x], out[3, y, x] = s0, s1, s2, s3
            o += 4


@nb.njit(inline="always")
def _edge_slope(r, mean, low, high, at_low, at_high, d_low, d_high):  # type: ignore[no-untyped-def]
    """Derivative by the radius of ``r * mean``, the mean of an edge between ``low`` and ``high``."""
    return mean + r * ((at_high - mean) * d_high - (at_low - mean) * d_low) / max(high - low, 1e-12)


@nb.njit(inline="always")
def _edges_at(shapes, s, piece, y, bulge, half, middle):  # type: ignore[no-untyped-def]
    """Left and right edge of the unit shape at height ``y``, which lies in piece ``piece``."""
    dy = y - shapes[s, piece, 0]
    t = (y - middle) / half
    arc = bulge * math.sqrt(max(1.0 - t * t, 0.0))
    return shapes[s, piece, 1] + shapes[s, piece, 5] * dy - arc, shapes[s, piece, 2] + shapes[s, piece, 6] * dy + arc


@nb.njit(cache=True, nogil=True, error_model="numpy")
def row_slopes(coc, first, n, shape, rows):  # type: ignore[no-untyped-def]
    """Derivatives by the radius of the ``rows (7, > n)`` that `row_table` has filled, left, right and weight.

    They go to ``rows[4:]``.
    """
    shapes, bulge, inv_area = shape
    s, r = 1 if coc < 0.0 else 0, abs(coc)
    knots = shapes.shape[1]
    bottom, top = shapes[s, 0, 0], shapes[s, knots - 1, 0]
    half, middle = 0.5 * (top - bottom), 0.5 * (top + bottom)
    inv = 1.0 / r
    piece = 0
    for k in range(n):
        low = (first + k - 0.5) * inv
        high = (first + k + 0.5) * inv
        d_low = -low * inv if low > bottom else 0.0
        d_high = -high * inv if high < top else 0.0
        low, high = max(low, bottom), min(high, top)
        while piece < knots - 2 and shapes[s, piece + 1, 0] <= low:
            piece += 1
        low_left, low_right = _edges_at(shapes, s, piece, low, bulge, half, middle)
        upper = piece
        while upper < knots - 2 and shapes[s, upper + 1, 0] <= high:
            upper += 1
        high_left, high_right = _edges_at(shapes, s, upper, high, bulge, half, middle)
        rows[4, k] = _edge_slope(r, rows[0, k] * inv, low, high, low_left, high_left, d_low, d_high)
        rows[5, k] = _edge_slope(r, rows[1, k] * inv, low, high, low_right, high_right, d_low, d_high)
        rows[6, k] = ((d_high - d_low) * inv_area - rows[2, k]) * inv


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _gather_band(src, coc, shape, grad, y0, y1, grad_src, grad_coc):  # type: ignore[no-untyped-def]
    """Adjoint of the splat for the pixels of rows ``y0 .. y1-1``.

    ``grad (H, W+2, 4)`` is the gradient of the differences. Adds to ``grad_src (H*W*4)``, ``grad_coc (H, W)``.
    """
    shapes = shape.tables
    height, width = coc.shape
    rows = np.empty((7, height + 1), np.float64)
    right_border = np.float64(width)
    pixel = np.empty(4, np.float64)
    total = np.empty(4, np.float64)
    for y in range(y0, y1):
        for x in range(width):
            p = 4 * (y * width + x)
            c = clamped(np.float64(coc[y, x]))
            s = 1 if c < 0.0 else 0
            first, n = row_range(abs(c), y, shapes[s, 0, 0], shapes[s, -1, 0], 0, height)
            row_table(c, first, n, shape, rows)
            row_slopes(c, first, n, shape, rows)
            for k in range(4):
                pixel[k] = src[p + k]
                total[k] = 0.0
            slope = 0.0
            for k in range(n):
                w = rows[2, k]
                left = x + 0.5 + rows[0, k]
                right = x + 0.5 + rows[1, k]
                left_moves = 0.0 < left < right_border
                right_moves = 0.0 < right < right_border
                left = min(max(left, 0.0), right_border)
                right = min(max(right, 0.0), right_border)
                i, j = int(left), int(right)
                f, g = left - i, right - j
                row = y + first + k
                by_left = by_right = by_weight = 0.0
                for ch in range(4):
                    a, b = grad[row, i, ch], grad[row, i + 1, ch]
                    d, e = grad[row, j, ch], grad[row, j + 1, ch]
                    mass = a + f * (b - a) - d - g * (e - d)
                    total[ch] += w * mass
                    by_weight += mass * pixel[ch]
                    by_left += (b - a) * pixel[ch]
                    by_right -= (e - d) * pixel[ch]
                if left_moves:
                    slope += by_left * w * rows[4, k]
                if right_moves:
                    slope += by_right * w * rows[5, k]
                slope += by_weight * rows[6, k]
            for k in range(4):
                grad_src[p + k] = total[k]
            if abs(c) > MIN_RADIUS:
                grad_coc[y, x] += slope if c > 0.0 else -slope


def shape_of(profile: Profile) -> Shape:
    """The shape of a profile, in double."""
    knots = profile.knots.detach().double()
    upright = (knots, torch.stack([-knots[:, 0], -knots[:, 2], -knots[:, 1]], 1).flip(0))
    tables = []
    for side in upright:
        rise = side[1:, :1] - side[:-1, :1]
        slopes = torch.where(rise > 1e-9, (side[1:, 1:] - side[:-1, 1:]) / rise.clamp_min(1e-9), 0.0)
        tables.append(torch.cat([side, knot_integrals(side), torch.cat([slopes, slopes[-1:]])], 1))
    inverse_area = 1.0 / area(Profile(knots, profile.bulge.detach().double()))
    return Shape(torch.stack(tables).numpy(), float(profile.bulge), float(inverse_area))


def splat_spans(values: Tensor, coc: Tensor, profile: Profile, integrate: bool) -> Tensor:
    """`torchbokeh.ops.splat.splat_spans` for CPU float32."""
    b, c, h, w = values.shape
    groups = -(-c // 4)
    shape = shape_of(profile)
    src = interleave(values.detach()).numpy()
    coc_np = coc.detach().contiguous().numpy()
    extent = max(abs(shape.tables[0, 0, 0]), abs(shape.tables[0, -1, 0]))
    reach = (coc.detach().abs().amax((1, 3)).clamp_min(MIN_RADIUS) * extent).numpy()
    out = torch.empty(b * groups, 4, h, w, dtype=torch.float32)
    out_np = out.numpy()

    def work(k: int, y0: int, y1: int) -> None:
        n = k // groups
        flat = src[k].reshape(-1)
        _splat_band(flat, coc_np[n, 0], reach[n], shape, integrate, y0, y1, out_np[k])

    run_all(work, [(k, y0, y1) for k in range(b * groups) for y0, y1 in row_bands(h, BAND)])
    return out.reshape(b, 4 * groups, h, w)[:, :c].contiguous()


def gather_spans(grad: Tensor, values: Tensor, coc: Tensor, profile: Profile) -> tuple[Tensor, Tensor]:
    """Adjoint: gradient ``(B, C, H, W)`` of the differences to the gradients of ``values`` and ``coc``."""
    b, c, h, w = values.shape
    groups = -(-c // 4)
    shape = shape_of(profile)
    src = interleave(values.detach()).numpy()
    differences = torch.nn.functional.pad(interleave(grad.double()), (0, 0, 0, 2)).numpy()
    coc_np = coc.detach().contiguous().numpy()
    grad_src = torch.empty(src.shape, dtype=torch.float32)
    grad_coc = torch.zeros(groups, b, 1, h, w, dtype=torch.float64)
    grad_src_np, grad_coc_np = grad_src.numpy(), grad_coc.numpy()

    def work(k: int, y0: int, y1: int) -> None:
        n = k // groups
        _gather_band(
            *(src[k].reshape(-1), coc_np[n, 0], shape, differences[k], y0, y1),
            *(grad_src_np[k].reshape(-1), grad_coc_np[k % groups, n, 0]),
        )

    run_all(work, [(k, y0, y1) for k in range(b * groups) for y0, y1 in row_bands(h, BAND)])
    return separate(grad_src, c), grad_coc.sum(0).to(coc.dtype)
