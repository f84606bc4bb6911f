"""`ChromaticAccumulation`: closed forms of dots, what must not change, agreement with `LensBlur`, what is refused."""

import doctest
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

import torchbokeh as tb
import torchbokeh.renderers.chromatic
from torchbokeh.lens.dispersion import RGB, Dispersion
from torchbokeh.lens.field_map import Field, FieldMap
from torchbokeh.report.measure import errors
from torchbokeh.scenes import Backdrop, Camera, Scene, Sprite

H, W = 28, 36
SIDE = 65
SPECTRA = ["rgb", "continuous"]
STRONG: list[dict[str, Any]] = [
    {"axial": 1.5},
    {"axial": 0.0, "lateral": 0.05},
    {"axial": 1.5, "lateral": 0.05},
]
TECHNIQUES: list[dict[str, Any]] = [{}, {"level_of_detail": "auto"}, {"reuse": 1}, {"subsamples": 4}]


def draw(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def thin(dispersion: Dispersion | None, f_number: float = 1.0, focus: float = 2.0) -> tb.ThinLens:
    return tb.ThinLens(0.05, f_number, focus, 0.036, dispersion=dispersion)


def dot(x: int = SIDE // 2, y: int = SIDE // 2) -> Tensor:
    layer = torch.zeros(1, 1, 4, SIDE, SIDE)
    layer[..., y, x] = 1
    return layer


def place(channel: Tensor) -> tuple[float, float]:
    """Centroid (x, y) from the middle of the picture."""
    x = torch.arange(SIDE, dtype=torch.float64) - SIDE // 2
    light = channel.double() / channel.double().sum()
    return float((light.sum(0) * x).sum()), float((light.sum(1) * x).sum())


def radius(channel: Tensor) -> float:
    """Of a disc: its second moment is half the square of its radius; pixels add a twelfth each way, twice."""
    x, y = place(channel)
    grid = torch.arange(SIDE, dtype=torch.float64) - SIDE // 2
    square = (grid - x).square() + (grid[:, None] - y).square()
    moment = float((channel.double() / channel.double().sum() * square).sum())
    return math.sqrt(max(0.0, 2 * (moment - 1 / 3)))


def layers(seed: int = 0) -> tuple[Tensor, Tensor]:
    """A half of random colours before an opaque layer, and their depths."""
    out = torch.rand(1, 2, 4, H, W, generator=draw(seed))
    out[:, :, 3] = 1
    out[:, 0, :, :, : W // 2] = 0
    depth = torch.tensor([1.4, 4.0]).view(1, 2, 1, 1, 1).expand(1, 2, 1, H, W)
    return out, depth + 0.3 * torch.rand(1, 2, 1, H, W, generator=draw(seed + 1))


def dispersed(camera: Camera, dispersion: Dispersion | None) -> Camera:
    lens = camera.lens
    values = lens.focal_length, lens.f_number, lens.focus_distance, lens.sensor_width
    return replace(camera, lens=tb.ThinLens(*values, dispersion=dispersion))


def world(dispersion: Dispersion | None = None, colour: float | None = None) -> tuple[Scene, Camera]:
    """A near card, one in focus, and what is behind them; of one colour where that is given."""
    picture = torch.rand(3, 30, 30, generator=draw(3)) if colour is None else torch.full((3, 30, 30), colour)
    card = torch.cat([picture, torch.ones(1, 30, 30)])
    cards = Sprite(card, (-0.2, 0.0, 1.3), (0.3, 0.3)), Sprite(card, (0.3, 0.1, 2.0), (0.5, 0.4))
    camera = Camera(thin(dispersion), (H, W))
    return Scene(cards, Backdrop(picture, 6.0, 1.0)), camera


@pytest.mark.parametrize("settings", TECHNIQUES)
@pytest.mark.parametrize("spectrum", SPECTRA)
def test_without_dispersion_it_is_the_accumulation_buffer(spectrum: Any, settings: dict[str, Any]) -> None:
    source, depth = layers()
    motion = torch.full((1, 2, 2, H, W), 4.0)
    plain = tb.AccumulationBuffer(thin(None), views=24, **settings)
    chromatic = tb.ChromaticAccumulation(thin(None), views=24, **settings)
    assert torch.equal(chromatic(source, depth, motion=motion), plain(source, depth, motion=motion))
    disparity = tb.DisparityLens(4.0, 0.4)
    found = tb.ChromaticAccumulation(disparity, views=24, **settings)(source, depth.reciprocal())
    assert torch.equal(found, tb.AccumulationBuffer(disparity, views=24, **settings)(source, depth.reciprocal()))
    coc = tb.ChromaticAccumulation(views=24, **settings)(source, coc=depth)
    assert torch.equal(coc, tb.AccumulationBuffer(views=24, **settings)(source, coc=depth))
    scene, camera = world()
    found = tb.ChromaticAccumulation(views=24, **settings)(scene, camera)
    assert torch.equal(found, tb.AccumulationBuffer(views=24, **settings)(scene, camera))
    none = thin(Dispersion("SF10", 0.0, 0.0, spectrum=spectrum))
    found = tb.ChromaticAccumulation(none, views=24, **settings)(source, depth)
    want = plain(source, depth)
    assert float((found - want).abs().mean()) < 0.05  # other points of the lens


@pytest.mark.parametrize("settings", TECHNIQUES)
@pytest.mark.parametrize("spectrum", SPECTRA)
@pytest.mark.parametrize("strength", STRONG)
def test_white_stays_white(strength: dict[str, Any], spectrum: Any, settings: dict[str, Any]) -> None:
    dispersion = Dispersion("SF10", **strength, spectrum=spectrum)
    scene, camera = world(dispersion, colour=1.0)
    out = tb.ChromaticAccumulation(views=30, **settings)(scene, camera)
    assert out.shape == (1, 4, H, W)
    assert float((out - 1).abs().mean()) < 1e-4
    source, depth = layers()
    white = source[:, :, 3:].expand(-1, -1, 4, -1, -1)
    for motion in (None, 5 * torch.rand(1, 2, 2, H, W, generator=draw(4))):
        out = tb.ChromaticAccumulation(thin(dispersion), views=30, **settings)(white, depth, motion=motion)
        assert float((out - 1).abs().mean()) < 1e-4


@pytest.mark.parametrize("settings", TECHNIQUES)
def test_grey_in_focus_stays_grey_with_three_wavelengths(settings: dict[str, Any]) -> None:
    # The border of the picture is where the axial part fades: a map that is 1 leaves none of it.
    flat = Dispersion("SF10", 1.5, axial_map=FieldMap(ones))
    grey = torch.rand(1, 1, 1, H, W, generator=draw(1)).expand(1, 1, 4, H, W).clone()
    grey[:, :, 3] = 1
    depth = torch.full((1, 1, 1, H, W), 5.0)
    out = tb.ChromaticAccumulation(thin(flat), views=30, **settings)(grey, depth)[0]
    torch.testing.assert_close(out[1:3], out[:1].expand(2, H, W), atol=1e-6, rtol=0)
    scene, camera = world(flat)
    scene = Scene(tuple(replace(s, texture=greyed(s.texture)) for s in scene.sprites), scene.backdrop)
    assert scene.backdrop is not None
    scene = replace(scene, backdrop=replace(scene.backdrop, texture=greyed(scene.backdrop.texture)))
    out = tb.ChromaticAccumulation(views=30, **settings)(scene, camera)[0]
    torch.testing.assert_close(out[1:3], out[:1].expand(2, H, W), atol=1e-5, rtol=0)


def ones(t: Tensor, _: Tensor) -> Tensor:
    return torch.ones_like(t)


def greyed(texture: Tensor) -> Tensor:
    return torch.cat([texture[:1].expand(3, -1, -1), texture[3:]])


@pytest.mark.parametrize("depth", [1.0, 1.5, 2.0, 3.0, 20.0])
def test_every_channel_of_a_dot_has_the_radius_of_its_wavelength(depth: float) -> None:
    lens = thin(Dispersion("SF10", 1.5, axial_map=None), 0.35)
    out = tb.ChromaticAccumulation(lens, views=600)(dot(), torch.full((1, 1, 1, SIDE, SIDE), depth))[0]
    reference = lens.coc(torch.full((1, 1), depth), SIDE)
    want = [(reference + lens.coc_shift(w, SIDE)).abs().item() for w in RGB]
    found = [radius(channel) for channel in out[:3]]
    assert found == pytest.approx(want, abs=0.25)
    assert max(want) > 4
    if depth >= 2:
        assert found[0] < found[1] < found[2]
    # What all channels cover is their mean.
    torch.testing.assert_close(out[3], out[:3].mean(0), atol=1e-6, rtol=1e-4)


def test_the_order_of_the_colours_turns_round_at_the_focus_plane() -> None:
    lens = thin(Dispersion("BK7", 1.0, axial_map=None), 0.5)
    buffer = tb.ChromaticAccumulation(lens, views=600)
    near, far = (buffer(dot(), torch.full((1, 1, 1, SIDE, SIDE), depth))[0] for depth in (0.95, 6.0))
    red, green, blue = (radius(channel) for channel in near[:3])
    assert red > green > blue
    red, green, blue = (radius(channel) for channel in far[:3])
    assert red < green < blue


@pytest.mark.parametrize("depth", [2.0, 3.5])
@pytest.mark.parametrize("lateral_map", [None, FieldMap(), FieldMap("angular"), FieldMap("inversion", "square")])
def test_blue_lies_farther_out_than_red(lateral_map: FieldMap | None, depth: float) -> None:
    dispersion = Dispersion("BK7", 0.0, 0.3, lateral_map=lateral_map)
    x, y = 54, 18
    buffer = tb.ChromaticAccumulation(thin(dispersion, 1.4), views=300)
    out = buffer(dot(x, y), torch.full((1, 1, 1, SIDE, SIDE), depth))[0]
    red, blue = place(out[0]), place(out[2])
    field = Field.pixels((SIDE, SIDE), 0, torch.zeros(()))
    larger = float(dispersion.enlargement(RGB[2], field)[y, x])
    want = larger * (x - SIDE // 2), larger * (y - SIDE // 2)
    assert (blue[0] - red[0], blue[1] - red[1]) == pytest.approx(want, abs=0.25)
    assert math.hypot(*want) > 0.3
    assert red == pytest.approx((x - SIDE // 2, y - SIDE // 2), abs=0.05)


@pytest.mark.parametrize("strength", [{"axial": 1.0, "axial_map": None}, {"axial": 0.0, "lateral": 0.2}])
@pytest.mark.parametrize("depth", [1.2, 3.0])
def test_a_dot_in_a_scene(strength: dict[str, Any], depth: float) -> None:
    dispersion = Dispersion("SF10", **strength)
    camera = Camera(thin(dispersion, 0.5), (SIDE, SIDE))
    focal = camera.focal_px
    wide = 3 * depth / focal  # 3 px
    x, y = (14.0, -9.0) if "lateral" in strength else (0.0, 0.0)
    # On a black card: only what is seen has a depth.
    texture = torch.zeros(4, 45, 45)
    texture[3] = 1
    texture[:3, 21:24, 21:24] = 1
    spot = Sprite(texture, (x * depth / focal, y * depth / focal, depth), (15 * wide, 15 * wide))
    out = tb.ChromaticAccumulation(views=600)(Scene((spot,)), camera)[0]
    reference = camera.lens.coc(torch.full((1, 1), depth), SIDE)
    coc = [(reference + camera.lens.coc_shift(w, SIDE)).abs().item() for w in RGB]
    # The texture's spot is 3 x 3 px: a square's variance beside the disc's.
    want = [math.sqrt(r * r + 2 * 2 * (9 - 1) / 12) for r in coc]
    assert [radius(channel) for channel in out[:3]] == pytest.approx(want, abs=0.35)
    field = Field(torch.tensor(x), torch.tensor(y), (SIDE, SIDE))
    for k, wavelength in enumerate(RGB):
        larger = 1 + float(dispersion.enlargement(wavelength, field))
        assert place(out[k]) == pytest.approx((x * larger, y * larger), abs=0.25)


ON_RAMP: list[dict[str, Any]] = [
    {"axial": 1.5},
    {"axial": 0.0, "lateral": 0.15},
    {"axial": 1.5, "lateral": 0.15},
]


def ssim(out: Tensor, truth: Tensor) -> float:
    """Without the border."""
    return float(errors(out, truth, 16, flip=False)["ssim"] or 0.0)


def ramp(strength: dict[str, Any], spectrum: str) -> tuple[Scene, Camera]:
    scene, camera = tb.scenes.ramp(seed=0, size=(96, 96), blur=5.0)
    return scene, dispersed(camera, Dispersion("SF10", **strength, spectrum=spectrum))  # type: ignore[arg-type]


@pytest.mark.parametrize("strength", ON_RAMP)
def test_lens_blur_of_layers_is_near_it(strength: dict[str, Any]) -> None:
    scene, camera = ramp(strength, "rgb")
    truth = tb.ChromaticAccumulation(views=900)(scene, camera)[:, :3]
    seen = {name: t[None] for name, t in scene.render(camera).items()}
    out = tb.LensBlur(camera.lens)(seen["layers"], seen["layer_depth"])[:, :3]
    assert ssim(out, truth) > 0.985
    single = tb.LensBlur(camera.lens)(seen["image"], seen["depth"])
    assert ssim(single, truth) > 0.96
    plain = tb.LensBlur(dispersed(camera, None).lens)(seen["layers"], seen["layer_depth"])[:, :3]
    near, far = (float((t - truth)[..., 16:-16, 16:-16].abs().mean()) for t in (out, plain))
    assert far > 1.4 * near


@pytest.mark.parametrize("spectrum", SPECTRA)
def test_layers_of_a_scene_are_near_the_scene(spectrum: str) -> None:
    scene, camera = ramp(ON_RAMP[2], spectrum)
    seen = {name: t[None] for name, t in scene.render(camera).items()}
    truth = tb.ChromaticAccumulation(views=300)(scene, camera)
    out = tb.ChromaticAccumulation(camera.lens, views=300)(seen["layers"], seen["layer_depth"])
    assert ssim(out[:, :3], truth[:, :3]) > 0.98
    plain = tb.AccumulationBuffer(camera.lens, views=300)(seen["layers"], seen["layer_depth"])
    near, far = (float((t - truth)[..., 16:-16, 16:-16].abs().mean()) for t in (out, plain))
    assert far > 3 * near


@pytest.mark.slow
@pytest.mark.parametrize("strength", ON_RAMP)
def test_lens_blur_of_a_continuous_spectrum_is_near_it(strength: dict[str, Any]) -> None:
    scene, camera = ramp(strength, "continuous")
    truth = tb.ChromaticAccumulation(views=2000)(scene, camera)[:, :3]
    seen = {name: t[None] for name, t in scene.render(camera).items()}
    out = tb.LensBlur(camera.lens, "disc", 4, "balanced")(seen["layers"], seen["layer_depth"])[:, :3]
    assert ssim(out, truth) > 0.97


@pytest.mark.parametrize("spectrum", SPECTRA)
@pytest.mark.parametrize("settings", [{"level_of_detail": 0.1}, {"reuse": 1}, {"reuse": 2}, {"subsamples": 4}])
def test_cheaper_pictures_are_nearly_the_same(settings: dict[str, Any], spectrum: Any) -> None:
    # Nothing is near focus in any light, or no detail could be left out.
    dispersion = Dispersion("BK7", 0.1, 0.02, spectrum=spectrum)
    scene, camera = world(dispersion)
    scene = replace(scene, sprites=scene.sprites[:1])
    camera = replace(camera, lens=thin(dispersion, 0.3 if "reuse" in settings else 0.05))
    buffer, cheap = (tb.ChromaticAccumulation(views=90, **more) for more in ({}, settings))
    assert 1e-4 < float((buffer(scene, camera) - cheap(scene, camera)).abs().mean()) < 0.03
    source, depth = layers()
    buffer, cheap = (tb.ChromaticAccumulation(camera.lens, views=90, **more) for more in ({}, settings))
    difference = float((buffer(source, depth) - cheap(source, depth)).abs().mean())
    if spectrum == "continuous" and "reuse" in settings:  # every view has a wavelength of its own
        assert difference == 0
    else:
        assert 1e-4 < difference < 0.03


@pytest.mark.parametrize("spectrum", SPECTRA)
def test_subsamples_fill_the_gaps_between_few_views(spectrum: Any) -> None:
    lens = thin(Dispersion("BK7", 0.3, axial_map=None, spectrum=spectrum), 0.25)
    depth = torch.full((1, 1, 1, SIDE, SIDE), 8.0)
    opaque = torch.zeros(1, 1, 4, SIDE, SIDE)
    opaque[:, :, 3] = 1
    opaque[:, :, :3, SIDE // 2 - 1 : SIDE // 2 + 2, SIDE // 2 - 1 : SIDE // 2 + 2] = 1
    truth = tb.ChromaticAccumulation(lens, views=1500)(opaque, depth)
    few, filled = (tb.ChromaticAccumulation(lens, views=45, subsamples=s)(opaque, depth) for s in (0, 16))
    assert float((filled - truth).abs().mean()) < 0.9 * float((few - truth).abs().mean())


def hue_step(out: Tensor, reach: int) -> float:
    """The largest change of a channel's share in the light, from one radius to the next."""
    grid = torch.arange(SIDE) - SIDE // 2
    ring = (grid[:, None] ** 2 + grid**2).float().sqrt().round().long().clamp(max=SIDE // 2).flatten()
    count = torch.zeros(SIDE // 2 + 1).index_add_(0, ring, torch.ones(len(ring)))
    profile = torch.stack([torch.zeros_like(count).index_add_(0, ring, c.flatten()) / count for c in out[:3]])
    hue = profile / profile.sum(0).clamp_min(1e-9)
    return float(hue[:, :reach].diff(dim=1).abs().max())


@pytest.mark.parametrize("f_number", [0.3, 0.15])
def test_a_spectrum_leaves_no_steps_of_colour(f_number: float) -> None:
    depth = torch.full((1, 1, 1, SIDE, SIDE), 3.0)
    steps = []
    for spectrum in SPECTRA:
        lens = thin(Dispersion("SF10", 1.5, axial_map=None, spectrum=spectrum), f_number)  # type: ignore[arg-type]
        reach = int(lens.coc(torch.full((1, 1), 3.0), SIDE) + lens.coc_shift(RGB[2], SIDE))
        accumulated = tb.ChromaticAccumulation(lens, views=600)(dot(), depth)[0]
        splatted = tb.LensBlur(lens)(dot(), depth)[0]
        steps.append([hue_step(out, reach) for out in (accumulated, splatted)])
    three, all_of_them = steps
    assert min(three) > 0.55
    assert max(all_of_them) < 0.4
    assert all_of_them[0] < 0.5 * three[0]
    assert all_of_them[1] < 0.5 * three[1]


def peaked(wavelength: Tensor) -> Tensor:
    return (-((wavelength - 560) / 20).square()).exp() + 1e-3


def test_views_go_where_the_equaliser_has_its_peak(monkeypatch: pytest.MonkeyPatch) -> None:
    dispersion = Dispersion("SF10", 1.5, axial_map=None, spectrum="continuous", equaliser=peaked)
    lens = thin(dispersion, 0.3)
    depth = torch.full((1, 1, 1, SIDE, SIDE), 3.0)
    draws = []
    spread = torchbokeh.renderers.chromatic.spectral_samples
    uniform: Callable[..., Any] = lambda unit, weight: spread(unit, weight, importance=False)  # noqa: E731
    for sampler in (spread, uniform):
        monkeypatch.setattr(torchbokeh.renderers.chromatic, "spectral_samples", sampler)
        draws.append(torch.cat([tb.ChromaticAccumulation(lens, views=64, seed=s)(dot(), depth) for s in range(6)]))
    important, even = (t[:, :2].var(0).mean().item() for t in draws)
    assert important < 0.5 * even
    # Both are of the same light.
    middle = [t.mean(0)[:2] for t in draws]
    assert [radius(c) for c in middle[0]] == pytest.approx([radius(c) for c in middle[1]], abs=0.6)


def test_views_are_shared_out_over_the_wavelengths() -> None:
    source, depth = layers()
    lens = thin(Dispersion("BK7", 0.5))
    for views, same in ((1, 3), (2, 3), (14, 12)):
        found = tb.ChromaticAccumulation(lens, views=views)(source, depth)
        assert torch.equal(found, tb.ChromaticAccumulation(lens, views=same)(source, depth))
    rainbow = thin(Dispersion("BK7", 0.5, spectrum="continuous"))
    assert tb.ChromaticAccumulation(rainbow, views=1)(source, depth).isfinite().all()
    one, other = (tb.ChromaticAccumulation(rainbow, views=32, seed=s)(source, depth) for s in (1, 2))
    assert not torch.equal(one, other)
    assert torch.equal(one, tb.ChromaticAccumulation(rainbow, views=32, seed=1)(source, depth))


def test_a_batch_is_one_by_one() -> None:
    pairs = [layers(seed) for seed in (0, 5)]
    source, depth = (torch.cat(t) for t in zip(*pairs, strict=True))
    lens = thin(Dispersion("SF10", 1.0, 0.05))
    for settings in TECHNIQUES:
        buffer = tb.ChromaticAccumulation(lens, views=24, **settings)
        together = buffer(source, depth)
        for k, pair in enumerate(pairs):
            torch.testing.assert_close(together[k : k + 1], buffer(*pair), atol=1e-6, rtol=0)


def test_gradients_reach_layers_depth_and_strengths() -> None:
    source, depth = (t.double() for t in layers())
    axial, lateral = (torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in (0.8, 0.0313))
    source, depth = source.requires_grad_(), depth.requires_grad_()
    aim = torch.rand(4, H, W, generator=draw(9), dtype=torch.float64)

    def loss(axial: Tensor, lateral: Tensor) -> Tensor:
        lens = thin(Dispersion("SF10", axial, lateral), 0.3).double()
        return (aim * tb.ChromaticAccumulation(lens, views=12)(source, depth)).sum()

    leaves = (source, depth, axial, lateral)
    grads = torch.autograd.grad(loss(axial, lateral), leaves)
    assert all(g.isfinite().all() and float(g.abs().max()) > 0 for g in grads)
    with torch.no_grad():
        ends = [loss(axial, lateral + s).item() for s in (1e-7, -1e-7)]
    assert (ends[0] - ends[1]) / 2e-7 == pytest.approx(grads[3].item(), rel=1e-2)


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: tb.ChromaticAccumulation(views=0), ValueError, "views: expected at least 1, got 0"),
        (lambda: tb.ChromaticAccumulation("BK7"), TypeError, "lens: expected a Lens, got str"),  # type: ignore[arg-type]
        (
            lambda: tb.ChromaticAccumulation(thin(Dispersion()), views=3)(*world()),
            ValueError,
            "lens: expected None for a scene, got ThinLens",
        ),
        (
            lambda: tb.ChromaticAccumulation(thin(Dispersion("BK7", torch.tensor([0.5, 1.0]))), views=3)(*layers()),
            ValueError,
            r"lens: expected scalar parameters with dispersion, got axial of shape \(2,\)",
        ),
        (
            lambda: tb.ChromaticAccumulation(
                tb.ThinLens(0.05, torch.tensor([1.0]), 2.0, 0.036, dispersion=Dispersion()), views=3
            )(*layers()),
            ValueError,
            r"lens: expected scalar parameters with dispersion, got f_number of shape \(1,\)",
        ),
        (
            lambda: tb.ChromaticAccumulation(views=3)(*world(Dispersion("BK7", lateral=torch.tensor([0.1, 0.2])))),
            ValueError,
            r"lens: expected scalar parameters with dispersion, got lateral of shape \(2,\)",
        ),
    ],
)
def test_what_does_not_fit_is_refused(make: Any, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=f"^{message}$"):
        make()


@pytest.mark.parametrize("spectrum", SPECTRA)
@pytest.mark.parametrize("views", [1, 2, 3, 5])
def test_white_is_white_and_opaque_with_any_number_of_views(spectrum: Any, views: int) -> None:
    lens = thin(Dispersion("BK7", 0.3, lateral=0.01, spectrum=spectrum))
    white = torch.ones(1, 1, 4, H, W)
    out = tb.ChromaticAccumulation(lens, views=views)(white, torch.full((1, 1, 1, H, W), 2.0))
    torch.testing.assert_close(out, torch.ones_like(out))


def test_a_channel_that_the_equaliser_leaves_dark_stays_dark_with_one_view() -> None:
    dispersion = Dispersion("BK7", spectrum="continuous", equaliser=lambda nm: ((nm > 400) & (nm < 420)).to(nm))
    out = tb.ChromaticAccumulation(thin(dispersion), views=1)(
        torch.ones(1, 1, 4, H, W), torch.full((1, 1, 1, H, W), 2.0)
    )
    assert out[:, 1].abs().max() == 0
    torch.testing.assert_close(out[:, 2], torch.ones(1, H, W))


def test_docstring_examples() -> None:
    result = doctest.testmod(torchbokeh.renderers.chromatic)
    assert result.attempted > 1
    assert result.failed == 0
