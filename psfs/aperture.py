"""Aperture shapes: what an out-of-focus highlight looks like.

Each shape lies within the unit circle and is scaled by the circle of confusion, so its reach never exceeds the
CoC radius. All are convex and flat, and their parameters may be trained.
"""

import math
import re

import torch
from torch import Tensor, nn

from torchbokeh.ops.checks import check_count, check_image, check_number
from torchbokeh.ops.spans import Profile

CHORDS = 16
"""Straight pieces that stand for one curved blade. Six round blades deviate from the circle by 0.05 % of the radius."""


def _setting(module: nn.Module, name: str, value: float | Tensor, low: float, high: float) -> None:
    """Keep an ``nn.Parameter`` as it is and make anything else a buffer, after a check of its range."""
    tensor = value if isinstance(value, Tensor) else torch.tensor(check_number(name, value))
    if not tensor.is_floating_point():
        raise TypeError(f"{name}: expected a floating-point tensor, got {tensor.dtype}")
    if tensor.dim() != 0:
        raise ValueError(f"{name}: expected one number, got shape {tuple(tensor.shape)}")
    check_number(name, tensor.item(), low, high)
    if isinstance(value, nn.Parameter):
        module.register_parameter(name, value)
    else:
        module.register_buffer(name, tensor.to(torch.get_default_dtype()))


class Aperture(nn.Module):
    """Base class: a shape that gives its `Profile`."""

    def profile(self) -> Profile:
        """The unit shape in double, differentiable to the shape's parameters."""
        raise NotImplementedError

    def forward(self) -> Profile:
        """`profile`, so that the module can be called."""
        return self.profile()


class Ellipse(Aperture):
    """An ellipse: the stretched bokeh of an anamorphic lens.

    Args:
        squeeze: height over width, >= 1; the long axis has the CoC radius. Anamorphic lenses: 1.33 to 2.
        rotation: angle in radians, counter-clockwise as seen in the image; 0 is upright.

    Raises:
        ValueError: a number out of range.

    Example:
        >>> Ellipse(squeeze=2.0).profile().bulge.item()
        0.5
    """

    squeeze: Tensor
    rotation: Tensor

    def __init__(self, squeeze: float | Tensor = 2.0, rotation: float | Tensor = 0.0) -> None:
        super().__init__()
        _setting(self, "squeeze", squeeze, 1.0, 100.0)
        _setting(self, "rotation", rotation, -1e3, 1e3)

    def profile(self) -> Profile:
        """The ellipse ``{A u : |u| <= 1}``, from ``A Aᵀ``: its height, its shear and its width at the centre."""
        cos, sin = self.rotation.double().cos(), self.rotation.double().sin()
        width = 1 / self.squeeze.double()
        xx = (width * cos) ** 2 + sin**2
        yy = (width * sin) ** 2 + cos**2
        xy = (1 - width**2) * sin * cos
        height = yy.sqrt()
        shear = xy / yy
        top = torch.stack([height, shear * height, shear * height])
        return Profile(torch.stack([-top, top]), (xx - xy * shear).clamp_min(0).sqrt())

    def extra_repr(self) -> str:
        """The settings, for ``print``."""
        return f"squeeze={self.squeeze.item():g}, rotation={self.rotation.item():g}"


class Disc(Aperture):
    """The round aperture, fully open.

    Example:
        >>> Disc().profile().bulge.item()
        1.0
    """

    one: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("one", torch.ones((), dtype=torch.float64), persistent=False)

    def profile(self) -> Profile:
        """The unit disc: two knots, and all of its width in the bulge."""
        one = self.one.double()
        zero = torch.zeros_like(one)
        return Profile(torch.stack([torch.stack([y, zero, zero]) for y in (-one, one)]), one)


class Polygon(Aperture):
    """A regular polygon with its corners on the CoC circle: the blades of a stopped-down iris.

    Args:
        blades: number of blades, >= 3.
        rotation: angle in radians, counter-clockwise as seen in the image; 0 puts a corner on top.
        curvature: 0 for straight blades, 1 for blades that lie on the circle; each blade is an arc, drawn as
            `CHORDS` chords.

    Raises:
        TypeError: ``blades`` is not an int.
        ValueError: a number out of range.

    Example:
        >>> len(Polygon(blades=6).profile().knots)
        6
    """

    rotation: Tensor
    curvature: Tensor

    def __init__(self, blades: int = 6, rotation: float | Tensor = 0.0, curvature: float | Tensor = 0.0) -> None:
        super().__init__()
        self.blades = check_count("blades", blades, 3, 64)
        _setting(self, "rotation", rotation, -1e3, 1e3)
        _setting(self, "curvature", curvature, 0.0, 1.0)

    def vertices(self) -> Tensor:
        """The corners ``(V, 2)`` as (x, y), y downwards, in order."""
        rotation, curvature = self.rotation.double(), self.curvature.double()
        known = not self.curvature.requires_grad and not torch.compiler.is_compiling()
        straight = known and curvature.item() == 0
        pieces = 1 if straight else CHORDS
        half = math.pi / self.blades
        # An arc of half-angle `bend` over a chord of half-length `sin(half)`, its height `curvature` times that
        # of the circle. sinc keeps the straight blade, bend = 0, from being a special case.
        bend = 2 * torch.atan(curvature * math.tan(half / 2))
        t = torch.linspace(-1, 1, pieces + 1, dtype=torch.float64, device=bend.device)[:-1]

        def sinc(angle: Tensor) -> Tensor:
            return torch.sinc(angle / math.pi)

        along = math.sin(half) * t * sinc(bend * t) / sinc(bend)
        rise = sinc(bend * (1 + t) / 2) * sinc(bend * (1 - t) / 2) / sinc(bend)
        out = math.cos(half) + math.sin(half) * 0.5 * bend * (1 - t * t) * rise
        blade = torch.arange(self.blades, dtype=torch.float64, device=bend.device)[:, None]
        angle = 0.5 * math.pi + rotation + 2 * half * (blade + 0.5)
        x = out * angle.cos() - along * angle.sin()
        y = out * angle.sin() + along * angle.cos()
        return torch.stack([x.reshape(-1), -y.reshape(-1)], 1)

    def profile(self) -> Profile:
        """Left and right edge at the height of every corner."""
        return polygon_profile(self.vertices())

    def extra_repr(self) -> str:
        """The settings, for ``print``."""
        return f"blades={self.blades}, rotation={self.rotation.item():g}, curvature={self.curvature.item():g}"


def polygon_profile(vertices: Tensor) -> Profile:
    """Profile of any convex polygon.

    Args:
        vertices: ``(V, 2)`` corners as (x, y) in order around the polygon, y downwards, in CoC radii.

    Returns:
        The `Profile`, differentiable to the corners.

    Raises:
        TypeError: ``vertices`` is not a floating-point tensor.
        ValueError: not ``(V, 2)`` with V >= 3, or the corners do not turn one way all around.
    """
    check_image("vertices", vertices, ("V", 2))
    if len(vertices) < 3:
        raise ValueError(f"vertices: expected shape (V, 2) with V >= 3, got {tuple(vertices.shape)}")
    edges = vertices.roll(-1, 0) - vertices
    following = edges.roll(-1, 0)
    turns = edges[:, 0] * following[:, 1] - edges[:, 1] * following[:, 0]
    convex = (turns.detach() > -1e-12).all() | (turns.detach() < 1e-12).all()
    if not torch.compiler.is_compiling() and not convex:
        raise ValueError("vertices: expected a convex polygon with its corners in order")
    y = vertices[:, 1]
    start, rise, run = y, edges[:, 1], edges[:, 0]
    slanted = rise.detach().abs() > 1e-9
    share = (y[:, None] - start) / torch.where(slanted, rise, 1.0)
    crosses = slanted & (share.detach() > -1e-9) & (share.detach() < 1 + 1e-9)
    x = vertices[:, 0] + run * share
    # The corner itself is there in any case, even where all edges at its height are too flat to be cut.
    left = torch.minimum(torch.where(crosses, x, math.inf).amin(1), vertices[:, 0])
    right = torch.maximum(torch.where(crosses, x, -math.inf).amax(1), vertices[:, 0])
    order = y.detach().argsort()
    return Profile(
        torch.stack([y, left, right], 1)[order],
        torch.zeros((), dtype=vertices.dtype, device=vertices.device),
    )


def parse_aperture(aperture: str | Aperture) -> Aperture:
    """An aperture from its name: ``"disc"`` or ``"N-gon"`` (``"6-gon"``); a module is returned as it is.

    Raises:
        TypeError: neither a string nor an `Aperture`.
        ValueError: a name that is not known.
    """
    if isinstance(aperture, Aperture):
        return aperture
    if not isinstance(aperture, str):
        raise TypeError(f"aperture: expected a name or an Aperture, got {type(aperture).__name__}")
    if aperture == "disc":
        return Disc()
    if gon := re.fullmatch(r"(\d+)-gon", aperture):
        return Polygon(int(gon[1]))
    raise ValueError(f"aperture: expected 'disc', 'N-gon' such as '6-gon', or an Aperture, got {aperture!r}")
