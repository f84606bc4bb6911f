"""Gradients through merged pixels."""

import importlib.util
from pathlib import Path

import pytest
import torch
from torch import Tensor
from torch.func import functional_call
from torch.nn import functional as F

import torchbokeh.ops.merge
from torchbokeh.ops.merge import STEPS, Merging, splat_merged
from torchbokeh.ops.spans import Profile
from torchbokeh.psfs import Disc, Polygon

# pytest puts no folder on the path: the helper beside this file is loaded by its place.
spec = importlib.util.spec_from_file_location("merging", Path(__file__).with_name("_merging.py"))
merging_scenes = importlib.util.module_from_spec(spec)
spec.loader.exec_module(merging_scenes)

F32, F64 = merging_scenes.F32, merging_scenes.F64
FINE, MIDDLE, COARSE, PLAIN = merging_scenes.FINE, merging_scenes.MIDDLE, merging_scenes.COARSE, merging_scenes.PLAIN
draw, noise, radii, smooth = merging_scenes.draw, merging_scenes.noise, merging_scenes.radii, merging_scenes.smooth
exact, relative_l1, assert_close = merging_scenes.exact, merging_scenes.relative_l1, merging_scenes.assert_close


def plateau_radii(h: int, w: int, seed: int = 5) -> Tensor:
    """Radii of levels 0 to 2 of `PLAIN`, away from the borders: what they change there is all in their gradient."""
    zones = torch.tensor([[1.0, 7.9], [9.1, 15.9], [18.1, 30.0]], dtype=F64)
    zone = zones[torch.randint(0, 3, (1, 1, h, w), generator=draw(seed))]
    radius = zone[..., 0] + (zone[..., 1] - zone[..., 0]) * noise(1, 1, h, w, seed=seed)
    return radius * (torch.randint(0, 2, radius.shape, generator=draw(seed + 1)) * 2 - 1)


@pytest.mark.parametrize("normalise", [False, True])
@pytest.mark.parametrize("radius", [1.0, 7.0, 12.0, 21.0])
def test_the_gradient_of_values_and_weight_matches_finite_differences(normalise: bool, radius: float) -> None:
    """Mean radii count as given, also where they change with the weight: so the radius is the same everywhere."""
    values, weight = noise(1, 2, 5, 6).requires_grad_(), (noise(1, 1, 5, 6, seed=8) + 0.1).requires_grad_()
    coc, profile = torch.full((1, 1, 5, 6), radius, dtype=F64), Polygon(5).profile()

    def blur(values: Tensor, weight: Tensor) -> Tensor:
        return splat_merged(values, coc, profile, PLAIN, highest=2, weight=weight, ones=normalise, normalise=normalise)

    assert torch.autograd.gradcheck(blur, (values, weight), fast_mode=True)


def test_the_gradient_of_the_values_matches_finite_differences() -> None:
    values, coc = noise(1, 2, 9, 6).requires_grad_(), radii(1, 9, 6, 30.0)

    def blur(values: Tensor) -> Tensor:
        return splat_merged(values, coc, Polygon(5).profile(), PLAIN, highest=2)

    assert torch.autograd.gradcheck(blur, (values,), fast_mode=True)


def test_the_gradient_of_the_radii_matches_finite_differences(monkeypatch: pytest.MonkeyPatch) -> None:
    """Radii are rounded as if they were not: without rounding, and at fixed shares, the gradient is exact."""
    monkeypatch.setattr(torchbokeh.ops.merge, "STEPS", 2.0**40)
    values, coc = noise(1, 2, 7, 6), plateau_radii(7, 6).requires_grad_()

    def blur(coc: Tensor) -> Tensor:
        return splat_merged(values, coc, Polygon(5).profile(), PLAIN, highest=2)

    assert torch.autograd.gradcheck(blur, (coc,), fast_mode=True)


def test_rounding_changes_the_gradient_of_the_radii_little(monkeypatch: pytest.MonkeyPatch) -> None:
    values, coc = smooth(1, 2, 60, 70, width=4.0), plateau_radii(60, 70).requires_grad_()
    seed = smooth(1, 2, 60, 70, width=6.0, seed=9)
    slopes = []
    for steps in (STEPS, 2.0**40):
        monkeypatch.setattr(torchbokeh.ops.merge, "STEPS", steps)
        out = splat_merged(values, coc, Disc().profile(), PLAIN, highest=2)
        slopes += torch.autograd.grad(out, coc, seed)
    assert relative_l1(*slopes) < 0.03
    assert not torch.equal(*slopes)


@pytest.mark.parametrize(("merging", "most"), [(FINE, 0.04), (MIDDLE, 0.12), (COARSE, 0.24)])
def test_the_gradient_of_the_radii_is_close_to_that_of_the_exact_splat(merging: Merging, most: float) -> None:
    """Over all levels and the borders between them, for blocks of 4 x 4 px. Found: 0.02, 0.08 and 0.16."""
    h, w = 96, 128
    values, coc = smooth(1, 2, h, w, width=6.0), smooth(1, 1, h, w, width=30.0, seed=3) * 60 - 20
    seed = smooth(1, 2, h, w, width=8.0, seed=9)
    coc.requires_grad_()
    (got,) = torch.autograd.grad(splat_merged(values, coc, Disc().profile(), merging), coc, seed)
    (want,) = torch.autograd.grad(exact(values, coc, Disc()), coc, seed)
    got, want = (F.avg_pool2d(g, 4) for g in (got, want))
    assert relative_l1(got, want) < most
    assert float(F.cosine_similarity(got.flatten(), want.flatten(), 0)) > 0.98


def turned(angle: Tensor) -> Profile:
    return functional_call(Polygon(5), {"rotation": angle}, ())


def test_a_trained_aperture_gets_its_gradient() -> None:
    values, coc = noise(1, 1, 5, 6), radii(1, 5, 6, 20.0)

    def blur(angle: Tensor) -> Tensor:
        return splat_merged(values, coc, turned(angle), PLAIN, highest=1)

    assert torch.autograd.gradcheck(blur, (torch.tensor(0.3, dtype=F64, requires_grad=True),), fast_mode=True)


def test_a_trained_aperture_gets_its_gradient_in_float32() -> None:
    values, coc = noise(1, 3, 40, 35), radii(1, 40, 35, 20.0)
    slopes, sources = [], []
    for dtype in (F32, F64):
        angle = torch.tensor(0.3, dtype=dtype, requires_grad=True)
        v = values.to(dtype).requires_grad_()
        out = splat_merged(v, coc.to(dtype), turned(angle), PLAIN)
        assert out.dtype == dtype
        (out * torch.linspace(0, 1, 35, dtype=dtype)).square().sum().backward()
        slopes.append(float(angle.grad))
        sources.append(v.grad)
    assert slopes[0] == pytest.approx(slopes[1], rel=1e-3)
    assert abs(slopes[1]) > 1e-4
    assert_close(*sources, 1e-5)


def test_only_what_is_asked_for_gets_a_gradient() -> None:
    values, coc, weight = noise(1, 2, 36, 36), radii(1, 36, 36), noise(1, 1, 36, 36, seed=8)
    for asked in (values, coc, weight):
        asked.requires_grad_()
        splat_merged(values, coc, Disc().profile(), MIDDLE, weight=weight).sum().backward()
        assert asked.grad is not None
        assert asked.grad.abs().sum() > 0
        asked.requires_grad_(False)
    assert not splat_merged(values, coc, Disc().profile(), MIDDLE, weight=weight).requires_grad
