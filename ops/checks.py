"""Argument checks: each error names the argument, what was expected and what came."""

import math
import sys
from collections.abc import Iterable, Sequence
from numbers import Integral, Real
from typing import TypeGuard

import torch
from torch import Tensor

MOST_PIXELS = 1 << 27
"""Pixels of a picture, at most (134 megapixels): whoever asks for more is refused before memory is."""


def check_pixels(name: str, height: int, width: int) -> None:
    """Raise a ValueError for a picture of more than `MOST_PIXELS`."""
    if height * width > MOST_PIXELS:
        raise ValueError(f"{name}: expected at most {MOST_PIXELS} pixels, got {width} x {height}")


def is_whole(value: object) -> TypeGuard[int]:
    """Whether ``value`` is a whole number; a bool is none."""
    return isinstance(value, Integral) and not isinstance(value, bool)


def is_number(value: object) -> TypeGuard[float]:
    """Whether ``value`` is a real number; a bool is none."""
    return isinstance(value, Real) and not isinstance(value, bool)


def check_whole(name: str, value: object, low: int, high: int = sys.maxsize) -> int:
    """Check a whole number from ``low`` to ``high``, and return it.

    Raises:
        TypeError: another kind of value.
        ValueError: out of its range.
    """
    if not is_whole(value):
        raise TypeError(f"{name}: expected an int, got {value!r}")
    number = int(value)
    if number < low:
        raise ValueError(f"{name}: expected at least {low}, got {number}")
    if number > high:
        raise ValueError(f"{name}: expected at most {high}, got {number}")
    return number


def check_count(name: str, value: object, low: int, high: int) -> int:
    """As `check_whole`, for a range so narrow that the message names both of its ends."""
    if not is_whole(value):
        raise TypeError(f"{name}: expected an int, got {type(value).__name__}")
    if not low <= value <= high:
        raise ValueError(f"{name}: expected {low} to {high}, got {value}")
    return int(value)


def check_number(name: str, value: object, low: float | None = None, high: float = math.inf) -> float:
    """As `check_whole`, for a number; NaN is out of every range. Without ``low``, only that it is one."""
    if not is_number(value):
        raise TypeError(f"{name}: expected a number, got {value!r}")
    number = float(value)
    if low is not None and not low <= number <= high:
        raise ValueError(f"{name}: expected a number from {low:g} to {high:g}, got {number:g}")
    return number


def check_finite(name: str, value: object, low: float, *, above: bool = False) -> float:
    """As `check_number`, for a finite number of at least ``low``, or only above it."""
    number = check_number(name, value)
    if not low <= number < math.inf or (above and number == low):
        bound = "above" if above else "of at least"
        raise ValueError(f"{name}: expected a finite number {bound} {low:g}, got {number}")
    return number


def check_flag(name: str, value: object) -> bool:
    """Check that ``value`` is a bool, and return it."""
    if not isinstance(value, bool):
        raise TypeError(f"{name}: expected a bool, got {value!r}")
    return value


def check_choice(name: str, value: object, choices: Iterable[str]) -> None:
    """Raise a ValueError unless ``value`` is one of the names."""
    if not isinstance(value, str) or value not in choices:
        raise ValueError(f"{name}: expected one of {', '.join(map(repr, choices))}, got {value!r}")


def check_kind(name: str, value: object, kind: type, *, optional: bool = False) -> None:
    """Raise a TypeError unless ``value`` is a ``kind``, or None where it is ``optional``."""
    if not isinstance(value, kind) and not (optional and value is None):
        article = "an" if kind.__name__[0] in "AEIOUaeiou" else "a"
        wanted = f"{article} {kind.__name__}{' or None' if optional else ''}"
        raise TypeError(f"{name}: expected {wanted}, got {type(value).__name__}")


def check_size(size: Sequence[int], name: str = "size") -> tuple[int, int]:
    """The height and the width of a ``size`` (H, W) in pixels, both at least 1.

    Raises:
        TypeError: not two integers.
        ValueError: one of them is below 1, or they make up more than `MOST_PIXELS`.

    Example:
        >>> check_size([3, 5])
        (3, 5)
    """
    pair = tuple(size) if isinstance(size, Sequence) and not isinstance(size, str) else ()
    if len(pair) != 2 or not all(is_whole(n) for n in pair):
        raise TypeError(f"{name}: expected two integers (H, W), got {size!r}")
    if min(pair) < 1:
        raise ValueError(f"{name}: expected (H, W) of at least 1, got {size!r}")
    check_pixels(name, *pair)
    return int(pair[0]), int(pair[1])


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


def not_finite(x: Tensor) -> str:
    """How many entries are not finite, for a message, and which is the first of them.

    Example:
        >>> not_finite(torch.tensor([1.0, 7e4]).half())
        '1 that are not, first inf: float16 ends at 65504'
    """
    wrong = x.detach()[~x.detach().isfinite()]
    end = f": {str(x.dtype).removeprefix('torch.')} ends at {torch.finfo(x.dtype).max:g}"
    cause = end if x.dtype.itemsize < 4 and bool(wrong[0].isinf()) else ""
    return f"{len(wrong)} that are not, first {wrong[0].item()}{cause}"


def _written(shape: Sequence[int | str | None]) -> str:
    # Only ever called for an error: `torch.compile` cannot write down a size that is not fixed.
    return "(" + ", ".join(str(s) for s in shape) + ")"
