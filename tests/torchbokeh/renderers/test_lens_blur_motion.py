"""`LensBlur` with motion: limits, symmetries, the truth of a small scene, gradients, and what is refused."""

import dataclasses
import math
from itertools import pairwise

import pytest
import torch
from torch import Tensor

import torchbokeh as tb
from torchbokeh import LensBlur
from torchbokeh.ops.capsules import splat_capsules
from torchbokeh.report.measure import errors

H, W = 40, 56


def draw(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def picture(seed: int = 0, batch: int = 1) -> Tensor:
    return torch.rand(batch, 3, H, W, generator=draw(seed))


def constant(*values: float, batch: int = 1) -> Tensor:
    return torch.tensor(values, dtype=torch.float32).view(1, -1, 1, 1).expand(batch, -1, H, W).contiguous()


def halves(left: float, right: float) -> Tensor:
    coc = torch.full((1, 1, H, W), float(right))
    coc[..., : W // 2] = left
    return coc


@pytest.mark.parametrize("quality", ["exact", "balanced"])
@pytest.mark.parametrize("coc", [halves(0, 0), halves(4, 4), halves(-7, 5)])
def test_what_stands_still_needs_no_motion(quality: str, coc: Tensor) -> None:
    blur = LensBlur(quality=quality, subapertures=1)
    still = blur(picture(), coc=coc)
    assert torch.equal(blur(picture(), coc=coc, motion=constant(0.3, -0.2)), still)
    assert not blur.plan(picture(), coc=coc, motion=constant(0.3, 0.0)).moves


def test_little_motion_changes_little() -> None:
    blur, image, coc = LensBlur(subapertures=1, layers=1), picture(), halves(3, 3)
    still = blur(image, coc=coc)
    uneven = 1e-4 * torch.rand(1, 2, H, W, generator=draw(1))
    step = [
        (blur(image, coc=coc, motion=constant(x, 0.0) + uneven) - still).abs().mean().item()
        for x in (0.51, 0.7, 1.0, 1.3)
    ]
    assert all(a < b for a, b in pairwise(step))
    assert step[0] < 1e-4
    assert step[-1] < 5e-3


@pytest.mark.parametrize("quality", ["exact", "balanced"])
@pytest.mark.parametrize("coc", [halves(0, 0), halves(9, 3), halves(-7, 5)])
def test_constant_in_constant_out(quality: str, coc: Tensor) -> None:
    motion = 25 * (torch.rand(1, 2, H, W, generator=draw(3)) - 0.5)
    out = LensBlur(quality=quality)(torch.full((1, 3, H, W), 0.6), coc=coc, motion=motion)
    torch.testing.assert_close(out, torch.full_like(out, 0.6), atol=1e-4, rtol=0)


def test_an_edge_moves_along_the_motion_only() -> None:
    image = torch.zeros(1, 3, H, W)
    image[..., W // 2 :] = 1.0
    blur = LensBlur()
    across = blur(image, coc=halves(0, 0), motion=constant(16.0, 0.0))[0, 0, H // 2]
    along = blur(image, coc=halves(0, 0), motion=constant(0.0, 16.0))[0, 0, H // 2]
    torch.testing.assert_close(along, image[0, 0, 0], atol=0.02, rtol=0)
    ramp = (torch.arange(W) - W / 2 + 8.5).div(16).clamp(0, 1)
    torch.testing.assert_close(across, ramp, atol=0.05, rtol=0)


def test_the_shutter_may_open_with_the_picture() -> None:
    image, coc = picture(), halves(2, 2)
    motion = constant(12.0, -8.0)
    centred, started = (LensBlur(shutter=s)(image, coc=coc, motion=motion) for s in ("centre", "start"))
    inside = (..., slice(16, -16), slice(18, -18))  # beyond the reach of what is unknown outside
    moved = centred.roll((-4, 6), (2, 3))  # half of the motion
    torch.testing.assert_close(started[inside], moved[inside], atol=2e-3, rtol=0)
    back = LensBlur()(image, coc=coc, motion=-motion)
    torch.testing.assert_close(back, centred, atol=1e-5, rtol=0)
    behind = LensBlur(shutter="start")(image, coc=coc, motion=-motion)
    assert float((behind - started).abs().max()) > 0.05


@pytest.mark.parametrize("shutter", ["centre", "start"])
@pytest.mark.parametrize("count", [2, 3])
def test_a_way_in_pieces_is_the_way(shutter: str, count: int) -> None:
    image, coc = picture(), halves(3, 5)
    motion = constant(15.0, -6.0) + 0.1 * torch.rand(1, 2, H, W, generator=draw(8))
    blur = LensBlur(layers=1, shutter=shutter)
    whole, pieces = (blur(image, coc=coc, motion=m) for m in (motion, [motion / count] * count))
    assert float((whole - pieces).abs().mean()) < 0.012
    assert float((whole.mean() - pieces.mean()).abs()) < 1e-3


@pytest.mark.parametrize("shutter", ["centre", "start"])
def test_light_goes_round_a_corner(shutter: str) -> None:
    dot = torch.zeros(1, 1, H, W)
    dot[..., H // 2, W // 2] = 1.0
    coc = halves(0.2, 0.2) + 1e-3 * torch.rand(1, 1, H, W, generator=draw(1))
    blur = LensBlur(layers=1, shutter=shutter)
    out = blur(dot, coc=coc, motion=(constant(10.0, 0.0), constant(0.0, 6.0)))[0, 0]
    # From the left to the corner, and down from there: at the corner the exposure is half over.
    x0, y0 = (W // 2, H // 2) if shutter == "start" else (W // 2 - 10, H // 2)
    assert out[y0, x0 + 2 : x0 + 9].min() > 0.3 * out.max()
    assert out[y0 + 2 : y0 + 5, x0 + 10].min() > 0.3 * out.max()
    assert float(out[y0 + 4, x0 + 3]) < 0.02 * float(out.max())
    x, y = (out.sum(0) @ torch.arange(W).float()), (out.sum(1) @ torch.arange(H).float())
    mean = (x0 + (5 + 10) / 2, y0 + (0 + 3) / 2)
    assert (x.item() / out.sum().item(), y.item() / out.sum().item()) == pytest.approx(mean, abs=0.3)


def test_one_opaque_layer_is_a_plain_picture() -> None:
    image, coc, motion = picture(), halves(2, 6), constant(9.0, 5.0)
    layer = torch.cat([image, torch.ones(1, 1, H, W)], 1)[:, None]
    blur = LensBlur(layers=2)
    out = blur(layer, coc=coc[:, None], motion=motion[:, None])
    torch.testing.assert_close(out[:, :3], blur(image, coc=coc, motion=motion), atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(out[:, 3:], torch.ones(1, 1, H, W), atol=1e-4, rtol=0)


def test_a_batch_is_one_by_one() -> None:
    image, motion = picture(1, 3), 20 * (torch.rand(3, 2, H, W, generator=draw(2)) - 0.5)
    coc = torch.cat([halves(-5, 4), halves(3, 3), halves(0, 8)])
    blur = LensBlur()
    plan = blur.plan(image, coc=coc, motion=motion)
    together = blur(image, coc=coc, motion=motion, plan=plan)
    for n in range(3):
        one = blur(image[n : n + 1], coc=coc[n : n + 1], motion=motion[n : n + 1], plan=plan)
        torch.testing.assert_close(together[n : n + 1], one, atol=5e-4, rtol=0)  # pads differ, and so does what leaks


def test_gradients_reach_picture_radius_and_motion() -> None:
    image, coc = picture().double(), halves(-4, 5).double()
    motion = 14 * (torch.rand(1, 2, H, W, generator=draw(4), dtype=torch.float64) - 0.5)
    aim = torch.rand(1, 3, H, W, generator=draw(5), dtype=torch.float64)
    blur = LensBlur(layers=1)
    plan = blur.plan(image, coc=coc, motion=motion)
    maps = [t.clone().requires_grad_() for t in (image, coc, motion)]

    def loss(image: Tensor, coc: Tensor, motion: Tensor) -> Tensor:
        return (aim * blur(image, coc=coc, motion=motion, plan=plan)).sum()

    grads = torch.autograd.grad(loss(*maps), maps)
    for grad in grads:
        assert grad.isfinite().all()
        assert float(grad.abs().max()) > 1e-3
    step = torch.rand(1, 3, H, W, generator=draw(6), dtype=torch.float64)
    ends = [loss(image + e * step, coc, motion).item() for e in (1e-4, -1e-4)]
    assert (ends[0] - ends[1]) / 2e-4 == pytest.approx((grads[0] * step).sum().item(), rel=1e-6)


def test_motion_can_be_recovered_from_a_blurred_picture() -> None:
    image, coc = picture(), halves(1, 1)
    blur = LensBlur(layers=1)
    wanted = blur(image, coc=coc, motion=constant(9.0, 0.0))
    length = torch.tensor(5.0, requires_grad=True)
    optimiser = torch.optim.Adam([length], lr=0.4)
    losses = []
    for _ in range(25):
        motion = torch.stack([length.expand(1, H, W), torch.zeros(1, H, W)], 1)
        loss = (blur(image, coc=coc, motion=motion) - wanted).square().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    assert losses[-1] < 0.1 * losses[0]
    assert length.item() == pytest.approx(9.0, abs=1.2)


@pytest.mark.slow
@pytest.mark.parametrize(("recipe", "image_ssim", "layers_ssim"), [("whirl", 0.95, 0.97), ("gears", 0.93, 0.96)])
def test_it_is_near_the_truth(recipe: str, image_ssim: float, layers_ssim: float) -> None:
    scene, camera = getattr(tb.scenes, recipe)(seed=0, size=(128, 128), blur=6.0)
    seen = {name: t[None] for name, t in scene.render(camera).items()}
    truth = tb.AccumulationBuffer(views=512)(scene, camera)[:, :3]
    blur = LensBlur(camera.lens)
    single = blur(seen["image"], seen["depth"], motion=seen["motion"])
    layered = blur(seen["layers"], seen["layer_depth"], motion=seen["layer_motion"])[:, :3]
    still = blur(seen["layers"], seen["layer_depth"])[:, :3]
    ssim = [errors(out, truth, 20, flip=False)["ssim"] for out in (single, layered, still)]
    assert ssim[0] > image_ssim
    assert ssim[1] > layers_ssim
    assert ssim[2] < ssim[1] - 0.03


@pytest.mark.parametrize("shutter", ["centre", "start"])
@pytest.mark.parametrize("radius", [0.0, -6.0])
def test_a_pan_at_one_depth_is_a_single_convolution(shutter: str, radius: float) -> None:
    blur, image, coc, motion = LensBlur(shutter=shutter), picture(), halves(radius, radius), constant(11.0, 7.0)
    plan = blur.plan(image, coc=coc, motion=motion)
    assert plan.uniform == radius
    assert "moved by (11.0, 7.0) px): a single convolution." in str(plan)
    out = blur(image, coc=coc, motion=motion)
    splatted = blur(image, coc=coc, motion=motion.clone().requires_grad_()).detach()
    assert float((out - splatted).abs().mean()) < 0.02
    dot = torch.zeros(1, 1, H, W)
    dot[..., H // 2, W // 2] = 1
    place = (blur(dot, coc=coc, motion=motion)[0, 0] * torch.arange(W)).sum() - W // 2
    assert place.item() == pytest.approx(5.5 if shutter == "start" else 0.0, abs=0.1)
    assert (
        blur.plan(image, coc=coc, motion=motion + (coc.new_zeros(1, 2, H, W).index_fill(3, torch.tensor(0), 1))).uniform
        is None
    )
    assert blur.plan(image, coc=halves(radius, radius + 1), motion=motion).uniform is None


def test_the_plan_says_that_things_move() -> None:
    blur = LensBlur()
    plan = blur.plan(picture(), coc=halves(-6, 5), motion=constant(3.0, 4.0))
    assert plan.motion == pytest.approx(5)
    assert plan.moves
    assert plan.subapertures == 1
    assert "Motion up to 5.0 px" in str(plan)
    sharp = blur.plan(picture(), coc=halves(0, 0), motion=constant(3.0, 4.0))
    assert not sharp.sharp
    layers = torch.cat([picture(), torch.ones(1, 1, H, W)], 1)[:, None]
    assert blur.plan(layers, coc=halves(1, 1)[:, None], motion=constant(3.0, 4.0)[:, None]).moves


def test_what_is_refused() -> None:
    image, coc = picture(), halves(1, 1)
    with pytest.raises(ValueError, match="shutter: expected one of 'centre', 'start', got 'end'"):
        LensBlur(shutter="end")
    with pytest.raises(ValueError, match=r"motion: expected shape \(1, 2, 40, 56\), got \(1, 1, 40, 56\)"):
        LensBlur()(image, coc=coc, motion=coc)
    endless = constant(1.0, 1.0)
    endless[0, 0, 3, 4] = math.inf
    with pytest.raises(ValueError, match="motion: expected finite values, got 1 that are not"):
        LensBlur()(image, coc=coc, motion=endless)
    with pytest.raises(ValueError, match="motion: expected None with an aperture that is not a disc"):
        LensBlur(aperture="6-gon")(image, coc=coc, motion=constant(1.0, 1.0))
    with pytest.raises(ValueError, match="motion: expected at least one displacement, got an empty sequence"):
        LensBlur()(image, coc=coc, motion=[])
    with pytest.raises(TypeError, match="motion: expected a tensor, a sequence of tensors or None, got float"):
        LensBlur()(image, coc=coc, motion=3.0)  # type: ignore[arg-type]
    plan = LensBlur().plan(image, coc=coc, motion=constant(4.0, 0.0))
    with pytest.raises(ValueError, match="plan: expected the motion it was made with, got none"):
        LensBlur()(image, coc=coc, plan=plan)
    still = dataclasses.replace(plan, motion=0.0)
    assert torch.equal(LensBlur()(image, coc=coc, motion=constant(9.0, 0.0), plan=still), LensBlur()(image, coc=coc))


def ends(start: float, stop: float) -> Tensor:
    return constant(start, stop)


@pytest.mark.parametrize(
    ("start", "stop", "motion", "bound"),
    [
        (2.0, 10.0, (20.0, 0.0), 0.16),
        (2.0, 10.0, (12.0, 9.0), 0.16),
        (-4.0, 5.0, (8.0, -6.0), 0.25),
        (4.0, 10.0, (0.0, 0.0), 0.12),
    ],
)
def test_a_dot_that_comes_nearer_is_all_its_discs(
    start: float, stop: float, motion: tuple[float, float], bound: float
) -> None:
    image = torch.zeros(1, 3, H, W)
    image[..., H // 2, W // 2] = 1.0
    blur, moments = LensBlur(layers=1, subapertures=1), (torch.arange(64) + 0.5) / 64
    way = constant(*motion)
    coc = halves((start + stop) / 2, (start + stop) / 2)
    got = blur(image, coc=coc, motion=way, shutter_depth=ends(start, stop))
    values, pixel = image.double(), torch.tensor([H // 2 * W + W // 2])
    want = sum(
        splat_capsules(
            values,
            pixel,
            torch.tensor([abs(start + (stop - start) * t)]),
            torch.zeros(1, 2, dtype=torch.float64),
            (t - 0.5) * torch.tensor([motion], dtype=torch.float64),
        )
        for t in moments.double().tolist()
    )
    assert float((got - want / 64).abs().sum() / 3) < bound
    plain = blur(image, coc=coc, motion=way)
    assert float((plain - want / 64).abs().sum() / 3) > 2 * bound
    # Back and forth is the same with a centred shutter.
    back = blur(image, coc=coc, motion=-way, shutter_depth=ends(stop, start))
    torch.testing.assert_close(back, got, atol=1e-5, rtol=0)


@pytest.mark.parametrize("quality", ["exact", "balanced"])
def test_nothing_changes_where_depth_does_not(quality: str) -> None:
    blur, way = LensBlur(quality=quality), constant(6.0, 2.0)
    given = {"coc": halves(9, 3), "motion": way}
    both = torch.cat([halves(9, 3), halves(9.2, 3)], 1)
    assert torch.equal(blur(picture(), **given, shutter_depth=both), blur(picture(), **given))
    flat = torch.full((1, 3, H, W), 0.6)
    for motion in (way, [way, -way], None):
        out = blur(flat, coc=halves(9, 3), motion=motion, shutter_depth=torch.cat([halves(14, -2), halves(4, 6)], 1))
        torch.testing.assert_close(out, flat, atol=2e-5, rtol=0)


def test_depth_at_the_ends_goes_through_the_lens() -> None:
    lens = tb.ThinLens(0.05, 0.5, 2.0, 0.036)
    depth = constant(2.2)
    both = constant(2.4, 2.0)
    got = LensBlur(lens)(picture(), depth, shutter_depth=both)
    want = LensBlur()(picture(), coc=lens.coc(depth, W), shutter_depth=lens.coc(both, W))
    torch.testing.assert_close(got, want)
    layers = torch.cat([picture(), torch.ones(1, 1, H, W)], 1)[:, None]
    layered = LensBlur(lens)(layers, depth[:, None], shutter_depth=both[:, None])
    torch.testing.assert_close(layered[:, :3], got, atol=1e-5, rtol=0)
    cut = LensBlur(lens, max_coc=1.0)
    assert cut.plan(picture(), depth, shutter_depth=both).approach <= 2


def test_gradients_reach_the_depth_at_the_ends() -> None:
    blur, image, coc = LensBlur(layers=1, subapertures=1), picture().double(), halves(4, 4).double()
    aim = torch.rand(1, 3, H, W, generator=draw(5)).double()
    both = (ends(3.0, 7.0).double() + 0.1 * torch.rand(1, 2, H, W, generator=draw(4))).requires_grad_()
    plan = blur.plan(image, coc=coc, shutter_depth=both)

    def loss(given: Tensor) -> Tensor:
        return (aim * blur(image, coc=coc, shutter_depth=given, plan=plan)).sum()

    (slope,) = torch.autograd.grad(loss(both), both)
    step = 1e-5 * torch.rand(1, 2, H, W, generator=draw(6)).double()
    with torch.no_grad():
        change = (loss(both + step) - loss(both - step)) / 2
    torch.testing.assert_close((slope * step).sum(), change, rtol=1e-3, atol=0)


@pytest.mark.parametrize("quality", ["exact", "balanced"])
def test_an_approach_is_cut_into_more_parts_gradually(quality: str) -> None:
    """From two parts to as many as there are: a small step of the closing radius changes the picture by little."""
    blur, image, coc = (
        LensBlur(quality=quality),
        torch.rand(1, 3, 24, 24, generator=draw(0)),
        torch.full((1, 1, 24, 24), -0.4),
    )

    def after(approach: float) -> Tensor:
        return blur(image, coc=coc, shutter_depth=torch.cat([coc + 3.0, coc + 3.0 - approach], 1))

    counts = set()
    for approach in (3.5, 4.0, 5.75, 6.0, 21.9, 22.0, 24.0, 25.0):
        near = [after(approach + d) for d in (-1e-4, 0.0, 1e-4)]
        assert max(float((b - a).abs().max()) for a, b in pairwise(near)) < 1e-3
        ends = torch.cat([coc + 3.0, coc + 3.0 - approach], 1)
        counts.add(blur.plan(image, coc=coc, shutter_depth=ends).parts)
    assert counts == {2, 3, 4, 12}


def test_the_plan_says_that_radii_change() -> None:
    blur = LensBlur()
    plan = blur.plan(picture(), coc=halves(4, 4), shutter_depth=ends(2.0, 9.0))
    assert plan.approaches
    assert plan.parts == 4
    assert plan.uniform is None
    assert "Motion in depth changes radii by up to 7.0 px, in 4 steps" in str(plan)
    with pytest.raises(ValueError, match="plan: expected the shutter_depth it was made with, got none"):
        blur(picture(), coc=halves(4, 4), plan=plan)
    for wrong, message in ((halves(1, 1), r"shutter_depth: expected shape"), (ends(1.0, math.nan), "finite")):
        with pytest.raises(ValueError, match=message):
            blur(picture(), coc=halves(4, 4), shutter_depth=wrong)
    with pytest.raises(ValueError, match="not a disc"):
        LensBlur(aperture="6-gon")(picture(), coc=halves(4, 4), shutter_depth=ends(2.0, 9.0))


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_long_motion_in_half_precision(dtype: torch.dtype) -> None:
    image, coc = torch.full((1, 3, 8, 9), 0.5, dtype=dtype), torch.full((1, 1, 8, 9), 2.0, dtype=dtype)
    motion = torch.full((1, 2, 8, 9), 1024.0, dtype=dtype)
    assert LensBlur().plan(image, coc=coc, motion=motion).motion == pytest.approx(1024 * 2**0.5)
    assert torch.equal(LensBlur()(image, coc=coc, motion=motion), image)


@pytest.mark.parametrize("quality", ["exact", "balanced", "fast"])
@pytest.mark.parametrize("seed", [15, 23, 41])
def test_a_huge_blur_in_motion_leaves_no_negative_light_and_none_above_the_picture(quality: str, seed: int) -> None:
    """Splats of radii up to 22000 px leave less on a pixel than sparse PSFs leave of rounding."""
    g = draw(seed)
    height, width = (int(n) for n in torch.randint(3, 60, (2,), generator=g))
    image = torch.rand(1, 3, height, width, generator=g)
    largest = 10 ** float(torch.rand((), generator=g) * 5.2)
    coc = (torch.rand(1, 1, height, width, generator=g) * 2 - 1) * largest
    motion = (torch.rand(1, 2, height, width, generator=g) * 2 - 1) * 10 ** float(torch.rand((), generator=g) * 3)
    out = LensBlur(quality=quality)(image, coc=coc, motion=motion)
    assert out.min() >= 0
    assert out.max() <= image.max()
