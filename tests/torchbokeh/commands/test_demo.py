"""The demo: its scene, the filling of unknown disparity, its colours and its files."""

import numpy as np
import pytest
import torch
from skimage.data import stereo_motorcycle

from torchbokeh.commands.demo import _fill, colour_coc, motorcycle, motorcycle_lens, run_demo
from torchbokeh.io.pictures import encode_srgb, read_image


def test_scene_is_the_photograph_with_depth_from_its_calibration():
    left, _, disparity = stereo_motorcycle()
    image, depth = motorcycle()
    np.testing.assert_array_equal(encode_srgb(image, 8), left)
    known = np.isfinite(disparity)
    expected = 0.193001 * 994.978 / (disparity[known].astype(np.float64) + 31.086)
    np.testing.assert_allclose(depth[0, 0].double().numpy()[known], expected, rtol=1e-6)
    assert depth.isfinite().all()
    assert depth.min() > 2.1
    assert depth.max() < 5.1


def test_smaller_scene_averages_colour_and_samples_depth():
    image, depth = motorcycle()
    small_image, small_depth = motorcycle(scale=0.2)
    assert small_image.shape[2:] == small_depth.shape[2:] == (100, 148)
    torch.testing.assert_close(small_image.mean(), image.mean(), rtol=2e-3, atol=0)
    assert torch.isin(small_depth, depth).all()


@pytest.mark.parametrize("scale", [0.0, -1.0, 1.5, float("nan")])
def test_scale_is_checked(scale, tmp_path):
    with pytest.raises(ValueError, match="scale: expected above 0 and at most 1"):
        run_demo(tmp_path / "new", scale=scale)
    assert not list(tmp_path.iterdir())


def test_unknown_disparity_takes_the_farther_neighbour():
    row = np.array([np.inf, 9.0, np.nan, np.inf, 4.0, 0.0, 7.0, np.inf])
    filled = _fill(np.tile(row, (12, 1)))
    np.testing.assert_array_equal(filled, np.tile([9.0, 9.0, 4.0, 4.0, 4.0, 4.0, 7.0, 7.0], (12, 1)))


def test_filling_keeps_what_is_known_and_drops_streaks():
    disparity = np.full((21, 5), 8.0)
    disparity[:, 2] = np.inf
    disparity[10, 3] = 1.0  # one far pixel: its row alone would be filled with 1, a streak
    filled = _fill(disparity)
    assert filled[10, 3] == 1.0
    np.testing.assert_array_equal(filled[:, 2], 8.0)


def test_lens_has_the_photographs_field_of_view_at_every_scale():
    depth = torch.tensor([2.2, 3.0, 5.0]).view(1, 1, 1, 3)
    lens = motorcycle_lens(3.0)
    focal_px = lens.focal_length / lens.sensor_width * 741
    assert focal_px.item() == pytest.approx(994.978)
    # The blur radius is the disparity between the centre and the rim of the aperture, seen past the focus.
    distance = 1 / (1 / lens.focal_length - 1 / 3.0)  # of the image plane
    parallax = focal_px * distance / lens.focal_length * lens.aperture_radius * (1 / 3.0 - 1 / depth)
    torch.testing.assert_close(lens.coc(depth, 741), parallax, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(lens.coc(depth, 74) * 741 / 74, parallax, rtol=1e-4, atol=1e-4)


def test_colours_diverge_from_white():
    coc = torch.tensor([-4.0, -2.0, 0.0, 2.0, 4.0]).view(1, 1, 1, 5)
    red, green, blue = colour_coc(coc)[0, :, 0]
    assert (red[2], green[2], blue[2]) == (1, 1, 1)
    assert blue[0] > red[0]
    assert red[4] > blue[4]
    assert (green.diff() * torch.tensor([1, 1, -1, -1]) > 0).all()


def test_demo_writes_its_pictures(tmp_path, capsys):
    out = tmp_path / "deep" / "demo"
    written = run_demo(out, scale=0.1, show_progress=False)
    names = ["pinhole.png", "coc.png", "front.png", "middle.png", "back.png", "sheet.png"]
    assert [path.name for path in written] == names
    assert sorted(path.name for path in out.iterdir()) == sorted(names)
    for path in written[:-1]:
        assert read_image(path).shape == (1, 3, 50, 74)
    assert read_image(written[-1]).shape[3] == 3 * 74
    # Each picture is sharpest, closest to the photograph, on the thing in focus.
    pinhole, depth = motorcycle(0.1)
    far = depth > 4
    error = {p.stem: (read_image(p) - pinhole).abs().mean(1, keepdim=True) for p in written[2:-1]}
    assert error["back"][far].mean() < 0.5 * error["front"][far].mean()
    near = depth < 2.3
    assert error["front"][near].mean() < 0.5 * error["back"][near].mean()
    said = capsys.readouterr().out
    assert "f/0.22" in said
    for thing in ("headlight", "rear wheel", "wall"):
        assert f"focus on the {thing} at " in said
