"""`Volume`: the glow about a point of light in fog, by light tracing (LKS table 1)."""

import math
from collections.abc import Sequence

import numpy as np

from torchbokeh.ops.checks import check_finite, check_number
from torchbokeh.psfs.arrays import Array
from torchbokeh.psfs.model import FRAME, Axis, Labels, Place, PsfModel
from torchbokeh.psfs.tracing import cropped

ANISOTROPY = 0.8
"""Mean cosine of the angle by which light is scattered, g."""

ALBEDO = np.array([1.0, 1.0, 0.9])
"""Share of red, green and blue that is scattered at a collision; the rest is absorbed."""

PHOTONS, SEED = 1 << 16, 0
"""How many are traced. Two seeds differ by 1 % (relative L1)."""

ORDERS = 64
"""Collisions that a photon is followed for. What comes after more of them is spread over all directions."""

REACH = FRAME // 2
"""Radius in px beyond which a glow is left out."""

RINGS, DEGREE = 40, 6
"""Rings in which light is collected, and the degree of the polynomial that is fitted to them."""


def deflections(shares: Array, g: float) -> Array:
    """Cosines of angles by which light is scattered, for shares in [0, 1]: Henyey and Greenstein's phase function."""
    return (1 + g * g - ((1 - g * g) / (1 - g + 2 * g * shares)) ** 2) / (2 * g)


def scattered(to: Array, cosine: Array, azimuth: Array) -> Array:
    """Unit directions ``(3, n)``, turned by angles with given cosines ``(n,)``, around azimuths ``(n,)``."""
    # Two directions across `to`, without a case that divides by zero (Duff et al. 2017).
    x, y, z = to
    sign = np.copysign(1.0, z)
    a = -1 / (sign + z)
    b = x * y * a
    across = np.stack([1 + sign * x * x * a, sign * b, -sign * x]), np.stack([b, sign + y * y * a, -y])
    sine = np.sqrt(np.maximum(1 - cosine**2, 0.0))
    out = cosine * to + sine * (np.cos(azimuth) * across[0] + np.sin(azimuth) * across[1])
    return out / np.sqrt((out**2).sum(0))


def glow(distance: float, focal: float, photons: int, seed: int) -> Array:
    """Light of an isotropic point source in a homogeneous medium that reaches a pinhole after 1, 2, ... collisions.

    Woodcock tracking draws free flights by the largest density of the medium; here that is the density everywhere, so
    that every collision is a real one and flights are exponential. By symmetry, each point of the sphere about the
    source is a pinhole that faces it: after a collision, a photon is scored where its way leaves the sphere, by the
    share of light that comes that far. (A score of what goes to one pinhole would have no finite variance: photons
    that collide beside it count too much.)

    Args:
        distance: of the source in mean free paths, > 0.
        focal: length of the camera in px.
        photons: how many.
        seed: of the random numbers.

    Returns:
        ``(ORDERS, RINGS)``: light in the rings of the picture between `edges`, with an albedo of 1. In the same unit,
        ``exp(-distance)`` comes without a collision.
    """
    draw = np.random.default_rng(seed)
    borders = edges()
    at, to = np.zeros((3, photons)), np.zeros((3, photons))
    to[2] = 1.0
    found = np.zeros((ORDERS, RINGS))
    for order in range(ORDERS):
        flight, share, turn = draw.random((3, photons))
        at = at - np.log1p(-flight) * to
        to = scattered(to, deflections(share, ANISOTROPY), 2 * math.pi * turn)
        along = (at * to).sum(0)
        square = along**2 - (at**2).sum(0) + distance**2
        root = np.sqrt(np.maximum(square, 0.0))
        seen = (square > 0) & (root > along)
        way, cosine = (root - along)[seen], root[seen] / distance
        radius = focal * np.sqrt(np.maximum(1 / cosine**2 - 1, 0.0))
        # A sensor shows radiance: the flux through the sphere over its cosine.
        found[order] = np.histogram(radius, borders, weights=np.exp(-way) / cosine)[0]
    cosines = np.cos(np.arctan(borders / focal))
    solid = 2 * math.pi * (cosines[:-1] - cosines[1:])
    return found / photons * (math.pi * np.diff(borders**2) / focal**2 / solid)


def edges() -> Array:
    """Radii ``(RINGS + 1,)`` in px between the rings."""
    return REACH * (np.arange(RINGS + 1) / RINGS) ** 1.5


def disc(rings: Array) -> Array:
    """The picture ``(2 REACH + 1, 2 REACH + 1)`` of a glow with the given light in its rings ``(RINGS,)``.

    A glow falls off like 1/r, as single scattering does. The factor of that is smooth: a polynomial, fitted to the
    rings, that fades out over the outer quarter. The integral of 1/r over a pixel is closed.
    """
    borders = edges()
    middle = np.sqrt((borders[:-1] + borders[1:]) / 2 / REACH)
    factor = np.polynomial.Polynomial.fit(middle, rings / (2 * math.pi * np.diff(borders)), DEGREE)
    x = np.arange(REACH + 1)
    radius = np.hypot(x, x[:, None]) / REACH
    fade = np.clip((1 - radius) * 4, 0, 1) ** 2 * (3 - 2 * np.clip((1 - radius) * 4, 0, 1))
    corner = np.arange(REACH + 2) - 0.5
    u, v = corner, corner[:, None]
    whole = u * np.arcsinh(v / np.abs(u)) + v * np.arcsinh(u / np.abs(v))
    quarter = np.diff(np.diff(whole, axis=0), axis=1) * np.maximum(factor(np.sqrt(np.minimum(radius, 1))), 0) * fade
    half = np.concatenate([quarter[:, :0:-1], quarter], 1)
    return np.concatenate([half[:0:-1], half])


class Volume(PsfModel):
    """A point of light in a homogeneous scattering medium, seen by a pinhole: itself, and a glow.

    The coordinate is the distance in mean free paths. The medium is that of LKS: `ALBEDO` and `ANISOTROPY`. What comes
    without a collision, ``exp(-distance)`` of it, stays on its pixel. The light is relative to the white glow and point
    together, so that red and green sum to 1; blue, which is absorbed, to less. What is dimmed by the distance is in the
    picture already. A glow ends `REACH` px from its centre; farther points are those at the bound.

    Args:
        density: of the medium in collisions per metre, > 0. LKS: 0.9.
        distance: largest one that is sampled in mean free paths, above 0 and at most 8.
        focal: length of the camera in px, at least `REACH`: how wide a glow is.

    Raises:
        TypeError: an argument is not a number.
        ValueError: an argument is out of range.

    Source:
        LKS section 5.1; phase function: Henyey and Greenstein, "Diffuse radiation in the galaxy", 1941; tracking:
        Woodcock et al. 1965.

    Example:
        >>> psf = Volume().dense((1.0,))
        >>> psf.shape, psf.sum((1, 2)).round(2).tolist()
        ((3, 511, 511), [1.0, 1.0, 0.93])
    """

    name = "volume"
    channels = 3
    symmetry = "octants"
    merges = False
    tints = True

    def __init__(self, density: float = 0.9, distance: float = 5.0, focal: float = 1024.0) -> None:
        check_finite("density", density, 0, above=True)
        if not 0 < check_number("distance", distance) <= 8:
            raise ValueError(f"distance: expected a number of mean free paths above 0 and at most 8, got {distance}")
        if not REACH <= check_number("focal", focal) < math.inf:
            raise ValueError(f"focal: expected a finite number of px from {REACH} on, got {focal}")
        self.density, self.focal = density, focal
        self.axes = (Axis("distance", "mean free paths", distance, 1.0, 100 * 101 // 2),)

    def settings(self) -> dict[str, float | int | str]:
        """All arguments."""
        return {"density": self.density, "distance": self.axes[0].bound, "focal": self.focal}

    def dense(self, coordinates: Sequence[float]) -> Array:
        """The point, and its glow by light tracing."""
        distance = max(coordinates[0], 1e-6)
        orders = glow(distance, self.focal, PHOTONS, SEED)
        powers = ALBEDO[:, None] ** np.arange(1, ORDERS + 1)
        picture = np.stack([disc(share @ orders) for share in powers])
        picture[:, REACH, REACH] += math.exp(-distance)
        return cropped(picture / picture[0].sum())

    def place(self, labels: Labels) -> Place:
        """The distance of every pixel; needs ``depth``."""
        if labels.depth is None:
            raise ValueError(f"{self.name}: expected depth, got none")
        return Place((labels.depth * self.density).clamp(max=self.axes[0].bound))
