"""What the operators of this package become in an exported ONNX file: standard operators only.

`splat_rows`, what it calls, `halved` and `doubled` are functions of the file. `splat_rows` is a loop over the rows of
the PSFs, as `torchbokeh.ops.splat` has it.
"""

# ruff: noqa: F821 (names of sizes)

import onnx
import torch
from onnxscript import DOUBLE, FLOAT, INT64, ir, script
from onnxscript import opset18 as op
from onnxscript.values import Op

from torchbokeh.ops.onnx_outline import DOMAIN, FUNCTIONS, mean_edges, row_pieces, side_arcs

HALF_PI = 1.5707963267948966
LEVELS = 14
"""Of the pyramid of `pull_push`: enough for 16384 px. From one pixel on, a further level changes nothing."""


@script(DOMAIN)
def add_differences(
    buffer: DOUBLE["C", "P"], index: INT64["M"], part: DOUBLE["M"], share: DOUBLE["C", "M"]
) -> DOUBLE["C", "P"]:
    """Add to the columns ``index`` and to the next, by the ``part`` of these."""
    behind = share * part
    both = op.Concat(index, index + 1, axis=0)
    update = op.Concat(share - behind, behind, axis=1)
    # Not ScatterND: the threads of onnxruntime lose some of what it adds to one place.
    return op.ScatterElements(buffer, op.Expand(both, op.Shape(update)), update, axis=1, reduction="add")


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
    left_turn, left_pieces, left_keys = side_arcs(op.Constant(value_int=0), knots, slopes, bulge, strides)
    right_turn, right_pieces, right_keys = side_arcs(op.Constant(value_int=2), knots, slopes, bulge, strides)
    turns = op.Concat(op.Reshape(left_turn, [1]), op.Reshape(right_turn, [1]), axis=0)
    pieces = op.Concat(left_pieces, right_pieces, axis=0)
    keys = op.Concat(left_keys, right_keys, axis=0)
    cells = op.Div(count, width) * (width + 2)
    buffer = op.Expand(zero, op.Concat(channels, op.Reshape(cells, [1]), axis=0))
    for k in range(2 * reach + 1):
        row = k - reach
        offset = op.Cast(row, to=DOUBLE.dtype)
        target = y + row
        inside = op.And(op.GreaterOrEqual(target, op.Constant(value_int=0)), op.Less(target, height))
        meets = op.And(inside, op.Greater(op.Abs(radius) + one, op.Abs(offset)))
        pixels = op.Squeeze(op.NonZero(meets), [0])
        wide = op.Cast(width, to=DOUBLE.dtype)  # here: outside, onnxruntime warns that it cannot optimise it away
        frame = op.Concat(op.Reshape(offset, [1]), op.Reshape(wide, [1]), axis=0)
        near = op.Gather(radius, pixels)
        owner, arc, low, high, column = row_pieces(
            near, op.Gather(x, pixels), frame, knots, slopes, bulge, turns, keys, pieces, strides
        )
        r = op.Gather(near, owner)
        owned = op.Gather(pixels, owner)
        mean, weight = mean_edges(r, arc, low, high, knots, integrals, slopes, bulge, whole, strides)
        kept = op.Max(column, zero)
        within = op.And(op.GreaterOrEqual(column, zero), op.Less(column, wide))
        part = op.Where(within, op.Min(op.Max(op.Gather(x, owned) + mean - kept, zero), one), zero)
        index = (op.Div(owned, width) + row) * (width + 2) + op.Cast(kept, to=INT64.dtype)
        buffer = add_differences(buffer, index, part, op.Gather(flat, owned, axis=1) * weight)
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


_CALLING = (*FUNCTIONS, add_differences, splat_rows)


def functions():
    """Functions of standard operators that an exported file has to hold."""
    calling = [f.to_function_proto() for f in _CALLING]
    own = onnx.helper.make_opsetid(DOMAIN.domain, DOMAIN.version)
    calling[-1].opset_import.append(own)  # onnxscript leaves it out, as the calls stand in a loop
    return [*calling, halved.to_function_proto(), doubled.to_function_proto()]
