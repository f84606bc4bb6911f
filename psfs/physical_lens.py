"""`PhysicalLens`: light traced through a lens of glass (LKS table 1): aberrations, coloured fringes and cat's eyes."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from torchbokeh.ops.checks import check_finite, check_number
from torchbokeh.ops.sellmeier import refractive_index
from torchbokeh.psfs.arrays import Array
from torchbokeh.psfs.model import FRAME, Axis, Labels, Place, PsfModel, field_of, scaled, turned
from torchbokeh.psfs.tracing import cropped, sobol_points, splat_rays

WAVELENGTHS = (0.650, 0.510, 0.475)
"""Of red, green and blue in micrometres."""

THICKNESS = 0.3
"""Of the lens, in focal lengths."""

OPEN = 4.0
"""f-number for which the rear of the lens is ground: a smaller stop does not make it narrower."""

POWER, SEED = 21, 0
"""``2**POWER`` rays per channel through the upper half of the stop.

PSFs of two seeds differ by 0.1 % (relative L1) or less, and if they are pre-filtered over a wide box, by 1 %.
"""

NODES = 8
"""Coordinates along each axis that a pre-filtered PSF is traced at, with an equal share of the rays for each pair."""


@dataclass(frozen=True)
class Singlet:
    """A bi-convex lens with equal spheres, and the sensor behind it. Lengths in metres.

    Attributes:
        radius: of both spheres.
        thickness: between the vertices.
        stop: radius of the front rim, the stop.
        rim: radius of the rear rim. It just lets pass what comes through the open stop from the middle of the focus
            plane.
        sensor: its distance from the rear vertex.
        nearness: 1 over the distance of the focus plane from the front vertex.
        coc: paraxial CoC radius of what is infinitely far.
        chief: paraxial image height of a chief ray, one through the middle of the stop, per its slope.
    """

    radius: float
    thickness: float
    stop: float
    rim: float
    sensor: float
    nearness: float
    coc: float
    chief: float


def singlet(focal_length: float, f_number: float, focus_distance: float) -> Singlet:
    """The lens with these data for green light: the lensmaker's equation and its paraxial matrix."""
    n = refractive_index("BK7", 1000 * WAVELENGTHS[1])
    thickness = THICKNESS * focal_length
    radius = focal_length * (n - 1) * THICKNESS / (n * (1 - math.sqrt(1 - THICKNESS / n)))
    power = (n - 1) / radius
    # Height and slope behind the lens are (a y + b u, c y + d u) for a ray with y and u at the front vertex.
    a, b = 1 - thickness * power / n, thickness / n
    c, d = -power * (1 + a), 1 - power * b
    nearness, stop = 1 / focus_distance, focal_length / (2 * f_number)
    rim = focal_length / (2 * min(f_number, OPEN)) * (a + nearness * b)
    sensor = -(a + nearness * b) / (c + nearness * d)
    coc, chief = -stop * (a + sensor * c), b + sensor * d
    return Singlet(radius, thickness, stop, rim, sensor, nearness, coc, chief)


class Landed(NamedTuple):
    """Where rays meet the sensor, in metres from the optical axis, and the light of each: 0 if it was stopped."""

    x: Array
    y: Array
    light: Array


def trace(lens: Singlet, start: Array, nearness: float, slope: float, index: float) -> Landed:
    """Rays from points of light through the lens, by Snell's law at both spheres.

    Reflections are left out, as if the lens were coated.

    Args:
        lens: the lens.
        start: ``(2, n)`` where they enter, in radii of the stop.
        nearness: 1 over the distance of the point from the front vertex; 0 is infinitely far.
        slope: of the chief ray, which goes along x.
        index: of the glass.
    """
    x, y = start * lens.stop
    height = np.sqrt(lens.radius**2 - x**2 - y**2)
    at = np.stack([x, y, lens.radius - height])
    to = at * nearness
    to[0] += slope
    to[2] += 1.0
    length = np.sqrt((to**2).sum(0))
    to /= length
    normal = np.stack([x, y, -height]) / lens.radius
    # Solid angle of a piece of the sphere, per its area across the axis.
    light = -(normal * to).sum(0) * lens.radius / (height * length**2)
    to, _ = _refracted(to, normal, 1 / index)
    # On to the rear sphere, whose centre is on this side of it.
    at[2] -= lens.thickness - lens.radius
    along = (at * to).sum(0)
    at += to * (np.sqrt(along**2 - (at**2).sum(0) + lens.radius**2) - along)
    to, passes = _refracted(to, -at / lens.radius, index)
    passes &= (at[0] ** 2 + at[1] ** 2 <= lens.rim**2) & (at[2] > 0)
    at[2] -= lens.radius
    at += to * ((lens.sensor - at[2]) / to[2])
    return Landed(at[0], at[1], np.where(passes, light, 0.0))


def _refracted(to: Array, normal: Array, ratio: float) -> tuple[Array, NDArray[np.bool_]]:
    """Directions behind a surface with normals against the light, and whether there are any."""
    cosine = -(normal * to).sum(0)
    square = 1 - ratio**2 * (1 - cosine**2)
    out = ratio * to + (ratio * cosine - np.sqrt(np.maximum(square, 0.0))) * normal
    return out, square > 0


class PhysicalLens(PsfModel):
    """A bi-convex spherical lens of BK7, traced in three wavelengths.

    Coordinates are the CoC radius in px on one side of the focus plane, and the eccentricity: the distance of the
    pixel from the centre of the picture, in half diagonals of a square as wide as the picture's longer side. Blur
    behind and before the focus plane differ in more than a sign (spherical aberration, order of the colours), so each
    side is a model of its own. What lies on the other side is taken to be in focus.

    The CoC is the paraxial one of green, with distances from the front vertex. Behind the focus plane it is
    ``bound * (1 - focus / distance)``, so that the bound is infinitely far. Before the focus plane it is
    ``bound * (focus / distance - 1)``, so that the bound is at half the focus distance. The sensor stands where green
    has its paraxial image of the focus plane, and the PSF is centred where the chief ray of green meets it: distortion
    is left out. Along x, the PSF points away from the centre of the picture.

    The front rim is the stop. Towards the corners, the rear rim cuts off more and more of it: cat's eyes, which vanish
    where the lens is stopped down. Every channel has a sum of 1 all the same.

    Args:
        side: ``"behind"`` or ``"front"`` of the focus plane.
        focal_length: in metres, > 0.
        f_number: above 1.
        focus_distance: from the front vertex in metres, above 2 focal lengths.
        sensor_width: in metres, > 0, at most the focal length.
        width: of a picture that fills the sensor, in px. In one of another width, PSFs have the size that the CoC says.
            The bound must be at most a quarter of `FRAME`.

    Raises:
        TypeError: an argument is not a number.
        ValueError: an argument is out of range.

    Source:
        LKS section 5.1 and 5.3; ray tracing: Smith, "Modern Optical Engineering", chapter 10.

    Example:
        >>> model = PhysicalLens()
        >>> round(model.axes[0].bound, 1)  # CoC radius of what is infinitely far
        58.2
        >>> model.dense((20.0, 0.0)).sum((1, 2)).round(6).tolist()
        [1.0, 1.0, 1.0]
    """

    name = "physical-lens"
    channels = 3
    similarity = 0.985
    symmetry = "mirror"
    turns = True
    fields = True

    def __init__(
        self,
        side: Literal["behind", "front"] = "behind",
        focal_length: float = 0.1,
        f_number: float = 4.0,
        focus_distance: float = 0.7,
        sensor_width: float = 0.036,
        width: int = 1024,
    ) -> None:
        if not isinstance(side, str) or side not in ("behind", "front"):
            raise ValueError(f"side: expected 'behind' or 'front', got {side!r}")
        lens = {"focal_length": focal_length, "f_number": f_number, "focus_distance": focus_distance}
        sensor = {"sensor_width": sensor_width, "width": width}
        lowest = {"f_number": 1.0, "focus_distance": 2 * check_number("focal_length", focal_length)}
        for name, value in (lens | sensor).items():
            check_finite(name, value, lowest.get(name, 0.0), above=True)
        if sensor_width > focal_length:
            raise ValueError(f"sensor_width: expected at most the focal length, {focal_length:g}, got {sensor_width:g}")
        self._settings = {"side": side, **lens, **sensor}
        self.lens = singlet(focal_length, f_number, focus_distance)
        self._pixels = width / sensor_width
        self._corner = sensor_width / math.sqrt(2) / self.lens.chief
        self._sign = 1 if side == "behind" else -1
        bound = self.lens.coc * self._pixels
        if bound > FRAME // 4:  # aberrations double the size of some
            raise ValueError(f"width: expected a largest CoC radius of at most {FRAME // 4} px, got {bound:.0f} px")
        self.axes = (Axis("radius", "px", bound, 2.5, 90), Axis("eccentricity", "", 1.0, 1.2, 90))

    @property
    def merges(self) -> bool:  # type: ignore[override]
        """Behind the focus plane only: before it, field curvature makes sharp in the corners what has a large CoC."""
        return self._sign > 0

    def settings(self) -> dict[str, float | int | str]:
        """All arguments."""
        return {**self._settings}

    def dense(self, coordinates: Sequence[float]) -> Array:
        """Traced from one point of light."""
        return self._traced([tuple(coordinates)] * NODES**2)

    def prefiltered(self, low: Sequence[float], high: Sequence[float]) -> Array:
        """As in the base class, but the points of light vary in the loop of the light tracing (LKS section 5.4).

        They stand at quantiles of the Gaussian: enough of them that their edges are not seen one by one.
        """
        return self._traced(list(product(*(_quantiles(a, b) for a, b in zip(low, high, strict=True)))))

    def place(self, labels: Labels) -> Place:
        """CoC and eccentricity of every pixel, and the rotation that points x outwards; needs ``coc``."""
        if labels.coc is None:
            raise ValueError(f"{self.name}: expected coc, got none")
        coc = (labels.coc * self._sign).clamp_min(0.0)
        field = field_of(coc) if labels.field is None else labels.field
        eccentricity = field.square().sum(1, keepdim=True).sqrt() / math.sqrt(2)
        # What is more blurred than the lens can is scaled from its largest.
        scale = (coc.detach() / self.axes[0].bound).clamp_min(1.0)
        return scaled(Place(torch.cat([coc / scale, eccentricity], 1), turned(field)), scale)

    def _traced(self, places: Sequence[Sequence[float]]) -> Array:
        """The mean of PSFs. Each gets a part of Sobol's sequence, which fills the stop by itself."""
        parts = np.split(sobol_points(POWER, SEED), len(places), axis=1)
        picture = np.zeros((3, FRAME, FRAME))
        for part, (coc, eccentricity) in zip(parts, places, strict=True):
            self._light(picture, part, coc, eccentricity)
        picture = picture + picture[:, ::-1]
        return cropped(picture / picture.sum((1, 2), keepdims=True))

    def _light(self, picture: Array, points: Array, coc: float, eccentricity: float) -> None:
        """Add rays through the upper half of the stop to ``(3, FRAME, FRAME)``; points in the unit square."""
        start = np.sqrt(points[0]) * np.stack([np.cos(math.pi * points[1]), np.sin(math.pi * points[1])])
        nearness = self.lens.nearness * (1 - self._sign * coc / self.axes[0].bound)
        slope = eccentricity * self._corner
        indices = [refractive_index("BK7", 1000 * wavelength) for wavelength in WAVELENGTHS]
        centre = trace(self.lens, np.zeros((2, 1)), nearness, slope, indices[1]).x
        for channel, index in zip(picture, indices, strict=True):
            ray = trace(self.lens, start, nearness, slope, index)
            splat_rays(channel, (ray.x - centre) * self._pixels, ray.y * self._pixels, ray.light)


def _quantiles(low: float, high: float) -> Array:
    """`NODES` quantiles of a Gaussian about the middle, with a quarter of the width as sigma, cut at both ends."""
    from scipy.special import ndtr, ndtri

    shares = (np.arange(NODES) + 0.5) / NODES
    tail = ndtr(-2.0)
    return (low + high) / 2 + (high - low) / 4 * ndtri(tail + shares * (1 - 2 * tail))
