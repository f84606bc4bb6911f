"""The four steps of LKS's sparsification, each against what defines it."""

import doctest
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import torchbokeh.psfs.sparsify
from torchbokeh.psfs.arrays import Array, Points
from torchbokeh.psfs.combined import capsule
from torchbokeh.psfs.refit import Sparse, reconstruction
from torchbokeh.psfs.represent import laplacian, nonzero
from torchbokeh.psfs.similarity import neighbourhood, score
from torchbokeh.psfs.sparsify import (
    ablation,
    anneal,
    cells,
    dart_throwing,
    lloyd,
    merged,
    points_for,
    sparsify,
    voronoi_sums,
)

seeds = st.integers(0, 2**31)
PSF = capsule(7.0, 12.0)


def noise(*shape: int) -> Array:
    return np.random.default_rng(1).random(shape)


def squared_distances(a: Array | Points, b: Array | Points) -> Array:
    return ((a[:, None] - b[None]) ** 2).sum(2)


def at(picture: Array, points: Points) -> Array:
    return picture[points[:, 1] + picture.shape[0] // 2, points[:, 0] + picture.shape[1] // 2]


def start(count: int) -> Points:
    return points_for(np.abs(laplacian(PSF)).sum(0), count, 0)


def l1(sparse: Sparse) -> float:
    return score(PSF, reconstruction(sparse, neighbourhood(PSF))).l1


@given(st.floats(0.0, 1.0), seeds)
@settings(max_examples=40, deadline=None)
def test_no_two_darts_are_nearer_than_the_smaller_radius(scale: float, seed: int) -> None:
    importance = noise(21, 33) ** 3
    points = dart_throwing(importance, scale, seed, failures=500)
    radius = np.minimum(scale / np.sqrt(at(importance, points) / importance.sum()), 54)
    least = np.minimum(radius[:, None], radius) ** 2
    far = squared_distances(points, points) >= least * (1 - 1e-12)
    assert (far | np.eye(len(points), dtype=bool)).all()
    assert len(merged(points)) == len(points)


def test_where_no_more_darts_fit_every_pixel_is_within_the_smaller_radius_of_one() -> None:
    importance = 1 + 8 * noise(21, 31)
    points = dart_throwing(importance, 0.15, 0)
    pixels = nonzero(importance[None]).points
    own, kept = (0.15 / np.sqrt(at(importance, p) / importance.sum()) for p in (pixels, points))
    assert (squared_distances(pixels, points) < np.minimum(own[:, None], kept) ** 2).any(1).all()


def test_darts_are_as_dense_as_the_importance() -> None:
    importance = np.ones((151, 201))
    importance[:, :100] = 9
    points = dart_throwing(importance, 0.03, 0)
    left = np.count_nonzero(points[:, 0] < 0)
    assert left / (len(points) - left) == pytest.approx(9, rel=0.1)
    importance[:, :100] = 0
    assert dart_throwing(importance, 0.03, 0)[:, 0].min() >= 0


def test_more_failures_only_add_darts() -> None:
    few, many = (dart_throwing(noise(31, 31), 0.05, 3, failures=n) for n in (10, 2000))
    assert 0 < len(few) < len(many)
    np.testing.assert_array_equal(few, many[: len(few)])


def test_without_a_radius_darts_find_every_pixel_and_with_a_large_one_a_single_one() -> None:
    importance = np.ones((9, 11))
    importance[2, 3] = 0
    assert len(dart_throwing(importance, 0.0, 0)) == 98
    assert len(dart_throwing(importance, 1e9, 0)) == 1


@pytest.mark.parametrize("count", [1, 7, 60, 400])
def test_about_as_many_points_are_found_as_wanted(count: int) -> None:
    assert len(points_for(noise(61, 41), count, 0)) == pytest.approx(count, rel=0.02)


def test_no_more_points_are_found_than_pixels() -> None:
    assert len(points_for(np.ones((5, 7)), 1000, 0)) == 35


@given(seeds, st.integers(1, 60))
@settings(max_examples=60, deadline=None)
def test_cells_are_the_first_of_the_nearest(seed: int, count: int) -> None:
    points = np.random.default_rng(seed).integers(-8, 9, (count, 2))
    places = nonzero(np.ones((1, 23, 23))).points
    # On a small lattice most places are as near to several points; argmin takes the first.
    np.testing.assert_array_equal(cells(points, places), squared_distances(places, points).argmin(1))


@given(seeds)
@settings(max_examples=15, deadline=None)
def test_relaxation_gathers_the_importance(seed: int) -> None:
    importance = noise(31, 31) ** 4
    before = np.random.default_rng(seed).integers(-15, 16, (20, 2))
    places = nonzero(importance[None])
    after = lloyd(before, importance)
    spread = [float(places.values[:, 0] @ squared_distances(places.points, p).min(1)) for p in (before, after)]
    assert spread[1] < spread[0]
    assert len(merged(after)) == len(after) <= 20


def test_relaxation_finds_single_peaks_and_stays_there() -> None:
    importance = np.zeros((21, 21))
    peaks = np.array([[-8, -7], [6, -9], [0, 9]])
    importance[peaks[:, 1] + 10, peaks[:, 0] + 10] = [1.0, 5.0, 0.1]
    np.testing.assert_array_equal(lloyd(peaks + np.array([[2, 1], [-3, 0], [1, -4]]), importance), peaks)
    np.testing.assert_array_equal(lloyd(peaks, importance), peaks)


def test_relaxation_merges_points_that_meet() -> None:
    importance = np.zeros((3, 3))
    importance[[1, 1, 2], [1, 2, 1]] = 1
    # The centroid (1/2, 1/2) of the pixels (1, 0) and (0, 1) rounds to (0, 0), where the other point is.
    assert lloyd(np.array([[1, 1], [0, 0]]), importance).tolist() == [[0, 0]]


@given(seeds, st.integers(1, 30))
@settings(max_examples=30, deadline=None)
def test_voronoi_sums_keep_the_total_of_every_channel(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    picture = rng.standard_normal((3, 15, 19))
    values = voronoi_sums(rng.integers(-9, 10, (count, 2)), picture)
    assert values.shape == (count, 3)
    np.testing.assert_allclose(values.sum(0), picture.sum((1, 2)), atol=1e-12)


def test_a_point_at_every_pixel_keeps_the_laplacian_as_it_is() -> None:
    full = nonzero(laplacian(PSF))
    np.testing.assert_array_equal(voronoi_sums(full.points, laplacian(PSF)), full.values)
    # Nothing is better than no error: the annealing returns what it was given.
    kept = anneal(full.points, laplacian(PSF), PSF, 0, steps=20)
    np.testing.assert_array_equal(kept.points, full.points)
    assert l1(kept) < 1e-12


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_annealing_never_leaves_a_larger_error(seed: int) -> None:
    points = start(60)
    errors = [l1(anneal(points, laplacian(PSF), PSF, seed, steps=steps)) for steps in (0, 10, 200)]
    assert errors[0] == l1(Sparse(points, voronoi_sums(points, laplacian(PSF))))
    assert errors[0] >= errors[1]
    assert errors[2] < 0.8 * errors[0]


def test_annealing_returns_distinct_points_and_their_sums() -> None:
    points = start(60)
    found = anneal(points, laplacian(PSF), PSF, 0, share=0.5)
    assert len(merged(found.points)) == len(found.points) <= len(points)
    np.testing.assert_array_equal(found.values, voronoi_sums(found.points, laplacian(PSF)))


def test_a_step_moves_its_share_of_points_by_a_pixel() -> None:
    points, moved = start(40), 0
    for seed in range(20):
        found = anneal(points, laplacian(PSF), PSF, seed, steps=1, share=0.05).points
        if len(found) == len(points):
            shifts = np.abs(found - points).max(1)
            assert shifts.max() <= 1
            assert np.count_nonzero(shifts) <= 2
            moved += int(shifts.any())
    assert moved > 3


def test_points_do_not_leave_the_neighbourhood() -> None:
    psf = np.ones((1, 1, 1))
    corner = np.array([[8, -8], [-8, 8], [0, 0]])
    found = anneal(corner, laplacian(psf), psf, 0, share=1.0)
    assert np.abs(found.points).max() <= 8


def test_the_same_seed_gives_the_same() -> None:
    one, two, other = (sparsify(PSF, 60, seed) for seed in (5, 5, 6))
    np.testing.assert_array_equal(one.points, two.points)
    np.testing.assert_array_equal(one.values, two.values)
    assert one.points.tolist() != other.points.tolist()


def test_values_sum_to_nothing_so_that_nothing_is_seen_far_away() -> None:
    sparse = sparsify(PSF, 60, 0)
    assert sparse.values.sum() == pytest.approx(0, abs=1e-15)
    far = reconstruction(sparse, (401, 401))[0]
    assert np.abs(far[[0, -1]]).max() < 0.01 * PSF.max()


def test_channels_share_their_points() -> None:
    grey = sparsify(PSF, 60, 0, annealing=False)
    colour = sparsify(np.concatenate([PSF, 0.5 * PSF, 0 * PSF]), 60, 0, annealing=False)
    np.testing.assert_array_equal(colour.points, grey.points)
    np.testing.assert_allclose(colour.values, grey.values * [[1, 0.5, 0]], atol=1e-18)


def test_each_switch_leaves_out_its_step() -> None:
    strength = np.abs(laplacian(PSF)).sum(0)
    darts = points_for(strength, 60, 4)
    relaxed = lloyd(darts, strength)
    for on, points in ((False, darts), (True, relaxed)):
        plain = sparsify(PSF, 60, 4, relaxation=on, annealing=False)
        np.testing.assert_array_equal(plain.points, points)
        annealed = sparsify(PSF, 60, 4, relaxation=on)
        np.testing.assert_array_equal(annealed.points, anneal(points, laplacian(PSF), PSF, 4).points)
    assert relaxed.tolist() != darts.tolist()


def test_the_ablation_is_the_ratio_of_mean_errors() -> None:
    psfs = [PSF, capsule(5.0, 9.0)]
    found = ablation(psfs, 0.3, 0)
    errors = []
    for relaxation in (False, True):
        made = [sparsify(p, round(0.3 * np.count_nonzero(p)), 0, relaxation=relaxation, annealing=False) for p in psfs]
        errors.append(sum(score(p, reconstruction(s, neighbourhood(p))).l1 for p, s in zip(psfs, made, strict=True)))
    assert found.darts == 1
    assert found.relaxation == pytest.approx(errors[1] / errors[0])
    assert found.annealing < 1
    assert found.both < found.relaxation


def test_bad_arguments_are_named() -> None:
    with pytest.raises(ValueError, match=r"importance: expected shape \(h, w\) of odd h and w, got \(4, 5\)"):
        dart_throwing(np.ones((4, 5)), 1.0, 0)
    with pytest.raises(ValueError, match="importance: expected finite numbers from 0 on, not all 0, got 0 to 0"):
        points_for(np.zeros((3, 3)), 1, 0)
    with pytest.raises(ValueError, match="importance: expected finite numbers from 0 on, not all 0, got -1 to 1"):
        dart_throwing(np.array([[-1.0, 0.0, 1.0]]), 1.0, 0)
    with pytest.raises(ValueError, match="scale: expected a finite number of at least 0, got nan"):
        dart_throwing(np.ones((3, 3)), math.nan, 0)
    with pytest.raises(ValueError, match="count: expected at least 1, got 0"):
        sparsify(PSF, 0, 0)
    with pytest.raises(ValueError, match=r"psf: expected shape \(C, h, w\) of odd h and w, got \(15, 27\)"):
        sparsify(PSF[0, :, :], 10, 0)
    with pytest.raises(ValueError, match=r"psf: expected finite numbers .* got nan to nan"):
        sparsify(PSF * math.nan, 10, 0)
    with pytest.raises(ValueError, match="psfs: expected at least one, got none"):
        ablation([], 0.1, 0)


def test_examples() -> None:
    assert doctest.testmod(torchbokeh.psfs.sparsify).failed == 0
