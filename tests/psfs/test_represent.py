"""Domains: what represents a PSF in the fewest points, and how near that comes."""

import numpy as np
import pytest

from torchbokeh.psfs.combined import capsule
from torchbokeh.psfs.refit import Sparse, fundamental
from torchbokeh.psfs.represent import (
    NOTHING,
    Represented,
    Target,
    candidates,
    diffused,
    laplacian,
    nonzero,
    represent,
    scanline,
)
from torchbokeh.psfs.similarity import Score, centred, neighbourhood, score
from torchbokeh.psfs.table import integrated


def test_the_laplacian_is_that_of_the_stencil() -> None:
    dot = np.zeros((1, 3, 3))
    dot[0, 1, 1] = 2.0
    want = np.zeros((1, 5, 5))
    want[0, 2, 2] = -8.0
    want[0, [1, 3, 2, 2], [2, 2, 1, 3]] = 2.0
    np.testing.assert_array_equal(laplacian(dot), want)
    assert laplacian(capsule(7.0, 9.0)).sum() == pytest.approx(0, abs=1e-15)


@pytest.mark.parametrize("psf", [capsule(5.0, 0.0), capsule(3.0, 8.0), capsule(0.0, 0.0)])
def test_row_differences_are_exact(psf: np.ndarray) -> None:
    got = integrated(Represented("scanline", scanline(psf)), (31, 31))
    np.testing.assert_allclose(got, centred(psf, (31, 31)), atol=1e-15)


def test_points_of_a_picture() -> None:
    picture = np.zeros((2, 3, 5))
    picture[1, 0, 4] = 3.0
    points, values = nonzero(picture)
    assert points.tolist() == [[2, -1]]
    assert values.tolist() == [[0.0, 3.0]]


def test_candidates_lie_where_the_laplacian_is_and_are_about_as_many_as_asked_for() -> None:
    psf = capsule(30.0, 50.0)
    few = candidates(psf, "quadrants", 150)
    assert 120 < len(few) < 180
    strength = np.abs(laplacian(psf))[0]
    middle = np.array([strength.shape[1] // 2, strength.shape[0] // 2])
    x, y = (few + middle).T
    assert strength[y, x].min() > 0
    # Dense along the rim, where the PSF bends most, with some inside.
    assert np.mean(strength[y, x] > strength.max() / 10) > 0.5
    exact = laplacian(capsule(4.0, 3.0))
    exact[np.abs(exact) < NOTHING * np.abs(exact).max()] = 0.0
    all_of_them = candidates(capsule(4.0, 3.0), "quadrants")
    assert len(all_of_them) == len(fundamental(nonzero(exact).points, "quadrants"))


def test_error_diffusion_keeps_the_sum() -> None:
    density = np.full((60, 80), 0.13)
    drawn = diffused(density)
    assert set(np.unique(drawn)) == {0.0, 1.0}
    assert drawn.sum() == pytest.approx(density.sum(), rel=0.03)
    blocks = drawn.reshape(6, 10, 8, 10).sum((1, 3))
    assert blocks.max() - blocks.min() <= 6  # a Poisson process would spread by 20


@pytest.mark.parametrize(
    ("radius", "length", "turns", "target", "domain"),
    [
        (0.0, 0.0, True, Target(), "direct"),
        (1.5, 2.0, True, Target(), "direct"),
        (25.0, 40.0, True, Target(), "laplacian"),
        (25.0, 0.0, False, Target(0.999, 0.003), "scanline"),
    ],
)
def test_the_sparsest_domain_is_taken(radius: float, length: float, turns: bool, target: Target, domain: str) -> None:
    psf = capsule(radius, length)
    found = represent(psf, "quadrants", turns=turns, target=target)
    assert found.domain == domain
    near = score(psf, integrated(found, neighbourhood(psf)))
    assert near.ssim >= target.ssim
    assert near.l1 <= target.l1
    assert len(found.sparse.points) <= (psf > 0).sum()


def test_more_is_asked_more_points_are_taken() -> None:
    psf = capsule(20.0, 35.0)
    few, many = (represent(psf, "quadrants", turns=True, target=Target(s, 1.0)) for s in (0.9, 0.98))
    assert len(few.sparse.points) < 0.6 * len(many.sparse.points)


def test_what_cannot_be_reached_takes_the_best_there_is() -> None:
    psf = capsule(25.0, 40.0)
    found = represent(psf, "quadrants", turns=True, target=Target(2.0, 0.0))
    assert found.domain == "laplacian"
    assert len(found.sparse.points) < (psf > 0).sum()


def test_scores() -> None:
    psf = capsule(6.0, 6.0)
    size = neighbourhood(psf)
    assert score(psf, centred(psf, size)) == Score(pytest.approx(1), pytest.approx(1), pytest.approx(0))
    worse = score(psf, centred(1.2 * psf, size))
    assert worse.l1 == pytest.approx(0.2)
    assert worse.ssim < worse.ssim_frame < 1
    empty = score(psf, np.zeros((1, *size)))
    assert empty.l1 == 1


def test_pictures_are_centred_in_any_odd_size() -> None:
    picture = np.arange(15.0).reshape(1, 3, 5)
    assert centred(picture, (5, 3))[0].tolist() == [[0, 0, 0], [1, 2, 3], [6, 7, 8], [11, 12, 13], [0, 0, 0]]
    assert integrated(Represented("direct", Sparse(np.array([[1, 0]]), np.array([[2.0]]))), (1, 3)).tolist() == [
        [[0, 0, 2]]
    ]
