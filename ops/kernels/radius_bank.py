"""Flat convex PSFs as short lists of points, for kernels that draw many of the same radii: four weights per row."""

import math
from typing import NamedTuple

import numba as nb
import numpy as np

from torchbokeh.ops.kernels.rows import PsfRows
from torchbokeh.ops.kernels.splat import Shape, row_slopes, row_table
from torchbokeh.ops.merge import EVEN, ROUNDED_TO, STEPS
from torchbokeh.ops.spans import MIN_RADIUS

LAST = 1.0 / MIN_RADIUS - 1.0 / EVEN
"""Number of the PSF with the radius `EVEN`, in units of `STEPS`."""

ROOT = EVEN**0.5


class RadiusBank(NamedTuple):
    """PSFs of the radii ``radius_of(0), radius_of(1), ...``, first for positive CoC, then for negative.

    PSF ``k`` has the rows ``ends[k] .. ends[k+1]-1``, from row ``firsts[k]`` relative to its centre.

    Attributes:
        shape: what PSFs of other radii are drawn from.
        mirrored: where the PSFs of negative CoC start; 0 if they are those of positive CoC.
        reach: columns left and right of a centre that any PSF stays within.
        firsts: ``(N,)``.
        ends: ``(N+1,)``.
        rows: those of all PSFs, one after the other.
    """

    shape: Shape
    mirrored: int
    reach: int
    firsts: np.ndarray
    ends: np.ndarray
    rows: PsfRows


class PsfBuffer(NamedTuple):
    """Room for ``n`` rows of one PSF of that shape; ``table (7, > n)`` is what `row_table` and `row_slopes` fill."""

    shape: Shape
    table: np.ndarray
    rows: PsfRows


@nb.njit(cache=True, nogil=True, error_model="numpy")
def psf_buffer(shape, n):  # type: ignore[no-untyped-def]
    """A `PsfBuffer` of ``n`` rows."""
    rows = PsfRows(np.empty((n, 2), np.int64), np.empty((n, 4), np.float64), np.empty((n, 4), np.float64))
    return PsfBuffer(shape, np.empty((7, n + 1), np.float64), rows)


@nb.njit(inline="always")
def number_of(radius):  # type: ignore[no-untyped-def]
    """The number of the PSF in a bank that stands for a radius, as a float: see `torchbokeh.ops.merge.rounded`."""
    graded = 1.0 / MIN_RADIUS - 1.0 / min(max(radius, MIN_RADIUS), EVEN)
    return np.rint(STEPS * (graded + (math.sqrt(max(radius, EVEN)) - ROOT) * (2.0 / ROOT**3)))


@nb.njit(inline="always")
def radius_of(number):  # type: ignore[no-untyped-def]
    """The radius of a PSF of a bank, at least `MIN_RADIUS`."""
    graded = number / STEPS
    return 1.0 / (1.0 / MIN_RADIUS - graded) if graded < LAST else (ROOT + (graded - LAST) * (0.5 * ROOT**3)) ** 2


@nb.njit(inline="always")
def rounded(coc):  # type: ignore[no-untyped-def]
    """The CoC with its radius rounded to one that a bank would hold."""
    r = abs(coc)
    return math.copysign(radius_of(number_of(r)), coc) if r < ROUNDED_TO else coc


@nb.njit(inline="always")
def rows_within(first, begin, end, y0, y1):  # type: ignore[no-untyped-def]
    """Of the rows ``begin .. end-1`` of a bank, the first of which lies in row ``first``, those in ``y0 .. y1-1``.

    Returns the row of the first of them, and from which to which they are.
    """
    skipped = max(y0 - first, 0)
    return first + skipped, (begin + skipped, begin + min(y1 - first, end - begin))


@nb.njit(cache=True, nogil=True, error_model="numpy")
def draw_psf(coc, x, first, n, borders, buffer):  # type: ignore[no-untyped-def]
    """Draw a PSF of the radius ``coc``, its centre at column ``x``, in the rows ``first .. first+n-1`` from its centre.

    ``coc`` is signed, and not 0. Ends are kept within the columns ``borders``, the lowest and the highest.
    """
    low, high = borders
    rows, (columns, weights, _) = buffer.table, buffer.rows
    row_table(coc, first, n, buffer.shape, rows)
    for k in range(n):
        left = min(max(x + rows[0, k], low), high)
        right = min(max(x + rows[1, k], low), high)
        w = rows[2, k]
        i, j = math.floor(left), math.floor(right)
        columns[k, 0], columns[k, 1] = i, j
        weights[k, 0], weights[k, 1] = w * (1.0 - (left - i)), w * (left - i)
        weights[k, 2], weights[k, 3] = -w * (1.0 - (right - j)), -w * (right - j)


@nb.njit(cache=True, nogil=True, error_model="numpy")
def draw_slopes(coc, x, first, n, borders, buffer):  # type: ignore[no-untyped-def]
    """The slopes of the rows; after `draw_psf`, with the same arguments."""
    low, high = borders
    rows, slopes = buffer.table, buffer.rows.slopes
    row_slopes(coc, first, n, buffer.shape, rows)
    for k in range(n):
        left, right, w = x + rows[0, k], x + rows[1, k], rows[2, k]
        by_left = w * rows[4, k] if low < left < high else 0.0
        by_right = w * rows[5, k] if low < right < high else 0.0
        f = min(max(left, low), high)
        f -= math.floor(f)
        g = min(max(right, low), high)
        g -= math.floor(g)
        dw = rows[6, k]
        slopes[k, 0], slopes[k, 1] = dw * (1.0 - f) - by_left, dw * f + by_left
        slopes[k, 2], slopes[k, 3] = -dw * (1.0 - g) + by_right, -dw * g - by_right


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _draw_all(count, shape, sign, with_slopes):  # type: ignore[no-untyped-def]
    shapes, s = shape.tables, 1 if sign < 0.0 else 0
    ends, firsts = np.zeros(count + 1, np.int64), np.zeros(count, np.int64)
    for k in range(count):
        r = radius_of(k)
        # A row that is only touched holds nothing: a PSF of half a pixel is one row.
        firsts[k] = math.ceil(r * shapes[s, 0, 0] - 0.5 + 1e-9)
        ends[k + 1] = ends[k] + math.floor(r * shapes[s, -1, 0] + 0.5 - 1e-9) - firsts[k] + 1
    columns, weights = np.empty((ends[-1], 2), np.int64), np.empty((ends[-1], 4), np.float64)
    slopes = np.zeros((ends[-1] if with_slopes else 0, 4), np.float64)
    table = np.empty((7, int(2 * radius_of(count)) + 8), np.float64)
    for k in range(count):
        coc = sign * radius_of(k)
        a, b = ends[k], ends[k + 1]
        first, n, borders = firsts[k], b - a, (-1e9, 1e9)
        psf = PsfBuffer(shape, table, PsfRows(columns[a:b], weights[a:b], slopes[a:b]))
        draw_psf(coc, 0.5, first, n, borders, psf)
        if with_slopes and k > 0:
            draw_slopes(coc, 0.5, first, n, borders, psf)
    return firsts, ends, columns, weights, slopes


def radius_bank(largest: float, shape: Shape, *, slopes: bool = False) -> RadiusBank:
    """Draw the PSFs of all radii up to ``largest``."""
    count = int(number_of(largest)) + 1
    symmetric = bool(np.abs(shape.tables[0, :, :3] - shape.tables[1, :, :3]).max() < 1e-14)
    firsts, ends, *rows = _draw_all(count, shape, 1.0, slopes)
    if not symmetric:
        behind, stops, *others = _draw_all(count, shape, -1.0, slopes)
        firsts, ends = np.concatenate([firsts, behind]), np.concatenate([ends, stops[1:] + ends[-1]])
        rows = [np.concatenate(pair) for pair in zip(rows, others, strict=True)]
    reach = math.ceil(largest) + 2
    return RadiusBank(shape, 0 if symmetric else count, reach, firsts, ends, PsfRows(*rows))
