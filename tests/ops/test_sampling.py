import doctest
import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import qmc
from torch import Tensor

import torchbokeh.ops.sampling
from torchbokeh.ops.sampling import DIMENSIONS, aperture_points, halton, stratified
from torchbokeh.ops.spans import Profile, area, edges_at
from torchbokeh.psfs import Aperture, Disc, Ellipse, Polygon

F64 = torch.float64
BASES = (2, 3, 5, 7, 11, 13)
SHAPES = {
    "disc": Disc(),
    "ellipse": Ellipse(1.8),
    "ellipse leaning": Ellipse(2.0, 0.7),
    "triangle": Polygon(3, 0.2),
    "square": Polygon(4, math.pi / 4),
    "pentagon": Polygon(5),
    "round blades": Polygon(7, 0.4, 0.6),
}
few = settings(deadline=None, max_examples=30)


@pytest.fixture(params=SHAPES)
def shape(request: pytest.FixtureRequest) -> Aperture:
    return SHAPES[request.param]


def radical_inverse(index: int, base: int) -> float:
    """The digits of the index, mirrored at the point."""
    total, place = 0.0, 1 / base
    while index:
        index, digit = divmod(index, base)
        total += digit * place
        place /= base
    return total


@few
@given(first=st.integers(0, 100_000), count=st.integers(0, 40))
def test_halton_mirrors_the_digits_of_the_index(first: int, count: int) -> None:
    want = [[radical_inverse(first + 1 + n, base) for base in BASES] for n in range(count)]
    got = halton(count, first=first)
    assert got.dtype == F64
    assert got.shape == (count, DIMENSIONS)
    assert torch.allclose(got, torch.tensor(want, dtype=F64).reshape(count, DIMENSIONS), atol=1e-14)


def test_the_origin_is_left_out() -> None:
    assert halton(5000).min() > 0
    assert halton(5000).max() < 1


@pytest.mark.parametrize("seed", [None, 0, 7])
def test_first_continues_the_sequence(seed: int | None) -> None:
    whole = halton(100, seed=seed)
    parts = [halton(37, seed=seed), halton(63, first=37, seed=seed)]
    assert torch.equal(torch.cat(parts), whole)
    assert torch.equal(halton(1, first=99, seed=seed), whole[99:])


@few
@given(seed=st.integers(0, 2**40), first=st.integers(0, 500))
def test_a_seed_turns_the_sequence(seed: int, first: int) -> None:
    plain, turned = halton(50, first=first), halton(50, first=first, seed=seed)
    assert torch.equal(turned, halton(50, first=first, seed=seed))
    assert (turned >= 0).all()
    assert (turned < 1).all()
    by = (turned - plain).remainder(1)
    away = (by - by[0] + 0.5).remainder(1) - 0.5  # around the circle
    assert away.abs().max() < 1e-12
    assert not torch.allclose(turned, halton(50, first=first, seed=seed + 1), atol=1e-3)
    # Every dimension has its own amount, none of them zero.
    assert len(by[0].unique()) == DIMENSIONS
    assert by[0].min() > 0


@pytest.mark.parametrize("columns", [(0, 3), (0, 1), (2, 4), (0, 1, 3)])
def test_any_run_of_points_is_spread_evenly(columns: tuple[int, ...]) -> None:
    rng = np.random.default_rng(0)
    for count in (64, 200):
        chance = np.mean([qmc.discrepancy(rng.random((count, len(columns)))) for _ in range(20)])
        for first in (0, 77, 1000, 12_345):
            for seed in (None, 3):
                run = halton(count, first=first, seed=seed)[:, columns].numpy()
                assert qmc.discrepancy(run) < 0.3 * chance


def test_the_disc_is_the_polar_map() -> None:
    square = torch.tensor([[0.25, 0.0], [0.81, 0.25], [0.49, 0.5], [0.0, 0.3], [0.36, 0.125]], dtype=F64)
    half = math.sqrt(0.5)
    want = torch.tensor([[0.5, 0], [0, 0.9], [-0.7, 0], [0, 0], [0.6 * half, 0.6 * half]], dtype=F64)
    assert torch.allclose(aperture_points(Disc().profile(), square), want, atol=1e-15)
    points = halton(500)[:, :2]
    angle = 2 * math.pi * points[:, 1]
    want = points[:, :1].sqrt() * torch.stack([angle.cos(), angle.sin()], 1)
    assert torch.allclose(aperture_points(Disc().profile(), points), want, atol=1e-14)


def test_an_ellipse_is_a_disc_squeezed_and_sheared() -> None:
    points = halton(400)[:, :2]
    disc = aperture_points(Disc().profile(), points)
    assert torch.allclose(aperture_points(Ellipse(2.0).profile(), points), disc * torch.tensor([0.5, 1]), atol=1e-12)
    leaning = aperture_points(Ellipse(2.0, 0.7).profile(), points)
    matrix = torch.linalg.lstsq(disc, leaning).solution
    assert torch.allclose(disc @ matrix, leaning, atol=1e-12)
    assert float(torch.linalg.det(matrix)) == pytest.approx(0.5)


def inside(profile: Profile, points: Tensor, slack: float = 1e-9) -> Tensor:
    x, y = points.unbind(1)
    left, right = edges_at(profile, y.clamp(profile.knots[0, 0], profile.knots[-1, 0]))
    within = (y >= profile.knots[0, 0] - slack) & (y <= profile.knots[-1, 0] + slack)
    return within & (x >= left - slack) & (x <= right + slack)


def test_all_points_lie_in_the_shape(shape: Aperture) -> None:
    profile = shape.profile()
    ends = torch.tensor([0.0, 1e-12, 0.5, 1 - 1e-12], dtype=F64)
    for square in (halton(4000)[:, :2], torch.cartesian_prod(ends, ends)):
        points = aperture_points(profile, square)
        assert inside(profile, points, 1e-6).all()  # a polar map ends in the arc, where the edge has no slope
        assert points.norm(dim=1).max() <= 1 + 1e-9


def exact(profile: Profile, power: tuple[int, int], low: float = -2.0, high: float = 2.0) -> float:
    """``∫ x^a y^b`` over the part of the shape with y between ``low`` and ``high``, by the midpoint rule."""
    bottom, top = (min(max(v, float(profile.knots[0, 0])), float(profile.knots[-1, 0])) for v in (low, high))
    y = bottom + (top - bottom) * (torch.arange(100_000, dtype=F64) + 0.5) / 100_000
    left, right = edges_at(profile, y)
    a, b = power
    return float(((right ** (a + 1) - left ** (a + 1)) / (a + 1) * y**b).sum() * (top - bottom) / 100_000)


@pytest.mark.parametrize("power", [(1, 0), (0, 1), (2, 0), (0, 2), (1, 1), (4, 0), (2, 2), (0, 3), (3, 0)])
def test_moments_are_those_of_the_area(shape: Aperture, power: tuple[int, int]) -> None:
    profile = shape.profile()
    assert exact(profile, (0, 0)) == pytest.approx(float(area(profile)), rel=1e-5)
    u, v = ((torch.arange(n, dtype=F64) + 0.5) / n for n in (2500, 200))
    x, y = aperture_points(profile, torch.cartesian_prod(u, v)).unbind(1)
    want = exact(profile, power) / float(area(profile))
    assert float((x ** power[0] * y ** power[1]).mean()) == pytest.approx(
        want, abs=1e-4
    )  # of 4096 rows, half of one may be lost


def test_every_region_gets_points_by_its_area(shape: Aperture) -> None:
    profile = shape.profile()
    n = 300
    grid = (torch.arange(n, dtype=F64) + 0.5) / n
    points = aperture_points(profile, torch.cartesian_prod(grid, grid))
    bottom, top = float(profile.knots[0, 0]), float(profile.knots[-1, 0])
    cuts = [bottom + (top - bottom) * k / 9 for k in range(10)]
    for low, high in pairwise(cuts):
        band = (points[:, 1] >= low) & (points[:, 1] < high)
        share = exact(profile, (0, 0), low, high) / float(area(profile))
        assert float(band.double().mean()) == pytest.approx(share, abs=4e-3)
        # In a row, both sides of its middle get as much, wherever the row lies.
        left, right = edges_at(profile, points[band, 1].clamp(bottom, top))
        right_half = points[band, 0] > 0.5 * (left + right)
        assert float(right_half.double().mean()) == pytest.approx(0.5, abs=0.02)


def test_points_have_the_dtype_of_the_profile_and_its_gradient() -> None:
    profile = Profile(*(t.float() for t in Polygon(5).profile()))
    assert aperture_points(profile, halton(3)[:, :2]).dtype == torch.float32
    assert aperture_points(Disc().profile(), torch.rand(3, 2)).dtype == F64
    assert aperture_points(Disc().profile(), torch.zeros(0, 2)).shape == (0, 2)
    for make in (lambda t: Polygon(6, t), lambda t: Ellipse(1.7, t)):
        rotation = torch.nn.Parameter(torch.tensor(0.3, dtype=F64))
        square = halton(40)[:, :2]
        aperture_points(make(rotation).profile(), square)[:, 0].square().mean().backward()
        step = 1e-5
        with torch.no_grad():
            ends = [
                aperture_points(make(torch.nn.Parameter(rotation + s)).profile(), square)[:, 0].square().mean()
                for s in (-step, step)
            ]
        assert rotation.grad is not None
        assert float(rotation.grad) == pytest.approx(float(ends[1] - ends[0]) / (2 * step), rel=1e-3, abs=1e-6)


@few
@given(values=st.lists(st.floats(0, 1, exclude_max=True), max_size=50))
def test_stratified_has_one_in_each_stratum_and_keeps_the_order(values: list[float]) -> None:
    points = torch.tensor(values, dtype=F64)
    got, n = stratified(points), len(values)
    assert torch.allclose(got.sort().values, (torch.arange(n, dtype=F64) + 0.5) / max(n, 1), atol=1e-15)
    assert torch.equal(got.argsort(), points.argsort(stable=True))


def test_stratified_halton_moves_no_point_far() -> None:
    points = halton(243)[:, 1]
    assert (stratified(points) - points).abs().max() <= 1 / 243
    assert stratified(points).mean() == pytest.approx(0.5, abs=1e-15)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: halton(-1), "count: expected at least 0, got -1"),
        (lambda: halton(3, first=-2), "first: expected at least 0, got -2"),
        (lambda: halton(3, seed=-5), "seed: expected at least 0, got -5"),
        (lambda: aperture_points(Disc().profile(), torch.zeros(4)), r"square: expected shape \(N, 2\), got \(4,\)"),
        (
            lambda: aperture_points(Disc().profile(), torch.zeros(4, 3)),
            r"square: expected shape \(N, 2\), got \(4, 3\)",
        ),
    ],
)
def test_what_does_not_fit_is_refused(call: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call()


def test_examples_in_the_docstrings() -> None:
    result = doctest.testmod(torchbokeh.ops.sampling)
    assert result.attempted > 0
    assert result.failed == 0
