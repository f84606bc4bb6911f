"""Sparse Laplacians: exact where all points are there, constraints, symmetry, and the order of an elimination."""

import numpy as np
import pytest

from torchbokeh.psfs.combined import capsule
from torchbokeh.psfs.model import Symmetry
from torchbokeh.psfs.refit import Fit, Sparse, fewest, fundamental, orbits, reconstruction, reflections
from torchbokeh.psfs.represent import laplacian, nonzero
from torchbokeh.psfs.similarity import neighbourhood, score

POINTS = np.array([[3, 1], [0, 2], [-4, 0], [2, 2], [0, 0]])


@pytest.mark.parametrize(("symmetry", "most"), [("none", 1), ("mirror", 2), ("quadrants", 4), ("octants", 8)])
def test_orbits_are_those_of_the_symmetry(symmetry: Symmetry, most: int) -> None:
    images = reflections(POINTS, symmetry)
    assert len(images) == most
    one = orbits(Sparse(POINTS[:1], np.ones((1, 1))), symmetry)
    assert len(one.points) == most
    for image in images:
        np.testing.assert_array_equal(fundamental(image, symmetry), fundamental(POINTS, symmetry))


def test_a_point_on_an_axis_counts_once() -> None:
    whole = orbits(Sparse(POINTS[1:], np.arange(4.0)[:, None]), "quadrants")
    assert len(whole.points) == len(np.unique(whole.points, axis=0)) == 2 + 2 + 4 + 1
    assert whole.values.sum() == 2 * 0 + 2 * 1 + 4 * 2 + 3


def test_all_points_of_the_laplacian_give_the_psf_back() -> None:
    psf = capsule(5.3, 8.0)
    exact = nonzero(laplacian(psf))
    np.testing.assert_allclose(reconstruction(exact, (41, 41))[:, 20 - 5 : 26, 20 - 9 : 30], psf, atol=1e-14)
    fit = Fit(psf, fundamental(exact.points, "quadrants"), "quadrants")
    found = fit.sparse(np.arange(len(fit.candidates)))
    assert score(psf, reconstruction(found, neighbourhood(psf))).l1 < 1e-6


@pytest.mark.parametrize("symmetry", ["none", "mirror", "quadrants", "octants"])
def test_moments_are_right_for_any_set(symmetry: Symmetry) -> None:
    psf = np.concatenate([capsule(6.0, 0.0), 0.5 * capsule(6.0, 0.0)])
    fit = Fit(psf, fundamental(nonzero(laplacian(psf)).points, symmetry), symmetry)
    chosen = np.random.default_rng(1).permutation(len(fit.candidates))[: max(8, len(fit.candidates) // 2)]
    sparse = fit.sparse(chosen)
    x, y = sparse.points.T
    for moment in (np.ones_like(x), x, y, x * x - y * y, x * y):
        np.testing.assert_allclose(moment @ sparse.values, 0, atol=1e-8)
    np.testing.assert_allclose((x * x + y * y) @ sparse.values / 4, [1.0, 0.5], rtol=1e-9)


def test_little_is_seen_far_away() -> None:
    psf = capsule(8.0, 12.0)
    fit = Fit(psf, fundamental(nonzero(laplacian(psf)).points, "quadrants"), "quadrants")
    sparse = fit.sparse(fit.elimination()[-20:])
    near, far = (np.abs(reconstruction(sparse, (2 * d + 1,) * 2)[0, 0]).max() for d in (60, 240))
    assert near < 1e-4 * psf.max()
    assert far < near / 4**3.5  # the fourth moments are the first that are left


def test_values_are_the_least_squares() -> None:
    """Nudging the values within the constraints only makes the weighted error larger."""
    psf = capsule(4.0, 5.0)
    fit = Fit(psf, fundamental(nonzero(laplacian(psf)).points, "quadrants"), "quadrants")
    chosen = fit.elimination()[-14:]
    values = fit.values(chosen)[:, 0]
    normal, target = fit.normal[np.ix_(chosen, chosen)], fit.target[chosen, 0]

    def error(v: np.ndarray) -> float:
        return float(v @ normal @ v - 2 * v @ target)

    free = np.linalg.svd(fit.moments[chosen].T)[2][fit.moments.shape[1] :]
    assert len(free) > 5
    for direction in free:
        for step in (1e-3, -1e-3):
            assert error(values + step * np.abs(values).max() * direction) > error(values)


def test_an_elimination_keeps_what_matters() -> None:
    psf = capsule(10.0, 14.0)
    fit = Fit(psf, fundamental(nonzero(laplacian(psf)).points, "quadrants"), "quadrants")
    order = fit.elimination()
    assert sorted(order) == list(range(len(fit.candidates)))
    draw = np.random.default_rng(3)

    def l1(chosen: np.ndarray) -> float:
        return score(psf, reconstruction(fit.sparse(chosen), neighbourhood(psf))).l1

    count = len(order) // 3
    by_chance = min(l1(draw.permutation(len(order))[:count]) for _ in range(5))
    assert l1(order[-count:]) < 0.35 * by_chance  # 0.31 here


def test_the_fewest_that_will_do() -> None:
    psf = capsule(6.0, 9.0)
    fit = Fit(psf, fundamental(nonzero(laplacian(psf)).points, "quadrants"), "quadrants")
    sizes = []

    def good(sparse: Sparse) -> bool:
        sizes.append(len(sparse.points))
        return len(sparse.points) >= 40

    found = fewest(fit, good)
    assert 40 <= len(found.points) < 48
    assert len(sizes) < 12
    everything = fewest(fit, lambda sparse: False)
    assert len(everything.points) == len(orbits(Sparse(fit.candidates, fit.candidates), "quadrants").points)


def test_exchanges_only_better_a_set() -> None:
    psf = capsule(8.0, 20.0)
    fit = Fit(psf, fundamental(nonzero(laplacian(psf)).points, "quadrants"), "quadrants")
    chosen = fit.elimination()[-14:]
    better = fit.exchange(chosen)
    assert len(np.unique(better)) == len(chosen)

    def l2(chosen: np.ndarray) -> float:
        values = fit.values(chosen)
        normal = fit.normal[np.ix_(chosen, chosen)]
        return float(np.sum(values * (normal @ values) - 2 * values * fit.target[chosen]) + fit.energy)

    assert 0 < l2(better) < 0.95 * l2(chosen)
    assert set(fit.without_weakest(chosen)) < set(chosen)
    assert len(fit.exchange(np.arange(len(fit.candidates)))) == len(fit.candidates)
