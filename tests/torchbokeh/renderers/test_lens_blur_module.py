"""`LensBlur` as a module: its keywords, what it refuses, and how it gets along with the rest of torch."""

import copy
import dataclasses
import doctest
import io
import pickle
from collections.abc import Iterator
from typing import Any

import pytest
import torch
from torch import Tensor, nn

import torchbokeh.renderers.lens_blur
from torchbokeh import DisparityLens, Ellipse, LensBlur, Plan, Polygon, ThinLens

F32, F64 = torch.float32, torch.float64
LENS = ThinLens(0.2, 1.8, focus_distance=2.0, sensor_width=0.036)
DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]


def noise(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def scene(batch: int = 1, channels: int = 3, height: int = 24, width: int = 32) -> tuple[Tensor, Tensor]:
    """A picture, and depths of 0.9 to 6 metres with something near in front."""
    depth = torch.linspace(6, 1.5, height)[:, None].repeat(batch, 1, 1, width)
    depth[..., height // 5 : -height // 5, width // 6 : width // 3] = 0.9
    return noise(batch, channels, height, width), depth + 0.1 * noise(batch, 1, height, width, seed=1)


def layered(batch: int = 1) -> tuple[Tensor, Tensor]:
    """Two premultiplied layers, the last one opaque, and their depths."""
    alpha = (noise(batch, 2, 1, 24, 32, seed=3) < 0.4).float()
    alpha[:, 1] = 1
    image = torch.cat([noise(batch, 2, 3, 24, 32) * alpha, alpha], 2)
    return image, torch.tensor([0.9, 4.0]).view(1, 2, 1, 1, 1).expand(batch, 2, 1, 24, 32).clone()


IMAGE, DEPTH = scene()


@pytest.fixture
def threads() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


def differs(one: Tensor, other: Tensor) -> bool:
    return float((one - other).abs().max()) > 1e-3


def test_examples_in_the_docstrings() -> None:
    result = doctest.testmod(torchbokeh.renderers.lens_blur)
    assert result.attempted > 0
    assert result.failed == 0


CHANGES: dict[str, Any] = {"lens": DisparityLens(2.0, 3.0), "aperture": "3-gon", "layers": 1, "max_coc": 3}
CHANGES["subapertures"] = 1


@pytest.mark.parametrize("keyword", CHANGES)
def test_every_keyword_has_an_effect(keyword: str) -> None:
    plain, changed = LensBlur(LENS), LensBlur(**{"lens": LENS, keyword: CHANGES[keyword]})
    assert differs(changed(IMAGE, DEPTH), plain(IMAGE, DEPTH))
    assert changed.plan(IMAGE, DEPTH) != plain.plan(IMAGE, DEPTH)


def test_the_auto_settings_are_the_defaults() -> None:
    default = LensBlur(LENS)(IMAGE, DEPTH)
    named = LensBlur(LENS, aperture="disc", layers="auto", quality="exact", max_coc=None, subapertures="auto")
    assert torch.equal(named(IMAGE, DEPTH), default)
    assert torch.equal(LensBlur(LENS, "disc", "auto", "exact")(IMAGE, DEPTH), default)
    assert not differs(LensBlur(LENS, max_coc=1e6)(IMAGE, DEPTH), default)


def test_every_argument_of_forward_has_an_effect() -> None:
    blur = LensBlur(LENS)
    plain = blur(IMAGE, DEPTH)
    coc = LENS.coc(DEPTH, 32)
    behind = noise(1, 3, 24, 32, seed=9)
    assert torch.equal(blur(IMAGE, coc=coc), plain)
    assert differs(blur(IMAGE, coc=-coc), plain)
    colour = blur(IMAGE, DEPTH, background=behind)
    assert differs(colour, plain)
    pair = blur(IMAGE, DEPTH, background=(behind, torch.full_like(DEPTH, 30.0)))
    assert differs(pair, colour)
    assert torch.equal(blur(IMAGE, coc=coc, background=(behind, LENS.coc(torch.full_like(DEPTH, 30.0), 32))), pair)
    plan = dataclasses.replace(blur.plan(IMAGE, DEPTH), subapertures=1)
    assert differs(blur(IMAGE, DEPTH, plan=plan), plain)


def test_max_coc_cuts_the_blur_of_everything() -> None:
    coc, behind = LENS.coc(DEPTH, 32), (IMAGE.flip(3), torch.full((1, 1, 24, 32), 9.0))
    cut = LensBlur(max_coc=2.5)(IMAGE, coc=coc, background=behind)
    by_hand = LensBlur()(IMAGE, coc=coc.clamp(-2.5, 2.5), background=(behind[0], behind[1].clamp(-2.5, 2.5)))
    assert torch.equal(cut, by_hand)


def test_what_is_printed() -> None:
    text = repr(LensBlur(LENS, "5-gon", layers=3, max_coc=40.0))
    for part in ("layers=3", "quality='exact'", "max_coc=40.0", "subapertures=auto", "focus_distance=2", "blades=5"):
        assert part in text


def test_an_aperture_and_a_lens_stay_the_modules_they_are() -> None:
    aperture = Polygon(5, nn.Parameter(torch.tensor(0.1)))
    blur = LensBlur(LENS, aperture)
    assert blur.aperture is aperture
    assert blur.lens is LENS
    assert [name for name, _ in blur.named_parameters()] == ["aperture.rotation"]


BAD_ARGUMENTS = [
    ({"lens": 3}, TypeError, "lens: expected a Lens, got int"),
    ({"lens": ThinLens}, TypeError, "lens: expected a Lens, got"),
    ({"aperture": 6}, TypeError, "aperture: expected a name or an Aperture, got int"),
    ({"aperture": "square"}, ValueError, "aperture: expected 'disc', 'N-gon'.*got 'square'"),
    ({"aperture": "2-gon"}, ValueError, "blades: expected 3 to 64, got 2"),
    ({"layers": 0}, ValueError, "layers: expected at least 1, got 0"),
    ({"layers": "many"}, TypeError, "layers: expected an int or 'auto', got 'many'"),
    ({"layers": 2.0}, TypeError, "layers: expected an int or 'auto', got 2.0"),
    ({"subapertures": -1}, ValueError, "subapertures: expected at least 1, got -1"),
    ({"subapertures": True}, TypeError, "subapertures: expected an int or 'auto', got True"),
    ({"quality": "best"}, ValueError, "quality: expected one of 'exact', 'high', 'balanced', 'fast', got 'best'"),
    ({"max_coc": 0}, ValueError, "max_coc: expected a radius in px above 0, got 0"),
    ({"max_coc": -3.0}, ValueError, "max_coc: expected a radius in px above 0, got -3.0"),
    ({"max_coc": float("nan")}, ValueError, "max_coc: expected a radius in px above 0, got nan"),
    ({"max_coc": "20"}, TypeError, "max_coc: expected a number or None, got '20'"),
    ({"max_coc": True}, TypeError, "max_coc: expected a number or None, got True"),
]


@pytest.mark.parametrize(("arguments", "error", "message"), BAD_ARGUMENTS)
def test_what_the_module_refuses(arguments: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        LensBlur(**arguments)


def marked(value: float, shape: tuple[int, ...] = (1, 1, 24, 32)) -> Tensor:
    """Ones, but for one pixel."""
    map_ = torch.ones(shape)
    map_.flatten()[7] = value
    return map_


LAYERS, LAYER_DEPTH = layered()
BAD_SCENES: list[tuple[dict[str, Any], type[Exception], str]] = [
    ({"image": IMAGE[0]}, ValueError, r"image: expected shape \(B, C, H, W\), got \(3, 24, 32\)"),
    ({"image": IMAGE[:, None]}, ValueError, r"image: expected shape \(B, L, 4, H, W\), got \(1, 1, 3, 24, 32\)"),
    ({"image": IMAGE.numpy()}, TypeError, r"image: expected a tensor of shape \(B, C, H, W\), got ndarray"),
    ({"image": (255 * IMAGE).byte()}, TypeError, "image: expected a floating-point tensor, got torch.uint8"),
    ({"depth": None}, ValueError, "depth: expected either depth or coc, got neither"),
    ({"coc": DEPTH}, ValueError, "depth: expected either depth or coc, got both"),
    ({"depth": DEPTH[:, 0]}, ValueError, r"depth: expected shape \(1, 1, 24, 32\), got \(1, 24, 32\)"),
    ({"depth": DEPTH[..., 1:]}, ValueError, r"depth: expected shape \(1, 1, 24, 32\), got \(1, 1, 24, 31\)"),
    ({"depth": 3.0}, TypeError, r"depth: expected a tensor of shape \(1, 1, 24, 32\), got float"),
    ({"depth": DEPTH.long()}, TypeError, "depth: expected a floating-point tensor, got torch.int64"),
    ({"depth": marked(torch.nan)}, ValueError, "depth: expected values above 0 .*got 1 bad of 768, the smallest nan"),
    ({"depth": marked(0.0)}, ValueError, "depth: expected values above 0 .*got 1 bad of 768, the smallest 0"),
    ({"depth": marked(-2.0)}, ValueError, "depth: expected values above 0 .*got 1 bad of 768, the smallest -2"),
    ({"depth": None, "coc": marked(torch.inf)}, ValueError, "coc: expected finite radii, got 1 that are not"),
    ({"depth": None, "coc": marked(torch.nan)}, ValueError, "coc: expected finite radii, got 1 that are not"),
    ({"depth": None, "coc": DEPTH[..., 1:]}, ValueError, r"coc: expected shape \(1, 1, 24, 32\), got"),
    ({"background": IMAGE[:, :1]}, ValueError, r"background: expected shape \(1, 3, 24, 32\), got \(1, 1, 24, 32\)"),
    ({"background": [IMAGE, DEPTH]}, TypeError, "background: expected a tensor .*got list"),
    ({"background": (IMAGE,)}, ValueError, "background: expected an image or a pair .*got 1 values"),
    ({"background": (IMAGE, DEPTH, DEPTH)}, ValueError, "background: expected an image or a pair .*got 3 values"),
    ({"background": (IMAGE, DEPTH[0])}, ValueError, r"background\[1\]: expected shape \(1, 1, 24, 32\), got"),
    ({"background": (IMAGE, marked(0.0))}, ValueError, "expected values above 0 .*got 1 bad of 768, the smallest 0"),
    ({"image": LAYERS}, ValueError, r"depth: expected shape \(1, 2, 1, 24, 32\), got \(1, 1, 24, 32\)"),
    (
        {"image": LAYERS, "depth": LAYER_DEPTH, "background": IMAGE},
        ValueError,
        "background: expected None for layers .*got a background",
    ),
]


@pytest.mark.parametrize(("arguments", "error", "message"), BAD_SCENES)
def test_what_a_call_refuses(arguments: dict[str, Any], error: type[Exception], message: str) -> None:
    arguments = {"image": IMAGE, "depth": DEPTH, **arguments}
    blur = LensBlur(LENS)
    for call in (blur, blur.plan):
        with pytest.raises(error, match=message):
            call(**arguments)


def test_radii_that_half_precision_holds_are_taken_and_others_named() -> None:
    image, coc = torch.ones(1, 3, 8, 8).half(), torch.full((1, 1, 8, 8), 6e4).half()
    coc[..., :4] = -6e4  # their difference is infinite in half precision
    assert LensBlur()(image, coc=coc).isfinite().all()
    with pytest.raises(
        ValueError, match="coc: expected finite radii, got 64 that are not, first inf: float16 ends at 65504"
    ):
        LensBlur()(image, coc=(coc.float().abs() + 1e4).half())


def test_depth_needs_a_lens() -> None:
    with pytest.raises(ValueError, match="depth: expected coc, since there is no lens, got depth"):
        LensBlur()(IMAGE, DEPTH)


def test_disparities_must_be_finite() -> None:
    with pytest.raises(ValueError, match="depth: expected finite disparities, got 1 bad of 768"):
        LensBlur(DisparityLens(3.0, 0.5))(IMAGE, marked(torch.inf))


@pytest.mark.parametrize("shape", [(0, 3, 24, 32), (1, 0, 24, 32), (1, 3, 0, 32), (2, 3, 24, 0)])
def test_an_empty_picture(shape: tuple[int, ...]) -> None:
    depth = torch.ones(shape[0], 1, *shape[2:])
    if shape[-1]:  # a lens maps a sensor to a number of pixels
        assert LensBlur(LENS)(torch.zeros(shape), depth).shape == shape
    assert LensBlur()(torch.zeros(shape), coc=depth).shape == shape


def test_no_layers_at_all() -> None:
    out = LensBlur()(torch.zeros(2, 0, 4, 5, 6), coc=torch.zeros(2, 0, 1, 5, 6))
    assert torch.equal(out, torch.zeros(2, 4, 5, 6))


@pytest.mark.parametrize("channels", [1, 2, 3, 4, 5, 9])
def test_channels_do_not_know_of_each_other(channels: int) -> None:
    image, depth = scene(channels=channels)
    blur = LensBlur(LENS)
    one_by_one = [blur(image[:, c : c + 1], depth) for c in range(channels)]
    torch.testing.assert_close(blur(image, depth), torch.cat(one_by_one, 1), rtol=0, atol=1e-6)


@pytest.mark.parametrize("aperture", ["disc", Polygon(5, 0.2, 0.3)])
def test_a_batch_with_a_lens_for_each_item(aperture: Any) -> None:
    image, depth = scene(batch=4)
    numbers, focus = torch.tensor([1.4, 2.0, 4.0, 8.0]), torch.tensor([1.0, 2.0, 3.0, torch.inf])
    blur = LensBlur(ThinLens(0.2, numbers, focus, 0.036), aperture)
    for plan in (blur.plan(image, depth), None):
        one_by_one = []
        for k in range(4):
            single = LensBlur(ThinLens(0.2, numbers[k], focus[k], 0.036), aperture)
            one_by_one.append(single(image[k : k + 1], depth[k : k + 1], plan=plan))
        torch.testing.assert_close(blur(image, depth, plan=plan), torch.cat(one_by_one), rtol=0, atol=1e-6)


def test_a_batch_of_layers() -> None:
    image, depth = layered(batch=3)
    blur = LensBlur(LENS)
    plan = blur.plan(image, depth)
    one_by_one = [blur(image[k : k + 1], depth[k : k + 1], plan=plan) for k in range(3)]
    torch.testing.assert_close(blur(image, depth), torch.cat(one_by_one), rtol=0, atol=1e-6)


@pytest.mark.parametrize("device", DEVICES)
def test_double_gives_double(device: str) -> None:
    image, depth = scene(height=12, width=16)
    blur = LensBlur(ThinLens(0.2, 1.8, 2.0, 0.02))
    single = blur(image, depth)
    blur = blur.to(device, F64)
    assert blur.lens.focus_distance.dtype == F64  # type: ignore[union-attr]
    out = blur(image.to(device, F64), depth.to(device, F64))
    assert out.dtype == F64
    torch.testing.assert_close(out.cpu().float(), single, rtol=0, atol=2e-5)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
@pytest.mark.parametrize("given_coc", [True, False])
def test_half_precision_is_computed_in_single(dtype: torch.dtype, given_coc: bool) -> None:
    image, depth = scene()
    image, depth = image.to(dtype), depth.to(dtype)
    coc = LENS.coc(depth, 32).to(dtype)
    blur = LensBlur(LENS)
    if given_coc:
        got, want = blur(image, coc=coc), blur(image.float(), coc=coc.float())
    else:
        got, want = blur(image, depth), blur(image.float(), depth.float())
    assert got.dtype == dtype
    assert torch.equal(got, want.to(dtype))


def test_layers_in_half_precision() -> None:
    image, depth = (t.half() for t in layered())
    coc = LENS.coc(depth, 32).half()
    got = LensBlur()(image, coc=coc)
    assert torch.equal(got, LensBlur()(image.float(), coc=coc.float()).half())


def test_depth_in_double_with_an_image_in_single() -> None:
    blur = LensBlur(LENS)
    out = blur(IMAGE[..., :12, :16], DEPTH[..., :12, :16].double())
    assert out.dtype == F32
    torch.testing.assert_close(out, blur(IMAGE[..., :12, :16], DEPTH[..., :12, :16]), rtol=0, atol=2e-5)


@pytest.mark.parametrize("layers", [False, True])
def test_strides_do_not_matter(layers: bool) -> None:
    image, depth = layered(2) if layers else scene(2)
    blur = LensBlur(LENS)
    calls = [(image.mT.contiguous().mT, depth.mT.contiguous().mT), (image.movedim(2, -1).clone().movedim(-1, 2), depth)]
    for strided in calls:
        torch.testing.assert_close(blur(*strided), blur(image, depth), rtol=0, atol=1e-6)
    same = depth[:1].expand_as(depth)
    torch.testing.assert_close(blur(image, same), blur(image, same.contiguous()), rtol=0, atol=1e-6)


def test_inputs_are_left_as_they_are() -> None:
    image, depth, background = IMAGE.clone(), DEPTH.clone(), IMAGE.flip(3).clone()
    LensBlur(LENS, max_coc=4.0)(image, depth, background=(background, depth))
    assert torch.equal(image, IMAGE)
    assert torch.equal(depth, DEPTH)
    assert torch.equal(background, IMAGE.flip(3))


def test_inference_mode_and_no_grad() -> None:
    blur = LensBlur(ThinLens(0.2, 1.8, nn.Parameter(torch.tensor(2.0)), 0.036))
    want = blur(IMAGE, DEPTH)
    assert want.requires_grad
    with torch.inference_mode():
        assert torch.equal(blur(IMAGE, DEPTH), want)
    with torch.no_grad():
        assert not blur(IMAGE, DEPTH).requires_grad


@pytest.mark.parametrize("layers", [False, True])
def test_autocast_changes_nothing(layers: bool) -> None:
    image, depth = layered() if layers else scene()
    blur = LensBlur(LENS, "6-gon")
    want = blur(image, depth)
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(blur(image, depth), want)
        assert torch.equal(blur(image, depth, plan=blur.plan(image, depth)), want)


MODULES = {
    "plain": LensBlur(LENS),
    "all set": LensBlur(DisparityLens(12.0, 0.5), Ellipse(1.7, 0.2), 3, "exact", max_coc=6.0, subapertures=2),
    "trained": LensBlur(ThinLens(0.2, nn.Parameter(torch.tensor(1.8)), 2.0, 0.036), Polygon(5, torch.tensor(0.4))),
}


@pytest.mark.parametrize("name", MODULES)
def test_copies_paint_the_same_picture(name: str) -> None:
    blur = MODULES[name]
    want = blur(IMAGE, DEPTH)
    file = io.BytesIO()
    torch.save(blur, file)
    file.seek(0)
    copies = [copy.deepcopy(blur), pickle.loads(pickle.dumps(blur)), torch.load(file, weights_only=False)]
    for other in copies:
        assert torch.equal(other(IMAGE, DEPTH), want)
        assert repr(other) == repr(blur)


def test_a_state_dict_brings_lens_and_aperture_over() -> None:
    blur, other = (
        LensBlur(ThinLens(0.2, number, focus, 0.036), Polygon(5, angle, curve))
        for number, focus, angle, curve in ((1.8, 2.0, 0.3, 0.5), (4.0, 1.1, 0.0, 0.1))
    )
    state = blur.state_dict()
    assert set(state) == {
        *(f"lens.{name}" for name in ("focal_length", "f_number", "focus_distance", "sensor_width")),
        *("aperture.rotation", "aperture.curvature"),
    }
    assert differs(other(IMAGE, DEPTH), blur(IMAGE, DEPTH))
    other.load_state_dict(state)
    assert torch.equal(other(IMAGE, DEPTH), blur(IMAGE, DEPTH))


def test_a_plan_can_be_stored() -> None:
    plan = LensBlur(LENS).plan(IMAGE, DEPTH)
    assert pickle.loads(pickle.dumps(plan)) == plan
    assert Plan(**dataclasses.asdict(plan)) == plan


@pytest.mark.parametrize("planned", [True, False])
def test_compiled_is_eager(planned: bool) -> None:
    torch.compiler.reset()
    blur = LensBlur(LENS, "5-gon", subapertures=1 if planned else 2)
    plan = blur.plan(IMAGE, DEPTH) if planned else None
    compiled = torch.compile(blur, backend="aot_eager" if planned else "eager")
    results = []
    for call in (blur, compiled):
        image = IMAGE.clone().requires_grad_()
        out = call(image, DEPTH, plan=plan)
        (slope,) = torch.autograd.grad(out.square().sum(), image)
        results.append((out, slope))
    for got, want in zip(*results, strict=True):
        torch.testing.assert_close(got, want, rtol=1e-5, atol=1e-5)


@pytest.mark.usefixtures("threads")
@pytest.mark.parametrize("layers", [False, True])
def test_the_same_bits_for_any_number_of_threads(layers: bool) -> None:
    image, depth = scene(2, 3, 150, 20)  # three bands of rows
    if layers:
        alpha = (noise(2, 1, 150, 20, seed=5) < 0.5).float()
        image = torch.stack([torch.cat([image * a, a], 1) for a in (alpha, torch.ones_like(alpha))], 1)
        depth = torch.stack([depth, depth + 2], 1)
    results = []
    for count in (1, 2):
        torch.set_num_threads(count)
        source, map_ = image.clone().requires_grad_(), depth.clone().requires_grad_()
        out = LensBlur(LENS)(source, map_)
        results.append((out, *torch.autograd.grad(out.square().sum(), (source, map_))))
    for one, two in zip(*results, strict=True):
        assert torch.equal(one, two)


@pytest.mark.parametrize("quality", ["exact", "balanced"])
@pytest.mark.parametrize("layered", [False, True])
def test_a_margin_is_known_and_cut_off(quality: str, layered: bool) -> None:
    lens = ThinLens(0.05, 1.4, focus_distance=2.0, sensor_width=0.02)
    draw = torch.Generator().manual_seed(5)
    image, depth = torch.rand(1, 3, 72, 88, generator=draw), 1.6 + 3 * torch.rand(1, 1, 9, 11, generator=draw)
    depth = torch.nn.functional.interpolate(depth, scale_factor=8, mode="bilinear")
    if layered:
        image, depth = torch.cat([image, torch.ones(1, 1, 72, 88)], 1)[:, None], depth[:, None]
    with_margin = LensBlur(lens, quality=quality, margin=12)
    out = with_margin(image, depth)
    assert out.shape[-2:] == (48, 64)
    signed = lens.coc(depth, 64)
    assert with_margin.plan(image, depth).coc_range == pytest.approx((signed.min().item(), signed.max().item()))
    torch.testing.assert_close(out, LensBlur(quality=quality)(image, coc=signed)[..., 12:-12, 12:-12])
    inner = LensBlur(lens, quality=quality)(image[..., 12:-12, 12:-12], depth[..., 12:-12, 12:-12])
    assert float((out - inner)[..., 12:-12, 12:-12].abs().mean()) < 0.02
    assert float((out - inner).abs().max()) > 0.02


def test_what_a_margin_may_be() -> None:
    image = torch.rand(1, 3, 10, 12)
    with pytest.raises(ValueError, match="margin: expected at least 0, got -1"):
        LensBlur(margin=-1)
    with pytest.raises(TypeError, match=r"margin: expected an int, got 1\.5"):
        LensBlur(margin=1.5)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"margin: expected less than half of \(10, 12\), got 5"):
        LensBlur(margin=5)(image, coc=torch.zeros(1, 1, 10, 12))
    sharp = LensBlur(margin=2)(image, coc=torch.zeros(1, 1, 10, 12))
    assert torch.equal(sharp, image[..., 2:-2, 2:-2])
    assert "margin=2" in repr(LensBlur(margin=2))
