"""Flat convex PSFs as short lists of points, for kernels that draw many of the same radii."""

import math
from typing import NamedTuple

import numba as nb
import numpy as np

from torchbokeh.ops.kernels.outline import Shape, at_rows, draw_arc, most_points, psf_buffer, psf_room
from torchbokeh.ops.kernels.rows import PsfPoints
from torchbokeh.ops.merge import EVEN, ROUNDED_TO, STEPS
from torchbokeh.ops.spans import MIN_RADIUS

LAST = 1.0 / MIN_RADIUS - 1.0 / EVEN
"""Number of the PSF with the radius `EVEN`, in units of `STEPS`."""

ROOT = EVEN**0.5


class RadiusBank(NamedTuple):
    """PSFs of the radii ``radius_of(0), radius_of(1), ...``, first for positive CoC, then for negative.

    PSF ``k`` starts in row ``firsts[k]`` relative to its centre; that of a level shape in its centre: the rows above it
    are left out. Its rows have the numbers ``ends[k] .. ends[k+1]-2``, and row j the points
    ``starts[j] .. starts[j+1]-1``.

    Attributes:
        shape: what PSFs of other radii are drawn from.
        mirrored: where the PSFs of negative CoC start; 0 if they are those of positive CoC.
        reach: columns left and right of a centre that any PSF stays within.
        firsts: ``(N,)``.
        ends: ``(N+1,)``.
        starts: ``(R,)``, that of each row of all PSFs; each PSF has one more, where its last row ends.
        points: of all PSFs; the first row of each has the number 0.
    """

    shape: Shape
    mirrored: int
    reach: int
    firsts: np.ndarray
    ends: np.ndarray
    starts: np.ndarray
    points: PsfPoints


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


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _draw_all(count, shape, sign, with_slopes):  # type: ignore[no-untyped-def]
    shapes, s = shape.tables, 1 if sign < 0.0 else 0
    ends, firsts = np.zeros(count + 1, np.int64), np.zeros(count, np.int64)
    most = 0
    for k in range(count):
        r = radius_of(k)
        # A row that is only touched holds nothing: a PSF of half a pixel is one row.
        firsts[k] = 0 if shape.level else math.ceil(r * shapes[s, 0, 0] - 0.5 + 1e-9)
        n = math.floor(r * shapes[s, -1, 0] + 0.5 - 1e-9) - firsts[k] + 1
        ends[k + 1] = ends[k] + n + 1
        most += (2 if shape.even else 4) * most_points(n, int(2 * r) + 2)
    starts = np.empty(ends[-1], np.int64)
    places, weights = np.empty((most, 4), np.int32), np.empty(most, np.float64)
    slopes = np.zeros(most if with_slopes else 0, np.float64)
    across = int(2 * radius_of(count)) + 8
    buffer, borders, done = psf_buffer(across, across), (-1000000, 1000000), 0
    room, arcs = psf_room(shape, buffer), (2 if shape.even else 0)
    counts, points = np.empty(across + 1, np.int64), buffer.points
    for k in range(count):
        coc, n, sloping = sign * radius_of(k), ends[k + 1] - ends[k] - 1, with_slopes and k > 0
        own = starts[ends[k] : ends[k + 1]]
        own[:] = 0
        at_rows(coc, (firsts[k], n), room)
        for again in range(2):  # first only how many points each row has, then each in its place
            if again:
                total = done
                for row in range(n + 1):
                    own[row], total = total, total + own[row]
                counts[:n] = 0
            for arc in range(arcs, 4):
                first, rows = draw_arc(arc, coc, (0, firsts[k], n), borders, room, sloping)
                for row in range(rows):
                    begin, end = buffer.starts[row], buffer.starts[row + 1]
                    if not again:
                        own[first + row] += end - begin
                        continue
                    at = own[first + row] + counts[first + row]
                    counts[first + row] += end - begin
                    for i in range(end - begin):
                        places[at + i] = points.places[begin + i]
                        places[at + i, 0] = first + row
                        weights[at + i] = points.weights[begin + i]
                        if sloping:
                            slopes[at + i] = points.slopes[begin + i]
        done = own[n]
    return firsts, ends, starts, places[:done].copy(), weights[:done].copy(), slopes[:done].copy()


def radius_bank(largest: float, shape: Shape, *, slopes: bool = False) -> RadiusBank:
    """Draw the PSFs of all radii up to ``largest``."""
    count = int(number_of(largest)) + 1
    symmetric = bool(np.abs(shape.tables[0, :, :3] - shape.tables[1, :, :3]).max() < 1e-14)
    firsts, ends, starts, *points = _draw_all(count, shape, 1.0, slopes)
    if not symmetric:
        others = _draw_all(count, shape, -1.0, slopes)
        ends = np.concatenate([ends, others[1][1:] + ends[-1]])
        firsts, starts = np.concatenate([firsts, others[0]]), np.concatenate([starts, others[2] + len(points[0])])
        points = [np.concatenate(pair) for pair in zip(points, others[3:], strict=True)]
    reach = math.ceil(largest) + 2
    places, weights, changes = points
    every = PsfPoints(places, weights, changes, scratch=np.empty((0, 0)))
    return RadiusBank(shape, 0 if symmetric else count, reach, firsts, ends, starts, every)
