"""Maps over the picture: how strong an effect is at each angle of view, as a composition of two simple functions."""

import math
import re
from collections.abc import Callable
from functools import cached_property

import torch
from torch import Tensor

BOUND = 20.0
"""Largest value of a reciprocal: it is bounded where its argument goes to 0."""


MIDDLE = 1e-12
"""Square of a distance in px below which a place counts as the middle."""


class Field:
    """Where the pixels of a picture are.

    Args:
        x: ``(H, W)`` to the right from the middle of the sensor, in px.
        y: ``(H, W)`` downwards from there, in px.
        size: ``(H, W)`` of the sensor in px.
    """

    def __init__(self, x: Tensor, y: Tensor, size: tuple[int, int]) -> None:
        self.x, self.y, self.size = x, y, size

    @classmethod
    def pixels(cls, size: tuple[int, int], margin: int, like: Tensor) -> "Field":
        """The field of a picture of ``(H, W)`` px, of which ``margin`` px on each side lie beyond the sensor."""
        height, width = size
        y, x = (torch.arange(n, dtype=like.dtype, device=like.device) - (n - 1) / 2 for n in size)
        sensor = height - 2 * margin, width - 2 * margin
        return cls(x.expand(height, width), y[:, None].expand(height, width), sensor)

    @cached_property
    def t(self) -> Tensor:
        """Distance from the middle ``(H, W)``; 1 in the corners of the sensor."""
        square = self._square
        # The root has no slope in the middle, and the angle no value.
        middle = square < MIDDLE
        return torch.where(middle, 1.0, square).sqrt() * ~middle / (math.hypot(*self.size) / 2)

    @cached_property
    def theta(self) -> Tensor:
        """Angle about the middle ``(H, W)`` in radians, 0 to the right and pi / 2 downwards."""
        middle = self._square < MIDDLE
        return torch.atan2(torch.where(middle, 0.0, self.y), torch.where(middle, 1.0, self.x))

    @property
    def _square(self) -> Tensor:
        return self.x.square() + self.y.square()


def _identity(t: Tensor, _: Tensor) -> Tensor:
    return t


def _square(t: Tensor, _: Tensor) -> Tensor:
    return t.square()


def _cube(t: Tensor, _: Tensor) -> Tensor:
    return t**3


def _exp(t: Tensor, _: Tensor) -> Tensor:
    return t.clamp(max=BOUND).exp()


def _inversion(t: Tensor, _: Tensor) -> Tensor:
    return 1 - t


def _reciprocal(t: Tensor, _: Tensor) -> Tensor:
    return torch.where(t < 0, -1.0, 1.0) / t.abs().clamp_min(1 / BOUND)


def _cosine(t: Tensor, _: Tensor) -> Tensor:
    return (2 * math.pi * t).cos()


def _angular(t: Tensor, theta: Tensor) -> Tensor:
    return t * theta.cos()


_ATOMS: dict[str, tuple[Callable[[Tensor, Tensor], Tensor], str]] = {
    "identity": (_identity, "{0}"),
    "square": (_square, "{1}**2"),
    "cube": (_cube, "{1}**3"),
    "exp": (_exp, "exp({0})"),
    "inversion": (_inversion, "1 - {1}"),
    "reciprocal": (_reciprocal, "1 / {1}"),
    "cosine": (_cosine, "cos(2 pi {1})"),
    "angular": (_angular, "{1} cos(theta)"),
}
"""Each function, and its formula: {0} is its argument, {1} that in brackets where it needs them."""

Atom = str | Callable[[Tensor, Tensor], Tensor]


class FieldMap:
    """A function of the distance t from the middle of the picture and the angle theta, (4.9) of the dissertation.

    ``post(pre(t, theta), theta)``, of functions by name: ``"identity"``, ``"square"``, ``"cube"``, ``"exp"``,
    ``"inversion"`` (1 - t), ``"reciprocal"`` (1 / t), ``"cosine"`` (cos 2 pi t), ``"angular"`` (t cos theta); or any
    callable of two tensors. Reciprocals stay within `BOUND`: 1 / t does so up to t = 0.05, and 1 / (1 - t), the
    reciprocal of the inversion, from t = 0.95 on.

    Args:
        pre: applied first.
        post: applied to its result.

    Raises:
        TypeError: neither a name nor callable.
        ValueError: an unknown name.

    Example:
        >>> FieldMap("inversion", "exp")
        FieldMap(exp(1 - t))
        >>> FieldMap("inversion", "reciprocal")(torch.tensor([0.0, 0.5, 1.0]), torch.zeros(3)).tolist()
        [1.0, 2.0, 20.0]
    """

    def __init__(self, pre: Atom = "identity", post: Atom = "identity") -> None:
        for name, atom in (("pre", pre), ("post", post)):
            if not isinstance(atom, str) and not callable(atom):
                raise TypeError(f"{name}: expected a name or a callable of two tensors, got {type(atom).__name__}")
            if isinstance(atom, str) and atom not in _ATOMS:
                raise ValueError(f"{name}: expected one of {', '.join(_ATOMS)} or a callable, got {atom!r}")
        self.pre, self.post = pre, post

    def __call__(self, t: Tensor, theta: Tensor) -> Tensor:
        """The map at distances t and angles theta of any one shape."""
        for atom in (self.pre, self.post):
            function = _ATOMS[atom][0] if isinstance(atom, str) else atom
            t = function(t, theta)
        return t

    def __repr__(self) -> str:
        text = "t"
        for atom in (self.pre, self.post):
            if isinstance(atom, str):
                simple = text.isidentifier() or re.fullmatch(r"\w+\([^()]*\)", text)
                text = _ATOMS[atom][1].format(text, text if simple else f"({text})")
            else:
                text = f"{getattr(atom, '__name__', type(atom).__name__)}({text}, theta)"
        return f"FieldMap({text})"

    def __eq__(self, other: object) -> bool:
        return isinstance(other, FieldMap) and (self.pre, self.post) == (other.pre, other.post)

    def __hash__(self) -> int:
        return hash((self.pre, self.post))
