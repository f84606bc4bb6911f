"""`LensBlur` of lenses with dispersion: closed forms of dots, what must not change, gradients, and what is refused."""

import dataclasses
import math
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

import torchbokeh as tb
from torchbokeh.lens import Lens
from torchbokeh.lens.dispersion import RGB, SEEN, Dispersion
from torchbokeh.lens.field_map import Field, FieldMap

H, W = 36, 48
SIDE = 97
STRONG: list[dict[str, Any]] = [
    {"axial": 1.5},
    {"axial": 0.0, "lateral": 0.05},
    {"axial": 1.5, "lateral": 0.05},
]


def draw(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def camera(dispersion: Dispersion | None, f_number: float = 1.0, focus: float = 2.0) -> tb.ThinLens:
    return tb.ThinLens(0.05, f_number, focus, 0.036, dispersion=dispersion)


def picture(seed: int = 0, batch: int = 1) -> Tensor:
    return torch.rand(batch, 3, H, W, generator=draw(seed))


def uneven(seed: int = 1, batch: int = 1) -> Tensor:
    """Depth from 1 to 5 m."""
    return 1 + 4 * torch.rand(batch, 1, H, W, generator=draw(seed))


def dot(x: int = SIDE // 2, y: int = SIDE // 2) -> Tensor:
    image = torch.zeros(1, 3, SIDE, SIDE)
    image[..., y, x] = 1
    return image


def as_layer(image: Tensor) -> Tensor:
    return torch.cat([image, torch.ones_like(image[:, :1])], 1)[:, None]


def place(channel: Tensor) -> tuple[float, float]:
    """Centroid (x, y) from the middle of the picture."""
    x, y = (torch.arange(SIDE, dtype=torch.float64) - SIDE // 2 for _ in range(2))
    light = channel.double() / channel.double().sum()
    return float((light.sum(0) * x).sum()), float((light.sum(1) * y).sum())


def radius(channel: Tensor) -> float:
    """Of a disc: its second moment is half the square of its radius; pixels add a twelfth each way, twice."""
    x, y = place(channel)
    grid = torch.arange(SIDE, dtype=torch.float64) - SIDE // 2
    square = (grid - x).square() + (grid[:, None] - y).square()
    moment = float((channel.double() / channel.double().sum() * square).sum())
    return math.sqrt(max(0.0, 2 * (moment - 1 / 3)))


@pytest.mark.parametrize("spectrum", ["rgb", "continuous"])
@pytest.mark.parametrize("strength", STRONG)
def test_white_stays_white(strength: dict[str, Any], spectrum: Any) -> None:
    lens = camera(Dispersion("SF10", **strength, spectrum=spectrum))
    white, depth = torch.ones(1, 3, H, W), uneven()
    ends = torch.cat([depth, 1.4 * depth], 1)
    motion = 8 * (torch.rand(1, 2, H, W, generator=draw(2)) - 0.5)
    for quality in ("exact", "balanced"):
        blur = tb.LensBlur(lens, quality=quality)
        assert len(blur.plan(white, depth).colours) >= 3
        assert float((blur(white, depth) - 1).abs().mean()) < 1e-4
    for more in ({"motion": motion}, {"shutter_depth": ends}, {"background": (white, depth + 3)}):
        assert float((tb.LensBlur(lens)(white, depth, **more) - 1).abs().mean()) < 1e-4
    cut = tb.LensBlur(lens, margin=5, max_coc=4.0)(white, depth)
    assert cut.shape == (1, 3, H - 10, W - 10)
    assert float((cut - 1).abs().mean()) < 1e-4
    layers = as_layer(white).repeat(1, 2, 1, 1, 1)
    layers[:, 0, :, :, : W // 2] = 0
    out = tb.LensBlur(lens)(layers, torch.stack([depth, depth + 1], 1))
    assert out.shape == (1, 4, H, W)
    assert float((out - 1).abs().mean()) < 1e-4


@pytest.mark.parametrize("quality", ["exact", "balanced"])
def test_what_is_grey_stays_grey_where_nothing_changes(quality: str) -> None:
    grey = torch.full((1, 3, H, W), 0.2)
    grey[..., W // 2 :] = 0.8
    lens = camera(Dispersion("SF10", 1.0, 0.02), 0.7)
    out = tb.LensBlur(lens, quality=quality)(grey, torch.full((1, 1, H, W), 2.0))
    hue = out.amax(1) - out.amin(1)
    assert float(hue[..., :8].max()) < 1e-4
    assert float(hue[..., -8:].max()) < 1e-4
    assert float(hue[..., W // 2 - 3 : W // 2 + 3].max()) > 0.05


@pytest.mark.parametrize("way", ["plain", "layers", "tilted"])
@pytest.mark.parametrize("depth", [1.0, 1.3, 2.0, 3.0, 20.0])
def test_every_channel_of_a_dot_has_the_radius_of_its_wavelength(depth: float, way: str) -> None:
    lens = camera(Dispersion("SF10", 1.5, axial_map=None), 0.35)
    image, depths = dot(), torch.full((1, 1, SIDE, SIDE), depth)
    if way == "tilted":  # not one convolution, but splats
        depths = (depths.reciprocal() + 1e-4 * torch.rand(depths.shape, generator=draw(3))).reciprocal()
    if way == "layers":
        layer = torch.cat([image, image[:, :1]], 1)[:, None]
        out = tb.LensBlur(lens)(layer, depths[:, None])[0]
    else:
        out = tb.LensBlur(lens)(image, depths)[0]
    reference = lens.coc(torch.full((1, 1), depth), SIDE)
    want = [(reference + lens.coc_shift(w, SIDE)).abs().item() for w in RGB]
    found = [radius(channel) for channel in out[:3]]
    assert found == pytest.approx(want, abs=0.25)
    # Far before the focus plane red is the widest, behind it blue: blue is focused nearer.
    assert (found[0] > found[2]) == (depth == 1.0 and want[0] > want[2])
    if depth >= 2:
        assert found[0] < found[1] < found[2]


def test_the_order_of_the_colours_turns_round_at_the_focus_plane() -> None:
    lens = camera(Dispersion("BK7", 1.0, axial_map=None), 0.5)
    near, far = (tb.LensBlur(lens)(dot(), torch.full((1, 1, SIDE, SIDE), depth))[0] for depth in (0.95, 6.0))
    red, green, blue = (radius(channel) for channel in near)
    assert red > green + 1
    assert green > blue + 0.3
    red, green, blue = (radius(channel) for channel in far)
    assert red < green - 1
    assert green < blue - 0.3


@pytest.mark.parametrize("axial_map", [FieldMap(), FieldMap("square"), FieldMap("inversion")])
def test_the_axial_part_is_that_of_the_place(axial_map: FieldMap) -> None:
    lens = camera(Dispersion("SF10", 1.5, axial_map=axial_map), 0.35)
    depth = torch.full((1, 1, 1, SIDE, SIDE), 3.0)
    x, y = 68, 30
    layer = torch.cat([dot(x, y), dot(x, y)[:, :1]], 1)[:, None]
    out = tb.LensBlur(lens)(layer, depth)[0]
    field = Field.pixels((SIDE, SIDE), 0, torch.zeros(()))
    coc = lens.coc(torch.full((1, 1), 3.0), SIDE)
    want = [(coc + lens.coc_shift(w, SIDE, field))[y, x].abs().item() for w in RGB]
    assert [radius(channel) for channel in out[:3]] == pytest.approx(want, abs=0.25)
    assert want[2] > want[0] + 2


@pytest.mark.parametrize("way", ["plain", "layers"])
@pytest.mark.parametrize("depth", [2.0, 3.5])
@pytest.mark.parametrize("lateral_map", [None, FieldMap(), FieldMap("angular"), FieldMap("inversion", "square")])
def test_blue_lies_farther_out_than_red(lateral_map: FieldMap | None, depth: float, way: str) -> None:
    dispersion = Dispersion("BK7", 0.0, 0.2, lateral_map=lateral_map)
    lens = camera(dispersion, 1.4)
    x, y = 80, 26
    image, depths = dot(x, y), torch.full((1, 1, SIDE, SIDE), depth)
    if way == "layers":
        out = tb.LensBlur(lens)(torch.cat([image, image[:, :1]], 1)[:, None], depths[:, None])[0]
    else:
        out = tb.LensBlur(lens)(image, depths)[0]
    red, blue = place(out[0]), place(out[2])
    field = Field.pixels((SIDE, SIDE), 0, torch.zeros(()))
    larger = float(dispersion.enlargement(RGB[2], field)[y, x])
    want = larger * (x - SIDE // 2), larger * (y - SIDE // 2)
    assert (blue[0] - red[0], blue[1] - red[1]) == pytest.approx(want, abs=0.25)
    assert math.hypot(*want) > 0.3
    assert red == pytest.approx((x - SIDE // 2, y - SIDE // 2), abs=0.05)


class Doubling(Lens):
    def coc(self, depth: Tensor, width: int, *, field: Field | None = None) -> Tensor:
        return 2 * depth

    def depth(self, coc: Tensor, width: int) -> Tensor:
        return coc / 2


@pytest.mark.parametrize("quality", ["exact", "balanced"])
def test_without_dispersion_nothing_changes(quality: str) -> None:
    image, depth = picture(), uneven()
    depth[..., : W // 2] += 3
    plain, none = (camera(d) for d in (None, Dispersion("SF10", axial=0.0, lateral=0.0)))
    blurs = [tb.LensBlur(lens, quality=quality) for lens in (plain, none)]
    plans = [blur.plan(image, depth) for blur in blurs]
    assert plans[0] == plans[1]
    assert plans[1].colours == ()
    assert plans[1].spread == 0
    assert torch.equal(*(blur(image, depth) for blur in blurs))
    layers = as_layer(image)
    assert torch.equal(*(blur(layers, depth[:, None]) for blur in blurs))
    motion = torch.full((1, 2, H, W), 3.0)
    assert torch.equal(*(blur(image, depth, motion=motion) for blur in blurs))
    for lens in (tb.DisparityLens(4.0, 0.0), tb.DisparityLens(1.0, 0.5), Doubling()):
        blur = tb.LensBlur(lens, quality=quality)
        assert blur.plan(image, depth / 2).colours == ()
        assert torch.equal(blur(image, depth / 2), tb.LensBlur(quality=quality)(image, coc=lens.coc(depth / 2, W)))


def test_grey_channels_of_any_number_need_no_dispersion() -> None:
    image = torch.rand(1, 5, H, W, generator=draw())
    assert tb.LensBlur(camera(None))(image, uneven()).shape == (1, 5, H, W)


@pytest.mark.parametrize("spectrum", ["rgb", "continuous"])
def test_a_plan_made_earlier_is_the_plan(spectrum: Any) -> None:
    blur = tb.LensBlur(camera(Dispersion("SF10", 1.0, 0.03, spectrum=spectrum)))
    image, depth = picture(), uneven()
    plan = blur.plan(image, depth)
    assert torch.equal(blur(image, depth, plan=plan), blur(image, depth))
    layers, depths = as_layer(image), depth[:, None]
    assert torch.equal(blur(layers, depths, plan=blur.plan(layers, depths)), blur(layers, depths))
    coc = blur.lens.coc(depth, W)  # type: ignore[union-attr]
    assert torch.equal(blur(image, coc=coc), blur(image, depth))


@pytest.mark.parametrize("spectrum", ["rgb", "continuous"])
def test_colours_come_gradually(spectrum: Any) -> None:
    image, depth = picture(), uneven()

    def blur(axial: float) -> tb.LensBlur:
        return tb.LensBlur(camera(Dispersion("SF10", axial, spectrum=spectrum), 0.5))

    strength = 0.075 / blur(1.0).plan(image, depth).spread
    plan = blur(strength).plan(image, depth)
    ((plain, share),) = plan.fading
    assert plain == blur(0.0).plan(image, depth)
    assert share == pytest.approx(2 - plan.spread / SEEN)
    assert 0.4 < share < 0.7
    coloured = blur(strength)(image, depth, plan=dataclasses.replace(plan, fading=()))
    want = torch.lerp(coloured, blur(0.0)(image, depth), share)
    assert torch.allclose(blur(strength)(image, depth), want, atol=1e-6)
    assert blur(2 * strength).plan(image, depth).fading == ()


def test_the_plan_says_how_colours_spread() -> None:
    image, depth = picture(), uneven()
    lens = camera(Dispersion("SF10", 1.0, axial_map=None), 0.5)
    plan = tb.LensBlur(lens).plan(image, depth)
    spread = float(lens.coc_shift(RGB[2], W) - lens.coc_shift(RGB[0], W))
    assert plan.spread == pytest.approx(spread, rel=1e-5)
    assert f"Dispersion spreads colours by up to {spread:.1f} px: red, green and blue are blurred one by one." in str(
        plan
    )
    assert [colour.light.wavelength for colour in plan.colours] == list(RGB)
    assert not any(colour.enlarged for colour in plan.colours)
    for colour in plan.colours:
        moved = float(lens.coc_shift(colour.light.wavelength, W))
        want = tuple(c + moved for c in plan.coc_range)
        assert colour.plan.coc_range == pytest.approx(want, abs=1e-4)
    wide = camera(Dispersion("SF10", 1.0, 0.02, spectrum="continuous"), 0.5)
    plan = tb.LensBlur(wide).plan(image, depth)
    assert len(plan.colours) == math.ceil(plan.spread)
    assert f"{len(plan.colours)} bands of the spectrum are blurred one by one." in str(plan)
    assert all(colour.enlarged for colour in plan.colours)
    assert "Dispersion" not in str(tb.LensBlur(camera(None)).plan(image, depth))
    cut = tb.LensBlur(lens, max_coc=3.0).plan(image, depth)
    assert all(-3 <= end <= 3 for colour in cut.colours for end in colour.plan.coc_range)


def test_what_is_in_focus_at_the_reference_is_blurred_in_other_light() -> None:
    lens = camera(Dispersion("SF10", 1.5, axial_map=None), 0.7)
    blur, image = tb.LensBlur(lens), picture()
    depth = torch.full((1, 1, H, W), 2.0)
    plan = blur.plan(image, depth)
    assert plan.sharp
    assert "passes through" not in str(plan)
    out = blur(image, depth)
    assert torch.equal(out[:, 0], image[:, 0])
    assert float((out[:, 1:] - image[:, 1:]).abs().mean()) > 0.1


@pytest.mark.parametrize("strength", STRONG)
def test_one_opaque_layer_is_a_plain_picture(strength: dict[str, Any]) -> None:
    image = picture()
    x = torch.linspace(0, 1, W).expand(1, 1, H, W)
    blur = tb.LensBlur(camera(Dispersion("SF10", **strength), 0.7), layers=2, subapertures=1)
    out = blur(as_layer(image), (2.5 + x)[:, None])
    torch.testing.assert_close(out[:, :3], blur(image, 2.5 + x), atol=2e-5, rtol=1e-4)
    torch.testing.assert_close(out[:, 3:], torch.ones(1, 1, H, W), atol=1e-4, rtol=0)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
@pytest.mark.parametrize("strength", STRONG)
def test_half_precision_is_worked_on_in_single(strength: dict[str, Any], dtype: torch.dtype) -> None:
    blur = tb.LensBlur(camera(Dispersion("BK7", **strength)))
    image, motion = picture().to(dtype), torch.full((1, 2, H, W), 3.0, dtype=dtype)
    coc = (uneven() - 3).to(dtype)
    for moves in ({}, {"motion": motion}):
        out = blur(image, coc=coc, **moves)
        want = blur(image.float(), coc=coc.float(), **{k: t.float() for k, t in moves.items()})
        assert out.dtype == dtype
        torch.testing.assert_close(out, want.to(dtype), atol=2e-6, rtol=torch.finfo(dtype).eps)


def test_a_batch_is_one_by_one() -> None:
    image, depth = picture(0, 2), uneven(1, 2)
    strengths = [(0.5, 0.0), (1.0, 0.05)]
    axial, lateral = torch.tensor(strengths).unbind(1)
    together = tb.LensBlur(camera(Dispersion("SF10", axial, lateral)))(image, depth)
    for k, (one, other) in enumerate(strengths):
        alone = tb.LensBlur(camera(Dispersion("SF10", one, other)))(image[k : k + 1], depth[k : k + 1])
        swapped = tb.LensBlur(camera(Dispersion("SF10", *strengths[1 - k])))(image[k : k + 1], depth[k : k + 1])
        error = float((together[k : k + 1] - alone).abs().mean())  # bins of the whole batch differ a little
        assert error < 2e-3
        assert float((together[k : k + 1] - swapped).abs().mean()) > 10 * error


def test_motion_and_dispersion_go_together() -> None:
    lens = camera(Dispersion("SF10", 1.5, 0.2, axial_map=None), 0.35)
    x, y = 68, 30
    depth, motion = torch.full((1, 1, SIDE, SIDE), 3.0), torch.tensor([18.0, 0.0]).view(1, 2, 1, 1)
    motion = motion.expand(1, 2, SIDE, SIDE)
    blur = tb.LensBlur(lens)
    still, moved = blur(dot(x, y), depth)[0], blur(dot(x, y), depth, motion=motion)[0]
    for before, after in zip(still, moved, strict=True):
        assert place(after) == pytest.approx(place(before), abs=0.25)
        assert radius(after) == pytest.approx(math.sqrt(radius(before) ** 2 + 2 * 18**2 / 12), abs=0.25)
    ways = [motion / 2] * 2
    pieces = blur(dot(x, y), depth, motion=ways)[0]
    assert float((pieces - moved).abs().sum()) < 0.15 * float(moved.sum())


def test_a_margin_leaves_the_middle_of_the_picture_where_it_is() -> None:
    inner = picture()
    outer = F.pad(inner, (9, 9, 9, 9), mode="replicate")
    lens = camera(Dispersion("SF10", 1.0, 0.03), 1.0)
    plain = tb.LensBlur(lens)(inner, torch.full((1, 1, H, W), 3.0))
    wide = tb.LensBlur(lens, margin=9)(outer, torch.full((1, 1, H + 18, W + 18), 3.0))
    inside = (..., slice(9, -9), slice(9, -9))
    torch.testing.assert_close(wide[inside], plain[inside], atol=2e-3, rtol=0)


def test_the_largest_radius_holds_for_every_light() -> None:
    lens = camera(Dispersion("SF10", 1.5, axial_map=None), 0.35)
    out = tb.LensBlur(lens, max_coc=6.0)(dot(), torch.full((1, 1, SIDE, SIDE), 20.0))[0]
    assert [radius(channel) for channel in out] == pytest.approx([4.44, 6.0, 6.0], abs=0.25)


def test_a_background_is_seen_in_its_own_light() -> None:
    image, behind = torch.full((1, 3, H, W), 0.5), torch.zeros(1, 3, H, W)
    depth = torch.full((1, 1, H, W), 3.0)
    depth[..., : W // 2] = 1.0
    lens = camera(Dispersion("BK7", 0.6, axial_map=None), 0.2)
    blur = tb.LensBlur(lens)
    out = blur(image, depth, background=(behind, torch.full((1, 1, H, W), 3.0)))
    assert blur.plan(image, depth, background=behind).hidden == "given"
    # The dark background shows through the rim of the foreground, in each colour as far in as that is blurred.
    dark = ((0.5 - out[0, :, H // 2, : W // 2]) > 0.01).sum(-1)
    reach = [float((lens.coc(torch.ones(1, 1), W) + lens.coc_shift(w, W)).abs()) for w in RGB]
    assert reach[0] > reach[1] + 1 > reach[2] + 1
    assert dark.tolist() == pytest.approx(reach, abs=1.0)
    assert dark[0] > dark[2]
    # Nothing behind is darker where it is of the picture's own brightness.
    same = blur(image, depth, background=(image, torch.full((1, 1, H, W), 3.0)))
    torch.testing.assert_close(same, image, atol=1e-4, rtol=0)


def test_other_apertures_are_turned_by_the_sign_of_each_radius() -> None:
    lens = camera(Dispersion("SF10", 1.5, axial_map=None), 0.35)
    depth = torch.full((1, 1, SIDE, SIDE), 1.3)
    signed = [float(lens.coc(torch.full((1, 1), 1.3), SIDE) + lens.coc_shift(w, SIDE)) for w in RGB]
    assert signed[0] < -2
    assert signed[2] > 2
    out = tb.LensBlur(lens, "3-gon")(dot(), depth)[0]
    for channel, coc in zip(out, signed, strict=True):
        want = tb.LensBlur(aperture="3-gon")(dot()[:, :1], coc=torch.full((1, 1, SIDE, SIDE), coc))[0, 0]
        assert float((channel - want).abs().sum()) < 0.01
    third = [float((c * (torch.arange(SIDE) - SIDE // 2)[:, None] ** 3).sum() / c.sum()) for c in out]
    assert third[0] * third[2] < 0


@pytest.mark.parametrize("channels", [1, 2, 4])
def test_a_picture_of_other_than_three_channels_is_refused(channels: int) -> None:
    blur = tb.LensBlur(camera(Dispersion()))
    message = f"^image: expected 3 channels for a lens with dispersion, got {channels}$"
    for call in (blur, blur.plan):
        with pytest.raises(ValueError, match=message):
            call(torch.ones(1, channels, H, W), torch.full((1, 1, H, W), 3.0))


def smooth(seed: int = 0, size: tuple[int, int] = (24, 32)) -> Tensor:
    coarse = torch.rand(1, 3, size[0] // 3, size[1] // 3, generator=draw(seed), dtype=torch.float64)
    return F.interpolate(coarse, size, mode="bicubic", align_corners=True)


@pytest.mark.parametrize("spectrum", ["rgb", "continuous"])
@pytest.mark.parametrize("way", ["plain", "foreground", "layers"])
def test_slopes_of_both_strengths(way: str, spectrum: Any) -> None:
    image = smooth()
    depth = torch.linspace(2.4, 3.2, 32, dtype=torch.float64).expand(1, 1, 24, 32).clone()
    if way == "foreground":
        depth[..., 8:16, 6:20] = 1.2
    if way == "layers":
        image, depth = as_layer(image), depth[:, None]
    aim = torch.rand(image.shape[-3], 24, 32, generator=draw(5), dtype=torch.float64)

    def blur(axial: Tensor, lateral: Tensor) -> tb.LensBlur:
        f_number = 0.3 if spectrum == "rgb" else 0.8
        return tb.LensBlur(camera(Dispersion("SF10", axial, lateral, spectrum=spectrum), f_number).double(), layers=2)

    values = torch.tensor([0.9, 0.0213], dtype=torch.float64)
    axial, lateral = (v.clone().requires_grad_() for v in values)
    plan = blur(axial, lateral).plan(image, depth)

    def loss(axial: Tensor, lateral: Tensor) -> Tensor:
        return (aim * blur(axial, lateral)(image, depth, plan=plan)).sum()

    grads = torch.autograd.grad(loss(axial, lateral), (axial, lateral))
    for k, grad in enumerate(grads):
        step = torch.zeros_like(values)
        step[k] = 1e-6
        ends = [loss(*(values + sign * step)).item() for sign in (1, -1)]
        assert (ends[0] - ends[1]) / 2e-6 == pytest.approx(grad.item(), rel=1e-3)
        assert abs(grad.item()) > 1e-2


def test_gradients_reach_the_picture_and_the_depth() -> None:
    image, depth = picture().requires_grad_(), uneven().requires_grad_()
    lens = camera(Dispersion("SF10", 1.0, 0.02))
    tb.LensBlur(lens)(image, depth).square().sum().backward()
    for leaf in (image, depth):
        assert leaf.grad is not None
        assert leaf.grad.isfinite().all()
        assert float(leaf.grad.abs().max()) > 1e-4


@pytest.mark.parametrize(("name", "start", "truth", "rate"), [("axial", 0.3, 0.8, 0.05), ("lateral", 0.0, 0.02, 0.002)])
def test_a_strength_can_be_recovered_from_a_blurred_picture(name: str, start: float, truth: float, rate: float) -> None:
    image = smooth(2).float()
    depth = torch.linspace(2.5, 3.5, 32).expand(1, 1, 24, 32)
    rest = {"lateral": 0.0} if name == "axial" else {"axial": 0.0}
    wanted = tb.LensBlur(camera(Dispersion("SF10", **{name: truth}, **rest), 0.3), layers=2)(image, depth)  # type: ignore[arg-type]
    value = nn.Parameter(torch.tensor(start))
    dispersion = Dispersion("SF10", **{name: value}, **rest)  # type: ignore[arg-type]
    blur = tb.LensBlur(camera(dispersion, 0.3), layers=2)
    optimiser = torch.optim.Adam(blur.parameters(), lr=rate, betas=(0.7, 0.9))
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, 40)
    for _ in range(40):
        optimiser.zero_grad()
        (blur(image, depth) - wanted).square().mean().backward()
        optimiser.step()
        schedule.step()
    assert getattr(dispersion, name) is value
    assert abs(value.item() - truth) < 0.1 * abs(start - truth)
