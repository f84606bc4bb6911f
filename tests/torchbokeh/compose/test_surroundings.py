"""What lies beyond the border of a picture: its ground, without its lights."""

from collections.abc import Callable

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

import torchbokeh as tb
from torchbokeh.compose.surroundings import Surrounding
from torchbokeh.picture.request import Optics, Request
from torchbokeh.picture.samples import Samples, pixel_positions

H, W, R = 64, 90, 12.0
THIN = tb.ThinLens(focal_length=0.05, f_number=1.4, focus_distance=0.6, sensor_width=0.036)


def with_alpha(image: Tensor) -> Tensor:
    return torch.cat([image, torch.ones_like(image[:, :1])], 1)[:, None]


def ramp(radius: float = R) -> Tensor:
    return torch.full((1, 1, H, W), radius) + 1e-3 * torch.arange(W)


def lens_blur(image: Tensor, quality: str) -> Tensor:
    return tb.LensBlur(quality=quality)(image, coc=ramp())


def foreground(image: Tensor, quality: str) -> Tensor:
    coc = torch.where(torch.arange(W) < W // 6, -ramp(), ramp())
    return tb.LensBlur(quality=quality)(image, coc=coc)


def layers(image: Tensor, quality: str) -> Tensor:
    return tb.LensBlur(quality=quality)(with_alpha(image), coc=ramp()[:, None])[:, :3]


def moving(image: Tensor, quality: str) -> Tensor:
    return tb.LensBlur(quality=quality)(image, coc=ramp(), motion=torch.full((1, 2, H, W), 3.0))


def splatting(image: Tensor, quality: str) -> Tensor:
    return tb.KernelSplatting(quality=quality)(image, ramp())


def even(image: Tensor, quality: str) -> Tensor:
    return tb.KernelSplatting(quality=quality)(image, torch.full((1, 1, H, W), R))


def banks(image: Tensor, quality: str) -> Tensor:
    bank = tb.PsfBank.load("combined")
    return tb.KernelSplatting(bank=bank, quality=quality)(image, ramp(), motion=torch.full((1, 2, H, W), 3.0))


def accumulated(image: Tensor, quality: str) -> Tensor:
    return tb.AccumulationBuffer(THIN, views=200)(with_alpha(image), torch.full((1, 1, 1, H, W), 0.9))[:, :3]


def in_colours(image: Tensor, quality: str) -> Tensor:
    return tb.ChromaticAccumulation(THIN, views=64)(with_alpha(image), torch.full((1, 1, 1, H, W), 0.9))[:, :3]


def reconstructed(image: Tensor, quality: str) -> Tensor:
    still = torch.zeros(1, 1, 2, H, W)
    middles = pixel_positions(still)[None, None]
    taken = torch.ones(1, 1, 1, H, W, dtype=torch.bool)
    return tb.reconstruct(Samples(image[None], middles, still, still[:, :, :1], ramp()[None], still + 3.0, taken))


Renderer = Callable[[Tensor, str], Tensor]
QUALITIES = ("exact", "high", "balanced", "fast")
EVERY = [
    *((r, q) for r in (lens_blur, foreground, layers, moving, splatting) for q in QUALITIES),
    *((r, "exact") for r in (even, banks, accumulated, in_colours, reconstructed)),
]


@pytest.mark.parametrize(("render", "quality"), EVERY, ids=[f"{r.__name__}-{q}" for r, q in EVERY])
@pytest.mark.parametrize("ground", [0.0, 0.05])
def test_a_disc_near_the_border_is_one_in_the_middle_that_the_frame_cuts(
    render: Renderer, quality: str, ground: float
) -> None:
    def at(y: int, x: int) -> Tensor:
        image = torch.full((1, 3, H, W), ground)
        image[..., y, x] = 200.0
        return render(image, quality) - ground

    whole = at(H // 2, W // 2 + 14)
    for y, x in ((H // 2, W - 1), (H // 2, W - 9), (2, W - 3), (H - 1, W - 1), (H - 6, W // 2 + 14)):
        got = at(y, x)
        want = torch.zeros_like(got)
        down, along = y - H // 2, x - (W // 2 + 14)
        source = whole[..., max(0, -down) : H - max(0, down), max(0, -along) : W - max(0, along)]
        want[..., max(0, down) : H - max(0, -down), max(0, along) : W - max(0, -along)] = source
        error = (got - want).abs().sum() / want.abs().sum()
        assert error < 0.03, (y, x)


@pytest.mark.parametrize("quality", QUALITIES)
def test_with_its_own_ground_around_a_picture_is_as_with_a_margin(quality: str) -> None:
    pad, image = 24, torch.full((1, 3, H, W), 0.02)
    image[..., [3, 30, 62, 20], [5, 88, 40, 0]] = 400.0
    wide = torch.full((1, 3, H + 2 * pad, W + 2 * pad), 0.02)
    wide[..., pad:-pad, pad:-pad] = image
    coc = torch.full((1, 1, H + 2 * pad, W + 2 * pad), R) + 1e-3 * torch.arange(W + 2 * pad)
    want = tb.LensBlur(quality=quality, margin=pad)(wide, coc=coc)
    got = tb.LensBlur(quality=quality)(image, coc=coc[..., pad:-pad, pad:-pad].contiguous())
    assert (got - want).abs().sum() <= 0.005 * want.sum()


@settings(deadline=None, max_examples=100)
@given(st.integers(1, 40), st.integers(1, 40), st.integers(1, 30), st.integers(0, 2**31))
def test_a_constant_goes_on_as_it_is(height: int, width: int, around: int, seed: int) -> None:
    colour = torch.rand(1, 3, 1, 1, generator=torch.Generator().manual_seed(seed)).double()
    image = colour.expand(1, 3, height, width).contiguous()
    request = Request.of(Optics(), image, coc=torch.full_like(image[:, :1], 3.0))
    wide = Surrounding(around).of(request)
    torch.testing.assert_close(wide.image, colour.expand_as(wide.image), rtol=1e-12, atol=0)
    assert torch.equal(wide.coc, torch.full_like(wide.image[:, :1], 3.0))
    assert torch.equal(Surrounding(around).cut(wide.image), image)


def test_lights_do_not_go_on_and_alpha_does() -> None:
    layers = torch.full((1, 2, 4, 40, 50), 0.25)
    layers[:, :, 3] = 0.5
    layers[:, :, :3, 20, 0] = 1000.0
    request = Request.of(Optics(), layers, coc=torch.full((1, 2, 1, 40, 50), 3.0))
    wide = Surrounding(9).of(request).image
    around = torch.ones(58, 68, dtype=torch.bool)
    around[9:-9, 9:-9] = False
    assert wide[:, :, :3, around].sub(0.25).abs().max() < 1e-3
    assert wide[:, :, 3, around].sub(0.5).abs().max() < 1e-6


def test_faint_layers_stay_faint_where_a_piece_of_the_lens_looks_past_the_border() -> None:
    rgba = 1e-4 * torch.rand(1, 2, 4, 16, 32, generator=torch.Generator().manual_seed(0))
    coc = torch.tensor([24.0, -24.0]).reshape(1, 2, 1, 1, 1).expand(1, 2, 1, 16, 32)
    for pieces in (1, 2, 3):
        assert tb.LensBlur(subapertures=pieces)(rgba, coc=coc)[:, 3].max() < 2e-4


def test_nothing_around_is_the_request_itself() -> None:
    request = Request.of(Optics(), torch.rand(1, 3, 8, 9), coc=torch.rand(1, 1, 8, 9))
    assert Surrounding(0).of(request) is request
    assert Surrounding(0).cut(request.image) is request.image


@pytest.mark.parametrize("layered", [False, True])
def test_gradients_reach_image_and_radii(layered: bool) -> None:
    image = torch.full((1, 3, 20, 24), 0.05, dtype=torch.float64)
    image[..., 9, 1] = 30.0
    coc = 4 + torch.rand(1, 1, 20, 24, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    inputs = [with_alpha(image), coc[:, None]] if layered else [image, coc]
    blur = tb.LensBlur(subapertures=1)
    plan = blur.plan(inputs[0], coc=inputs[1])
    assert plan.surrounded
    inputs = [t.requires_grad_() for t in inputs]

    def render(image: Tensor, coc: Tensor) -> Tensor:
        return blur(image, coc=coc, plan=plan)

    assert torch.autograd.gradcheck(render, inputs, fast_mode=True, atol=1e-4)
