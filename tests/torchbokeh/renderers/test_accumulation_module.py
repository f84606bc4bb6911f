import doctest
import io
import math
import pickle
from typing import Any

import pytest
import torch
from torch import nn

import torchbokeh as tb
import torchbokeh.renderers.accumulation
from torchbokeh.psfs import Polygon
from torchbokeh.scenes import Camera, Scene


def test_settings_are_shown_and_saved() -> None:
    lens = tb.ThinLens(0.05, 1.8, nn.Parameter(torch.tensor(2.0)), sensor_width=0.036)
    aperture = Polygon(6, nn.Parameter(torch.tensor(0.2)))
    buffer = tb.AccumulationBuffer(lens, aperture, 12, level_of_detail=0.5, reuse=2, subsamples=3, seed=4, first=7)
    assert "views=12, level_of_detail=0.5, reuse=2, subsamples=3, seed=4, first=7" in repr(buffer)
    assert "blades=6" in repr(buffer)
    assert dict(buffer.named_parameters()).keys() == {"lens.focus_distance", "aperture.rotation"}
    generator = torch.Generator().manual_seed(0)
    layers, depth = torch.rand(1, 2, 4, 10, 12, generator=generator), torch.full((1, 2, 1, 10, 12), 3.0)
    out = buffer(layers, depth)
    assert torch.equal(pickle.loads(pickle.dumps(buffer))(layers, depth), out)
    file = io.BytesIO()
    torch.save(buffer.state_dict(), file)
    file.seek(0)
    other = tb.AccumulationBuffer(
        tb.ThinLens(0.1, 2.8, nn.Parameter(torch.tensor(9.0)), sensor_width=0.036),
        Polygon(6, nn.Parameter(torch.tensor(0.9))), 12, level_of_detail=0.5, reuse=2, subsamples=3, seed=4, first=7,
    )  # fmt: skip
    assert not torch.equal(other(layers, depth), out)
    other.load_state_dict(torch.load(file))
    assert torch.equal(other(layers, depth), out)


@pytest.mark.parametrize(
    ("settings", "error", "message"),
    [
        ({"lens": 2.0}, TypeError, "lens: expected a Lens, got float"),
        ({"aperture": 5}, TypeError, "aperture: expected a name or an Aperture, got int"),
        ({"aperture": "star"}, ValueError, "aperture: expected 'disc'"),
        ({"views": 0}, ValueError, "views: expected at least 1, got 0"),
        ({"views": 0, "level_of_detail": "auto"}, ValueError, "views: expected at least 1, got 0"),
        ({"views": 4.0}, TypeError, "views: expected an int, got 4.0"),
        ({"views": True}, TypeError, "views: expected an int, got True"),
        ({"level_of_detail": "fine"}, TypeError, "level_of_detail: expected a number or 'auto', got 'fine'"),
        ({"level_of_detail": True}, TypeError, "level_of_detail: expected a number or 'auto', got True"),
        ({"level_of_detail": 1.5}, ValueError, "level_of_detail: expected a share from 0 to 1, got 1.5"),
        ({"level_of_detail": math.nan}, ValueError, "level_of_detail: expected a share from 0 to 1, got nan"),
        ({"reuse": -1}, ValueError, "reuse: expected at least 0, got -1"),
        ({"subsamples": 1.5}, TypeError, "subsamples: expected an int, got 1.5"),
        ({"seed": -1}, ValueError, "seed: expected at least 0, got -1"),
        ({"first": None}, TypeError, "first: expected an int, got None"),
    ],
)
def test_settings_are_checked(settings: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        tb.AccumulationBuffer(**settings)


LAYERS, RADII = torch.ones(2, 3, 4, 5, 6), torch.ones(2, 3, 1, 5, 6)


@pytest.mark.parametrize(
    ("given", "error", "message"),
    [
        ({"source": None}, TypeError, "source: expected a Scene, with its Camera, or layers, got NoneType"),
        ({"source": LAYERS[:, 0]}, ValueError, r"source: expected shape \(B, L, 4, H, W\), got \(2, 4, 5, 6\)"),
        ({"source": LAYERS.int()}, TypeError, "source: expected a floating-point tensor"),
        ({"coc": None}, ValueError, "depth: expected either depth or coc, got neither"),
        ({"depth": RADII}, ValueError, "depth: expected either depth or coc, got both"),
        ({"coc": None, "depth": RADII}, ValueError, "depth: expected coc, since .* no lens, got depth"),
        ({"coc": RADII[:, :2]}, ValueError, r"coc: expected shape \(2, 3, 1, 5, 6\), got \(2, 2, 1, 5, 6\)"),
        ({"coc": RADII / 0}, ValueError, "coc: expected finite radii, got 180 that are not"),
        ({"coc": RADII * math.nan}, ValueError, "coc: expected finite radii, got 180 that are not"),
        ({"coc": 3.0}, TypeError, r"coc: expected a tensor of shape \(2, 3, 1, 5, 6\), got float"),
        ({"motion": RADII}, ValueError, r"motion: expected shape \(2, 3, 2, 5, 6\), got \(2, 3, 1, 5, 6\)"),
        ({"motion": LAYERS[:, :, :2].int()}, TypeError, "motion: expected a floating-point tensor"),
        ({"motion": LAYERS[:, :, :2] / 0}, ValueError, "motion: expected finite ways, got 360 that are not"),
        ({"source": Scene(())}, TypeError, "depth: expected a Camera beside the scene, got NoneType"),
    ],
)
def test_layers_are_checked(given: dict[str, Any], error: type[Exception], message: str) -> None:
    arguments = {"source": LAYERS, "coc": RADII, **given}
    with pytest.raises(error, match=message):
        tb.AccumulationBuffer(views=2)(arguments.pop("source"), arguments.pop("depth", None), **arguments)


def test_a_camera_goes_with_a_scene() -> None:
    lens = tb.ThinLens(0.05, 1.8, 2.0, sensor_width=0.036)
    camera, buffer, free = (
        Camera(lens, size=(6, 5)),
        tb.AccumulationBuffer(lens, views=2),
        tb.AccumulationBuffer(views=2),
    )
    with pytest.raises(TypeError, match=r"depth: expected a tensor of shape .*, got Camera"):
        buffer(LAYERS, camera)
    for name in ("coc", "motion"):
        with pytest.raises(ValueError, match=f"{name}: expected None for a scene, got Tensor"):
            free(Scene(()), camera, **{name: RADII})
    with pytest.raises(ValueError, match="lens: expected None for a scene, got ThinLens"):
        buffer(Scene(()), camera)
    with pytest.raises(TypeError, match="source: expected a Scene, with its Camera, or layers, got tuple"):
        free((Scene(()), camera))
    with pytest.raises(ValueError, match="depth: expected values above 0"):
        buffer(LAYERS, RADII - 1)
    assert torch.equal(free(Scene(()), camera), torch.zeros(1, 4, 6, 5))


def test_examples_in_the_docstrings() -> None:
    result = doctest.testmod(torchbokeh.renderers.accumulation)
    assert result.attempted > 0
    assert result.failed == 0
