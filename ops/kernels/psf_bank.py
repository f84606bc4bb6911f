"""Flat convex PSFs as short lists of points, for kernels that draw many of the same radii: four weights per row."""

import math
from typing import NamedTuple

import numba as nb
import numpy as np

from torchbokeh.ops.kernels.splat import row_slopes, row_table
from torchbokeh.ops.spans import MIN_RADIUS


class Bank(NamedTuple):
    """PSFs of the radii ``0, 1/steps, 2/steps, ...``, first for positive CoC, then for negative.

    PSF ``k`` has the rows ``ends[k] .. ends[k+1]-1`` of the tables, from row ``firsts[k]`` relative to its centre.

    Attributes:
        steps: radii per pixel.
        mirrored: where the PSFs of negative CoC start; 0 if they are those of positive CoC.
        reach: columns left and right of a centre that any PSF stays within.
        firsts: ``(N,)``.
        ends: ``(N+1,)``.
        columns: ``(R, 2)`` whole column of the left and of the right end.
        weights: ``(R, 4)`` what the left end adds to its column and the next, then the right end.
        slopes: ``(R, 4)`` derivatives of the weights by the radius; empty if they were not asked for.
    """

    steps: int
    mirrored: int
    reach: int
    firsts: np.ndarray
    ends: np.ndarray
    columns: np.ndarray
    weights: np.ndarray
    slopes: np.ndarray


@nb.njit(cache=True, nogil=True, error_model="numpy")
def draw_psf(r, x, first, n, low, high, shapes, s, bulge, inv_area, rows, columns, weights):  # type: ignore[no-untyped-def]
    """One PSF of radius ``r``, its centre at column ``x``, in the rows ``first .. first+n-1`` from its centre.

    Fills ``columns (n, 2)`` and ``weights (n, 4)``, see `Bank`; ends are kept within columns ``low`` to ``high``.
    ``rows (4, > n)`` is scratch.
    """
    row_table(r, first, n, shapes, s, bulge, inv_area, rows)
    for k in range(n):
        left = min(max(x + rows[0, k], low), high)
        right = min(max(x + rows[1, k], low), high)
        w = rows[2, k]
        i, j = math.floor(left), math.floor(right)
        columns[k, 0], columns[k, 1] = i, j
        weights[k, 0], weights[k, 1] = w * (1.0 - (left - i)), w * (left - i)
        weights[k, 2], weights[k, 3] = -w * (1.0 - (right - j)), -w * (right - j)


@nb.njit(cache=True, nogil=True, error_model="numpy")
def draw_slopes(r, x, first, n, low, high, shapes, s, bulge, inv_area, rows, moves, slopes):  # type: ignore[no-untyped-def]
    """Derivatives ``slopes (n, 4)`` by the radius of the weights; after `draw_psf`, with the same ``rows``.

    ``moves (3, n)`` is scratch.
    """
    row_slopes(r, first, n, shapes, s, bulge, inv_area, rows, moves)
    for k in range(n):
        left, right, w = x + rows[0, k], x + rows[1, k], rows[2, k]
        by_left = w * moves[0, k] if low < left < high else 0.0
        by_right = w * moves[1, k] if low < right < high else 0.0
        f = min(max(left, low), high)
        f -= math.floor(f)
        g = min(max(right, low), high)
        g -= math.floor(g)
        dw = moves[2, k]
        slopes[k, 0], slopes[k, 1] = dw * (1.0 - f) - by_left, dw * f + by_left
        slopes[k, 2], slopes[k, 3] = -dw * (1.0 - g) + by_right, -dw * g - by_right


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _draw_all(count, steps, shapes, s, bulge, inv_area, with_slopes):  # type: ignore[no-untyped-def]
    ends, firsts = np.zeros(count + 1, np.int64), np.zeros(count, np.int64)
    for k in range(count):
        r = max(k / steps, MIN_RADIUS)
        # A row that is only touched holds nothing: a PSF of half a pixel is one row.
        firsts[k] = math.ceil(r * shapes[s, 0, 0] - 0.5 + 1e-9)
        ends[k + 1] = ends[k] + math.floor(r * shapes[s, -1, 0] + 0.5 - 1e-9) - firsts[k] + 1
    columns, weights = np.empty((ends[-1], 2), np.int64), np.empty((ends[-1], 4), np.float64)
    slopes = np.zeros((ends[-1] if with_slopes else 0, 4), np.float64)
    most = int(2 * count / steps) + 8
    rows, moves = np.empty((4, most), np.float64), np.empty((3, most), np.float64)
    for k in range(count):
        r = max(k / steps, MIN_RADIUS)
        a, b = ends[k], ends[k + 1]
        first, n = firsts[k], b - a
        draw_psf(r, 0.5, first, n, -1e9, 1e9, shapes, s, bulge, inv_area, rows, columns[a:b], weights[a:b])
        if with_slopes and k / steps > MIN_RADIUS:
            draw_slopes(r, 0.5, first, n, -1e9, 1e9, shapes, s, bulge, inv_area, rows, moves, slopes[a:b])
    return firsts, ends, columns, weights, slopes


def psf_bank(
    largest: float, steps: int, shapes: np.ndarray, bulge: float, inv_area: float, *, slopes: bool = False
) -> Bank:
    """Draw the PSFs of all radii up to ``largest``, for the tables of `_span_kernels.shape_tables`."""
    count = math.ceil(largest * steps) + 1
    symmetric = bool(np.abs(shapes[0, :, :3] - shapes[1, :, :3]).max() < 1e-14)
    upright = _draw_all(count, steps, shapes, 0, bulge, inv_area, slopes)
    reach = math.ceil(largest) + 2
    if symmetric:
        return Bank(steps, 0, reach, *upright)
    firsts, ends, *tables = _draw_all(count, steps, shapes, 1, bulge, inv_area, slopes)
    both = zip(upright, [firsts, ends[1:] + upright[1][-1], *tables], strict=True)
    return Bank(steps, count, reach, *(np.concatenate(pair) for pair in both))
