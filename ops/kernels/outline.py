"""Flat convex PSFs as short lists of points, for numba kernels: what `torchbokeh.ops.outline` does for one PSF.

Where the outline meets the borders of rows and those of columns is tabulated first, in loops that the compiler turns
into vector code; then a walk along it adds up the pieces between. Of a shape that is its own mirror image one half is
drawn, or one quarter. Arrays are handed on as pointers: numba would count references to them, for every PSF, in memory
that all threads share.
"""

import math
from typing import NamedTuple

import numba as nb
import numpy as np
import torch

from torchbokeh.ops.kernels.rows import PsfPoints, pointer
from torchbokeh.ops.outline import arcs_of, edge_at
from torchbokeh.ops.spans import MIN_RADIUS, Profile, area, edge_integrals, edge_slopes, knot_integrals, piece_at


class Shape(NamedTuple):
    """The unit shape of a `Profile`, upright and point-mirrored: ``inverse_area`` is 1 / area.

    ``tables (2, K, 7)`` has for each knot: y, left, right, the integrals of both, the slopes of both.
    ``turns (2, 2, 3)`` has for the left and the right edge where it is furthest out: y, x and the integral up to there.
    ``pieces (2, 2)`` are the numbers of the knots just below that. ``even`` says that the right edge is the mirror
    image of the left one, and ``level`` that the lower half is that of the upper one. ``ends`` are the least and the
    largest y.
    """

    tables: np.ndarray
    turns: np.ndarray
    pieces: np.ndarray
    bulge: float
    inverse_area: float
    even: bool
    level: bool
    ends: tuple[float, float]


class PsfBuffer(NamedTuple):
    """Room for one arc of a PSF (see `torchbokeh.ops.outline.Arcs`): ``starts (> n,)``, where the points of each row
    start, and of the row behind the last one, where these end; and ``points``, whose first row has the number 0. Of a
    level shape, rows below the centre stand for those above it as well.

    The scratch of the points has lines of floats. Where the outline meets the borders of rows, the first hold y, and
    for the left and the right edge x and the area between it and the axis up to there; from `CROSSED` on, where an arc
    meets borders of columns, y and area. All are in px from the centre.
    """

    starts: np.ndarray
    points: PsfPoints


CROSSED = 5


@nb.njit(cache=True, nogil=True, error_model="numpy")
def most_points(n, columns):  # type: ignore[no-untyped-def]
    """No arc in ``n`` rows and so many columns has more: it meets each border once."""
    return 2 * (n + columns) + 8


@nb.njit(cache=True, nogil=True, error_model="numpy")
def psf_buffer(n, columns):  # type: ignore[no-untyped-def]
    """A `PsfBuffer` for ``n`` rows and as many columns between the borders."""
    count = most_points(n, columns)
    places, weights, slopes = np.zeros((count, 4), np.int32), np.empty(count, np.float64), np.empty(count, np.float64)
    floats = np.empty((CROSSED + 2, max(n, columns) + 4), np.float64)
    return PsfBuffer(np.empty(n + 1, np.int64), PsfPoints(places, weights, slopes, floats))


@nb.njit(inline="always")
def psf_room(shape, buffer):  # type: ignore[no-untyped-def]
    """What `draw_arc` draws, and into what: numbers, and pointers to arrays, which must outlive its last call."""
    tables = pointer(shape.tables), shape.tables.shape[1], pointer(shape.turns), pointer(shape.pieces)
    points = pointer(buffer.points.places), pointer(buffer.points.weights), pointer(buffer.points.slopes)
    kind = shape.bulge, shape.inverse_area, shape.even, shape.level
    floats = buffer.points.scratch
    return (tables, kind), (pointer(floats), floats.shape[1]), (pointer(buffer.starts), points)


@nb.njit(inline="always")
def clamped(coc):  # type: ignore[no-untyped-def]
    """`torchbokeh.ops.spans.clamp_radius` for one pixel."""
    r = max(abs(coc), MIN_RADIUS)
    return -r if coc < 0.0 else r


@nb.njit(inline="always")
def rows_to_draw(coc, y, y0, y1, ends, level):  # type: ignore[no-untyped-def]
    """First row and number of rows that a PSF centred on row ``y`` reaches within ``y0 .. y1-1``.

    The unit shape runs from ``ends[0]`` to ``ends[1]``. Of a ``level`` one, these are the rows below its centre that
    stand for all of them. The number is 0 or less where the PSF stays outside.
    """
    bottom, top = coc * ends[0], coc * ends[1]
    if coc < 0.0:
        bottom, top = top, bottom
    first = max(y0 - y, math.ceil(max(bottom - 0.5, -1e9)))
    last = min(y1 - 1 - y, math.floor(min(top + 0.5, 1e9)))
    if level and first < 0 and last >= first:
        first, last = (0, max(last, -first)) if last >= 0 else (-last, -first)
    return first, last - first + 1


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
def at_rows(coc, rows, room):  # type: ignore[no-untyped-def]
    """Tabulate where the outline of a PSF meets the borders of ``rows``, the first and how many, before `draw_arc`."""
    (((table, knots, _, _), (bulge, _, even, level)), (floats, length), _), (first, n) = room, rows
    s, r = 1 if coc < 0.0 else 0, abs(coc)
    base, last = 7 * knots * s, 7 * (knots * (s + 1) - 1)
    bottom, top = table[base], table[last]
    half, middle, inv, square = 0.5 * (top - bottom), 0.5 * (top + bottom), 1.0 / r, r * r
    lowest = middle if level else bottom
    if knots == 2:
        # One line at a time, so that it becomes vector code.
        for k in range(n + 1):
            floats[k] = r * min(max((first + k - 0.5) * inv, lowest), top)
        for side in range(1 if even else 0, 2):
            edge, slope, sign, line = (
                table[base + 1 + side],
                table[base + 5 + side],
                2.0 * side - 1.0,
                (1 + 2 * side) * length,
            )
            for k in range(n + 1):
                y = min(max((first + k - 0.5) * inv, lowest), top)
                t, dy = (y - middle) / half, y - bottom
                arc, part = bulge * math.sqrt(max(1.0 - t * t, 0.0)), bulge * half * _semicircle(t)
                floats[line + k] = r * (edge + slope * dy + sign * arc)
                floats[line + length + k] = square * (dy * (edge + 0.5 * slope * dy) + sign * part)
        return
    for k in range(n + 1):
        y = min(max((first + k - 0.5) * inv, lowest), top)
        while base < last - 7 and table[base + 7] <= y:
            base += 7
        arc = part = 0.0
        if bulge > 0.0:
            t = (y - middle) / half
            arc, part = bulge * math.sqrt(max(1.0 - t * t, 0.0)), bulge * half * _semicircle(t)
        dy = y - table[base]
        floats[k] = r * y
        for side in range(2):
            edge, slope = table[base + 1 + side], table[base + 5 + side]
            sign = 2.0 * side - 1.0
            x, line = r * (edge + slope * dy + sign * arc), (1 + 2 * side) * length
            below = square * (table[base + 3 + side] + dy * (edge + 0.5 * slope * dy) + sign * part)
            floats[line + k], floats[line + length + k] = x, below


@nb.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "nsz"})
def _at_columns(arc, s, r, places, shape, lines):  # type: ignore[no-untyped-def]
    """Tabulate where an arc meets the borders of columns, y rising: at the first x, the step and their number."""
    (start, step, count), ((table, knots, _, pieces), (bulge, _, _, _)), (floats, length) = places, shape, lines
    side, line = arc >> 1, CROSSED * length
    sign, rising = 1.0 - 2.0 * side, 2.0 * (arc & 1) - 1.0
    base, last = 7 * knots * s, 7 * (knots * (s + 1) - 1)
    bottom, top = table[base], table[last]
    half, middle, inv, square = 0.5 * (top - bottom), 0.5 * (top + bottom), 1.0 / r, r * r
    if knots == 2:
        edge, slope = table[base + 1 + side], table[base + 5 + side]
        tilt, centre = sign * slope * half, sign * (edge + slope * half)
        inverse = 1.0 / max(tilt * tilt + bulge * bulge, 1e-24)
        for k in range(count):
            x = start + k * step
            beyond = sign * x * inv - centre
            root = rising * bulge * math.sqrt(max(tilt * tilt + bulge * bulge - beyond * beyond, 0.0))
            t = min(max((tilt * beyond + root) * inverse, -1.0), 1.0)
            dy = half * t + half
            y, area = (
                r * (bottom + dy),
                square * (dy * (edge + 0.5 * slope * dy) - sign * bulge * half * _semicircle(t)),
            )
            floats[line + k], floats[line + length + k] = y, area
        return
    if arc & 1:
        base += 7 * pieces[2 * s + side]
    if bulge == 0.0:
        for k in range(count):
            x = sign * (start + k * step) * inv
            while base < last - 7 and rising * (x - sign * table[base + 8 + side]) >= 0.0:
                base += 7
            edge, slope, y = table[base + 1 + side], table[base + 5 + side], table[base]
            # A level piece has its x at any height: it must not leave its knots.
            dy = (x - sign * edge) / (sign * slope) if slope != 0.0 else 0.0
            dy = min(max(dy, 0.0), table[base + 7] - y)
            floats[line + k] = r * (y + dy)
            floats[line + length + k] = square * (table[base + 3 + side] + dy * (edge + 0.5 * slope * dy))
        return
    for k in range(count):
        x = sign * (start + k * step) * inv
        while base < last - 7:
            t = (table[base + 7] - middle) / half
            reached = sign * table[base + 8 + side] - bulge * math.sqrt(max(1.0 - t * t, 0.0))
            if rising * (x - reached) < 0.0:
                break
            base += 7
        edge, slope, y = table[base + 1 + side], table[base + 5 + side], table[base]
        tilt = sign * slope * half
        norm, beyond = max(tilt * tilt + bulge * bulge, 1e-24), x - sign * (edge + slope * (middle - y))
        t = tilt * beyond + rising * bulge * math.sqrt(max(norm - beyond * beyond, 0.0))
        # A level piece has its x at any height: it must not leave its knots.
        height = min(max(middle + half * (t / norm), y), table[base + 7])
        t, dy = min(max((height - middle) / half, -1.0), 1.0), height - y
        part = sign * bulge * half * _semicircle(t) if bulge > 0.0 else 0.0
        area = square * (table[base + 3 + side] + dy * (edge + 0.5 * slope * dy) - part)
        floats[line + k], floats[line + length + k] = r * height, area


@nb.njit(inline="always")
def _column(u, low, high):  # type: ignore[no-untyped-def]
    """The column of x, in px: one before ``low`` for all that is further left, ``high`` for what is further right."""
    return math.floor(min(max(u, low - 1.0), high + 0.0))


@nb.njit(inline="always")
def _walk(kind, arc, rows, place, borders, room):  # type: ignore[no-untyped-def]
    """Write the points of an arc, once its crossings with columns are tabulated.

    ``kind`` says whether columns rise with y, whether the shape is even and whether slopes are asked for. ``arc`` has
    y, x and the area where it begins, least and largest y of the shape, the radius, and the weight of a unit of area;
    ``rows`` the first, the one behind the last, how many columns are crossed, and whether the first is half of a row.
    ``place`` are the columns of the centre and of the beginning, and the first float of the edge; ``borders`` the
    lowest and the highest column of the picture, and the one from which on all is drawn in one.

    Each turn of the loop goes to the next border, of a row or of a column, without a branch that no one could predict.
    """
    (up, even, slopes), (at, e, below, bottom, top, r, scale) = kind, arc
    (k, end, count, half), (x, c, line), (low, high, beyond) = rows, place, borders
    (_, (floats, length), (starts, (places, weights, growths))) = room
    begin, centre, crossed, step = k, x + 0.5, CROSSED * length, 1 if up else -1
    pending, pending_growth, done, met = 0.0, 0.0, 0, 0
    starts[0] = 0
    for _ in range(end - k + count):
        border, column = floats[k + 1], floats[crossed + met]
        # What is met after the last row, as rounding or a shape that is not convex may have it, is met at its end.
        across = column < border or (k + 1 == end and met < count)
        column = min(column, border)
        next_at, i = (column, crossed + met + length) if across else (border, line + length + k + 1)
        next_below, height = floats[i], max(next_at - at, 0.0)
        inside = low <= c < beyond
        part = min(max(next_below - below - (c - centre) * height, 0.0), height) if inside else 0.0
        one, rest = (height - part, part) if up else (part, height - part)
        one += pending
        near, far = (c, c + 1) if up else (c + 1, c)
        if even:
            places[4 * done + 1], places[4 * done + 2] = max(2 * x + 1 - near, low), min(near, high)
            places[4 * done + 5], places[4 * done + 6] = max(2 * x + 1 - far, low), min(far, high)
        else:
            places[4 * done + 1], places[4 * done + 5] = min(max(near, low), high), min(max(far, low), high)
        places[4 * done], places[4 * done + 4] = k - begin, k - begin
        w = 2.0 * scale if half and k == begin else scale
        weights[done], weights[done + 1] = w * one, w * rest
        if slopes:
            # Of all cuts, only the ends of the shape move with it.
            next_e = c + (1 if up else 0) - centre if across else floats[line + k + 1]
            moved = (next_at if next_at >= top else 0.0) - (at if at <= bottom else 0.0)
            change = 2.0 * (next_below - below) - (next_at * next_e if next_at < top else 0.0)
            change += (at * e if at > bottom else 0.0) - (c - centre) * moved
            change = change if inside else 0.0
            one_growth, rest_growth = (moved - change, change) if up else (change, moved - change)
            one_growth += pending_growth
            growths[done], growths[done + 1] = w * (one_growth - 2.0 * one) / r, w * (rest_growth - 2.0 * rest) / r
            pending_growth, e = rest_growth if across else 0.0, next_e
        pending = rest if across else 0.0
        done += 1 if across else 2
        c, met, k = (c + step, met + 1, k) if across else (c, met, k + 1)
        starts[end - begin if across else k - begin] = done
        at, below = next_at, next_below


@nb.njit(cache=True, nogil=True, error_model="numpy")
def draw_arc(arc, coc, place, borders, room, slopes):  # type: ignore[no-untyped-def]
    """Draw what one arc of a PSF of the radius ``coc`` leaves, once `at_rows` has been called for it.

    ``coc`` is signed, and not 0; ``place`` is the column of its centre and the rows, those of `rows_to_draw`. Points
    are kept within the columns ``borders``, the lowest and the highest. Fills ``starts`` and ``points`` of the buffer
    that is the ``room``, with or without their slopes, and returns the first of the rows and how many there are.
    """
    (shape, lines, _), (x, first, n), (low, high) = room, place, borders
    ((table, knots, turns, _), (_, inverse_area, even, level)), (floats, length) = shape, lines
    s, r, centre, side, half = 1 if coc < 0.0 else 0, abs(coc), x + 0.5, arc >> 1, arc & 1
    turning, line = 6 * s + 3 * side, (1 + 2 * side) * length
    turn = r * turns[turning]
    row = min(max(math.floor(turn + 0.5 - first), 0), n)  # that of the turn
    k, end = (row, n) if half else (0, min(row + 1, n))
    if k >= end or (floats[n] <= turn if half else floats[0] >= turn):
        return 0, 0
    at, e, below = floats[k], floats[line + k], floats[line + length + k]
    kept, kept_e, kept_below = floats[end], floats[line + end], floats[line + length + end]
    extreme, extreme_below = r * turns[turning + 1], r * r * turns[turning + 2]
    if half and at < turn:
        at, e, below = turn, extreme, extreme_below
    elif not half and kept > turn:
        floats[end], floats[line + end], floats[line + length + end] = turn, extreme, extreme_below
    # The mirror image of a column that is beyond one border may lie before the other.
    beyond = x + max(x - low, high - x) + 1 if even else high
    c, up = _column(centre + e, low, beyond), half != side
    step = 1 if up else -1
    count = (_column(centre + floats[line + end], low, beyond) - c) * step
    if count > 0:
        _at_columns(arc, s, r, (c + (1 if up else 0) - centre, step, count), shape, lines)
    floats[CROSSED * length + count] = 1e300
    scale = inverse_area / (r * r) if even or side == 0 else -inverse_area / (r * r)
    outline = at, e, below, r * table[7 * knots * s], r * table[7 * (knots * (s + 1) - 1)], r, scale
    rows, frame = (k, end, count, level and first + k == 0), (low, high, beyond)
    if even and not up and not slopes:  # the most frequent kind, compiled for itself
        _walk((False, True, False), outline, rows, (x, c, line), frame, room)
    else:
        _walk((up, even, slopes), outline, rows, (x, c, line), frame, room)
    floats[end], floats[line + end], floats[line + length + end] = kept, kept_e, kept_below
    return k, end - k


def shape_of(profile: Profile) -> Shape:
    """The shape of a profile, in double."""
    knots, bulge = profile.knots.detach().double(), profile.bulge.detach().double()
    mirrored = torch.stack([-knots[:, 0], -knots[:, 2], -knots[:, 1]], 1).flip(0)
    tables, turns, pieces = [], [], []
    for side in (knots, mirrored):
        shape, slopes = Profile(side, bulge), edge_slopes(side)
        tables.append(torch.cat([side, knot_integrals(side), torch.cat([slopes, slopes[-1:]])], 1))
        turn = arcs_of(shape).ends[[1, 3], 0]
        edges, sides = edge_at(shape, torch.tensor([1, 3]), turn), edge_integrals(shape, turn)
        # Integrals of the tables start at the middle, as far as the arc goes.
        turns.append(torch.stack([turn, edges, sides.diagonal()], 1))
        pieces.append(piece_at(side, turn))
    table, turn_table, piece_table = (torch.stack(t).numpy() for t in (tables, turns, pieces))
    even = bool((knots[:, 1] + knots[:, 2]).abs().max() < 1e-14)
    level = bool((knots - knots.new_tensor([-1, 1, 1]) * knots.flip(0)).abs().max() < 1e-14)
    inverse_area = float(1.0 / area(Profile(knots, bulge)))
    ends = float(knots[0, 0]), float(knots[-1, 0])
    return Shape(table, turn_table, piece_table, float(bulge), inverse_area, even, level, ends)
