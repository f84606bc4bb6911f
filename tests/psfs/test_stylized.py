"""Masks of any size: their light is kept, their shape is scaled exactly, and their colours part."""

import doctest
import math
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import torchbokeh.psfs.stylized
from torchbokeh.psfs.model import Labels
from torchbokeh.psfs.stylized import LARGEST, LUMINANCE, Stylized, encoded, overlaps, star
from torchbokeh.psfs.tracing import cropped

F64 = torch.float64


def noise(height: int, width: int) -> NDArray[np.uint8]:
    return np.random.default_rng(1).integers(1, 256, (height, width, 4), dtype=np.uint8)


def white(height: int, width: int) -> NDArray[np.uint8]:
    return np.full((height, width, 4), 255, np.uint8)


@given(st.integers(1, 40), st.floats(1e-3, 90.0), st.floats(0.0, 3.0))
@settings(deadline=None)
def test_pieces_of_a_segment_lie_on_pixels_as_their_moments_say(count: int, length: float, more: float) -> None:
    shares = overlaps(count, length, length / 2 + more)
    np.testing.assert_allclose(shares.sum(0), 1.0, atol=1e-9)
    # A piece and its pixels have the same mean, up to what a pixel does not resolve; the whole segment exactly.
    place = np.arange(len(shares)) - len(shares) // 2
    assert abs((place @ shares).mean()) < 1e-9
    middles = ((np.arange(count) + 0.5) / count - 0.5) * length
    assert np.abs(place @ shares - middles).max() <= 0.5


@given(st.floats(0.0, 64.0), st.integers(1, 30), st.integers(1, 30), st.floats(0.0, 0.5))
@settings(max_examples=40, deadline=None)
def test_the_luminance_sums_to_one_and_colours_stay(coordinate: float, height: int, width: int, shift: float) -> None:
    model = Stylized(noise(height, width), shift)
    psf, sharp = model.dense((coordinate,)), model.dense((0.0,))
    assert LUMINANCE @ psf.sum((1, 2)) == pytest.approx(1.0)
    np.testing.assert_allclose(psf.sum((1, 2)), sharp[:, 0, 0], rtol=1e-9)
    assert psf.min() >= 0


def test_in_focus_all_light_stays_on_its_pixel() -> None:
    assert Stylized(shift=0.5).dense((0.0,)).shape == (3, 1, 1)


def test_a_white_square_is_the_square_of_that_size() -> None:
    psf = Stylized(white(7, 7), shift=0.0).dense((4.25,))  # 9.5 px wide
    side = np.array([0.25, *[1.0] * 9, 0.25])
    np.testing.assert_allclose(psf, np.broadcast_to(np.outer(side, side) / 9.5**2, (3, 11, 11)), atol=1e-15)


def test_an_oblong_mask_keeps_its_proportions() -> None:
    psf = Stylized(white(10, 30), shift=0.0).dense((7.0,))  # 15 px wide
    assert psf.shape == (3, 5, 15)


def test_whole_magnification_repeats_pixels() -> None:
    mask = noise(5, 5)
    psf = Stylized(mask, shift=0.0).dense((7.0,))  # 15 px: 3 for each
    light = Stylized(mask)._light
    np.testing.assert_allclose(psf, cropped(np.repeat(np.repeat(light, 3, 1), 3, 2) / 9), atol=1e-15)


def test_red_is_larger_and_blue_smaller() -> None:
    psf = Stylized(white(3, 3), shift=0.1).dense((30.0,))
    columns = [np.count_nonzero(channel.sum(0)) for channel in psf]
    assert columns == [2 * math.ceil(30 * k) + 1 for k in (1.1, 1.0, 0.9)]


def test_the_picture_stands_upright() -> None:
    mask = white(8, 8)
    mask[:4, :, 3], mask[:, 4:, 2] = 0, 0  # light in the lower half, blue in the left one
    psf = Stylized(mask, shift=0.0).dense((9.5,))
    middle = psf.shape[1] // 2
    assert not psf[:, :middle].any()
    assert not psf[2, :, psf.shape[2] // 2 + 1 :].any()
    assert psf[2, middle + 1, 0] > 0


def test_colours_are_decoded_and_weighed_by_alpha() -> None:
    mask = white(1, 2)
    mask[0, 0] = [188, 188, 188, 255]  # half of the light, in sRGB
    mask[0, 1] = [255, 255, 255, 51]
    light = Stylized(mask, shift=0.0).dense((0.5,))[0, 0]
    assert light[0] / light[-1] == pytest.approx(0.5 / 0.2, rel=1e-2)


def test_the_star_has_its_area_and_its_symmetry() -> None:
    alpha = star(201)[..., 3] / 255
    # Ten triangles between the middle, a tip at 1 and a notch.
    notch = math.sin(math.pi / 10) / math.sin(7 * math.pi / 10)
    area = 5 * notch * math.sin(math.pi / 5)
    assert alpha.mean() * 4 == pytest.approx(area, rel=2e-3)
    np.testing.assert_array_equal(alpha, alpha[:, ::-1])


@pytest.mark.parametrize("mask", [None, noise(6, 9)])
def test_settings_build_it_again(mask: Any) -> None:
    model = Stylized(mask, 0.1, 40.0)
    again = Stylized(**model.settings())  # type: ignore[arg-type]
    assert again.settings() == model.settings()
    assert again.axes == model.axes
    np.testing.assert_array_equal(again.dense((12.0,)), model.dense((12.0,)))


def test_a_pixel_takes_the_size_of_its_blur_on_either_side() -> None:
    coc = torch.tensor([[[[-10.5, 0.2, 20.5, 128.0]]]], dtype=F64, requires_grad=True)
    model = Stylized(radius=64.0)
    place = model.place(Labels(coc=coc))
    assert place.coordinates.flatten().tolist() == pytest.approx([10.0, 0.0, 20.0, 63.5])
    assert place.scale is not None
    assert place.scale.flatten().tolist() == [1.0, 1.0, 1.0, 2.0]
    assert model.places(Labels(coc=coc), 4)[0].coordinates[0, 0, 0, 0].item() == pytest.approx(10.5 / 4 - 0.5)
    place.coordinates.sum().backward()
    assert coc.grad is not None
    assert coc.grad.flatten().tolist() == [-1.0, 0.0, 1.0, 0.5]


def test_the_mask_is_copied() -> None:
    mask = noise(3, 3)
    model = Stylized(mask)
    text = model.settings()["mask"]
    mask[:] = 0
    assert model.settings()["mask"] == text


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"mask": np.zeros((2, 2, 4), np.uint8)}, "mask: expected a pixel that is neither black nor transparent"),
        (
            {"mask": white(2, 2)[..., :3]},
            r"mask: expected shape \(H, W, 4\) of at most 1024 px per side, got \(2, 2, 3\)",
        ),
        ({"mask": white(1, LARGEST + 1)}, r"got \(1, 1025, 4\)"),
        ({"mask": encoded(white(1, LARGEST + 1))}, r"mask: expected at most 1024 px along each side, got \(1025, 1\)"),
        ({"mask": "cats"}, "mask: expected a PNG file in base64, got 'cats'"),
        ({"mask": "no!"}, "mask: expected a PNG file in base64, got 'no!'"),
        ({"shift": 0.6}, "shift: expected a number from 0 to 0.5, got 0.6"),
        ({"radius": math.nan}, "radius: expected a number of px above 0.5 and at most 128, got nan"),
    ],
)
def test_bad_arguments_are_named(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Stylized(**arguments)


@pytest.mark.parametrize(("mask", "kind"), [(np.zeros((2, 2, 4)), "an array of float64"), (3, "int")])
def test_a_mask_of_another_kind_is_refused(mask: Any, kind: str) -> None:
    with pytest.raises(TypeError, match=f"mask: expected an array of uint8 or a str, got {kind}"):
        Stylized(mask)


def test_it_needs_the_circle_of_confusion() -> None:
    with pytest.raises(ValueError, match="stylized: expected coc, got none"):
        Stylized().places(Labels(depth=torch.ones(1, 1, 2, 2)))


def test_the_examples_run() -> None:
    assert doctest.testmod(torchbokeh.psfs.stylized).failed == 0
