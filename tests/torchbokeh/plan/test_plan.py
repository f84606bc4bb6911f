import dataclasses
from typing import Any

import pytest
import torch
from torch import Tensor

import torchbokeh as tb
from torchbokeh import KernelSplatting, LensBlur, Plan
from torchbokeh.plan.bins import FOREGROUND, SPACING
from torchbokeh.plan.quality import QUALITIES


def picture(channels: int = 3, height: int = 24, width: int = 32) -> Tensor:
    return torch.rand(1, channels, height, width, generator=torch.Generator().manual_seed(1))


def halves(left: float, right: float, height: int = 24, width: int = 32) -> Tensor:
    coc = torch.full((1, 1, height, width), float(right))
    coc[..., : width // 2] = left
    return coc


def rgba(*alphas: Tensor | float) -> Tensor:
    """Premultiplied layers with these coverages."""
    layers = []
    for k, alpha in enumerate(alphas):
        colour = torch.rand(1, 3, 24, 32, generator=torch.Generator().manual_seed(k))
        cover = torch.as_tensor(alpha).expand(1, 1, 24, 32)
        layers.append(torch.cat([colour * cover, cover], 1))
    return torch.stack(layers, 1)


def radii(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float32).view(1, -1, 1, 1, 1).expand(1, len(values), 1, 24, 32).clone()


left_half = (halves(1.0, 0.0) > 0).float()


def test_a_plan_is_frozen_and_can_be_compared() -> None:
    blur = LensBlur()
    plan = blur.plan(picture(), coc=halves(-5, 5))
    with pytest.raises(dataclasses.FrozenInstanceError):
        plan.subapertures = 1  # type: ignore[misc]
    assert plan == blur.plan(picture(), coc=halves(-5, 5))
    assert plan != blur.plan(picture(), coc=halves(-6, 5))
    assert len({plan, blur.plan(picture(), coc=halves(-5, 5))}) == 1


def test_what_a_plan_says_of_a_scene() -> None:
    plan = LensBlur(aperture="6-gon", max_coc=9.0).plan(picture(), coc=halves(-12, 8))
    assert plan.size == (24, 32)
    assert plan.coc_range == (-9.0, 8.0)
    assert plan.clamped == 0.5
    assert not plan.sharp
    assert plan.layers == ()
    assert plan.hidden == "filled"
    front, rest = plan.bins
    assert front == (-9.0, -9.0 + SPACING, -9.0 + 2 * SPACING)
    assert rest == (FOREGROUND[0], FOREGROUND[0] + SPACING, FOREGROUND[0] + 2 * SPACING)
    assert plan.fading == ()
    assert plan.aperture == "Polygon(blades=6, rotation=0, curvature=0)"


@pytest.mark.parametrize(
    ("left", "right", "hidden", "surfaces"),
    [
        (-8, 8, "filled", 2),
        (-8, -1.9, "filled", 2),  # some of it is less than fully foreground
        (-8, -2.5, "nothing", 1),  # nothing but foreground hides nothing of the rest
        (-0.9, 8, "nothing", 1),
        (0, 8, "nothing", 1),
        (-2.2, -1.4, "nothing", 1),  # depth hardly differs
    ],
)
def test_a_foreground_is_split_off_where_there_is_one(left: float, right: float, hidden: str, surfaces: int) -> None:
    plan = LensBlur().plan(picture(), coc=halves(left, right))
    assert (plan.hidden, len(plan.bins)) == (hidden, surfaces)


def test_a_background_is_used_only_where_something_hides_it() -> None:
    background = picture()
    assert LensBlur().plan(picture(), coc=halves(-5, 5), background=background).hidden == "given"
    assert LensBlur().plan(picture(), coc=halves(1, 5), background=background).hidden == "nothing"


@pytest.mark.parametrize("coc", [0.0, 0.3, -0.5])
def test_a_scene_in_focus_passes_through(coc: float) -> None:
    blur, image = LensBlur(), picture()
    plan = blur.plan(image, coc=halves(coc, 0))
    assert plan.sharp
    out = blur(image, coc=halves(coc, 0))
    assert torch.equal(out, image)
    assert out.data_ptr() != image.data_ptr()
    out += 1
    assert torch.equal(image, picture())


def test_half_a_pixel_is_the_limit_of_sharpness() -> None:
    assert not LensBlur().plan(picture(), coc=halves(0.51, 0)).sharp
    assert LensBlur(max_coc=0.5).plan(picture(), coc=halves(12, 0)).sharp


def test_layers_are_planned_one_by_one() -> None:
    plan = LensBlur().plan(rgba(left_half, 1.0), coc=radii(-13.0, 4.0))
    assert plan.hidden == "layers"
    assert plan.layers == (0, 1)
    assert plan.bins == ((-13.0,), (4.0,))
    assert plan.coc_range == (-13.0, 4.0)


def test_only_the_coc_of_what_a_layer_holds_counts() -> None:
    coc = radii(-13.0, 4.0)
    coc[:, 0][left_half == 0] = 500.0
    plan = LensBlur(max_coc=10.0).plan(rgba(left_half, 1.0), coc=coc)
    assert plan.coc_range == (-10.0, 4.0)
    assert plan.clamped == pytest.approx(1 / 3)  # of the pixels that hold something
    assert plan.bins == ((-10.0,), (4.0,))


def test_empty_layers_are_left_out() -> None:
    blur = LensBlur()
    image, coc = rgba(0.0, left_half, 0.0, 1.0), radii(-3.0, -9.0, 77.0, 5.0)
    plan = blur.plan(image, coc=coc)
    assert plan.layers == (1, 3)
    assert plan.coc_range == (-9.0, 5.0)
    assert torch.equal(blur(image, coc=coc), blur(image[:, [1, 3]], coc=coc[:, [1, 3]]))


def test_a_layer_that_one_item_of_a_batch_holds_is_kept() -> None:
    image = torch.cat([rgba(0.0, 1.0), rgba(left_half, 0.0)])
    assert LensBlur().plan(image, coc=radii(-3.0, 5.0).expand(2, -1, -1, -1, -1)).layers == (0, 1)


def test_nothing_in_any_layer_gives_nothing() -> None:
    blur = LensBlur()
    image, coc = rgba(0.0, 0.0), radii(-3.0, 5.0)
    plan = blur.plan(image, coc=coc)
    assert plan.layers == ()
    assert torch.equal(blur(image, coc=coc), torch.zeros(1, 4, 24, 32))
    assert "0 layers of the input" in str(plan)


def test_an_opaque_layer_is_a_plain_picture_without_a_foreground() -> None:
    image, coc = rgba(1.0), torch.empty(1, 1, 1, 24, 32).uniform_(0, 9, generator=torch.Generator().manual_seed(0))
    blur = LensBlur(subapertures=2)
    assert blur.plan(image, coc=coc).bins == blur.plan(image[:, 0, :3], coc=coc[:, 0]).bins
    got, want = blur(image, coc=coc), blur(image[:, 0, :3], coc=coc[:, 0])
    assert torch.allclose(got[:, :3], want, atol=1e-5)
    assert torch.allclose(got[:, 3:], torch.ones(1, 1, 24, 32), atol=1e-5)


@pytest.mark.parametrize(
    ("left", "right", "background", "side"),
    [
        (-8, 8, False, 2),
        (-8, 8, True, 3),
        (0, 8, False, 2),
        (7.5, 8, False, 1),  # one bin: nothing hides anything
        (-2.5, 2.5, False, 1),  # too little blur to show it
    ],
)
def test_how_finely_the_lens_is_cut(left: float, right: float, background: bool, side: int) -> None:
    behind = picture() if background else None
    assert LensBlur().plan(picture(), coc=halves(left, right), background=behind).subapertures == side
    for asked in (1, 2, 4):
        plan = LensBlur(subapertures=asked).plan(picture(), coc=halves(left, right), background=behind)
        assert plan.subapertures == asked


def test_how_finely_the_lens_is_cut_for_layers() -> None:
    def side(*values: float) -> int:
        return LensBlur().plan(rgba(*[1.0] * len(values)), coc=radii(*values)).subapertures

    assert side(-8, 8) == 3
    assert side(-2, 2) == 1
    assert side(8) == 1


def uniform_motion(length: float) -> Tensor:
    return torch.tensor([length, 0.0]).view(1, 2, 1, 1).expand(1, 2, 24, 32)


@pytest.mark.parametrize(
    ("left", "right", "length", "without"),
    [
        (-2.25, -0.75, 0.0, {("nothing", 1, False): 0.5}),  # a foreground, from an extent of 1 px on
        (1.0, 2.25, 0.0, {}),  # nothing that hides anything, and no blur to cut the lens for
        (-2.5, 3.25, 0.0, {("filled", 1, False): 0.75}),  # sub-apertures, from a radius of 3 px on
        (2.25, 3.75, 0.0, {("nothing", 1, False): 0.625}),  # likewise, where bins begin to hide one another
        (-8.0, 8.0, 0.625, {("filled", 2, False): 0.75}),  # motion, from half a pixel on
        (-8.0, -1.75, 0.0, {("nothing", 2, False): 0.75}),  # the rest, where nearly all is foreground
        (  # all of these at once
            -3.5,
            -1.5,
            0.75,
            {
                ("nothing", 1, False): 0.125,
                ("nothing", 2, False): 0.125,
                ("filled", 1, False): 0.125,
                ("filled", 2, False): 0.125,
                ("nothing", 1, True): 0.25,
            },
        ),
    ],
)
def test_parts_of_a_plan_come_gradually(left: float, right: float, length: float, without: dict[Any, float]) -> None:
    blur, image, coc, motion = LensBlur(), picture(), halves(left, right), uniform_motion(length)
    plan = blur.plan(image, coc=coc, motion=motion)
    found = {(p.hidden, p.subapertures, p.moves): share for p, share in plan.fading}
    assert found == pytest.approx(without)
    want = (1 - sum(share for _, share in plan.fading)) * blur(image, coc=coc, motion=motion, plan=alone(plan))
    for other, share in plan.fading:
        want = want + share * blur(image, coc=coc, motion=motion, plan=other)
    assert torch.allclose(blur(image, coc=coc, motion=motion), want, atol=1e-6)
    assert ("hardly needed" in str(plan)) == bool(without)


def alone(plan: Plan) -> Plan:
    return dataclasses.replace(plan, fading=())


def test_a_lens_that_is_cut_by_request_is_cut_at_once() -> None:
    assert LensBlur(subapertures=3).plan(picture(), coc=halves(-2.5, 3.25)).fading == ()
    assert LensBlur(quality="fast").plan(picture(), coc=halves(-2.5, 3.25)).fading == ()


@pytest.mark.parametrize(("layers", "most"), [("auto", QUALITIES[0].bins), (1, 1), (3, 3), (20, 20)])
def test_the_number_of_bins_is_limited(layers: Any, most: int) -> None:
    blur = LensBlur(layers=layers)
    assert [len(b) for b in blur.plan(picture(), coc=halves(-500, 500)).bins] == [most, most]
    assert [len(b) for b in blur.plan(rgba(1.0), coc=halves(-500, 500)[:, None]).bins] == [most]


@pytest.mark.parametrize(
    ("blur", "coc", "given", "facts"),
    [
        (LensBlur(), halves(0.2, 0), False, ["32 x 24 image", "CoC +0.0 to +0.2 px", "passes through unchanged"]),
        (LensBlur(), halves(5, 5), False, ["One surface in 1 bin:", "no foreground", "Disc(), whole"]),
        (LensBlur(), halves(0, 9), False, ["One surface in 3 bins:", "Disc(), cut into 2 x 2 sub-apertures"]),
        (
            LensBlur(aperture="5-gon", max_coc=6),
            halves(-8, 5),
            False,
            [
                "-6.0 to +5.0 px",
                "2 and 3 bins",
                "filled from its surroundings",
                "pass background=",
                "50 % of the pixels",
            ],
        ),
        (LensBlur(), halves(-8, 5), True, ["what it hides comes from background=", "3 x 3 sub-apertures"]),
    ],
)
def test_a_plan_can_be_read(blur: LensBlur, coc: Tensor, given: bool, facts: list[str]) -> None:
    text = str(blur.plan(picture(), coc=coc, background=picture() if given else None))
    for fact in facts:
        assert fact in text
    assert ("max_coc" in text) == (blur.max_coc is not None)


def test_a_plan_of_layers_can_be_read() -> None:
    text = str(LensBlur().plan(rgba(left_half, 0.0, 1.0), coc=radii(-9.0, 0.0, 5.0)))
    assert "2 layers of the input are blurred (1 and 1 bins)" in text
    assert "cut into 3 x 3" in text


@pytest.mark.parametrize(
    ("image", "coc", "background"),
    [
        (picture(), halves(-7, 6), None),
        (picture(), halves(-7, 6), picture() + 1),
        (picture(), halves(0, 6), None),
        (picture(), halves(0.1, 0), None),
        (rgba(left_half, 1.0), radii(-6, 6), None),
    ],
)
def test_a_plan_used_again_gives_the_same_picture(image: Tensor, coc: Tensor, background: Tensor | None) -> None:
    blur = LensBlur()
    plan = blur.plan(image, coc=coc, background=background)
    want = blur(image, coc=coc, background=background)
    assert torch.equal(blur(image, coc=coc, background=background, plan=plan), want)


def test_what_a_plan_says_is_what_is_done() -> None:
    blur, image = LensBlur(), picture()
    coc = 14 * torch.rand(1, 1, 24, 32, generator=torch.Generator().manual_seed(0)) - 7
    plan = blur.plan(image, coc=coc)
    want = blur(image, coc=coc, plan=plan)
    for change in ({"subapertures": 1}, {"bins": (plan.bins[0], plan.bins[1][:1])}, {"sharp": True}):
        out = blur(image, coc=coc, plan=dataclasses.replace(plan, **change))
        assert not torch.allclose(out, want, atol=1e-3)
    coarse = LensBlur(subapertures=1)
    assert torch.equal(coarse(image, coc=coc), blur(image, coc=coc, plan=coarse.plan(image, coc=coc)))


@pytest.mark.parametrize(
    ("image", "coc", "background", "message"),
    [
        (picture(3, 24, 33), torch.full((1, 1, 24, 33), -7.0), None, r"size \(24, 33\), got one for \(24, 32\)"),
        (rgba(1.0), radii(-7), None, r"one for 1 layers, got one for 0"),
        (picture(), halves(-7, 6), picture(), r"background it was made with \(filled\), got another"),
    ],
)
def test_a_plan_for_something_else_is_refused(image: Tensor, coc: Tensor, background: Any, message: str) -> None:
    plan = LensBlur().plan(picture(), coc=halves(-7, 6))
    with pytest.raises(ValueError, match=f"plan: expected .*{message}"):
        LensBlur()(image, coc=coc, background=background, plan=plan)


def test_a_plan_for_layers_or_a_background_is_refused_without_them() -> None:
    blur = LensBlur()
    layered = blur.plan(rgba(left_half, 1.0), coc=radii(-6, 6))
    with pytest.raises(ValueError, match=r"plan: expected one for [0-9] layers, got one for [0-9]"):
        blur(picture(), coc=halves(-7, 6), plan=layered)
    with pytest.raises(ValueError, match=r"plan: expected one for [0-9] layers, got one for [0-9]"):
        blur(rgba(left_half), coc=radii(-6), plan=layered)
    given = blur.plan(picture(), coc=halves(-7, 6), background=picture())
    with pytest.raises(ValueError, match=r"plan: expected the background it was made with \(given\), got another"):
        blur(picture(), coc=halves(-7, 6), plan=given)


def test_a_plan_for_fewer_layers_is_refused() -> None:
    two, three = (rgba(1.0).repeat(1, n, 1, 1, 1) for n in (2, 3))
    plan = LensBlur().plan(two, coc=radii(-7).repeat(1, 2, 1, 1, 1))
    with pytest.raises(ValueError, match="plan: expected one for 3 layers, got one for 2"):
        LensBlur()(three, coc=radii(-7).repeat(1, 3, 1, 1, 1), plan=plan)


def test_only_a_plan_is_a_plan() -> None:
    with pytest.raises(TypeError, match="plan: expected a Plan, got dict"):
        LensBlur()(picture(), coc=halves(-7, 6), plan={"sharp": True})


def test_there_is_nothing_to_plan_in_an_empty_picture() -> None:
    with pytest.raises(ValueError, match=r"image: expected at least one pixel to plan for, got shape \(0, 3, 4, 5\)"):
        LensBlur().plan(torch.zeros(0, 3, 4, 5), coc=torch.zeros(0, 1, 4, 5))


def test_a_plan_needs_no_gradient() -> None:
    focus = torch.nn.Parameter(torch.tensor(2.0))
    lens = tb.ThinLens(0.2, 1.8, focus, 0.036)
    depth = halves(1.0, 5.0)
    assert LensBlur(lens).plan(picture().requires_grad_(), depth) == LensBlur(lens).plan(picture(), depth)
    assert isinstance(LensBlur(lens).plan(picture(), depth), Plan)


@pytest.mark.parametrize("radius", [9.0, -12.5])
def test_one_radius_for_all_takes_a_single_convolution(radius: float) -> None:
    image, coc = picture(), torch.full_like(halves(0, 0), radius)
    blur = LensBlur(aperture="5-gon")
    plan = blur.plan(image, coc=coc)
    assert plan.uniform == radius
    assert str(plan).endswith("a single convolution.")
    want = KernelSplatting("5-gon", quality="exact")(image, coc)
    torch.testing.assert_close(blur(image, coc=coc), want)
    by_splats = blur(image, coc=coc.clone().requires_grad_(), plan=plan)
    torch.testing.assert_close(by_splats, want, rtol=1e-5, atol=1e-6)
    assert blur.plan(image, coc=halves(radius, radius + 0.1)).uniform is None
    assert LensBlur(quality="fast").plan(image, coc=coc).uniform is None  # merging is faster yet
