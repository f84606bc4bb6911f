"""Pixels interleaved in fours (RGB and coverage, say), and vector operations that add one to a buffer.

numba caches compiled kernels by the file they stand in, which these are not: after a change here, remove the
``__pycache__`` beside it.
"""

from typing import Any

import torch
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic
from torch import Tensor


def _add(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """LLVM code of `add_one` and `add_pair`: one load, multiply, add and store for all weights together."""
    out, o, src, p, *weights = args
    lanes = range(4 * len(weights))
    indices = ir.VectorType(ir.IntType(32), len(lanes))
    f4 = ir.VectorType(ir.FloatType(), 4)
    doubles = ir.VectorType(ir.DoubleType(), len(lanes))
    d4 = ir.VectorType(ir.DoubleType(), 4)
    undefined = ir.Constant(d4, ir.Undefined)
    out_data = context.make_array(sig.args[0])(context, builder, out).data
    src_data = context.make_array(sig.args[2])(context, builder, src).data
    out_ptr = builder.bitcast(builder.gep(out_data, [o]), doubles.as_pointer())
    src_ptr = builder.bitcast(builder.gep(src_data, [p]), f4.as_pointer())
    pixel = builder.load(src_ptr)
    pixel.align = 4
    pixel = builder.fpext(pixel, d4)
    factors = undefined
    for k, weight in enumerate(weights):
        factors = builder.insert_element(factors, weight, ir.IntType(32)(k))
    pixel = builder.shuffle_vector(pixel, undefined, ir.Constant(indices, [k % 4 for k in lanes]))
    factors = builder.shuffle_vector(factors, undefined, ir.Constant(indices, [k // 4 for k in lanes]))
    product = builder.fmul(pixel, factors)
    old = builder.load(out_ptr)
    old.align = 8
    store = builder.store(builder.fadd(old, product), out_ptr)
    store.align = 8
    return context.get_dummy_value()


@intrinsic
def add_one(typingctx: Any, out: Any, o: Any, src: Any, p: Any, w: Any) -> Any:
    """``out[o:o+4] += w * src[p:p+4]``, double += double * float, as one vector."""
    return types.void(out, types.int64, src, types.int64, types.float64), _add


@intrinsic
def add_pair(typingctx: Any, out: Any, o: Any, src: Any, p: Any, w0: Any, w1: Any) -> Any:
    """``out[o:o+4] += w0 * src[p:p+4]; out[o+4:o+8] += w1 * src[p:p+4]``, double += double * float, as one vector."""
    return types.void(out, types.int64, src, types.int64, types.float64, types.float64), _add


def interleave(values: Tensor) -> Tensor:
    """``(B, C, H, W) -> (B*G, H, W, 4)`` with G groups of four channels, the last one filled up with zeros."""
    b, c, h, w = values.shape
    groups = -(-c // 4)
    if c % 4:
        values = torch.nn.functional.pad(values, (0, 0, 0, 0, 0, 4 * groups - c))
    return values.reshape(b * groups, 4, h, w).permute(0, 2, 3, 1).contiguous()


def separate(lanes: Tensor, channels: int) -> Tensor:
    """Undo `interleave`: ``(B*G, H, W, 4) -> (B, C, H, W)``."""
    _, h, w, _ = lanes.shape
    groups = -(-channels // 4)
    return lanes.permute(0, 3, 1, 2).reshape(-1, 4 * groups, h, w)[:, :channels].contiguous()
