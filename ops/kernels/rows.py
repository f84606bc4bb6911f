"""Rows of PSFs as short lists of points, and loops over them and over the pixels of a row.

The loops are vector code: numba alone leaves four lanes apart. Lanes are four interleaved channels. As for
`torchbokeh.ops.kernels.interleave`: after a change here, remove the ``__pycache__`` beside it.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numba as nb
import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.types.containers import UniTuple
from numba.core.types.misc import CPointer
from numba.extending import intrinsic

_D4 = ir.VectorType(ir.DoubleType(), 4)
_F4 = ir.VectorType(ir.FloatType(), 4)
_I64 = ir.IntType(64)


class PsfPoints(NamedTuple):
    """Points of PSFs: ``places (R, 4)`` int32, the row, the column, that of the mirror image, and 0; ``weights (R,)``;
    and their ``slopes (R,)``, derivatives by the radius, empty if they were not asked for.

    Of shapes that are even, each point stands for two: its mirror image has the opposite weight. ``scratch`` is what
    they are made in, see `torchbokeh.ops.kernels.outline.PsfBuffer`: it has to live as long as they do.
    """

    places: np.ndarray
    weights: np.ndarray
    slopes: np.ndarray
    scratch: np.ndarray


def _data(context: Any, builder: Any, array_type: Any, array: Any) -> Any:
    return context.make_array(array_type)(context, builder, array).data


def _load(builder: Any, data: Any, index: Any, vector: Any) -> Any:
    out = builder.load(builder.bitcast(builder.gep(data, [index]), vector.as_pointer()))
    out.align = 4 if vector is _F4 else 8
    return out


def _store(builder: Any, value: Any, data: Any, index: Any) -> None:
    done = builder.store(value, builder.bitcast(builder.gep(data, [index]), value.type.as_pointer()))
    done.align = 4 if value.type is _F4 else 8


def _picked(builder: Any, vector: Any, lanes: list[int]) -> Any:
    """These lanes of a vector, as a vector."""
    undefined = ir.Constant(vector.type, ir.Undefined)
    return builder.shuffle_vector(vector, undefined, ir.Constant(ir.VectorType(ir.IntType(32), len(lanes)), lanes))


def _times(builder: Any, k: Any, factor: int, plus: int = 0) -> Any:
    return builder.add(builder.mul(k, _I64(factor)), _I64(plus))


def _loop(builder: Any, start: Any, stop: Any) -> Iterator[Any]:
    """A loop that is not unrolled: most have a few turns."""
    before, body, after = builder.block, builder.append_basic_block("rows"), builder.append_basic_block("rows_end")
    builder.cbranch(builder.icmp_signed("<", start, stop), body, after)
    builder.position_at_end(body)
    k = builder.phi(_I64)
    k.add_incoming(start, before)
    yield k
    following = builder.add(k, _I64(1))
    k.add_incoming(following, builder.block)
    back = builder.cbranch(builder.icmp_signed("<", following, stop), body, after)
    module = builder.module
    once = module.add_metadata([ir.MetaDataString(module, "llvm.loop.unroll.disable")])
    back.set_metadata("llvm.loop", _distinct(module, once))
    builder.position_at_end(after)


def _distinct(module: Any, *parts: Any) -> Any:
    """Metadata of a loop: its first part is itself, which makes it one of a kind."""
    found = module.add_metadata([ir.Constant(ir.IntType(32), len(module.metadata)), *parts])
    found.operands = (found, *parts)
    return found


def _points(
    builder: Any, rows: list[tuple[Any, bool]], stride: Any, places: Any, span: Any, sides: int
) -> Iterator[tuple[Any, list[Any]]]:
    """In a loop over the points of a span: the number of the point, and where it and its mirror images lie.

    ``rows`` are where row 0 lies, of those that go down and of those that go up.
    """
    for k in _loop(builder, *cgutils.unpack_tuple(builder, span)):
        row, *columns = (
            builder.sext(builder.load(builder.gep(places, [_times(builder, k, 4, field)])), _I64)
            for field in range(1 + sides)
        )
        down = builder.mul(row, stride)
        starts = [builder.sub(o, down) if up else builder.add(o, down) for o, up in rows]
        yield k, [builder.add(start, _times(builder, column, 4)) for start in starts for column in columns]


def _plus_product(builder: Any, total: Any, lanes: Any, table: Any, index: Any, sign: int = 1) -> Any:
    factor = _picked(builder, _load(builder, table, index, ir.VectorType(ir.DoubleType(), 1)), [0] * 4)
    product = builder.fmul(lanes, factor, flags=("contract",))
    return (builder.fadd if sign > 0 else builder.fsub)(total, product, flags=("contract",))


def _kinds(builder: Any, even: Any, both: Any, o: Any, above: Any) -> Iterator[tuple[int, list[tuple[Any, bool]], Any]]:
    for sides, mirrored in ((2, even), (1, builder.not_(even))):
        yield sides, [(o, False)], builder.and_(mirrored, builder.not_(both))
        yield sides, [(o, False), (above, True)], builder.and_(mirrored, both)


@intrinsic
def draw_points(typingctx, band, o, stride, source, points, span, even):  # type: ignore[no-untyped-def]
    """Add ``span[0] .. span[1]-1`` of `PsfPoints` to ``band``, where column 0 of row 0 of the PSF lies at ``o[0]``.

    Where ``o[1]`` is not negative, the rows go up from there as well.

    ``source`` are the pixels and the place of the one that is spread: each point adds ``src[p:p+4]`` times its weight.
    """

    def build(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        band, o, stride, source, points, span, even = args
        o, above = (builder.extract_value(o, k) for k in range(2))
        src, p = (builder.extract_value(source, k) for k in range(2))
        band_data, src_data = (
            _data(context, builder, kind, array) for kind, array in ((sig.args[0], band), (sig.args[3].types[0], src))
        )
        places, weights = (
            _data(context, builder, sig.args[4].types[k], builder.extract_value(points, k)) for k in range(2)
        )
        pixel = builder.fpext(_load(builder, src_data, p, _F4), _D4)
        both = builder.icmp_signed(">=", above, _I64(0))
        for sides, rows, wanted in _kinds(builder, even, both, o, above):
            with builder.if_then(wanted):
                for k, places_of in _points(builder, rows, stride, places, span, sides):
                    for number, at in enumerate(places_of):
                        before = _load(builder, band_data, at, _D4)
                        after = _plus_product(builder, before, pixel, weights, k, 1 - 2 * (number % sides))
                        _store(builder, after, band_data, at)
        return context.get_dummy_value()

    i64 = types.int64
    return types.void(band, UniTuple(i64, 2), i64, source, points, UniTuple(i64, 2), types.boolean), build


@intrinsic
def gather_points(typingctx, sums, o, stride, points, span, even, found):  # type: ignore[no-untyped-def]
    """The transpose of `draw_points`: adds to ``found[0:4]`` by the weights, to ``found[4:8]`` by their slopes."""

    def build(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        sums, o, stride, points, span, even, found = args
        sums_data, found_data = (
            _data(context, builder, kind, array) for kind, array in ((sig.args[0], sums), (sig.args[6], found))
        )
        places, *tables = (
            _data(context, builder, sig.args[3].types[k], builder.extract_value(points, k)) for k in range(3)
        )
        totals = [cgutils.alloca_once_value(builder, _load(builder, found_data, _I64(4 * k), _D4)) for k in range(2)]
        with builder.if_else(even) as (mirrored, plain):
            for branch, sides in ((mirrored, 2), (plain, 1)):
                with branch:
                    for k, here in _points(builder, [(o, False)], stride, places, span, sides):
                        lanes = _load(builder, sums_data, here[0], _D4)
                        if sides == 2:
                            lanes = builder.fsub(lanes, _load(builder, sums_data, here[1], _D4))
                        for table, total in zip(tables, totals, strict=True):
                            builder.store(_plus_product(builder, builder.load(total), lanes, table, k), total)
        for k, total in enumerate(totals):
            _store(builder, builder.load(total), found_data, _I64(4 * k))
        return context.get_dummy_value()

    i64 = types.int64
    return types.void(sums, i64, i64, points, UniTuple(i64, 2), types.boolean, found), build


@intrinsic
def pointer(typingctx, array):  # type: ignore[no-untyped-def]
    """Where the numbers of an array lie: to be handed on where numba would count references to it."""

    def build(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _data(context, builder, sig.args[0], args[0])

    return CPointer(array.dtype)(array), build


@nb.njit(inline="always")
def rows_within(first, n, y0, y1):  # type: ignore[no-untyped-def]
    """From which to which of the ``n`` rows of a PSF that starts in row ``first`` lie in the rows ``y0 .. y1-1``."""
    skipped = min(max(y0 - first, 0), n)
    return skipped, max(min(y1 - first, n), skipped)


@nb.njit(inline="always")
def rows_above(first, y, n, y0, y1):  # type: ignore[no-untyped-def]
    """`rows_within` of the mirror images of the rows of a level PSF centred on row ``y``, that in ``y`` left out.

    They run upwards from row ``y - first``.
    """
    return rows_within(first - y, n, max(1 - y1, 1 - y), 1 - y0)


@intrinsic
def running_sum(typingctx, band, o, skipped, fine, row, count):  # type: ignore[no-untyped-def]
    """``row[:4*count]``: running sum in double of ``band`` from ``o`` on, after ``skipped`` columns, plus ``fine``."""

    def build(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        _, o, skipped, _, _, count = args
        band_data, fine_data, row_data = (_data(context, builder, sig.args[k], args[k]) for k in (0, 3, 4))
        total = cgutils.alloca_once_value(builder, ir.Constant(_D4, [0.0] * 4))

        def step(at: Any) -> Any:
            new = builder.fadd(builder.load(total), _load(builder, band_data, at, _D4))
            builder.store(new, total)
            return new

        with cgutils.for_range(builder, skipped) as loop:
            step(builder.add(o, _times(builder, loop.index, 4)))
        begin = builder.add(o, _times(builder, skipped, 4))
        with cgutils.for_range(builder, count) as loop:
            p = _times(builder, loop.index, 4)
            new = builder.fptrunc(step(builder.add(begin, p)), _F4)
            _store(builder, builder.fadd(new, _load(builder, fine_data, p, _F4)), row_data, p)
        return context.get_dummy_value()

    i64 = types.int64
    return types.void(band, i64, i64, fine, row, i64), build
