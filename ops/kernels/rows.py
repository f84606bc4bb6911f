"""Rows of PSFs as short lists of points, and loops over them and over the pixels of a row.

The loops are vector code: numba alone leaves four lanes apart. Lanes are four interleaved channels. As for
`torchbokeh.ops.kernels.interleave`: after a change here, remove the ``__pycache__`` beside it.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.types.containers import UniTuple
from numba.extending import intrinsic

_D4 = ir.VectorType(ir.DoubleType(), 4)
_F4 = ir.VectorType(ir.FloatType(), 4)
_I64 = ir.IntType(64)


class PsfRows(NamedTuple):
    """Rows of PSFs: ``columns (R, 2)``, the whole column of the left and of the right end; ``weights (R, 4)``, what the
    left end adds to its column and the next, then the right end; and their ``slopes (R, 4)``, derivatives by the
    radius, empty if they were not asked for.
    """

    columns: np.ndarray
    weights: np.ndarray
    slopes: np.ndarray


def _data(context: Any, builder: Any, array_type: Any, array: Any) -> Any:
    return context.make_array(array_type)(context, builder, array).data


def _tables(context: Any, builder: Any, rows_type: Any, rows: Any) -> list[Any]:
    """The data of all arrays of `PsfRows`."""
    fields = enumerate(rows_type.types)
    return [_data(context, builder, kind, builder.extract_value(rows, k)) for k, kind in fields]


def _load(builder: Any, data: Any, index: Any, vector: Any) -> Any:
    out = builder.load(builder.bitcast(builder.gep(data, [index]), vector.as_pointer()))
    out.align = 4 if vector is _F4 else 8
    return out


def _store(builder: Any, value: Any, data: Any, index: Any) -> None:
    done = builder.store(value, builder.bitcast(builder.gep(data, [index]), value.type.as_pointer()))
    done.align = 4 if value.type is _F4 else 8


def _splat(builder: Any, value: Any) -> Any:
    """A scalar in all four lanes."""
    undefined = ir.Constant(_D4, ir.Undefined)
    first = builder.insert_element(undefined, value, ir.IntType(32)(0))
    return builder.shuffle_vector(first, undefined, ir.Constant(ir.VectorType(ir.IntType(32), 4), [0] * 4))


def _times(builder: Any, k: Any, factor: int, plus: int = 0) -> Any:
    return builder.add(builder.mul(k, _I64(factor)), _I64(plus))


def _points(builder: Any, o: Any, stride: Any, columns: Any, span: Any) -> Iterator[tuple[Any, int, Any]]:
    """In a loop over the rows of a span, for each point: the number of its row, its own, and where it lies."""
    start, stop = cgutils.unpack_tuple(builder, span)
    with cgutils.for_range_slice(builder, start, stop, _I64(1), _I64) as (k, _):
        row = builder.add(o, builder.mul(builder.sub(k, start), stride))
        for end in range(2):
            column = builder.load(builder.gep(columns, [_times(builder, k, 2, end)]))
            at = builder.add(row, _times(builder, column, 4))
            for side in range(2):
                yield k, 2 * end + side, builder.add(at, _I64(4 * side))


def _plus_product(builder: Any, total: Any, lanes: Any, table: Any, index: Any) -> Any:
    product = builder.fmul(lanes, _splat(builder, builder.load(builder.gep(table, [index]))), flags=("contract",))
    return builder.fadd(total, product, flags=("contract",))


@intrinsic
def draw_rows(typingctx, band, o, stride, src, p, rows, span):  # type: ignore[no-untyped-def]
    """Add the rows ``span[0] .. span[1]-1`` of `PsfRows`, the first of them to the row of ``band`` at ``o``.

    Each end adds ``src[p:p+4]`` to its column and to the next, by its weights.
    """

    def build(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        band, o, stride, src, p, rows, span = args
        band_data, src_data = _data(context, builder, sig.args[0], band), _data(context, builder, sig.args[3], src)
        columns_data, weights_data, _ = _tables(context, builder, sig.args[5], rows)
        pixel = builder.fpext(_load(builder, src_data, p, _F4), _D4)
        for k, point, here in _points(builder, o, stride, columns_data, span):
            before = _load(builder, band_data, here, _D4)
            index = _times(builder, k, 4, point)
            _store(builder, _plus_product(builder, before, pixel, weights_data, index), band_data, here)
        return context.get_dummy_value()

    i64 = types.int64
    return types.void(band, i64, i64, src, i64, rows, UniTuple(i64, 2)), build


@intrinsic
def gather_rows(typingctx, sums, o, stride, rows, span, found):  # type: ignore[no-untyped-def]
    """The transpose of `draw_rows`: ``found[0:4]`` by the weights, ``found[4:8]`` by the slopes of the weights."""

    def build(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        sums, o, stride, rows, span, found = args
        sums_data, found_data = _data(context, builder, sig.args[0], sums), _data(context, builder, sig.args[5], found)
        columns_data, *tables = _tables(context, builder, sig.args[3], rows)
        zero = ir.Constant(_D4, [0.0] * 4)
        totals = [cgutils.alloca_once_value(builder, zero) for _ in tables]
        for k, point, here in _points(builder, o, stride, columns_data, span):
            lanes, index = _load(builder, sums_data, here, _D4), _times(builder, k, 4, point)
            for table, total in zip(tables, totals, strict=True):
                builder.store(_plus_product(builder, builder.load(total), lanes, table, index), total)
        for k, total in enumerate(totals):
            _store(builder, builder.load(total), found_data, _I64(4 * k))
        return context.get_dummy_value()

    i64 = types.int64
    return types.void(sums, i64, i64, rows, UniTuple(i64, 2), found), build


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
