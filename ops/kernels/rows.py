"""Loops over the rows of a PSF and over the pixels of a row, as vector code: numba alone leaves four lanes apart.

Lanes are four interleaved channels. As for `torchbokeh.ops.kernels.interleave`: after a change here, remove the
``__pycache__`` beside it.
"""

from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

_D4 = ir.VectorType(ir.DoubleType(), 4)
_F4 = ir.VectorType(ir.FloatType(), 4)
_I64 = ir.IntType(64)


def _data(context: Any, builder: Any, sig: Any, args: Any, k: int) -> Any:
    return context.make_array(sig.args[k])(context, builder, args[k]).data


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


@intrinsic
def draw_rows(typingctx, band, o, stride, src, p, columns, weights, start, stop):  # type: ignore[no-untyped-def]
    """Add the rows ``start .. stop-1`` of a PSF, the first of them to the row of ``band`` at ``o``.

    Each end adds ``src[p:p+4]`` to its column and to the next, by its weights; see `_psf_bank.Bank`.
    """

    def build(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        _, o, stride, _, p, _, _, start, stop = args
        band_data, src_data, columns_data, weights_data = (_data(context, builder, sig, args, k) for k in (0, 3, 5, 6))
        pixel = builder.fpext(_load(builder, src_data, p, _F4), _D4)
        with cgutils.for_range_slice(builder, start, stop, _I64(1), _I64) as (k, _):
            row = builder.add(o, builder.mul(builder.sub(k, start), stride))
            for end in range(2):
                column = builder.load(builder.gep(columns_data, [_times(builder, k, 2, end)]))
                at = builder.add(row, _times(builder, column, 4))
                for side in range(2):
                    weight = builder.load(builder.gep(weights_data, [_times(builder, k, 4, 2 * end + side)]))
                    here = builder.add(at, _I64(4 * side))
                    product = builder.fmul(pixel, _splat(builder, weight), flags=("contract",))
                    total = builder.fadd(_load(builder, band_data, here, _D4), product, flags=("contract",))
                    _store(builder, total, band_data, here)
        return context.get_dummy_value()

    i64 = types.int64
    return types.void(band, i64, i64, src, i64, columns, weights, i64, i64), build


@intrinsic
def gather_rows(typingctx, sums, o, stride, columns, weights, slopes, start, stop, found):  # type: ignore[no-untyped-def]
    """The transpose of `draw_rows`: ``found[0:4]`` by the weights, ``found[4:8]`` by the slopes of the weights."""

    def build(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        _, o, stride, _, _, _, start, stop, _ = args
        sums_data, columns_data, *tables, found_data = (_data(context, builder, sig, args, k) for k in (0, 3, 4, 5, 8))
        zero = ir.Constant(_D4, [0.0] * 4)
        totals = [cgutils.alloca_once_value(builder, zero) for _ in tables]
        with cgutils.for_range_slice(builder, start, stop, _I64(1), _I64) as (k, _):
            row = builder.add(o, builder.mul(builder.sub(k, start), stride))
            for end in range(2):
                column = builder.load(builder.gep(columns_data, [_times(builder, k, 2, end)]))
                at = builder.add(row, _times(builder, column, 4))
                for side in range(2):
                    lanes = _load(builder, sums_data, builder.add(at, _I64(4 * side)), _D4)
                    for table, total in zip(tables, totals, strict=True):
                        weight = builder.load(builder.gep(table, [_times(builder, k, 4, 2 * end + side)]))
                        product = builder.fmul(lanes, _splat(builder, weight), flags=("contract",))
                        builder.store(builder.fadd(builder.load(total), product, flags=("contract",)), total)
        for k, total in enumerate(totals):
            _store(builder, builder.load(total), found_data, _I64(4 * k))
        return context.get_dummy_value()

    i64 = types.int64
    return types.void(sums, i64, i64, columns, weights, slopes, i64, i64, found), build


@intrinsic
def running_sum(typingctx, band, o, skipped, fine, row, count):  # type: ignore[no-untyped-def]
    """``row[:4*count]``: running sum in double of ``band`` from ``o`` on, after ``skipped`` columns, plus ``fine``."""

    def build(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        _, o, skipped, _, _, count = args
        band_data, fine_data, row_data = (_data(context, builder, sig, args, k) for k in (0, 3, 4))
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
