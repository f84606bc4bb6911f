"""The traced lens against Gaussian optics, and what aberrations must look like."""

import doctest
import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import torchbokeh.psfs.physical_lens
from torchbokeh.ops.sellmeier import refractive_index
from torchbokeh.psfs.arrays import Array
from torchbokeh.psfs.model import Labels, PsfModel, mean_picture
from torchbokeh.psfs.physical_lens import PhysicalLens, singlet, trace
from torchbokeh.psfs.tracing import splat_rays

GREEN = 510.0
F64 = torch.float64


@pytest.fixture(autouse=True)
def fewer_rays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torchbokeh.psfs.physical_lens, "POWER", 16)
    monkeypatch.setattr(torchbokeh.psfs.physical_lens, "NODES", 4)


def spread_of(psf: Array) -> Array:
    """Root of the mean squared distance from the centre, of every channel."""
    y, x = (np.arange(n) - n // 2 for n in psf.shape[1:])
    return np.sqrt((psf * (x**2 + y[:, None] ** 2)).sum((1, 2)))


def difference(a: Array, b: Array) -> float:
    """Largest relative L1 error of a channel."""
    return float(np.abs(mean_picture([a, b], [1.0, -1.0])).sum((1, 2)).max())


@pytest.mark.parametrize("side", ["behind", "front"])
def test_a_small_stop_gives_the_disc_of_a_thin_lens(side: str) -> None:
    focal, f_number, focus, width = 0.1, 64.0, 0.7, 16384
    model = PhysicalLens(side, focal, f_number, focus, 0.036, width)  # type: ignore[arg-type]
    distance = 2.0 if side == "behind" else 0.45
    radius = model.axes[0].bound * abs(1 - focus / distance)
    # A thin lens stands at the front principal plane, which is this far behind the vertex.
    lens, n = model.lens, refractive_index("BK7", GREEN)
    plane = focal * lens.thickness * (n - 1) / (n * lens.radius)
    aperture = focal / (2 * f_number) * (1 + plane / distance)
    thin = aperture * focal / (focus + plane - focal) * abs(distance - focus) / (distance + plane)
    assert radius == pytest.approx(thin * width / 0.036, rel=5e-3)
    traced = math.sqrt(2) * spread_of(model.dense((radius, 0.0)))[1]
    assert traced == pytest.approx(radius, rel=0.02)


def test_the_focal_length_is_that_of_green() -> None:
    lens = singlet(0.05, 8.0, 1e6)
    ray = trace(lens, np.array([[0.0, 0.02], [0.0, 0.0]]), 0.0, 1e-3, refractive_index("BK7", GREEN))
    # Parallel rays meet on the sensor, where their slope times the focal length says.
    assert abs(ray.x[0] - 0.05e-3) < 1e-3 * 0.05e-3
    assert abs(ray.x[1] - ray.x[0]) < 1e-7


def test_a_ray_obeys_snell_s_law_through_parallel_faces() -> None:
    # Through the two vertices, a singlet is a plate: the ray goes on in parallel, shifted.
    lens, slope, n = singlet(0.1, 4.0, 0.7), 1e-4, refractive_index("BK7", GREEN)
    inside = math.tan(math.asin(math.sin(math.atan(slope)) / n))
    ray = trace(lens, np.zeros((2, 1)), 1.0, slope, n)
    height = lens.thickness * inside
    bend = (n - 1) * height / lens.radius
    assert ray.x[0] == pytest.approx(height + lens.sensor * (slope - bend), rel=1e-5)
    assert ray.y[0] == 0.0


@pytest.mark.parametrize("side", ["behind", "front"])
@pytest.mark.parametrize("place", [(0.0, 0.0), (12.0, 0.4), (50.0, 1.0)])
def test_every_channel_is_whole_and_mirrored(side: str, place: tuple[float, float]) -> None:
    psf = PhysicalLens(side).dense(place)  # type: ignore[arg-type]
    assert psf.min() >= 0
    assert psf.sum((1, 2)) == pytest.approx([1.0, 1.0, 1.0], abs=1e-12)
    np.testing.assert_allclose(psf, psf[:, ::-1], atol=1e-15)
    assert psf.shape[1] % 2 == psf.shape[2] % 2 == 1


def test_on_the_axis_it_is_round() -> None:
    psf = PhysicalLens().dense((30.0, 0.0))
    assert difference(psf, psf.transpose(0, 2, 1)) < 0.02
    assert difference(psf, psf[:, :, ::-1]) < 0.02


def test_blue_is_bent_most() -> None:
    # Behind the focus plane light meets before the sensor, and blue first: it is the widest there.
    behind = spread_of(PhysicalLens("behind").dense((40.0, 0.0)))
    front = spread_of(PhysicalLens("front").dense((40.0, 0.0)))
    assert behind[0] + 1 < behind[1] < behind[2]
    assert front[0] > front[1] + 1 > front[2] + 1


def passing(f_number: float, eccentricity: float) -> float:
    """Share of the rays through the stop that reach the sensor."""
    model = PhysicalLens(f_number=f_number)
    x = np.linspace(-1, 1, 101)
    start = np.stack([a.ravel() for a in np.meshgrid(x, x)])
    start = start[:, (start**2).sum(0) <= 1]
    slope = eccentricity * 0.036 / math.sqrt(2) / model.lens.chief
    return float(
        (trace(model.lens, start, model.lens.nearness, slope, refractive_index("BK7", GREEN)).light > 0).mean()
    )


def test_cat_s_eyes_narrow_towards_the_corners_of_an_open_lens() -> None:
    open_ = [passing(4.0, e) for e in (0.0, 0.3, 0.6, 1.0)]
    assert open_[0] > 0.97
    assert all(a > b for a, b in pairwise(open_))
    assert open_[-1] < 0.9
    assert passing(16.0, 1.0) == 1.0


def test_distortion_is_left_out() -> None:
    # With a small stop, off the axis, what is in focus stays where the pinhole sees it.
    psf = PhysicalLens(f_number=64.0).dense((0.0, 1.0))
    x = np.arange(psf.shape[2]) - psf.shape[2] // 2
    assert abs(float((psf[1] * x).sum())) < 0.5


def test_two_seeds_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torchbokeh.psfs.physical_lens, "POWER", 18)
    places = [(30.0, 0.0), (58.0, 1.0)]
    first = [PhysicalLens().dense(place) for place in places]
    monkeypatch.setattr(torchbokeh.psfs.physical_lens, "SEED", 1)
    second = [PhysicalLens().dense(place) for place in places]
    assert max(difference(a, b) for a, b in zip(first, second, strict=True)) < 0.015


def test_filtering_in_the_loop_is_that_of_the_base_class() -> None:
    model = PhysicalLens()
    low, high = (18.0, 0.3), (20.0, 0.34)
    assert difference(model.prefiltered(low, high), PsfModel.prefiltered(model, low, high)) < 0.015
    assert difference(model.prefiltered(low, low), model.dense(low)) < 1e-12


def test_a_pixel_takes_its_radius_and_its_distance_from_the_centre() -> None:
    coc = torch.zeros(1, 1, 3, 5, dtype=F64)
    coc[..., 0, 0], coc[..., 1, 2], coc[..., 1, 4] = 7.0, -3.0, 1e3
    behind, front = PhysicalLens("behind"), PhysicalLens("front")
    place = behind.place(Labels(coc=coc))
    assert place.frame is not None
    assert place.scale is not None
    bound = behind.axes[0].bound
    assert place.coordinates[0, 0, [0, 1, 1], [0, 2, 4]].tolist() == [7.0, 0.0, pytest.approx(bound)]
    assert place.scale[0, 0, 1, 4] == pytest.approx(1e3 / bound)
    assert place.coordinates[0, 1, 1, 2] == 0
    assert place.coordinates[0, 1, 0, 0] == pytest.approx(math.hypot(2, 1) / (2.5 * math.sqrt(2)))
    # x turns outwards: up and to the left in the first pixel.
    np.testing.assert_allclose(place.frame[0, :, 0, 0, 0], np.array([-2, -1]) / math.sqrt(5), atol=1e-12)
    assert front.place(Labels(coc=coc)).coordinates[0, 0, 1, 2] == 3.0


def test_the_radius_is_differentiable_to_the_label() -> None:
    coc = torch.tensor([[[[5.0, -5.0]]]], dtype=F64, requires_grad=True)
    PhysicalLens().place(Labels(coc=coc)).coordinates[:, 0].sum().backward()
    assert coc.grad is not None
    assert coc.grad.flatten().tolist() == [1.0, 0.0]


def test_settings_build_it_again() -> None:
    model = PhysicalLens("front", 0.085, 2.8, 1.5, 0.024, 800)
    again = PhysicalLens(**model.settings())  # type: ignore[arg-type]
    assert again.settings() == model.settings()
    assert again.axes == model.axes
    assert again.lens == model.lens


def test_rays_are_shared_by_four_pixels_and_lost_outside() -> None:
    picture = np.zeros((5, 7))
    splat_rays(picture, np.array([0.0, -2.5, 3.25, 0.0, 1.0]), np.array([0.25, 1.5, 0.0, -2.5, 0.0]), np.ones(5))
    assert picture.sum() == 3
    assert picture[2:4, 3].tolist() == [0.75, 0.25]
    assert picture[3:, :2].tolist() == [[0.25, 0.25], [0.25, 0.25]]
    assert picture[2, 4] == 1


@given(st.integers(0, 2**31), st.floats(0.1, 20.0))
@settings(max_examples=30, deadline=None)
def test_a_picture_keeps_the_middle_of_its_rays(seed: int, reach: float) -> None:
    x, y, light = np.random.default_rng(seed).uniform(-reach, reach, (3, 40))
    picture = np.zeros((43, 45))
    splat_rays(picture, x, y, light)
    light = np.maximum(light, 0)
    assert picture.sum() == pytest.approx(light.sum())
    assert picture.sum(0) @ (np.arange(45) - 22) == pytest.approx(light @ x, abs=1e-9)
    assert picture.sum(1) @ (np.arange(43) - 21) == pytest.approx(light @ y, abs=1e-9)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"side": "left"}, "side: expected 'behind' or 'front', got 'left'"),
        ({"f_number": 1.0}, "f_number: expected a finite number above 1, got 1.0"),
        ({"focus_distance": 0.2}, "focus_distance: expected a finite number above 0.2, got 0.2"),
        ({"focal_length": math.nan}, "focal_length: expected a finite number above 0, got nan"),
        ({"sensor_width": 0.2}, "sensor_width: expected at most the focal length, 0.1, got 0.2"),
        ({"width": 0}, "width: expected a finite number above 0, got 0"),
        ({"width": 4096}, "width: expected a largest CoC radius of at most 128 px, got 233 px"),
    ],
)
def test_bad_arguments_are_named(arguments: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        PhysicalLens(**arguments)  # type: ignore[arg-type]


def test_it_needs_the_circle_of_confusion() -> None:
    with pytest.raises(ValueError, match="physical-lens: expected coc, got none"):
        PhysicalLens().place(Labels(depth=torch.ones(1, 1, 2, 2)))


def test_the_examples_run() -> None:
    assert doctest.testmod(torchbokeh.psfs.physical_lens).failed == 0
