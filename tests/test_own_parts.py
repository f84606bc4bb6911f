"""A lens and an aperture from outside the package, each a file of examples/, through every renderer that takes it."""

import importlib.util
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from torch import Tensor

import torchbokeh as tb
from torchbokeh.picture import Sensor

EXAMPLES = Path(__file__).parents[1] / "examples"
QUALITIES = ("exact", "high", "balanced", "fast")
SIZE = (29, 40)


def load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


TiltedLens, Squircle = load("own_lens").TiltedLens, load("own_aperture").Squircle


def tilted(**changes: Any) -> Any:
    settings = {"focal_length": 0.05, "f_number": 1.8, "focus_distance": 2.0, "sensor_width": 0.004, "slope": 0.2}
    return TiltedLens(**{**settings, **changes})


def plane(slope: float, offset: float = 0.0, size: tuple[int, int] = SIZE) -> Tensor:
    """Depth of the plane in focus, and ``offset`` dioptres behind it: its nearness is linear in the picture."""
    y = Sensor(size).field(torch.zeros((), dtype=torch.float64)).y
    return (0.5 - offset + slope * y * 2 / size[1]).reciprocal()[None, None].float()


def picture(channels: int = 3) -> Tensor:
    return torch.rand(1, channels, *SIZE, generator=torch.Generator().manual_seed(1))


@pytest.mark.parametrize("quality", QUALITIES)
def test_the_tilted_plane_is_sharp_all_over_and_no_other(quality: str) -> None:
    image, depth = picture(), plane(0.2)
    blur = tb.LensBlur(tilted(), quality=quality)
    assert torch.equal(blur(image, depth), image)
    assert blur.plan(image, depth).sharp
    assert not tb.LensBlur(tilted(slope=-0.2), quality=quality).plan(image, depth).sharp
    radius = tilted().coc(depth, SIZE[1], field=Sensor(SIZE).field(depth))
    assert float(radius.abs().max()) < 1e-3


def test_parallel_to_the_plane_all_is_blurred_alike() -> None:
    depth = plane(0.2, offset=0.1)
    lens = tilted()
    radius = lens.coc(depth, SIZE[1], field=Sensor(SIZE).field(depth))
    gain = 0.05**2 / 3.6 / (1 - 0.05 / 2) * SIZE[1] / 0.004
    torch.testing.assert_close(radius, torch.full_like(radius, 0.1 * gain), rtol=1e-4, atol=0)
    for quality in QUALITIES:
        got = tb.LensBlur(lens, quality=quality)(picture(), depth)
        want = tb.LensBlur(quality=quality)(picture(), coc=radius)
        torch.testing.assert_close(got, want)


def test_the_margin_lies_outside_of_the_field() -> None:
    """The same pixels of the sensor have the same blur, whatever is known around them."""
    image, depth = picture(), plane(-0.1)
    wide = torch.nn.functional.pad(depth, (6, 6, 6, 6), mode="replicate")
    plain = tb.LensBlur(tilted()).request(image, depth)
    with_margin = tb.LensBlur(tilted(), margin=6).request(torch.zeros(1, 3, *wide.shape[2:]), wide)
    torch.testing.assert_close(with_margin.sensor.crop(with_margin.coc), plain.coc)


def renderings(lens: Any = None, aperture: Any = "disc") -> dict[str, Tensor]:
    """One rendering by every renderer that takes a lens or an aperture."""
    image, depth = picture(), plane(-0.2)
    layers = torch.stack([torch.cat([picture() * a, torch.full((1, 1, *SIZE), a)], 1) for a in (0.5, 1.0)], 1)
    layer_depth = torch.stack([depth, depth + 2], 1)
    given = {"depth": depth} if lens is not None else {"coc": 4 * depth - 6}
    layer_map = {"depth": layer_depth} if lens is not None else {"coc": 4 * layer_depth - 6}
    settings = {"lens": lens, "aperture": aperture}
    found = {f"LensBlur, {q}": tb.LensBlur(**settings, quality=q)(image, **given) for q in QUALITIES}
    found |= {f"layers, {q}": tb.LensBlur(**settings, quality=q)(layers, **layer_map) for q in QUALITIES}
    blur = tb.LensBlur(**settings)
    found["background"] = blur(image, **given, background=picture().flip(3))
    if isinstance(aperture, str):
        motion = torch.full((1, 2, *SIZE), 3.0)
        name, ends = next(iter(given)), torch.cat([next(iter(given.values()))] * 2, 1)
        found["motion"] = blur(image, **{name: given[name]}, motion=motion)
        found["approach"] = blur(image, **given, shutter_depth=ends * torch.tensor([1.0, 1.4])[:, None, None])
    found["AccumulationBuffer"] = tb.AccumulationBuffer(**settings, views=16)(layers, **layer_map)
    found["ChromaticAccumulation"] = tb.ChromaticAccumulation(**settings, views=16)(layers, **layer_map)
    found["planned"] = blur.planned(blur.plan(image, **given))(image, **given)
    if lens is None:
        found |= {q: tb.KernelSplatting(aperture, q)(image, **given) for q in QUALITIES}
        world, camera = tb.scenes.ramp(seed=0, size=SIZE, blur=5.0)
        found["scene"] = tb.AccumulationBuffer(aperture=aperture, views=16)(world, camera)
    return found


@pytest.mark.parametrize("slope", [0.0, 0.3])
def test_a_lens_of_ones_own_goes_through_every_renderer(slope: float) -> None:
    """With no slope it is a thin lens, of which every renderer makes the same picture; with one, of its own CoC."""
    got = renderings(tilted(slope=slope))
    thin = renderings(tb.ThinLens(0.05, 1.8, 2.0, 0.004))
    for name, out in got.items():
        assert out.isfinite().all(), name
        same = torch.allclose(out, thin[name], rtol=1e-4, atol=1e-5)
        assert same == (slope == 0), name


def test_an_aperture_of_ones_own_goes_through_every_renderer() -> None:
    """At a power of 2 it is the disc, or its polygon of 64 corners; at a high one the square.

    Views look through 16 points, which lie elsewhere in a polygon than in a disc.
    """
    disc, square = renderings(aperture="disc"), renderings(aperture=Squircle(60.0))
    for name, out in renderings(aperture=Squircle(2.0)).items():
        off = float((out - disc[name]).abs().mean() / disc[name].abs().mean())
        other = float((square[name] - disc[name]).abs().mean() / disc[name].abs().mean())
        of_views = "Accumulation" in name or name == "scene"
        assert off < (0.05 if of_views else 0.01), name
        assert other > (0.01 if of_views else 2 * off), name


def test_both_are_learned() -> None:
    slope, power = torch.nn.Parameter(torch.tensor(0.1)), torch.nn.Parameter(torch.tensor(3.0))
    blur = tb.LensBlur(tilted(slope=slope), Squircle(power))
    (blur(picture(), plane(-0.2)) * picture().flip(3)).sum().backward()
    for parameter in (slope, power):
        assert parameter.grad is not None
        assert parameter.grad.isfinite()
        assert parameter.grad != 0


@pytest.mark.slow
def test_both_are_exported(tmp_path: Path) -> None:
    onnxruntime = pytest.importorskip("onnxruntime")
    blur = tb.LensBlur(tilted(), Squircle(4.0), quality="balanced")
    image, depth = picture(), plane(-0.2)
    session = onnxruntime.InferenceSession(str(tb.export_onnx(blur, tmp_path / "own.onnx", image, depth)))
    (got,) = session.run(None, {"image": image.numpy(), "depth": depth.numpy()})
    torch.testing.assert_close(torch.from_numpy(got), blur(image, depth), rtol=0, atol=1e-4)


def test_what_a_camera_of_a_scene_refuses() -> None:
    with pytest.raises(TypeError, match="lens: expected a ThinLens, got TiltedLens"):
        tb.scenes.Camera(tilted(), SIZE)
