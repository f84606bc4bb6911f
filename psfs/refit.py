"""Sparse Laplacians by least squares: which points, and what values.

LKS sums the Laplacian over the Voronoi cell of each point. Given the points, better values follow from a linear fit of
what they integrate to, with constraints that keep them from being seen far away: a sum of Green's functions falls off
the faster, the more of its moments vanish. And given the fit, the points follow as well: begin with many, and take away
the one whose loss costs least, again and again (the *surgeon's* rule: without point i, the best fit is worse by
``v_i**2 / (H^-1)_ii``). One run gives the best sets found of every size.
"""

from collections.abc import Callable
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from torchbokeh.ops.integrate import lattice_green, poisson_fft
from torchbokeh.psfs.arrays import Array, Points
from torchbokeh.psfs.model import Symmetry

OUTSIDE = 3.0
"""Weight of a pixel that the PSF does not reach: what leaks there is seen over dark surroundings."""

MARGIN = 8
"""Pixels around the PSF that take part in the fit."""

RIDGE = 1e-13
"""Of the mean diagonal of the normal equations; neighbouring points are nearly the same to the fit."""

HEAVY = 1e3
"""Weight of the constraints, as observations, while points are given up."""

TRIED = 8
"""Points of a set that an exchange tries to replace."""

EXCHANGED = (4, 100)
"""Orbits of a set between which exchanges are tried: of more, none is bettered."""

REFRESH = 64
"""Steps of an elimination after which its inverse is computed anew."""


class Sparse(NamedTuple):
    """A sparse picture in some domain.

    Attributes:
        points: ``(n, 2)`` whole offsets (dx, dy) in px from the centre.
        values: ``(n, C)``.
    """

    points: Points
    values: Array


def reflections(points: Points, symmetry: Symmetry) -> list[Points]:
    """The images of offsets ``(n, 2)`` under a symmetry, themselves first. Some may coincide."""
    signs = {"none": [(1, 1)], "mirror": [(1, 1), (1, -1)]}.get(symmetry, [(1, 1), (1, -1), (-1, 1), (-1, -1)])
    images = [points * np.array(sign) for sign in signs]
    return images + [image[:, ::-1] for image in images] if symmetry == "octants" else images


def fundamental(points: Points, symmetry: Symmetry) -> Points:
    """One representative of every orbit, without repetition."""
    x, y = points.T
    if symmetry != "none":
        y = np.abs(y)
    if symmetry in ("quadrants", "octants"):
        x = np.abs(x)
    if symmetry == "octants":
        x, y = np.maximum(x, y), np.minimum(x, y)
    return np.unique(np.stack([x, y], 1), axis=0)


def orbits(sparse: Sparse, symmetry: Symmetry) -> Sparse:
    """All points of orbits whose representatives and values are given."""
    images = reflections(sparse.points, symmetry)
    points, first = np.unique(np.concatenate(images), axis=0, return_index=True)
    return Sparse(points, sparse.values[first % len(sparse.points)])


class Fit:
    """Normal equations of values at candidate points, for all sets of them.

    Args:
        psf: ``(C, h, w)``, odd sizes, centred.
        candidates: ``(m, 2)`` representatives of orbits, as (dx, dy).
        symmetry: of the PSF.
    """

    def __init__(self, psf: Array, candidates: Points, symmetry: Symmetry) -> None:
        self.candidates, self.symmetry = candidates, symmetry
        channels, height, width = psf.shape
        wide = np.pad(psf, ((0, 0), (MARGIN, MARGIN), (MARGIN, MARGIN)))
        reach_y, reach_x = height // 2 + MARGIN, width // 2 + MARGIN
        top = 0 if symmetry == "none" else reach_y
        left = reach_x if symmetry in ("quadrants", "octants") else 0
        seen = wide[:, top:, left:]
        times = np.ones(seen.shape[1:])
        if top:
            times[1:] *= 2
        if left:
            times[:, 1:] *= 2
        times[~(seen > 0).any(0)] *= OUTSIDE**2
        rows, columns = np.arange(top, 2 * reach_y + 1) - reach_y, np.arange(left, 2 * reach_x + 1) - reach_x
        far = np.abs(candidates).max(initial=0) + max(reach_y, reach_x)
        quarter = lattice_green(far + 1, far + 1).numpy()
        green = np.block([[quarter[:0:-1, :0:-1], quarter[:0:-1]], [quarter[:, :0:-1], quarter]])

        images = reflections(candidates, symmetry)
        same = [np.all(image[:, None] == np.stack(images, 1)[:, :k], 2).any(1) for k, image in enumerate(images)]
        design = np.empty((len(candidates), *seen.shape[1:]))
        self.moments = np.zeros((len(candidates), 6))
        for number, column in enumerate(design):
            column[:] = 0.0
            for image, twice in zip(images, same, strict=True):
                if twice[number]:
                    continue
                x, y = image[number]
                y0, x0 = far + rows[0] - y, far + columns[0] - x
                column += green[y0 : y0 + len(rows), x0 : x0 + len(columns)]
                self.moments[number] += (1.0, (x * x + y * y) / 4, x, y, x * x - y * y, x * y)
        root = np.sqrt(times).ravel()
        flat = design.reshape(len(candidates), -1)
        flat *= root
        wanted = seen.reshape(channels, -1) * root
        self.normal = flat @ flat.T
        self.target = flat @ wanted.T
        self.energy = float((wanted**2).sum())
        scale = np.abs(self.moments).max(0)
        asked = np.zeros((6, channels))
        asked[1] = psf.sum((1, 2))
        present = scale > 0
        self.moments = self.moments[:, present] / scale[present]
        self.asked = asked[present] / scale[present, None]

    def values(self, chosen: NDArray[np.int64]) -> Array:
        """Values ``(n, C)`` of chosen candidates: the best fit whose moments are right.

        The sums of v, v x, v y, v (x**2 - y**2) and v x y vanish, as far as symmetry does not see to that by itself:
        then little is seen far away. That of v (x**2 + y**2) / 4 is the light of the PSF.
        """
        normal = self._regular(chosen)
        # Without enough points for all of them, the first ones are kept.
        kept = max(min(self.moments.shape[1], len(chosen) - 1), 0)
        bound = self.moments[chosen, :kept].T
        free = np.linalg.solve(normal, np.concatenate([self.target[chosen], bound.T], 1))
        fitted, reaction = np.split(free, [self.target.shape[1]], axis=1)
        if not kept:
            return fitted
        push, *_ = np.linalg.lstsq(bound @ reaction, bound @ fitted - self.asked[:kept], rcond=None)
        return fitted - reaction @ push

    def sparse(self, chosen: NDArray[np.int64]) -> Sparse:
        """All points of the chosen orbits, with the best values."""
        return orbits(Sparse(self.candidates[chosen], self.values(chosen)), self.symmetry)

    def _regular(self, chosen: NDArray[np.int64]) -> Array:
        normal = self.normal[np.ix_(chosen, chosen)]
        return normal + RIDGE * np.mean(np.diag(self.normal)) * np.eye(len(chosen))

    @cached_property
    def _bound(self) -> tuple[Array, Array]:
        """Normal equations with the constraints as heavy observations: what they cost is then in every score."""
        weighty = HEAVY * np.mean(np.diag(self.normal)) * self.moments
        normal = self._regular(np.arange(len(self.candidates))) + weighty @ self.moments.T
        return normal, self.target + weighty @ self.asked

    def elimination(self) -> NDArray[np.int64]:
        """The candidates in the order in which they are given up: any set of the last n is a good one of its size."""
        alive = np.arange(len(self.candidates))
        order: list[int] = []
        normal, target = self._bound
        while len(alive):
            inverse = np.linalg.inv(normal[np.ix_(alive, alive)])
            values = inverse @ target[alive]
            present = np.ones(len(alive), bool)
            for _ in range(min(REFRESH, len(alive))):
                diagonal = np.where(present, np.diag(inverse), 1.0)
                score = np.where(present, (values**2).sum(1) / diagonal, np.inf)
                i = int(score.argmin())
                order.append(int(alive[i]))
                present[i] = False
                column = inverse[:, i] / inverse[i, i]
                values = values - column[:, None] * values[i]
                inverse -= np.outer(column, inverse[i])
            alive = alive[present]
        return np.array(order, np.int64)

    def exchange(self, chosen: NDArray[np.int64]) -> NDArray[np.int64]:
        """Replace points by better ones, one at a time, until none of the few that matter least can be bettered."""
        for _ in range(len(chosen)):
            for place in self._weakest(chosen)[:TRIED]:
                better = self._replaced(chosen, int(place))
                if better is not None:
                    chosen = better
                    break
            else:
                break
        return chosen

    def _weakest(self, chosen: NDArray[np.int64]) -> NDArray[np.int64]:
        """Places in ``chosen``, by what the loss of each would cost."""
        normal, target = self._bound
        inverse = np.linalg.inv(normal[np.ix_(chosen, chosen)])
        return np.argsort(((inverse @ target[chosen]) ** 2).sum(1) / np.diag(inverse))

    def without_weakest(self, chosen: NDArray[np.int64]) -> NDArray[np.int64]:
        """All but the point whose loss costs least."""
        return np.delete(chosen, self._weakest(chosen)[0])

    def _replaced(self, chosen: NDArray[np.int64], place: int) -> NDArray[np.int64] | None:
        """The set with another point at a place, the best one; None if that is the one that is there."""
        normal, target = self._bound
        rest = np.delete(chosen, place)
        inverse = np.linalg.inv(normal[np.ix_(rest, rest)])
        across = normal[:, rest]
        left = target - across @ (inverse @ target[rest])
        room = np.diag(normal) - ((across @ inverse) * across).sum(1)
        gain = (left**2).sum(1) / np.maximum(room, 1e-14 * np.diag(normal))
        gain[rest] = -1.0
        best = int(gain.argmax())
        if gain[best] <= gain[chosen[place]] * (1 + 1e-6):
            return None
        return np.append(rest, best)


def fewest(fit: Fit, good: Callable[[Sparse], bool]) -> Sparse:
    """The smallest set of an elimination that is good enough, or all candidates if none is.

    Args:
        fit: of the candidates.
        good: tells whether a sparse picture will do. Taken to hold for all sets larger than one for which it holds.
    """
    order = fit.elimination()
    low, high = 0, len(order)  # `low` orbits are too few, `high` are enough or all there are
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if good(fit.sparse(order[-middle:])) else (middle, high)
    chosen = order[len(order) - high :]
    if not EXCHANGED[0] <= len(chosen) <= min(EXCHANGED[1], len(order) - 1):
        return fit.sparse(chosen)
    # Few points gain most from better places; then one or another can go.
    while len(fewer := fit.without_weakest(chosen)) >= EXCHANGED[0] and good(fit.sparse(fewer := fit.exchange(fewer))):
        chosen = fewer
    return fit.sparse(chosen)


def drawn(sparse: Sparse, reach: tuple[int, int]) -> Array:
    """The points in a picture ``(C, 2 ry + 1, 2 rx + 1)`` that holds them, by its reach; those that meet add up."""
    reach_y, reach_x = reach
    height, width = 2 * reach_y + 1, 2 * reach_x + 1
    flat = (sparse.points[:, 1] + reach_y) * width + sparse.points[:, 0] + reach_x
    planes = [np.bincount(flat, weights, height * width) for weights in sparse.values.T]
    return np.stack(planes).astype(np.float64).reshape(-1, height, width)


def reconstruction(sparse: Sparse, size: tuple[int, int]) -> Array:
    """What a sparse Laplacian integrates to: ``(C, h, w)``, odd sizes, centred; in free space, exactly."""
    height, width = size
    far_x, far_y = np.abs(sparse.points).max(0, initial=0).tolist()
    reach_y, reach_x = max(far_y, height // 2), max(far_x, width // 2)
    buffer = torch.from_numpy(drawn(sparse, (reach_y, reach_x)))
    whole = poisson_fft(buffer[None], compact=False)[0].numpy()
    top, left = reach_y - height // 2, reach_x - width // 2
    return whole[:, top : top + height, left : left + width]
