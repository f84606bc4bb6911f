"""What the operators of this package become in an exported ONNX file: standard operators only.

`splat_rows`, what it calls, `halved` and `doubled` are functions of the file. `splat_rows` is a loop over the rows of
the PSFs, as `torchbokeh.ops.splat` has it. Two things differ there, since onnxruntime has no arc functions in double:
the angle between the two ends of a slab is taken in float32, from its sine and cosine in double, so that it is exact to
a relative 1e-7; and knots are found by halving.
"""

# ruff: noqa: F821 (names of sizes)

import onnx
import torch
from onnxscript import DOUBLE, FLOAT, INT64, ir, script
from onnxscript import opset18 as op
from onnxscript.values import Op, Opset

DOMAIN = Opset("torchbokeh", 1)
HALF_PI = 1.5707963267948966
LEVELS = 14
"""Of the pyramid of `pull_push`: enough for 16384 px. From one pixel on, a further level changes nothing."""


@script(DOMAIN)
def edge_integrals(
    ends: DOUBLE["N"],
    knots: DOUBLE["K", 3],
    integrals: DOUBLE["K", 2],
    slopes: DOUBLE["S", 2],
    strides: INT64["T"],
) -> DOUBLE["N", 2]:
    """Integrals of the left and right edge up to the heights ``ends``; knots are found by halving, two need none."""
    heights = op.Squeeze(op.Slice(knots, [0], [1], [1]), [1])
    last = op.Size(heights) - 2
    found = op.Cast(op.CastLike(0.0, ends) * ends, to=INT64.dtype)
    halvings = op.Size(strides)
    for step in range(halvings):
        further = op.Min(found + op.Gather(strides, step), last)
        found = op.Where(op.GreaterOrEqual(ends, op.Gather(heights, further)), further, found)
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
def add_differences(
    buffer: DOUBLE["C", "P"], base: INT64["N"], left: DOUBLE["N"], right: DOUBLE["N"], share: DOUBLE["C", "N"]
) -> DOUBLE["C", "P"]:
    """Add the two differences of each row that begins at ``base`` and runs from ``left`` to ``right``."""
    left_column = op.Floor(left)
    right_column = op.Floor(right)
    left_index = base + op.Cast(left_column, to=INT64.dtype)
    right_index = base + op.Cast(right_column, to=INT64.dtype)
    left_next = share * (left - left_column)
    right_next = share * (right - right_column)
    index = op.Concat(left_index, left_index + 1, right_index, right_index + 1, axis=0)
    update = op.Concat(share - left_next, left_next, right_next - share, op.Neg(right_next), axis=1)
    # Not ScatterND: the threads of onnxruntime lose some of what it adds to one place.
    return op.ScatterElements(buffer, op.Expand(index, op.Shape(update)), update, axis=1, reduction="add")


@script(DOMAIN)
def splat_rows(
    values: DOUBLE["B", "C", "H", "W"],
    coc: DOUBLE["B", 1, "H", "W"],
    knots: DOUBLE["K", 3],
    bulge: DOUBLE,
    integrals: DOUBLE["K", 2],
    slopes: DOUBLE["S", 2],
    whole: DOUBLE,
    strides: INT64["T"],
) -> DOUBLE["B", "C", "H", "W"]:
    """`torchbokeh.ops.splat._splat_spans_torch`, before the sum along x: ``(B, C, H, W)`` in double."""
    zero = op.CastLike(0.0, coc)
    half = op.CastLike(0.5, coc)
    one = op.CastLike(1.0, coc)
    tiny = op.CastLike(1e-12, coc)
    shape = op.Shape(values)
    channels = op.Slice(shape, [1], [2])
    height = op.Squeeze(op.Slice(shape, [2], [3]))
    width = op.Squeeze(op.Slice(shape, [3], [4]))
    flat = op.Reshape(
        op.Transpose(values, perm=[1, 0, 2, 3]), op.Concat(channels, op.Constant(value_ints=[-1]), axis=0)
    )
    signed = op.Reshape(coc, [-1])
    radius = op.Where(op.Less(signed, zero), op.Neg(op.Max(op.Abs(signed), half)), op.Max(op.Abs(signed), half))
    count = op.Size(radius)
    where = op.Range(op.Constant(value_int=0), count, op.Constant(value_int=1))
    y = op.Mod(op.Div(where, width), height)
    x = op.Cast(op.Mod(where, width), to=DOUBLE.dtype) + half
    reach = op.Min(op.Cast(op.ReduceMax(op.Abs(radius), keepdims=0), to=INT64.dtype) + 1, height - 1)
    bottom = op.Squeeze(op.Slice(knots, [0, 0], [1, 1]))
    top = op.Squeeze(op.Slice(knots, [-1, 0], [2147483647, 1]))
    middle = half * (top + bottom)
    extent = half * (top - bottom)
    cells = op.Div(count, width) * (width + 2)
    buffer = op.Expand(zero, op.Concat(channels, op.Reshape(cells, [1]), axis=0))
    for k in range(2 * reach + 1):
        row = k - reach
        offset = op.Cast(row, to=DOUBLE.dtype)
        target = y + row
        inside = op.And(op.GreaterOrEqual(target, op.Constant(value_int=0)), op.Less(target, height))
        meets = op.And(inside, op.Greater(op.Abs(radius) + one, op.Abs(offset)))
        pixels = op.Squeeze(op.NonZero(meets), [0])
        r = op.Gather(radius, pixels)
        first = (offset - half) / r
        second = (offset + half) / r
        low = op.Max(op.Min(op.Min(first, second), top), bottom)
        high = op.Max(op.Min(op.Max(first, second), top), bottom)
        covered = high - low
        safe = op.Where(op.Greater(covered, tiny), covered, one)
        integral = edge_integrals(op.Concat(low, high, axis=0), knots, integrals, slopes, strides)
        before, after = op.Split(integral, axis=0, num_outputs=2)
        straight = (after - before) / op.Unsqueeze(safe, [1])
        arc = arc_integral((low - middle) / extent, (high - middle) / extent)
        round_part = bulge * extent * arc / safe
        left_edge = r * (op.Squeeze(op.Slice(straight, [0], [1], [1]), [1]) - round_part)
        right_edge = r * (op.Squeeze(op.Slice(straight, [1], [2], [1]), [1]) + round_part)
        weight = op.Where(op.Greater(covered, tiny), covered, zero) / (op.Abs(r) * whole)
        share = op.Gather(flat, pixels, axis=1) * weight
        base = (op.Div(pixels, width) + row) * (width + 2)
        here = op.Gather(x, pixels)
        wide = op.Cast(width, to=DOUBLE.dtype)  # here: outside, onnxruntime warns that it cannot optimise it away
        left = op.Max(op.Min(op.Min(left_edge, right_edge) + here, wide), zero)
        right = op.Max(op.Min(op.Max(left_edge, right_edge) + here, wide), zero)
        buffer = add_differences(buffer, base, left, right, share)
    padded = op.Concat(channels, op.Slice(shape, [0], [1]), op.Reshape(height, [1]), op.Reshape(width + 2, [1]), axis=0)
    planes = op.Transpose(op.Reshape(buffer, padded), perm=[1, 0, 2, 3])
    return op.Slice(planes, [0], op.Reshape(width, [1]), [3])


@script(DOMAIN)
def halved(x: FLOAT["B", "C", "H", "W"]) -> FLOAT["B", "C", "V", "H"]:
    """`torchbokeh.ops.composite._halved` along the last axis, which then goes before the other."""
    end = op.Constant(value_ints=[2147483647])
    odd = op.Mod(op.Shape(x, start=3), op.Constant(value_ints=[2]))
    none, one = op.Constant(value_ints=[0, 0, 0]), op.Constant(value_ints=[1])
    padded = op.Pad(x, op.Concat(none, odd, none, one, axis=0))
    outer = op.Slice(padded, [0], end, [3], [2])
    inner = op.Slice(padded, [1], end, [3], [2])
    before = op.Slice(outer, [0], [-1], [3])
    after = op.Slice(outer, [1], end, [3])
    sides = op.Where(op.Equal(odd, one), op.CastLike(0.5, x) * (before + after), before)
    return op.Transpose(inner + sides, perm=[0, 1, 3, 2])


@script(DOMAIN)
def doubled(x: FLOAT["B", "C", "H", "W"], n: INT64[1]) -> FLOAT["B", "C", "V", "H"]:
    """`torchbokeh.ops.composite._doubled` along the last axis, which then goes before the other."""
    end = op.Constant(value_ints=[2147483647])
    odd = op.Equal(op.Mod(n, op.Constant(value_ints=[2])), op.Constant(value_ints=[1]))
    half = op.CastLike(0.5, x)
    quarter = op.CastLike(0.25, x)
    before = op.Concat(op.Slice(x, [0], [1], [3]), op.Slice(x, [0], [-1], [3]), axis=3)
    after = op.Concat(op.Slice(x, [1], end, [3]), op.Slice(x, [-1], end, [3]), axis=3)
    first = op.Where(odd, x, x + quarter * (before - x))
    second = x + op.Where(odd, half, quarter) * (after - x)
    pairs = op.Concat(op.Unsqueeze(first, [4]), op.Unsqueeze(second, [4]), axis=4)
    whole = op.Reshape(pairs, op.Constant(value_ints=[0, 0, 0, -1]))
    return op.Transpose(op.Slice(whole, [0], n, [3]), perm=[0, 1, 3, 2])


def _schema(name, inputs, out="double"):
    formal = onnx.defs.OpSchema.FormalParameter
    given = [formal(k, f"tensor({dtype})") for k, dtype in inputs.items()]
    return onnx.defs.OpSchema(
        name, DOMAIN.domain, DOMAIN.version, inputs=given, outputs=[formal("out", f"tensor({out})")]
    )


_DOUBLES = ("values", "coc", "knots", "bulge", "integrals", "slopes", "whole")
SPLAT_ROWS = Op(DOMAIN, "splat_rows", _schema("splat_rows", dict.fromkeys(_DOUBLES, "double") | {"strides": "int64"}))
HALVED = Op(DOMAIN, "halved", _schema("halved", {"x": "float"}, "float"))
DOUBLED = Op(DOMAIN, "doubled", _schema("doubled", {"x": "float", "n": "int64"}, "float"))


def splat_spans(values, coc, knots, bulge, integrate=False):
    """Translation of the operator ``torchbokeh::splat_spans``."""
    heights, edges = op.Slice(knots, [0], [1], [1]), op.Slice(knots, [1], [3], [1])
    upper, lower = op.Slice(edges, [1], [2147483647], [0]), op.Slice(edges, [0], [-1], [0])
    rise = op.Sub(op.Slice(heights, [1], [2147483647], [0]), op.Slice(heights, [0], [-1], [0]))
    half = op.CastLike(0.5, knots)
    zero = op.CastLike(0.0, knots)
    pieces = op.Mul(op.Mul(half, op.Add(upper, lower)), rise)
    integrals = op.Concat(op.Mul(zero, op.Slice(edges, [0], [1], [0])), op.CumSum(pieces, 0), axis=0)
    flat = op.LessOrEqual(rise, op.CastLike(1e-9, knots))
    slopes = op.Where(flat, zero, op.Div(op.Sub(upper, lower), op.Where(flat, op.CastLike(1.0, knots), rise)))
    sides = op.Slice(integrals, [-1], [2147483647], [0])
    straight = op.Sub(op.Slice(sides, [1], [2], [1]), op.Slice(sides, [0], [1], [1]))
    height = op.ReduceSum(rise, keepdims=0)
    whole = op.Add(op.Squeeze(straight), op.Mul(op.Mul(op.CastLike(HALF_PI, knots), bulge), height))
    count = knots.shape[0]
    halvings = [2**k for k in reversed(range((count - 2).bit_length()))]
    strides = op.Constant(value=ir.tensor(halvings, dtype=ir.DataType.INT64))
    out = SPLAT_ROWS(
        op.Cast(values, to=DOUBLE.dtype), op.Cast(coc, to=DOUBLE.dtype), knots, bulge, integrals, slopes, whole, strides
    )
    if integrate:
        out = op.CumSum(out, -1)
    return op.CastLike(out, values)


def pull_push(values, weight):
    """Translation of the operator ``torchbokeh::pull_push``."""
    one = op.CastLike(1.0, values)
    tiny = op.CastLike(1e-12, values)
    known, share, levels = op.Mul(values, weight), weight, []

    for _ in range(LEVELS):
        levels.append((known, share))
        known, share = (HALVED(HALVED(x)) for x in (known, share))
        full = op.Min(share, one)
        known, share = op.Mul(known, op.Div(full, op.Max(share, tiny))), full
    filled = op.Div(known, op.Max(share, tiny))
    for known, share in reversed(levels):
        height, width = op.Shape(share, start=2, end=3), op.Shape(share, start=3)
        up = DOUBLED(DOUBLED(filled, width), height)
        filled = op.Add(known, op.Mul(op.Sub(one, share), up))
    return filled


def translations():
    """What each operator of this package becomes in an exported file."""
    operators = torch.ops.torchbokeh
    return {operators.splat_spans.default: splat_spans, operators.pull_push.default: pull_push}


def functions():
    """Functions of standard operators that an exported file has to hold."""
    calling = [f.to_function_proto() for f in (edge_integrals, arc_integral, add_differences, splat_rows)]
    own = onnx.helper.make_opsetid(DOMAIN.domain, DOMAIN.version)
    calling[-1].opset_import.append(own)  # onnxscript leaves it out, as the calls stand in a loop
    return [*calling, halved.to_function_proto(), doubled.to_function_proto()]
