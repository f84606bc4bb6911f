"""Sparse Laplacians the way of LKS section 5.5: dart throwing, Lloyd relaxation, Voronoi sums, simulated annealing.

`torchbokeh.psfs.refit` finds better points and better values; this is what it is compared with. Points ``(n, 2)`` are
whole offsets (dx, dy) in px from the centre.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchbokeh.ops.checks import check_finite, check_whole
from torchbokeh.psfs.arrays import Array, Points
from torchbokeh.psfs.refit import Sparse, reconstruction
from torchbokeh.psfs.represent import laplacian as laplacian_of
from torchbokeh.psfs.represent import nonzero
from torchbokeh.psfs.similarity import centred, neighbourhood, score

TRIES = 24
"""Bisections of the scale of a pattern."""

HEAT = 1e-3
"""First temperature of the annealing over the error it begins with. It falls to 0 linearly; LKS names no schedule.

On capsules any value below 3e-3 gives the same within chance, and 1e-2 is worse.
"""

NOISE = 1e-12
"""Of the largest magnitude in a picture: what is below came about by rounding."""

ORDER = 1e-3
"""Squared px that tell points of equal distance apart; squared distances of pixels differ by 1 or more."""


def dart_throwing(importance: Array, scale: float, seed: int, failures: int = 10_000) -> Points:
    """A Poisson-disk pattern whose density follows an importance.

    If n points are to be as dense as the importance, a pixel of normalised importance p has n p of them, and a point
    an area of ``1 / (n p)`` to itself: the radius that it keeps free is inverse to the root of p. A dart is kept if no
    point before it is nearer than the smaller of both radii.

    Args:
        importance: ``(h, w)``, odd sizes, >= 0. Where it is 0 no dart lands.
        scale: the radius is ``scale / sqrt(p)`` px, but no more than ``h + w``. For n points, about ``0.8 / sqrt(n)``.
        seed: of the darts.
        failures: darts that are not kept after which it ends. In all: LKS does not say "in a row".

    Returns:
        Points ``(n, 2)`` in the order of the darts, no two the same.

    Raises:
        ValueError: ``importance`` is not of odd sizes, not finite, below 0, or 0 everywhere; ``scale`` is below 0.

    Example:
        >>> len(dart_throwing(np.ones((1, 9)), 0.0, seed=0)), len(dart_throwing(np.ones((1, 9)), 10.0, seed=0))
        (9, 1)
    """
    check_picture("importance", importance, 2)
    check_finite("scale", scale, 0)
    height, width = importance.shape
    weight = importance.ravel().cumsum()
    radius = np.full(importance.shape, math.inf)
    np.divide(scale * math.sqrt(weight[-1]), np.sqrt(importance), out=radius, where=importance > 0)
    radius = np.minimum(radius, height + width)
    y, x = np.ogrid[:height, :width]
    free = np.ones(importance.shape, bool)
    rng = np.random.default_rng(seed)
    kept: list[tuple[int, int]] = []
    failed = 0
    while failed < failures:
        # As many darts as may still fail: the limit is not passed in between.
        for place in weight.searchsorted(rng.random(failures - failed) * weight[-1], side="right").tolist():
            row, column = divmod(place, width)
            if not free[row, column]:
                failed += 1
                continue
            kept.append((column - width // 2, row - height // 2))
            free[row, column] = False
            reach = radius[row, column]
            rows, columns = (slice(max(c - int(reach), 0), c + int(reach) + 1) for c in (row, column))
            squared = (y[rows] - row) ** 2 + (x[:, columns] - column) ** 2
            free[rows, columns] &= squared >= np.minimum(radius[rows, columns], reach) ** 2
    return np.array(kept, np.int64)


def points_for(importance: Array, count: int, seed: int) -> Points:
    """`dart_throwing` of a wanted number of points, by bisection of its scale.

    Args:
        importance: ``(h, w)``, odd sizes, >= 0.
        count: wanted number of points, >= 1. It may be missed by a few; no more are found than darts at scale 0 find.
        seed: of the darts, the same at every scale.

    Returns:
        Points ``(n, 2)``.

    Raises:
        ValueError: ``count`` is below 1, or ``importance`` as in `dart_throwing`.

    Example:
        >>> len(points_for(np.ones((41, 41)), 20, seed=0))
        20
    """
    check_picture("importance", importance, 2)
    check_whole("count", count, 1)
    # At the upper end, the radius of every pixel is the largest: there is room for one point.
    low, high = 0.0, sum(importance.shape) * math.sqrt(importance.max() / importance.sum())
    best = dart_throwing(importance, high, seed)
    for _ in range(TRIES):
        if len(best) == count:
            break
        middle = (low + high) / 2
        points = dart_throwing(importance, middle, seed)
        low, high = (middle, high) if len(points) > count else (low, middle)
        best = min(best, points, key=lambda p: abs(len(p) - count))
    return best


def cells(points: NDArray[np.number], places: Points) -> NDArray[np.int64]:
    """Voronoi cells: the nearest of ``points (n, 2)`` to each of ``places (m, 2)``, the first of those equally near."""
    from scipy.spatial import KDTree

    # The tree does not say which of several it finds: a third coordinate makes the first one nearest.
    height = np.sqrt(np.arange(len(points)) * (ORDER / len(points)))
    tree = KDTree(np.column_stack([points, height]))
    return np.asarray(tree.query(np.column_stack([places, np.zeros(len(places))]))[1], np.int64)


def merged(points: Points) -> Points:
    """Points ``(n, 2)`` without repetition, in their order."""
    _, first = np.unique(points, axis=0, return_index=True)
    return points[np.sort(first)]


def lloyd(points: Points, importance: Array, iterations: int = 50) -> Points:
    """Lloyd's relaxation: each point goes to the centroid of its Voronoi cell, weighted by the importance, repeatedly.

    Args:
        points: ``(n, 2)``, n >= 1.
        importance: ``(h, w)``, odd sizes, >= 0.
        iterations: how often.

    Returns:
        Points ``(m, 2)``: rounded at the end, those that meet there merged.

    Example:
        >>> lloyd(np.array([[-1, 0], [0, 0]]), np.array([[1.0, 0.0, 0.0, 0.0, 1.0]])).tolist()
        [[-2, 0], [2, 0]]
    """
    found = nonzero(importance[None])
    weight = found.values[:, 0]
    moving = points.astype(np.float64)
    for _ in range(iterations):
        owner = cells(moving, found.points)
        total = np.bincount(owner, weight, len(moving))
        held = total > 0
        for axis in (0, 1):
            moment = np.bincount(owner, weight * found.points[:, axis], len(moving))
            moving[held, axis] = moment[held] / total[held]
    return merged(np.rint(moving).astype(np.int64))


def voronoi_sums(points: Points, laplacian: Array) -> Array:
    """Values ``(n, C)``: each of ``points (n, 2)``, n >= 1, sums a Laplacian ``(C, h, w)`` over its Voronoi cell.

    The total is kept. A pixel as near to several points belongs to the first.

    Example:
        >>> voronoi_sums(np.array([[-1, 0], [1, 0]]), np.array([[[1.0, 2.0, 4.0]]])).tolist()
        [[3.0], [4.0]]
    """
    return _sums(points, nonzero(laplacian))


def _sums(points: Points, found: Sparse) -> Array:
    owner = cells(points, found.points)
    return np.stack([np.bincount(owner, channel, len(points)) for channel in found.values.T], 1)


def anneal(points: Points, laplacian: Array, psf: Array, seed: int, *, steps: int = 400, share: float = 0.01) -> Sparse:
    """Simulated annealing of the points, their values being `voronoi_sums`.

    A step moves some points by at most a pixel along each axis and merges those that meet. What adds d to the L1 error
    of the reconstruction is kept with probability ``exp(-d / temperature)``, what adds nothing always.

    Args:
        points: ``(n, 2)``, n >= 1, within the PSF's `neighbourhood`. They stay there.
        laplacian: of the PSF, ``(C, h + 2, w + 2)``.
        psf: ``(C, h, w)``, odd sizes, >= 0.
        seed: of the moves and of what is kept.
        steps: how many.
        share: of the points, how many move in a step: 0 to 1. One does in any case.

    Returns:
        The best that was seen, beginning with the points given.

    Example:
        >>> psf = np.full((1, 3, 3), 1 / 9)
        >>> anneal(np.array([[0, 0], [2, 0]]), laplacian_of(psf), psf, seed=0).values.shape
        (2, 1)
    """
    rng = np.random.default_rng(seed)
    found, wanted = nonzero(laplacian), centred(psf, neighbourhood(psf))
    half = np.array([wanted.shape[2] // 2, wanted.shape[1] // 2])
    now = best = Sparse(points, _sums(points, found))
    cost = least = _error(now, wanted)
    for temperature in np.linspace(HEAT * cost, 0, steps, endpoint=False):
        trial = now.points.copy()
        chosen = rng.choice(len(trial), max(round(share * len(trial)), 1), replace=False)
        trial[chosen] = np.clip(trial[chosen] + rng.integers(-1, 2, (len(chosen), 2)), -half, half)
        trial = merged(trial)
        moved = Sparse(trial, _sums(trial, found))
        error = _error(moved, wanted)
        # The same as comparing exp(-d / temperature) with a uniform number, without a division.
        if error - cost <= temperature * rng.exponential():
            now, cost = moved, error
            if cost < least:
                best, least = now, cost
    return best


def _error(sparse: Sparse, wanted: Array) -> float:
    """Sum of absolute differences of the `reconstruction` from a picture."""
    height, width = wanted.shape[1:]
    return float(np.abs(reconstruction(sparse, (height, width)) - wanted).sum())


def sparsify(psf: Array, count: int, seed: int, *, relaxation: bool = True, annealing: bool = True) -> Sparse:
    """The sparse Laplacian of a PSF, in the four steps of LKS.

    Args:
        psf: ``(C, h, w)``, odd sizes, centred, >= 0.
        count: of points that the darts give, see `points_for`. Merging leaves fewer.
        seed: of all that is drawn.
        relaxation: whether to run `lloyd`.
        annealing: whether to run `anneal`.

    Returns:
        Points and their values; these sum to 0.

    Raises:
        ValueError: ``psf`` is no PSF, or ``count`` is below 1.

    Example:
        >>> len(sparsify(np.full((1, 9, 9), 1 / 81), 40, seed=0).points) <= 40
        True
    """
    check_picture("psf", psf, 3)
    laplacian = laplacian_of(psf)
    laplacian[np.abs(laplacian) < NOISE * np.abs(laplacian).max()] = 0.0
    importance = np.abs(laplacian).sum(0)
    points = points_for(importance, count, seed)
    if relaxation:
        points = lloyd(points, importance)
    return anneal(points, laplacian, psf, seed) if annealing else Sparse(points, voronoi_sums(points, laplacian))


class Ablation(NamedTuple):
    """Mean relative L1 error over some PSFs, over that of dart throwing alone. LKS: 1, 0.967, 0.871 and 0.865."""

    darts: float
    relaxation: float
    annealing: float
    both: float


def ablation(psfs: Sequence[Array], count_share: float, seed: int) -> Ablation:
    """What each step of `sparsify` is worth (LKS section 7.3), on one or more PSFs ``(C, h, w)``.

    ``count_share`` is the number of darts over that of pixels of the PSF that are not 0.
    """
    if not psfs:
        raise ValueError("psfs: expected at least one, got none")

    def error(psf: Array, relaxation: bool, annealing: bool) -> float:
        count = max(round(count_share * np.count_nonzero(psf.any(0))), 1)
        sparse = sparsify(psf, count, seed, relaxation=relaxation, annealing=annealing)
        return score(psf, reconstruction(sparse, neighbourhood(psf))).l1

    switches = ((False, False), (True, False), (False, True), (True, True))
    errors = np.array([[error(psf, *on) for on in switches] for psf in psfs]).mean(0)
    return Ablation(*(errors / errors[0]).tolist())


def check_picture(name: str, picture: Array, dimensions: int) -> None:
    """Raise ValueError where a picture is not of odd sizes, not finite, below 0 or 0 everywhere."""
    if picture.ndim != dimensions or not all(n % 2 for n in picture.shape[-2:]):
        shape = "(h, w)" if dimensions == 2 else "(C, h, w)"
        raise ValueError(f"{name}: expected shape {shape} of odd h and w, got {picture.shape}")
    low, high = float(picture.min()), float(picture.max())
    if not (low >= -NOISE * high and 0 < high < math.inf):
        raise ValueError(f"{name}: expected finite numbers from 0 on, not all 0, got {low:g} to {high:g}")
