"""What `LensBlur` paints: constants, silhouettes, units and gradients. Its face is in `test_lens_blur_module.py`."""

import dataclasses
import math
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn

import torchbokeh as tb
from torchbokeh import DisparityLens, Ellipse, LensBlur, ThinLens
from torchbokeh.ops.splat import splat_spans
from torchbokeh.psfs import parse_aperture

F32, F64 = torch.float32, torch.float64
INF = torch.inf
few = settings(deadline=None, max_examples=25)
DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
APERTURES = {"disc": "disc", "5-gon": "5-gon", "ellipse": Ellipse(2.0, 0.3)}


square = torch.zeros(1, 1, 40, 56, dtype=torch.bool)
square[..., 14:26, 20:36] = True


def noise(*shape: int, seed: int = 0, dtype: torch.dtype = F32) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=F64).to(dtype)


def constant(height: int, width: int, dtype: torch.dtype = F32) -> Tensor:
    """A dark, a bright and a very bright channel."""
    return torch.tensor([0.003, 0.7, 5e4], dtype=dtype).view(1, 3, 1, 1).repeat(1, 1, height, width)


def coc_map(kind: str, height: int, width: int) -> Tensor:
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    middle = ((x - width / 2).abs() < width / 5) & ((y - height / 2).abs() < height / 4)
    wide = 0.35 * width
    maps = {
        "uniform": torch.full((height, width), 0.2 * width),
        "uniform, in front": torch.full((height, width), -0.2 * width),
        "ramp through focus": ((x - width / 2) + (y - height / 2)) * 0.5,
        "step": torch.where(x < width / 2, wide, 0.0),
        "step across focus": torch.where(y < height / 2, -wide, wide),
        "sharp before blurred": torch.where(middle, 0.0, wide),
        "blurred before sharp": torch.where(middle, -wide, 0.0),
        "blurred before blurred": torch.where(middle, -wide, 0.7 * wide),
        "a wire": torch.where(x == width // 2, -wide, 2.0),
        "random": (noise(height, width) - 0.5) * 2 * wide,
        "far beyond the picture": torch.where(noise(height, width) < 0.5, -20.0 * width, 15.0 * width),
    }
    return maps[kind].float().view(1, 1, height, width)


KINDS = [
    *("uniform", "uniform, in front", "ramp through focus", "step", "step across focus", "sharp before blurred"),
    *("blurred before sharp", "blurred before blurred", "a wire", "random", "far beyond the picture"),
]


def assert_constant(got: Tensor, want: Tensor) -> None:
    assert got.dtype == want.dtype
    torch.testing.assert_close(got, want, rtol=1e-5, atol=0)


@pytest.mark.parametrize("subapertures", [1, 2, 3])
@pytest.mark.parametrize("aperture", APERTURES)
@pytest.mark.parametrize("kind", KINDS)
def test_constant_in_constant_out(kind: str, aperture: str, subapertures: int) -> None:
    image, coc = constant(40, 56), coc_map(kind, 40, 56)
    for layers in (1, 4, "auto"):
        blur = LensBlur(aperture=APERTURES[aperture], layers=layers, subapertures=subapertures)  # type: ignore[arg-type]
        assert_constant(blur(image, coc=coc), image)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("aperture", APERTURES)
@pytest.mark.parametrize("kind", KINDS)
def test_constant_in_constant_out_in_double(kind: str, aperture: str, device: str) -> None:
    image, coc = constant(13, 17, F64).to(device), coc_map(kind, 13, 17).to(device, F64)
    for subapertures in (1, 2):
        blur = LensBlur(aperture=APERTURES[aperture], subapertures=subapertures).to(device)  # type: ignore[arg-type]
        torch.testing.assert_close(blur(image, coc=coc), image, rtol=1e-12, atol=0)


@few
@given(
    seed=st.integers(0, 10**6),
    height=st.integers(1, 30),
    width=st.integers(1, 30),
    reach=st.floats(0.1, 60),
    side=st.integers(1, 3),
    given_background=st.booleans(),
)
def test_constant_whatever_the_coc(
    seed: int, height: int, width: int, reach: float, side: int, given_background: bool
) -> None:
    image = constant(height, width)
    coc = torch.where(
        noise(1, 1, height, width, seed=seed) < 0.3,
        (noise(1, 1, height, width, seed=seed + 1) - 0.5) * 2 * reach,
        (seed % 5 - 2) * reach / 2,
    )
    background = (image, coc.flip(3)) if given_background else None
    assert_constant(LensBlur(subapertures=side)(image, coc=coc, background=background), image)


@pytest.mark.parametrize("side", [1, 2, 3])
@pytest.mark.parametrize("radius", [1e4, 1e5])
def test_constant_in_constant_out_for_extreme_blur(radius: float, side: int) -> None:
    """As where a depth map holds a few micrometres instead of nothing."""
    image = constant(40, 56)
    for near, far in ((radius, radius), (-radius, radius), (-radius, 0.0), (0.0, radius)):
        coc = torch.where(square, near, far).requires_grad_()
        out = LensBlur(subapertures=side)(image, coc=coc)
        assert_constant(out, image)
        (slope,) = torch.autograd.grad(out.sum(), coc)
        assert slope.isfinite().all()


@pytest.mark.parametrize("focus", [1.0, 2.0, INF])
@pytest.mark.parametrize("side", [1, 2, 3])
def test_a_constant_scene_before_the_sky_stays_constant(focus: float, side: int) -> None:
    lens = ThinLens(0.2, 1.8, focus, 0.036)
    depth = torch.full((1, 1, 40, 56), INF)
    depth[..., 20:, :] = torch.linspace(6, 0.8, 20)[:, None]
    depth[..., 8:34, 10:20] = 1.0
    blur = LensBlur(lens, subapertures=side)
    image = constant(40, 56)
    assert_constant(blur(image, depth), image)
    assert_constant(blur(image, torch.full_like(depth, INF)), image)


@pytest.mark.parametrize("side", [1, 2, 3])
@pytest.mark.parametrize("bins", [1, 4])
def test_layers_of_one_colour_stay_that_colour(side: int, bins: int) -> None:
    alpha = torch.where(noise(1, 3, 1, 40, 56) < 0.5, 0, noise(1, 3, 1, 40, 56, seed=1))
    alpha[:, :, :, 10:30, 12:24] = 1
    image = torch.cat([constant(40, 56)[:, None] * alpha, alpha], 2)
    coc = torch.stack([coc_map(k, 40, 56) for k in ("step across focus", "random", "ramp through focus")], 1)
    blur = LensBlur(layers=bins, subapertures=side)
    out = blur(image, coc=coc)
    # Nothing opaque is behind: the colour is premultiplied by a coverage that depends on the layers.
    torch.testing.assert_close(out[:, :3], constant(40, 56) * out[:, 3:], rtol=1e-5, atol=1e-7)
    assert out[:, 3].min() >= 0
    assert out[:, 3].max() <= 1 + 1e-5
    image[:, 2] = torch.cat([constant(40, 56), torch.ones(1, 1, 40, 56)], 1)
    assert_constant(blur(image, coc=coc), torch.cat([constant(40, 56), torch.ones(1, 1, 40, 56)], 1))


def test_the_depth_of_a_layer_counts_only_where_the_layer_is() -> None:
    image = torch.cat([noise(1, 2, 3, 40, 56), torch.ones(1, 2, 1, 40, 56)], 2)
    image[:, 0] *= square
    near = torch.full((1, 1, 40, 56), -6.0)
    want, *others = (
        LensBlur()(image, coc=torch.stack([torch.where(square, near, empty), near + 9], 1))
        for empty in (-6.0, 0.0, -50.0, 50.0)
    )
    for other in others:
        assert torch.equal(other, want)


@pytest.mark.parametrize("aperture", APERTURES)
def test_even_blur_is_one_normalised_splat(aperture: str) -> None:
    image, coc = noise(1, 3, 40, 56), torch.full((1, 1, 40, 56), 6.3)
    profile = parse_aperture(APERTURES[aperture]).profile()  # type: ignore[arg-type]
    splat = splat_spans(torch.cat([image, torch.ones_like(coc)], 1), coc, profile, integrate=True)
    got = LensBlur(aperture=APERTURES[aperture])(image, coc=coc)  # type: ignore[arg-type]
    torch.testing.assert_close(got, splat[:, :3] / splat[:, 3:], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("side", [2, 3])
def test_sub_apertures_light_a_highlight_evenly_where_blur_varies(side: int) -> None:
    """What hides nothing looks through all pieces of the lens together as it does through the whole."""
    image, coc = noise(1, 3, 40, 56), 3 + 4 * noise(1, 1, 40, 56, seed=6)
    image[..., 20, 28] = 500.0
    whole, pieces = (LensBlur(layers=1, subapertures=s)(image, coc=coc) for s in (1, side))
    inner = (..., slice(8, -8), slice(8, -8))
    torch.testing.assert_close(pieces[inner], whole[inner], rtol=0.01, atol=0.01)


@pytest.mark.parametrize("kind", KINDS)
def test_no_colour_leaves_the_range_of_the_picture(kind: str) -> None:
    image = noise(1, 2, 40, 56, seed=4)
    out = LensBlur()(image, coc=coc_map(kind, 40, 56))
    assert out.min() >= image.min() - 1e-5
    assert out.max() <= image.max() + 1e-5


@pytest.mark.parametrize("subapertures", [1, 2, 3, "auto"])
@pytest.mark.parametrize("background", [0.0, 0.2])
def test_a_sharp_subject_does_not_bleed_over_what_is_behind(background: float, subapertures: Any) -> None:
    image = torch.where(square, 100.0, background)
    out = LensBlur(subapertures=subapertures)(image, coc=torch.where(square, 0.0, 9.0))
    torch.testing.assert_close(out, image, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("subapertures", [1, 2, 3])
@pytest.mark.parametrize("coc", [0.0, -0.9])
def test_a_sharp_subject_has_no_influence_outside_itself(coc: float, subapertures: int) -> None:
    behind, blur = noise(1, 3, 40, 56), LensBlur(subapertures=subapertures)
    radii = torch.where(square, coc, 9.0)
    one, two = (blur(torch.where(square, value, behind), coc=radii) for value in (0.0, 100.0))
    beyond = ~torch.nn.functional.max_pool2d(square.float(), 3, 1, 1).bool()  # a radius of 0.9 is a little blur
    torch.testing.assert_close(one[beyond.expand_as(one)], two[beyond.expand_as(two)], rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("coc", [0.0, 7.0])
def test_a_wide_bright_region_leaves_no_trace_beside_it(coc: float) -> None:
    bright = (torch.arange(2048) < 1024).expand(1, 1, 4, 2048)
    image, radii = torch.where(bright, 1000.0, 0.01), torch.where(bright, coc, 5.0)
    out = LensBlur(subapertures=3)(image, coc=radii)
    torch.testing.assert_close(out[..., 1034:], image[..., 1034:], rtol=1e-4, atol=0)


def segment(distance: Tensor) -> Tensor:
    """Share of the unit disc beyond a line at this distance from its centre."""
    t = distance.clamp(-1, 1)
    return (t.acos() - t * (1 - t * t).sqrt()) / math.pi


@pytest.mark.parametrize("side", [1, 2, 3])
@pytest.mark.parametrize("given_background", [True, False])
def test_a_blurred_foreground_is_see_through_at_its_rim(given_background: bool, side: int) -> None:
    """White before black: the coverage is the share of the disc that lies on the white side of the edge."""
    near = (torch.arange(56) < 28).expand(1, 1, 40, 56)
    image, coc = near.float(), torch.where(near, -8.0, 0.0)
    background = torch.zeros_like(image) if given_background else None
    out = LensBlur(subapertures=side)(image, coc=coc, background=background)
    want = segment((torch.arange(56) + 0.5 - 28) / 8)
    torch.testing.assert_close(out[0, 0, 20], want, rtol=0, atol=0.002)


def test_what_shines_through_is_what_the_caller_says() -> None:
    near = ((torch.arange(56) - 28).abs() < 3).expand(1, 1, 40, 56)
    image, coc = noise(1, 3, 40, 56), torch.where(near, -9.0, 0.0)
    hidden = torch.full_like(image, 3.0)
    with_it, without = (LensBlur()(torch.where(near, 0.0, image), coc=coc, background=b) for b in (hidden, None))
    assert (with_it[..., 20, 27:29] > 1.0).all()  # five columns of a disc of 18: most of the light comes from behind
    assert (without[..., 20, 27:29] < 1.0).all()


THIN = {"focal_length": 0.2, "f_number": 1.8, "focus_distance": 2.0, "sensor_width": 0.036}


def scene(height: int = 40, width: int = 56, dtype: torch.dtype = F32) -> tuple[Tensor, Tensor]:
    """A picture and its depth: slanted ground from 0.9 to 6 metres, something near, and the sky."""
    depth = torch.linspace(6, 0.9, height, dtype=dtype)[:, None].repeat(1, width)
    depth[: height // 4] = INF
    depth[height // 5 : -height // 5, width // 6 : width // 3] = 1.2
    return noise(1, 3, height, width, dtype=dtype), depth.view(1, 1, height, width)


@pytest.mark.parametrize("side", [1, 2])
def test_the_unit_of_length_does_not_matter(side: int) -> None:
    image, depth = scene()
    want = LensBlur(ThinLens(**THIN), subapertures=side)(image, depth)
    assert not torch.allclose(want, image, atol=0.1)
    for factor in (2.0, 0.25):  # powers of two: not even the rounding changes
        lens = ThinLens(**{k: v if k == "f_number" else factor * v for k, v in THIN.items()})
        assert torch.equal(LensBlur(lens, subapertures=side)(image, factor * depth), want)
    lens = ThinLens(**{k: v if k == "f_number" else 1000 * v for k, v in THIN.items()})
    torch.testing.assert_close(LensBlur(lens, subapertures=side)(image, 1000 * depth), want, rtol=0, atol=1e-4)


@pytest.mark.parametrize("unit", [1.0, 0.1])
def test_disparity_and_depth_describe_the_same_camera(unit: float) -> None:
    image, depth = scene(24, 32, F64)
    f, n, df, sensor = (torch.tensor(v, dtype=F64) for v in THIN.values())
    strength = f * f / (2 * n) / (1 - f / df) * 32 / sensor / unit
    thin = LensBlur(ThinLens(f, n, df, sensor))
    disparity = LensBlur(DisparityLens(strength, unit / df))
    torch.testing.assert_close(disparity(image, unit / depth), thin(image, depth), rtol=0, atol=1e-9)


def test_coc_may_be_given_for_depth() -> None:
    image, depth = scene()
    lens = ThinLens(**THIN)
    assert torch.equal(LensBlur()(image, coc=lens.coc(depth, 56)), LensBlur(lens)(image, depth))


@pytest.mark.parametrize("side", [1, 2])
@pytest.mark.parametrize("split", [True, False])
def test_gradients_to_image_depth_and_lens(side: int, split: bool) -> None:
    image = noise(1, 2, 6, 7, seed=3, dtype=F64).requires_grad_()
    lens = {"focus": torch.tensor(2.0, dtype=F64), "number": torch.tensor(2.0, dtype=F64)}
    # Depths for CoCs of 0.6 to 3 px of either sign: not within half a pixel of sharp, where radii have no effect.
    sign = torch.where(noise(1, 1, 6, 7, seed=4, dtype=F64) < 0.4, -1.0, 1.0) if split else 1.0
    coc = sign * (0.6 + 2.4 * noise(1, 1, 6, 7, seed=5, dtype=F64))
    depth = ThinLens(0.2, lens["number"], lens["focus"], 0.01).depth(coc, 7).requires_grad_()
    assert depth.isfinite().all()

    def paint(image: Tensor, depth: Tensor, focus: Tensor, number: Tensor) -> Tensor:
        blur = LensBlur(ThinLens(0.2, number, focus, 0.01), aperture="5-gon")
        return blur(image, depth, plan=plan)

    plan = LensBlur(aperture="5-gon", subapertures=side).plan(image, coc=coc)
    # The outer bins end a little beyond all pixels, where their weights bend.
    bins = ((-3.3, -0.9), (-2.1, 3.3)) if split else ((0.4, 3.3),)
    plan = dataclasses.replace(plan, bins=bins)
    inputs = (image, depth, *(v.requires_grad_() for v in lens.values()))
    assert torch.autograd.gradcheck(paint, inputs, fast_mode=True)


def test_gradients_to_layers_and_their_coverage() -> None:
    image = (0.2 + 0.6 * noise(1, 2, 4, 5, 6, seed=3, dtype=F64)).requires_grad_()
    coc = (torch.tensor([-2.6, 1.9], dtype=F64).view(1, 2, 1, 1, 1) + noise(1, 2, 1, 5, 6, dtype=F64)).requires_grad_()
    plan = dataclasses.replace(LensBlur(subapertures=2).plan(image, coc=coc), bins=((-2.7, -1.5), (1.8, 3.0)))
    assert torch.autograd.gradcheck(lambda i, c: LensBlur()(i, coc=c, plan=plan), (image, coc), fast_mode=True)


def test_gradients_in_single_are_those_in_double() -> None:
    image, _ = scene(12, 16, F64)
    depth = 0.9 + 5 * noise(1, 1, 12, 16, seed=2, dtype=F64)
    found = []
    for dtype in (F32, F64):
        inputs = [t.to(dtype).requires_grad_() for t in (image, depth, torch.tensor(2.0))]
        out = LensBlur(ThinLens(0.2, 1.8, inputs[2], 0.01), subapertures=2)(*inputs[:2])
        found.append(torch.autograd.grad((out * noise(*out.shape, seed=7, dtype=dtype)).sum(), inputs))
    for single, double in zip(*found, strict=True):
        torch.testing.assert_close(single.double(), double, rtol=1e-3, atol=1e-5 * float(double.abs().max()))


@pytest.mark.parametrize("distance", [1.7, 2.0])
def test_the_gradient_to_the_lens_is_that_of_the_whole_way(distance: float) -> None:
    """With a plan made anew for each distance: bins move with the sky and the nearest row, which lie at their ends."""
    image, depth = scene(24, 32)
    image, pattern = nn.functional.avg_pool2d(image, 3, 1, 1), noise(1, 3, 24, 32, seed=7)

    def loss(focus: Tensor) -> Tensor:
        blur = LensBlur(ThinLens(0.2, 1.8, focus, 0.01), subapertures=1)
        return (blur(image.to(focus), depth.to(focus)) * pattern.to(focus)).sum()

    focus, step = torch.tensor(distance, requires_grad=True), 1e-4
    (slope,) = torch.autograd.grad(loss(focus), focus)
    one, other = (loss(torch.tensor(distance + d, dtype=F64)) for d in (step, -step))
    # The gradient leaves out that the bins in between move too, which changes little.
    assert slope.item() == pytest.approx((one - other).item() / (2 * step), rel=0.05)


def test_gradients_reach_the_aperture_and_the_background() -> None:
    rotation = nn.Parameter(torch.tensor(0.2))
    image, background = noise(1, 3, 24, 32), noise(1, 3, 24, 32, seed=1).requires_grad_()
    behind = torch.full((1, 1, 24, 32), 4.0, requires_grad=True)
    coc = coc_map("blurred before sharp", 24, 32)
    blur = LensBlur(aperture=tb.Polygon(3, rotation))
    blur(image, coc=coc, background=(background, behind)).square().sum().backward()
    for parameter in (rotation, background, behind):
        assert parameter.grad is not None
        assert parameter.grad.isfinite().all()
        assert parameter.grad.abs().sum() > 1e-4


@pytest.mark.parametrize("far", [0.0, 1e-30, 1e6])
def test_gradients_stay_finite_before_black_and_before_glare(far: float) -> None:
    near = coc_map("blurred before sharp", 24, 32) < 0
    image = torch.where(near, 1.0, far).repeat(1, 3, 1, 1).requires_grad_()
    coc = torch.where(near, -8.0, 0.0).requires_grad_()
    LensBlur()(image, coc=coc).sum().backward()
    for tensor in (image, coc):
        assert tensor.grad is not None
        assert tensor.grad.isfinite().all()


def test_a_sharp_scene_still_gives_the_lens_its_gradient() -> None:
    focus = nn.Parameter(torch.tensor(2.0))
    image = noise(1, 3, 12, 16).requires_grad_()
    depth = torch.full((1, 1, 12, 16), 2.01)
    out = LensBlur(ThinLens(0.05, 8.0, focus, 0.036))(image, depth)
    torch.testing.assert_close(out, image, rtol=1e-5, atol=1e-6)
    out.sum().backward()
    assert focus.grad is not None
    assert focus.grad.isfinite()
    assert torch.allclose(image.grad, torch.ones_like(image), atol=1e-5)  # type: ignore[arg-type]


@pytest.mark.parametrize("start", [1.6, 2.5])
def test_a_focus_distance_is_found_from_a_blurred_picture(start: float) -> None:
    image = nn.functional.avg_pool2d(noise(1, 3, 24, 32, seed=8), 3, 1, 1)  # in white noise all blur looks alike
    depth = torch.tensor([1.3, 1.8, 2.4, 4.0]).repeat_interleave(8).expand(1, 1, 24, 32).clone()
    true = ThinLens(0.2, 1.8, 2.0, 0.036)
    with torch.no_grad():
        target = LensBlur(true)(image, depth)
    focus = nn.Parameter(torch.tensor(start))
    blur = LensBlur(ThinLens(0.2, 1.8, focus, 0.036))
    optimizer = torch.optim.Adam(blur.parameters(), lr=0.05)
    for _ in range(60):
        optimizer.zero_grad()
        (blur(image, depth) - target).square().mean().backward()
        optimizer.step()
    assert focus.item() == pytest.approx(2.0, rel=0.02)
    assert focus is blur.lens.focus_distance  # type: ignore[union-attr]
