"""The outlines of PSFs in an exported ONNX file: `torchbokeh.ops.outline` in standard operators.

Two things differ, since onnxruntime has no arc functions in double: the angle between the two ends of a piece is taken
in float32, from its sine and cosine in double, so that it is exact to a relative 1e-7; and knots are found by halving.
"""

# ruff: noqa: F821 (names of sizes)

from onnxscript import DOUBLE, FLOAT, INT64, script
from onnxscript import opset18 as op
from onnxscript.values import Opset

DOMAIN = Opset("torchbokeh", 1)


@script(DOMAIN)
def piece_of(ends: DOUBLE["N"], heights: DOUBLE["K"], strides: INT64["T"]) -> INT64["N"]:
    """The piece of an outline that each of the heights ``ends`` lies in: knots are found by halving, two need none."""
    last = op.Size(heights) - 2
    found = op.Cast(op.CastLike(0.0, ends) * ends, to=INT64.dtype)
    halvings = op.Size(strides)
    for step in range(halvings):
        further = op.Min(found + op.Gather(strides, step), last)
        found = op.Where(op.GreaterOrEqual(ends, op.Gather(heights, further)), further, found)
    return found


@script(DOMAIN)
def edge_integrals(
    ends: DOUBLE["N"],
    knots: DOUBLE["K", 3],
    integrals: DOUBLE["K", 2],
    slopes: DOUBLE["S", 2],
    strides: INT64["T"],
) -> DOUBLE["N", 2]:
    """Integrals of the left and right edge up to the heights ``ends``."""
    heights = op.Squeeze(op.Slice(knots, [0], [1], [1]), [1])
    found = piece_of(ends, heights, strides)
    beyond = op.Unsqueeze(ends - op.Gather(heights, found), [1])
    edges = op.Slice(knots, [1], [3], [1])
    edge = op.Gather(edges, found) + op.CastLike(0.5, ends) * op.Gather(slopes, found) * beyond
    return op.Gather(integrals, found) + beyond * edge


@script(DOMAIN)
def arc_integral(u: DOUBLE["N"], v: DOUBLE["N"]) -> DOUBLE["N"]:
    """Integral of ``sqrt(1 - x²)`` from u to v: the angle between is twice that whose tangent is sin / (1 + cos)."""
    zero = op.CastLike(0.0, u)
    half = op.CastLike(0.5, u)
    one = op.CastLike(1.0, u)
    at_u = op.Sqrt(op.Max(one - u * u, zero))
    at_v = op.Sqrt(op.Max(one - v * v, zero))
    sine = v * at_u - u * at_v
    cosine = u * v + at_u * at_v
    obtuse = op.Less(cosine, zero)
    tiny = op.CastLike(1e-12, u)
    tangent = op.Where(obtuse, one - cosine, sine) / op.Where(obtuse, op.Max(sine, tiny), one + cosine)
    angle = op.CastLike(2.0, u) * op.Cast(op.Atan(op.Cast(tangent, to=FLOAT.dtype)), to=DOUBLE.dtype)
    return half * (v * at_v - u * at_u + angle)


@script(DOMAIN)
def edges_at(
    ends: DOUBLE["N"],
    arc: INT64["N"],
    knots: DOUBLE["K", 3],
    slopes: DOUBLE["S", 2],
    bulge: DOUBLE,
    strides: INT64["T"],
) -> DOUBLE["N"]:
    """`torchbokeh.ops.outline.edge_at`."""
    zero = op.CastLike(0.0, ends)
    one = op.CastLike(1.0, ends)
    two = op.CastLike(2.0, ends)
    heights = op.Squeeze(op.Slice(knots, [0], [1], [1]), [1])
    found = piece_of(ends, heights, strides)
    right = op.GreaterOrEqual(arc, op.Constant(value_int=2))
    side = op.Cast(right, to=INT64.dtype)
    pair = op.Unsqueeze(found * 2 + side, [1])
    tilt = op.GatherND(op.Reshape(slopes, [-1]), pair)
    edge = op.GatherND(op.Reshape(op.Slice(knots, [1], [3], [1]), [-1]), pair)
    bottom = op.Squeeze(op.Slice(knots, [0, 0], [1, 1]))
    top = op.Squeeze(op.Slice(knots, [-1, 0], [2147483647, 1]))
    t = (two * ends - bottom - top) / (top - bottom)
    round_part = bulge * op.Sqrt(op.Max(one - t * t, zero))
    return edge + tilt * (ends - op.Gather(heights, found)) + op.Where(right, round_part, op.Neg(round_part))


@script(DOMAIN)
def side_arcs(arc: INT64, knots: DOUBLE["K", 3], slopes: DOUBLE["S", 2], bulge: DOUBLE, strides: INT64["T"]):
    """Of `torchbokeh.ops.outline.arcs_of`, for the left (0) or right (2) edge: where it is furthest out, the first and
    last pieces of both of its arcs ``(2, 2)``, and their keys ``(2 K,)``."""
    half = op.CastLike(0.5, bulge)
    one = op.CastLike(1.0, bulge)
    heights = op.Squeeze(op.Slice(knots, [0], [1], [1]), [1])
    before = op.Slice(heights, [0], [-1])
    after = op.Slice(heights, [1], [2147483647])
    bottom = op.Gather(heights, 0)
    top = op.Gather(heights, -1)
    extent = half * (top - bottom)
    sign = op.Where(op.Greater(arc, op.Constant(value_int=0)), op.Neg(one), one)
    side = op.Reshape(op.Div(arc, op.Constant(value_int=2)), [1])
    tilt = sign * extent * op.Squeeze(op.Gather(slopes, side, axis=1), [1])
    length = op.Max(op.Sqrt(tilt * tilt + bulge * bulge), op.CastLike(1e-12, bulge))
    extreme = op.Min(op.Max(half * (top + bottom) - extent * tilt / length, before), after)
    arcs = op.Expand(arc, op.Shape(extreme))
    best = op.ArgMin(sign * edges_at(extreme, arcs, knots, slopes, bulge, strides), axis=0, keepdims=0)
    turn = op.Gather(extreme, best)
    below = op.ReduceSum(op.Cast(op.Less(heights, turn), to=INT64.dtype), keepdims=0) - 1
    above = op.ReduceSum(op.Cast(op.LessOrEqual(heights, turn), to=INT64.dtype), keepdims=0) - 1
    last = op.Size(heights) - 2
    none = op.Constant(value_int=0)
    ends = op.Concat([0], op.Reshape(op.Max(below, none), [1]), axis=0)
    others = op.Concat(op.Reshape(op.Min(above, last), [1]), op.Reshape(last, [1]), axis=0)
    pieces = op.Concat(op.Unsqueeze(ends, [0]), op.Unsqueeze(others, [0]), axis=0)
    places = op.Concat(op.Min(heights, turn), op.Max(heights, turn), axis=0)
    edges = sign * edges_at(places, op.Expand(arc, op.Shape(places)), knots, slopes, bulge, strides)
    falling, rising = op.Split(edges, axis=0, num_outputs=2)
    keys = op.Concat(op.Neg(falling), rising, axis=0)
    return turn, pieces, keys


@script(DOMAIN)
def crossings(
    x: DOUBLE["N"],
    arc: INT64["N"],
    knots: DOUBLE["K", 3],
    slopes: DOUBLE["S", 2],
    bulge: DOUBLE,
    keys: DOUBLE["M"],
    pieces: INT64["4", "2"],
    strides: INT64["T"],
) -> DOUBLE["N"]:
    """`torchbokeh.ops.outline.crossings`, where there is one: the pieces between knots are found by halving."""
    zero = op.CastLike(0.0, x)
    half = op.CastLike(0.5, x)
    one = op.CastLike(1.0, x)
    right = op.GreaterOrEqual(arc, op.Constant(value_int=2))
    side = op.Cast(right, to=INT64.dtype)
    rising = op.Equal(arc - 2 * side, op.Constant(value_int=1))
    sign = op.Where(right, op.Neg(one), one)
    direction = op.Where(rising, one, op.Neg(one))
    signed = sign * x
    wanted = direction * signed
    count = op.Squeeze(op.Shape(knots, start=0, end=1))
    first = op.Squeeze(op.Slice(pieces, [0], [1], [1]), [1])
    last = op.Gather(op.Squeeze(op.Slice(pieces, [1], [2], [1]), [1]), arc)
    found = op.Gather(first, arc)
    halvings = op.Size(strides)
    for step in range(halvings):
        further = op.Min(found + op.Gather(strides, step), last)
        found = op.Where(op.GreaterOrEqual(wanted, op.Gather(keys, arc * count + further)), further, found)
    pair = op.Unsqueeze(found * 2 + side, [1])
    slope = op.GatherND(op.Reshape(slopes, [-1]), pair)
    edge = op.GatherND(op.Reshape(op.Slice(knots, [1], [3], [1]), [-1]), pair)
    heights = op.Squeeze(op.Slice(knots, [0], [1], [1]), [1])
    bottom = op.Squeeze(op.Slice(knots, [0, 0], [1, 1]))
    top = op.Squeeze(op.Slice(knots, [-1, 0], [2147483647, 1]))
    middle = half * (top + bottom)
    extent = half * (top - bottom)
    tilt = sign * slope * extent
    beyond = signed - sign * (edge + slope * (middle - op.Gather(heights, found)))
    square = op.Max(tilt * tilt + bulge * bulge, op.CastLike(1e-24, x))
    root = op.Sqrt(op.Max(square - beyond * beyond, zero))
    y = middle + extent * (tilt * beyond + direction * bulge * root) / square
    return op.Max(op.Min(y, op.Gather(heights, found + 1)), op.Gather(heights, found))


@script(DOMAIN)
def row_pieces(
    near: DOUBLE["N"],
    x: DOUBLE["N"],
    frame: DOUBLE["2"],
    knots: DOUBLE["K", 3],
    slopes: DOUBLE["S", 2],
    bulge: DOUBLE,
    turns: DOUBLE["2"],
    keys: DOUBLE["M"],
    pieces: INT64["4", "2"],
    strides: INT64["T"],
):
    """`torchbokeh.ops.outline.row_pieces` of the radii ``near``: owner, arc, low, high and column of each piece.

    ``frame`` is the offset of the row and the width of the picture.
    """
    offset = op.Squeeze(op.Slice(frame, [0], [1]))
    wide = op.Squeeze(op.Slice(frame, [1], [2]))
    zero = op.CastLike(0.0, near)
    half = op.CastLike(0.5, near)
    one = op.CastLike(1.0, near)
    tiny = op.CastLike(1e-12, near)
    bottom = op.Squeeze(op.Slice(knots, [0, 0], [1, 1]))
    top = op.Squeeze(op.Slice(knots, [-1, 0], [2147483647, 1]))
    left_turn = op.Squeeze(op.Slice(turns, [0], [1]))
    right_turn = op.Squeeze(op.Slice(turns, [1], [2]))
    first = (offset - half) / near
    second = (offset + half) / near
    lowest = op.Max(op.Min(op.Min(first, second), top), bottom)
    highest = op.Max(op.Min(op.Max(first, second), top), bottom)
    # The four arcs, one after the other: below and above where each edge is furthest out.
    lows = op.Concat(lowest, op.Max(lowest, left_turn), lowest, op.Max(lowest, right_turn), axis=0)
    highs = op.Concat(op.Min(highest, left_turn), highest, op.Min(highest, right_turn), highest, axis=0)
    filled = op.Squeeze(op.NonZero(op.Greater(highs - lows, tiny)), [0])
    many = op.Max(op.Size(near), op.Constant(value_int=1))
    arc = op.Div(filled, many)
    of = op.Mod(filled, many)
    low = op.Gather(lows, filled)
    high = op.Gather(highs, filled)
    radii = op.Gather(near, of)
    here = op.Gather(x, of)
    from_x = here + radii * edges_at(low, arc, knots, slopes, bulge, strides)
    to_x = here + radii * edges_at(high, arc, knots, slopes, bulge, strides)
    begin = op.Max(op.Min(op.Floor(from_x), wide), op.Neg(one))
    end = op.Max(op.Min(op.Floor(to_x), wide), op.Neg(one))
    amount = op.Cast(op.Abs(end - begin), to=INT64.dtype) + 1
    # Which of them each piece belongs to, and the how many-th it is.
    sums = op.CumSum(amount, op.Constant(value_int=0))
    total = op.ReduceSum(amount, keepdims=0)
    starts = sums - amount
    ones = op.Expand(op.Constant(value_int=1), op.Reshape(total, [1]))
    marks = op.ScatterElements(ones * 0, starts, amount * 0 + 1, axis=0)
    owner = op.CumSum(marks, op.Constant(value_int=0)) - 1
    number = op.CumSum(ones, op.Constant(value_int=0)) - 1 - op.Gather(starts, owner)
    step = op.Gather(op.Sign(end - begin), owner)
    column = op.Gather(begin, owner) + step * op.Cast(number, to=DOUBLE.dtype)
    arcs = op.Gather(arc, owner)
    r = op.Gather(radii, owner)
    centre = op.Gather(here, owner)
    entered = op.Where(op.Less(step, zero), column + one, column)
    cut = crossings((entered - centre) / r, arcs, knots, slopes, bulge, keys, pieces, strides)
    lower = op.Gather(low, owner)
    upper = op.Gather(high, owner)
    start = op.Where(op.Equal(number, op.Constant(value_int=0)), lower, op.Min(op.Max(cut, lower), upper))
    following = op.Concat(op.Slice(start, [1], [2147483647], [0]), op.Slice(start, [0], [1], [0]), axis=0)
    stop = op.Where(op.Equal(number, op.Gather(amount, owner) - 1), upper, following)
    return op.Gather(of, owner), arcs, start, stop, column


@script(DOMAIN)
def mean_edges(
    r: DOUBLE["N"],
    arc: INT64["N"],
    low: DOUBLE["N"],
    high: DOUBLE["N"],
    knots: DOUBLE["K", 3],
    integrals: DOUBLE["K", 2],
    slopes: DOUBLE["S", 2],
    bulge: DOUBLE,
    whole: DOUBLE,
    strides: INT64["T"],
):
    """`torchbokeh.ops.outline.mean_edge`, its weight negative on right edges of the picture."""
    zero = op.CastLike(0.0, r)
    half = op.CastLike(0.5, r)
    tiny = op.CastLike(1e-12, r)
    bottom = op.Squeeze(op.Slice(knots, [0, 0], [1, 1]))
    top = op.Squeeze(op.Slice(knots, [-1, 0], [2147483647, 1]))
    middle = half * (top + bottom)
    extent = half * (top - bottom)
    covered = high - low
    safe = op.Max(covered, tiny)
    integral = edge_integrals(op.Concat(low, high, axis=0), knots, integrals, slopes, strides)
    before, after = op.Split(integral, axis=0, num_outputs=2)
    straight = (after - before) / op.Unsqueeze(safe, [1])
    round_part = bulge * extent * arc_integral((low - middle) / extent, (high - middle) / extent) / safe
    on_left = op.Squeeze(op.Slice(straight, [0], [1], [1]), [1]) - round_part
    on_right = op.Squeeze(op.Slice(straight, [1], [2], [1]), [1]) + round_part
    is_left = op.Less(arc, op.Constant(value_int=2))
    mean = r * op.Where(is_left, on_left, on_right)
    weight = covered / (op.Abs(r) * whole)
    weight = op.Where(op.Equal(is_left, op.Greater(r, zero)), weight, op.Neg(weight))
    return mean, weight


FUNCTIONS = (piece_of, edge_integrals, arc_integral, edges_at, side_arcs, crossings, row_pieces, mean_edges)
"""Each calls only those before it."""
