"""`LensBlur` where pixels are merged by radius: the few fused passes against their definition, and the qualities."""

import dataclasses
from dataclasses import replace
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

import torchbokeh as tb
from torchbokeh.compose.composition import compose
from torchbokeh.compose.foreground import foreground_over_rest
from torchbokeh.compose.surfaces import COARSE, split_foreground
from torchbokeh.ops.kernels import foreground as _foreground_kernels
from torchbokeh.plan.quality import QUALITIES

NAMES = [q.name for q in QUALITIES]


def scene(b: int = 1, c: int = 3, h: int = 96, w: int = 130) -> tuple[Tensor, Tensor]:
    seed = torch.Generator().manual_seed(h + w)
    image = torch.rand(b, c, h, w, generator=seed)
    image[:, :, ::29, ::31] *= 50
    y, x = torch.meshgrid(torch.arange(h), torch.arange(w), indexing="ij")
    coc = (x / w * 40 - 5).expand(b, 1, h, w).clone()
    coc[..., (y - h / 2) ** 2 + (x - w / 2) ** 2 < (h / 5) ** 2] = -18.0
    coc[..., (y - h / 4) ** 2 + (x - w / 5) ** 2 < (h / 8) ** 2] = 0.0
    return image, coc


def test_blocks_are_those_of_the_kernels() -> None:
    assert COARSE == _foreground_kernels.BLOCK


@pytest.mark.parametrize("quality", ["balanced", "fast"])
@pytest.mark.parametrize("size", [(1, 3, 96, 130), (2, 1, 50, 41), (1, 2, 33, 7)])
def test_fused_passes_equal_the_composition(size: tuple[int, int, int, int], quality: str) -> None:
    image, coc = scene(*size)
    blur = tb.LensBlur(quality=quality)
    plan = blur.plan(image, coc=coc)
    assert plan.hidden == "filled"
    profile = blur.aperture.profile()
    want, _ = compose(split_foreground(image, coc, None, plan.bins, COARSE), [profile], plan.detail)
    got = foreground_over_rest(image, coc, plan.bins, profile, plan.detail)
    assert (got - want).abs().max() < 1e-4 * want.abs().max()
    assert torch.equal(blur(image, coc=coc, plan=replace(plan, surrounded=0)), got)


def test_with_gradients_the_composition_is_taken() -> None:
    image, coc = scene()
    blur = tb.LensBlur(quality="balanced")
    leaves = image.clone().requires_grad_(), coc.clone().requires_grad_()
    out = blur(leaves[0], coc=leaves[1])
    torch.testing.assert_close(out.detach(), blur(image, coc=coc), rtol=0, atol=1e-3)
    out.sum().backward()
    assert all(t.grad is not None and t.grad.isfinite().all() and t.grad.any() for t in leaves)


@settings(deadline=None, max_examples=15)
@given(st.sampled_from(NAMES[1:]), st.integers(2, 60), st.integers(2, 60), st.sampled_from([2.0, 15.0, 200.0]))
def test_constant_in_constant_out(quality: str, height: int, width: int, reach: float) -> None:
    seed = torch.Generator().manual_seed(height * 61 + width)
    coc = (torch.rand(1, 1, height, width, generator=seed) * 2 - 1) * reach
    image = torch.tensor([0.003, 0.7, 5e4]).view(1, 3, 1, 1).repeat(1, 1, height, width)
    out = tb.LensBlur(quality=quality)(image, coc=coc)
    torch.testing.assert_close(out, image, rtol=1e-4, atol=0)


@pytest.mark.parametrize(("quality", "least"), [("high", 0.01), ("balanced", 0.05), ("fast", 0.06)])
def test_every_quality_is_near_the_exact_one(quality: str, least: float) -> None:
    image, coc = scene()
    image = image.clamp(max=1)
    exact, got = (tb.LensBlur(quality=q)(image, coc=coc) for q in ("exact", quality))
    assert (got - exact).abs().sum() < least * exact.sum()


@pytest.mark.parametrize("quality", NAMES)
def test_layers(quality: str) -> None:
    image, coc = scene()
    alpha = (coc < -10).float()
    front = torch.cat([image * alpha, alpha], 1)
    back = torch.cat([image.flip(3), torch.ones_like(alpha)], 1)
    layers, radii = torch.stack([front, back], 1), torch.stack([coc, coc.abs()], 1)
    out = tb.LensBlur(quality=quality)(layers, coc=radii)
    assert out.shape == (1, 4, 96, 130)
    torch.testing.assert_close(out[:, 3:], torch.ones_like(alpha), rtol=0, atol=1e-4)
    exact = tb.LensBlur(quality="exact")(layers, coc=radii)
    assert (out - exact).abs().mean() < 0.05 * exact.abs().mean()


def test_the_plan_names_the_quality() -> None:
    image, coc = scene()
    for quality in QUALITIES:
        plan = tb.LensBlur(quality=quality.name).plan(image, coc=coc)
        assert plan.quality == quality
        assert (plan.highest > 0) == (quality.merging is not None and 2 * quality.merging.cells <= 35)
        assert plan.predicted_error <= quality.error
        assert (f"Quality {quality.name!r}" in str(plan)) == (quality.merging is not None)
    picked = tb.LensBlur(tolerance=0.05).plan(image, coc=coc)
    assert picked.quality.name in ("balanced", "fast")
    assert picked.predicted_error <= 0.05


def test_a_plan_carries_the_quality() -> None:
    image, coc = scene()
    fast = tb.LensBlur(quality="fast")
    plan = fast.plan(image, coc=coc)
    assert torch.equal(tb.LensBlur(quality="exact")(image, coc=coc, plan=plan), fast(image, coc=coc))
    assert dataclasses.replace(plan) == plan


@pytest.mark.parametrize("kind", ["background", "four channels", "float64"])
def test_what_the_fused_passes_do_not_take_is_composed(kind: str) -> None:
    image, coc = scene(c=4 if kind == "four channels" else 3)
    arguments: dict[str, Any] = {"coc": coc}
    if kind == "background":
        arguments["background"] = image.flip(3), coc.abs()
    if kind == "float64":
        image, arguments["coc"] = image.double(), coc.double()
    out = tb.LensBlur(quality="balanced")(image, **arguments)
    assert out.shape == image.shape
    assert out.isfinite().all()
    exact = tb.LensBlur(quality="exact")(image, **arguments)
    assert (out - exact).abs().mean() < 0.08 * exact.mean()
