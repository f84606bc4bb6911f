"""The quad tree: its squares, what it keeps, and how it compares with sparse Laplacians."""

import doctest
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import torchbokeh.psfs.quadtree
from torchbokeh.psfs.arrays import Array
from torchbokeh.psfs.combined import capsule
from torchbokeh.psfs.quadtree import quadtree, tree
from torchbokeh.psfs.refit import reconstruction
from torchbokeh.psfs.similarity import centred, neighbourhood, score
from torchbokeh.psfs.sparsify import sparsify


def noise(*shape: int) -> Array:
    return np.random.default_rng(1).random(shape)


@given(st.floats(0.0, 12.0), st.integers(0, 20), st.integers(1, 300))
@settings(max_examples=60, deadline=None)
def test_squares_tile_the_light_and_keep_it(radius: float, length: int, leaves: int) -> None:
    psf = capsule(radius, length)
    squares, near = tree(psf, leaves), quadtree(psf, leaves)
    covered = np.zeros_like(psf)
    for square in squares:
        square.seen(covered)[:] += 1
        np.testing.assert_allclose(square.seen(near), square.seen(psf).mean(), rtol=1e-12)
    assert covered.max() == 1
    assert ((covered == 1) | (psf <= 1e-12 * psf.max())).all()
    assert near.sum() == pytest.approx(psf.sum(), rel=1e-11)
    assert len(squares) <= leaves
    assert len(squares) >= leaves - 2 or np.abs(near - psf).max() <= 1e-12 * psf.max()


def test_one_square_is_the_mean() -> None:
    psf = noise(3, 7, 11)
    np.testing.assert_allclose(quadtree(psf, 1), np.broadcast_to(psf.mean((1, 2), keepdims=True), psf.shape))


def test_enough_squares_are_exact() -> None:
    psf = noise(2, 9, 13)
    assert len(tree(psf, 10_000)) == 9 * 13
    np.testing.assert_array_equal(quadtree(psf, 9 * 13), psf)


def test_dark_squares_are_not_counted() -> None:
    psf = np.zeros((1, 31, 31))
    psf[0, 3, 20] = 1.0
    assert len(tree(psf, 1)) == 1
    np.testing.assert_array_equal(quadtree(psf, 1), psf)


def test_constant_squares_are_found_with_no_more_than_there_are() -> None:
    rng = np.random.default_rng(2)
    wide = rng.random((2, 2)).repeat(8, 0).repeat(8, 1)
    wide[8:, 8:] = rng.random((2, 2)).repeat(4, 0).repeat(4, 1)
    wide[12:, 8:12] = rng.random((2, 2)).repeat(2, 0).repeat(2, 1)
    psf = wide[None, 1:, 1:]  # the first row and column of the root lie outside a picture of odd size
    assert len(tree(psf, 1000)) == 10
    np.testing.assert_allclose(quadtree(psf, 10), psf, rtol=1e-12)
    assert np.abs(quadtree(psf, 9) - psf).max() > 1e-3


def test_the_largest_error_is_split_first() -> None:
    psf = np.ones((1, 15, 15))
    psf[0, 3, 3] += 1.0
    psf[0, 11, 11] += 2.0
    near = quadtree(psf, 7)
    assert np.ptp(near[0, :7, :7]) == 0
    assert np.ptp(near[0, 7:, 7:]) > 0


def test_squared_error_falls_with_the_number_of_squares() -> None:
    psf = capsule(20.0, 30.0)
    errors = [((quadtree(psf, n) - psf) ** 2).sum() for n in (4, 16, 64, 256, 1024)]
    assert all(b < 0.9 * a for a, b in pairwise(errors))


@pytest.mark.parametrize(("radius", "length"), [(25.0, 60.0), (20.0, 40.0)])
def test_at_equal_sparsity_it_is_less_similar_than_a_sparse_laplacian(radius: float, length: float) -> None:
    psf = capsule(radius, length)
    sparse = sparsify(psf, round(0.093 * np.count_nonzero(psf)), seed=0)
    squares = centred(quadtree(psf, len(sparse.points)), neighbourhood(psf))
    ours, theirs = score(psf, reconstruction(sparse, neighbourhood(psf))), score(psf, squares)
    assert ours.ssim > theirs.ssim + 0.02
    assert ours.l1 < 0.8 * theirs.l1


def test_bad_arguments_are_named() -> None:
    with pytest.raises(ValueError, match=r"psf: expected shape \(C, h, w\) of odd h and w, got \(1, 4, 5\)"):
        quadtree(np.ones((1, 4, 5)), 3)
    with pytest.raises(ValueError, match="leaves: expected at least 1, got 0"):
        quadtree(np.ones((1, 5, 5)), 0)


def test_examples() -> None:
    assert doctest.testmod(torchbokeh.psfs.quadtree).failed == 0
