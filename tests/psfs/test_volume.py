"""Light in fog, against single scattering by quadrature, the phase function and the limits."""

import doctest
import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import torchbokeh.psfs.volume
from torchbokeh.psfs.arrays import Array
from torchbokeh.psfs.model import Labels
from torchbokeh.psfs.volume import ANISOTROPY, REACH, Volume, deflections, disc, edges, glow, scattered

PHOTONS = 1 << 14
FOCAL = 1024.0


@pytest.fixture(autouse=True)
def fewer_photons(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torchbokeh.psfs.volume, "PHOTONS", PHOTONS)


def once_scattered(distance: float, radius: Array) -> Array:
    """Light per px at radii in px that was scattered once, in units of what comes of a source without a medium."""
    cosine = np.cos(np.arctan(radius / FOCAL))[:, None]
    nodes, weights = np.polynomial.legendre.leggauss(400)
    # Dense where the way passes the source: t = middle + width sinh(u).
    middle, width = distance * cosine, distance * np.sqrt(1 - cosine**2)
    low, high = np.arcsinh(-middle / width), np.arcsinh((40 - middle) / width)
    u = (low + high) / 2 + (high - low) / 2 * nodes
    way = middle + width * np.sinh(u)
    there = np.sqrt(distance**2 + way**2 - 2 * distance * way * cosine)
    turned = (distance * cosine - way) / there  # the cosine of the angle between the way there and the way on
    phase = (1 - ANISOTROPY**2) / (4 * math.pi * (1 + ANISOTROPY**2 - 2 * ANISOTROPY * turned) ** 1.5)
    found = np.exp(-there - way) / there**2 * phase * width * np.cosh(u) * weights * (high - low) / 2
    return found.sum(1) * distance**2 / FOCAL**2


@given(st.floats(-0.95, 0.95).filter(lambda g: abs(g) > 0.05))
def test_the_mean_cosine_is_g(g: float) -> None:
    nodes, weights = np.polynomial.legendre.leggauss(200)
    assert weights @ deflections((nodes + 1) / 2, g) / 2 == pytest.approx(g, abs=1e-6)
    assert deflections(np.array([0.0, 1.0]), g).tolist() == pytest.approx([-1.0, 1.0])


@given(st.integers(0, 2**31))
@settings(max_examples=30, deadline=None)
def test_directions_are_turned_by_their_angle(seed: int) -> None:
    draw = np.random.default_rng(seed)
    to = draw.normal(size=(3, 50))
    to /= np.sqrt((to**2).sum(0))
    to[:, :2] = np.array([[0, 0], [0, 0], [1, -1]])
    cosine, azimuth = draw.uniform(-1, 1, 50), draw.uniform(0, 2 * math.pi, 50)
    new, opposite = scattered(to, cosine, azimuth), scattered(to, cosine, azimuth + math.pi)
    np.testing.assert_allclose((new**2).sum(0), 1.0, atol=1e-12)
    np.testing.assert_allclose((new * to).sum(0), cosine, atol=1e-12)
    np.testing.assert_allclose(new + opposite, 2 * cosine * to, atol=1e-12)


def in_rings(distance: float) -> Array:
    """`once_scattered`, integrated over the rings."""
    borders = edges()
    nodes, weights = np.polynomial.legendre.leggauss(8)
    radius = (borders[:-1] + borders[1:])[:, None] / 2 + np.diff(borders)[:, None] / 2 * nodes
    light = once_scattered(distance, radius.ravel()).reshape(radius.shape) * 2 * math.pi * radius
    return light @ weights * np.diff(borders) / 2


@pytest.mark.parametrize("distance", [0.3, 1.0, 4.0])
def test_light_that_is_scattered_once_is_that_of_the_quadrature(
    distance: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torchbokeh.psfs.volume, "ORDERS", 1)
    found, wanted = glow(distance, FOCAL, 1 << 19, 3)[0], in_rings(distance)
    assert found.sum() == pytest.approx(wanted.sum(), rel=0.01)
    assert found.reshape(4, 10).sum(1) == pytest.approx(wanted.reshape(4, 10).sum(1), rel=0.03)


def test_the_point_has_what_comes_without_a_collision(monkeypatch: pytest.MonkeyPatch) -> None:
    # So thin a fog scatters light once, or not at all: both are known.
    monkeypatch.setattr(torchbokeh.psfs.volume, "PHOTONS", 1 << 18)
    monkeypatch.setattr(torchbokeh.psfs.volume, "ORDERS", 3)
    distance = 0.02
    psf = Volume().dense((distance,))[0]
    x = np.arange(len(psf)) - len(psf) // 2
    ring = np.hypot(x, x[:, None])
    ring = (ring >= 20) & (ring < 120)
    radius = np.arange(20, 120) + 0.5
    wanted = (once_scattered(distance, radius) * 2 * math.pi * radius).sum() / math.exp(-distance)
    assert psf[ring].sum() / psf.max() == pytest.approx(wanted, rel=0.05)


def test_without_a_medium_between_there_is_only_the_point() -> None:
    assert Volume().dense((0.0,)).shape == (3, 1, 1)
    np.testing.assert_allclose(Volume().dense((0.0,)).ravel(), 1.0)


def test_a_glow_of_1_over_r_is_integrated_over_every_pixel() -> None:
    borders = edges()
    picture = disc(2 * math.pi * np.diff(borders))
    fine = (np.arange(200) + 0.5) / 200 - 0.5
    for y, x in ((0, 0), (0, 1), (2, 1), (30, 40)):
        wanted = (1 / np.hypot(x + fine, (y + fine)[:, None])).mean()
        assert picture[REACH + y, REACH + x] == pytest.approx(wanted, rel=5e-3)
    assert picture.sum() == pytest.approx(2 * math.pi * REACH * 0.875, rel=1e-3)  # an eighth is lost where it fades


@pytest.fixture(scope="module")
def pictures() -> list[Array]:
    return [Volume().dense((distance,)) for distance in (0.1, 0.5, 1.5, 3.0, 5.0)]


def test_white_is_whole_and_blue_is_absorbed(pictures: list[Array]) -> None:
    for psf in pictures:
        assert psf.min() >= 0
        assert psf.sum((1, 2))[:2] == pytest.approx([1.0, 1.0])
        assert (psf[2] <= psf[0] + 1e-12).all()
    blue = [psf[2].sum() for psf in pictures]
    assert all(a > b for a, b in pairwise(blue))


def test_it_has_the_symmetry_of_a_disc(pictures: list[Array]) -> None:
    for psf in pictures:
        np.testing.assert_array_equal(psf, psf[:, ::-1])
        np.testing.assert_array_equal(psf, psf[:, :, ::-1])
        np.testing.assert_allclose(psf, psf.transpose(0, 2, 1), atol=1e-15)


def test_it_is_wider_the_farther_away(pictures: list[Array]) -> None:
    spread = []
    for psf in pictures:
        x = np.arange(psf.shape[1]) - psf.shape[1] // 2
        spread.append((psf[0] * (x**2 + x[:, None] ** 2)).sum())
    assert all(a < b for a, b in pairwise(spread))


def test_two_seeds_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torchbokeh.psfs.volume, "PHOTONS", 1 << 16)
    first = Volume().dense((2.0,))
    monkeypatch.setattr(torchbokeh.psfs.volume, "SEED", 1)
    assert np.abs(first - Volume().dense((2.0,)))[0].sum() < 0.015


def test_a_pixel_takes_its_distance_in_mean_free_paths() -> None:
    depth = torch.tensor([[[[2.0, math.inf]]]], dtype=torch.float64, requires_grad=True)
    coordinates = Volume(density=0.25, distance=3.0).place(Labels(depth=depth)).coordinates
    assert coordinates.flatten().tolist() == [0.5, 3.0]
    coordinates[..., 0].sum().backward()
    assert depth.grad is not None
    assert depth.grad[..., 0].item() == 0.25


def test_settings_build_it_again() -> None:
    model = Volume(0.3, 2.0, 700.0)
    again = Volume(**model.settings())  # type: ignore[arg-type]
    assert again.settings() == model.settings()
    assert again.axes == model.axes


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"density": 0.0}, "density: expected a finite number above 0, got 0.0"),
        ({"distance": 9.0}, "distance: expected a number of mean free paths above 0 and at most 8, got 9.0"),
        ({"focal": 100.0}, "focal: expected a finite number of px from 256 on, got 100.0"),
        ({"focal": math.nan}, "focal: expected a finite number of px from 256 on, got nan"),
    ],
)
def test_bad_arguments_are_named(arguments: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Volume(**arguments)


def test_it_needs_the_depth() -> None:
    with pytest.raises(ValueError, match="volume: expected depth, got none"):
        Volume().place(Labels(coc=torch.ones(1, 1, 2, 2)))


def test_the_examples_run() -> None:
    assert doctest.testmod(torchbokeh.psfs.volume).failed == 0
