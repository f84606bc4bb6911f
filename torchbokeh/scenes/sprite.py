"""What a scene is made of: textured cards in space, and what is behind them all."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from torchbokeh.ops.checks import check_finite, check_image, check_number, is_number

Vector = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Sprite:
    """A flat card with a picture on it, seen from both sides.

    Space is that of the `Camera`: x to the right, y down, z along the optical axis, in metres. Unturned, a card
    faces the camera. All that moves is given for the middle of the exposure, time 0.

    Args:
        texture: ``(4, h, w)`` premultiplied RGBA, linear radiance, HDR welcome; between texels it is interpolated
            bilinearly, outside it is transparent.
        position: of the card's centre.
        size: (width, height) of the card in metres.
        rotation: how the card is turned, as a rotation vector in radians (axis times angle).
        velocity: metres per second.
        angular_velocity: about the card's centre, radians per second, as a rotation vector in space.
        emission: factor on the radiance: a lamp is a card with a large one. Coverage stays.

    Raises:
        TypeError: ``texture`` is not a floating-point tensor, or a tuple holds no numbers.
        ValueError: a shape or a number that does not fit.

    Example:
        >>> card = Sprite(torch.ones(4, 8, 8), position=(0.0, 0.0, 2.0), size=(0.5, 0.5))
    """

    texture: Tensor = field(repr=False)
    position: Vector
    size: tuple[float, float]
    rotation: Vector = (0.0, 0.0, 0.0)
    velocity: Vector = (0.0, 0.0, 0.0)
    angular_velocity: Vector = (0.0, 0.0, 0.0)
    emission: float = 1.0

    def __post_init__(self) -> None:
        _check_texture(self.texture, 4)
        for name in ("position", "rotation", "velocity", "angular_velocity"):
            value = _numbers(name, getattr(self, name))
            if len(value) != 3 or not all(math.isfinite(v) for v in value):
                raise ValueError(f"{name}: expected three finite numbers, got {value}")
        if len(_numbers("size", self.size)) != 2 or not all(0 < v < math.inf for v in self.size):
            raise ValueError(f"size: expected a width and a height above 0 in metres, got {self.size}")
        check_finite("emission", self.emission, 0)


@dataclass(frozen=True, eq=False)
class Backdrop:
    """A picture behind everything, without end: its texture goes on mirrored at its edges.

    Args:
        texture: ``(3, h, w)`` linear radiance.
        distance: from the camera in metres, or ``inf`` for a sky.
        width: how wide the texture is for each metre of distance; its texels are square.

    Raises:
        TypeError: ``texture`` is not a floating-point tensor.
        ValueError: a shape or a number that does not fit.

    Example:
        >>> wall = Backdrop(torch.full((3, 4, 4), 0.5), distance=8.0, width=1.2)
    """

    texture: Tensor = field(repr=False)
    distance: float = math.inf
    width: float = 1.0

    def __post_init__(self) -> None:
        _check_texture(self.texture, 3)
        if not check_number("distance", self.distance) > 0:
            raise ValueError(f"distance: expected metres above 0, or inf, got {self.distance}")
        check_finite("width", self.width, 0, above=True)


def _numbers(name: str, value: object) -> Sequence[float]:
    if not isinstance(value, Sequence) or not all(is_number(v) for v in value):
        raise TypeError(f"{name}: expected a tuple of numbers, got {value!r}")
    return value


def _check_texture(texture: Tensor, channels: int) -> None:
    check_image("texture", texture, (channels, "h", "w"))
    if texture.numel() == 0:
        raise ValueError(f"texture: expected at least one texel, got shape {tuple(texture.shape)}")
    if not bool(((texture >= 0) & texture.isfinite()).all()):
        raise ValueError("texture: expected finite radiance, 0 or more, got other values")
    if bool((texture[3:] > 1 + 1e-6).any()):
        raise ValueError(f"texture: expected coverage from 0 to 1, got {float(texture[3].max()):g}")


def place(sprites: Sequence[Sprite], backdrop: Backdrop | None, times: Tensor) -> Tensor:
    """Matrices from texture coordinates ``(s, t, 1)`` in texels to points of space ``(X, Y, Z, 1)``.

    Args:
        sprites: K of them.
        backdrop: comes last, where there is one; at infinity its points are directions ``(X, Y, Z, 0)``.
        times: ``(V,)`` seconds.

    Returns:
        ``(V, K, 4, 3)`` or ``(V, K + 1, 4, 3)``, double.
    """

    def table(name: str, width: int = 3) -> Tensor:
        rows = [getattr(s, name) for s in sprites]
        return torch.tensor(rows, dtype=torch.float64).reshape(len(sprites), width)

    times = times.double()[:, None, None]
    turn = rotation_matrix(times * table("angular_velocity")) @ rotation_matrix(table("rotation"))
    centre = table("position") + times * table("velocity")
    texels = torch.tensor([s.texture.shape[:0:-1] for s in sprites], dtype=torch.float64).reshape(-1, 2)
    axes = turn[..., :2] * (table("size", 2) / texels)[:, None]
    matrix = torch.zeros(len(times), len(sprites) + (backdrop is not None), 4, 3, dtype=torch.float64)
    cards = matrix[:, : len(sprites)]
    cards[:, :, :3, :2] = axes
    cards[:, :, :3, 2] = centre - (axes @ (texels[..., None] / 2))[..., 0]
    cards[:, :, 3, 2] = 1
    if backdrop is not None:
        h, w = backdrop.texture.shape[1:]
        far = 1.0 if math.isinf(backdrop.distance) else backdrop.distance
        texel = backdrop.width * far / w
        last = [[texel, 0, -texel * w / 2], [0, texel, -texel * h / 2], [0, 0, far], [0, 0, 1]]
        matrix[:, -1] = torch.tensor(last, dtype=torch.float64)
        if math.isinf(backdrop.distance):
            matrix[:, -1, 3] = 0
    return matrix


def rotation_matrix(vector: Tensor) -> Tensor:
    """Rotation vectors ``(..., 3)``, axis times angle, as matrices ``(..., 3, 3)`` (Rodrigues' formula)."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))
    angle = vector.norm(dim=-1)[..., None, None]
    # sinc keeps a rotation by nothing from being a special case: sin(a)/a and (1 - cos(a))/a².
    first, second = torch.sinc(angle / math.pi), 0.5 * torch.sinc(angle / (2 * math.pi)) ** 2
    return torch.eye(3, dtype=vector.dtype) + first * cross + second * (cross @ cross)
