"""Argument checks: each error names the argument, what was expected and what came."""

from collections.abc import Sequence

import torch
from torch import Tensor


def check_image(
    name: str,
    x: object,
    shape: Sequence[int | str | None],
    *,
    like: Tensor | None = None,
    integer: bool = False,
) -> Tensor:
    """Check that ``x`` is a tensor of the given shape and kind, and return it.

    Args:
        name: name of the argument, for the message.
        x: what the caller passed.
        shape: one entry per dimension; an ``int`` must match, a ``str`` only names the dimension.
        like: a tensor whose device ``x`` must share.
        integer: expect an integer tensor instead of a floating-point one.

    Raises:
        TypeError: not a tensor, or not of the expected kind of dtype.
        ValueError: wrong number of dimensions, wrong size, or another device.
    """
    if not isinstance(x, Tensor):
        raise TypeError(f"{name}: expected a tensor of shape {_written(shape)}, got {type(x).__name__}")
    if integer and (x.is_floating_point() or x.is_complex() or x.dtype == torch.bool):
        raise TypeError(f"{name}: expected an integer tensor, got {x.dtype}")
    if not integer and not x.is_floating_point():
        raise TypeError(f"{name}: expected a floating-point tensor, got {x.dtype}")
    fits = x.dim() == len(shape) and all(not isinstance(s, int) or s == n for s, n in zip(shape, x.shape, strict=True))
    if not fits:
        raise ValueError(f"{name}: expected shape {_written(shape)}, got {tuple(x.shape)}")
    if like is not None and x.device != like.device:
        raise ValueError(f"{name}: expected device {like.device}, got {x.device}")
    return x


def _written(shape: Sequence[int | str | None]) -> str:
    # Only ever called for an error: `torch.compile` cannot write down a size that is not fixed.
    return "(" + ", ".join(str(s) for s in shape) + ")"
