"""The domain in which a PSF takes the fewest points."""

from typing import Literal, NamedTuple

import numpy as np

from torchbokeh.psfs.arrays import Array, Points
from torchbokeh.psfs.model import Symmetry
from torchbokeh.psfs.refit import Fit, Sparse, fewest, fundamental, reconstruction
from torchbokeh.psfs.similarity import neighbourhood, score

Domain = Literal["direct", "scanline", "laplacian"]
DOMAINS: tuple[Domain, ...] = ("direct", "scanline", "laplacian")

CANDIDATES = 700
"""Orbits of points that an elimination begins with, at most."""

NOTHING = 1e-11
"""Of the largest magnitude: below this, a Laplacian is what rounding left. Bright centres outshine the rest by far."""

POWER = 0.75
"""Candidates are as dense as this power of the Laplacian: a PSF that is smooth over wide areas needs some there."""


class Target(NamedTuple):
    """What is asked of a sparse PSF.

    Attributes:
        ssim: least similarity in the neighbourhood, see `torchbokeh.psfs.similarity.Score`.
        l1: largest relative L1 error there.
    """

    ssim: float = 0.97
    l1: float = 0.04


class Represented(NamedTuple):
    """A PSF in the domain that suits it."""

    domain: Domain
    sparse: Sparse


def laplacian(psf: Array) -> Array:
    """5-point Laplacian of ``(C, h, w)``, one pixel larger on each side."""
    p = np.pad(psf, ((0, 0), (2, 2), (2, 2)))
    return p[:, :-2, 1:-1] + p[:, 2:, 1:-1] + p[:, 1:-1, :-2] + p[:, 1:-1, 2:] - 4 * p[:, 1:-1, 1:-1]


def nonzero(picture: Array) -> Sparse:
    """All points of a centred picture ``(C, h, w)`` that are not zero."""
    y, x = np.nonzero((picture != 0).any(0))
    centre = np.array([picture.shape[2] // 2, picture.shape[1] // 2])
    return Sparse(np.stack([x, y], 1) - centre, picture[:, y, x].T)


def scanline(psf: Array) -> Sparse:
    """Backward differences along x."""
    wide = np.pad(psf, ((0, 0), (0, 0), (1, 1)))
    steps = np.diff(wide, axis=2, prepend=0.0)
    steps[np.abs(steps) < 1e-12 * psf.max()] = 0.0
    return nonzero(steps)


def candidates(psf: Array, symmetry: Symmetry, most: int = CANDIDATES) -> Points:
    """Representatives of orbits where the Laplacian of a PSF is not zero, thinned to about ``most``.

    Thinning is error diffusion of a power of the magnitude: dense where the PSF bends most, evenly spread, and the same
    each time.
    """
    strength = np.abs(laplacian(psf)).sum(0)
    strength[strength < NOTHING * strength.max()] = 0.0
    found = nonzero(strength[None])
    points = fundamental(found.points, symmetry)
    if len(points) <= most:
        return points
    y0, x0 = strength.shape[0] // 2, strength.shape[1] // 2
    area = np.zeros_like(strength)
    area[points[:, 1] + y0, points[:, 0] + x0] = strength[points[:, 1] + y0, points[:, 0] + x0] ** POWER
    low, high = 0.0, 1.0 / area[area > 0].min()
    for _ in range(60):  # the factor with which as many points are drawn as asked for
        middle = (low + high) / 2
        low, high = (middle, high) if np.minimum(area * middle, 1.0).sum() < most else (low, middle)
    drawn = diffused(np.minimum(area * high, 1.0))
    return fundamental(nonzero(drawn[None]).points, symmetry)


def diffused(density: Array) -> Array:
    """Floyd and Steinberg's error diffusion to 0 and 1, row by row, turning at the borders."""
    out = np.zeros_like(density)
    height, width = density.shape
    left = np.pad(density, ((0, 1), (1, 1)))
    for y in range(height):
        step = 1 if y % 2 == 0 else -1
        for x in range(1, width + 1)[::step]:
            value = left[y, x]
            if value == 0:
                continue
            drawn = float(value >= 0.5)
            out[y, x - 1] = drawn
            error = value - drawn
            left[y, x + step] += error * 7 / 16
            left[y + 1, [x - step, x, x + step]] += error * np.array([3, 5, 1]) / 16
    return out * (density > 0)


def represent(psf: Array, symmetry: Symmetry, *, turns: bool, target: Target) -> Represented:
    """The domain in which a PSF needs the fewest points, and these points.

    Where no Laplacian of as many points as are tried meets the target, the best one stands for all.

    Args:
        psf: ``(C, h, w)``, odd sizes, centred.
        symmetry: of the PSF.
        turns: whether it must still be right when its points are turned; row differences are not.
        target: what is asked of it.
    """
    best = Represented("direct", nonzero(psf))
    if not turns:
        rows = scanline(psf)
        if len(rows.points) < len(best.sparse.points):
            best = Represented("scanline", rows)

    def good(sparse: Sparse) -> bool:
        found = score(psf, reconstruction(sparse, neighbourhood(psf)))
        return found.ssim >= target.ssim and found.l1 <= target.l1

    sparse = fewest(Fit(psf, candidates(psf, symmetry), symmetry), good)
    return Represented("laplacian", sparse) if len(sparse.points) < len(best.sparse.points) else best
