"""Tiny, empty, huge and wrong input of what merges pixels by radius."""

import importlib.util
import math
from pathlib import Path
from typing import Any

import pytest
import torch

from torchbokeh.ops.merge import highest_level, splat_merged
from torchbokeh.ops.spans import Profile
from torchbokeh.psfs import Disc, Polygon

# pytest puts no folder on the path: the helper beside this file is loaded by its place.
spec = importlib.util.spec_from_file_location("merging", Path(__file__).with_name("_merging.py"))
merging_scenes = importlib.util.module_from_spec(spec)
spec.loader.exec_module(merging_scenes)

F32, F64 = merging_scenes.F32, merging_scenes.F64
MIDDLE, COARSE, PLAIN = merging_scenes.MIDDLE, merging_scenes.COARSE, merging_scenes.PLAIN
noise, radii = merging_scenes.noise, merging_scenes.radii
exact, relative_l1, assert_close = merging_scenes.exact, merging_scenes.relative_l1, merging_scenes.assert_close


@pytest.mark.parametrize("dtype", [F32, F64])
@pytest.mark.parametrize("size", [(1, 1), (1, 40), (40, 1), (2, 3)])
@pytest.mark.parametrize("radius", [0.0, 3.0, 30.0, 1e4])
def test_tiny_pictures(dtype: torch.dtype, size: tuple[int, int], radius: float) -> None:
    values, coc = noise(2, 3, *size).to(dtype), torch.full((2, 1, *size), radius, dtype=dtype)
    out = splat_merged(values, coc, Disc().profile(), MIDDLE)
    assert out.shape == values.shape
    assert relative_l1(out, exact(values, coc, Disc())) < 0.02


@pytest.mark.parametrize("dtype", [F32, F64])
@pytest.mark.parametrize("shape", [(0, 3, 4, 5), (1, 3, 0, 5), (1, 3, 4, 0), (0, 3, 64, 64)])
@pytest.mark.parametrize("ones", [False, True])
def test_nothing_to_splat(dtype: torch.dtype, shape: tuple[int, ...], ones: bool) -> None:
    values = torch.zeros(shape, dtype=dtype, requires_grad=True)
    coc = torch.zeros(shape[0], 1, *shape[2:], dtype=dtype, requires_grad=True)
    for highest in (None, 0, 2):
        out = splat_merged(values, coc, Disc().profile(), MIDDLE, highest=highest, ones=ones, normalise=ones)
        assert out.shape == (shape[0], shape[1] + ones, *shape[2:])
        assert out.dtype == dtype
        out.sum().backward()
    assert values.grad is not None
    assert coc.grad is not None


@pytest.mark.parametrize("dtype", [F32, F64])
def test_no_channels_but_the_coverage(dtype: torch.dtype) -> None:
    coc = torch.full((1, 1, 40, 50), 12.0, dtype=dtype)
    out = splat_merged(coc.new_zeros(1, 0, 40, 50), coc, Disc().profile(), MIDDLE, ones=True)
    assert_close(out, splat_merged(torch.ones_like(coc), coc, Disc().profile(), MIDDLE), 1e-6)
    assert splat_merged(coc.new_zeros(1, 0, 40, 50), coc, Disc().profile(), MIDDLE).shape == (1, 0, 40, 50)


@pytest.mark.parametrize("dtype", [F32, F64])
@pytest.mark.parametrize("radius", [1e3, 1e6, 1e12, 1e30])
def test_huge_radii_are_flat_and_finite(dtype: torch.dtype, radius: float) -> None:
    values = noise(1, 2, 70, 41).to(dtype).requires_grad_()
    coc = torch.full((1, 1, 70, 41), radius, dtype=dtype).requires_grad_()
    out = splat_merged(values, coc, Disc().profile(), MIDDLE)
    flat = values.detach().sum((2, 3), keepdim=True) / (math.pi * radius) / radius
    if radius < 1e10:  # further out the ends of a row are more digits away than a double has
        assert_close(out, flat.expand_as(out), 1e-4)
    assert float(out.detach().abs().max()) <= 2 * float(flat.max())
    out.sum().backward()
    assert all(t.grad is not None and t.grad.isfinite().all() for t in (values, coc))


@pytest.mark.parametrize("dtype", [F32, F64])
@pytest.mark.parametrize("bad", [math.inf, -math.inf, math.nan])
@pytest.mark.parametrize("radius", [3.0, 9.0, 20.0, 40.0])
def test_a_value_that_is_no_number_stays_within_its_reach(dtype: torch.dtype, bad: float, radius: float) -> None:
    """On the rows that its PSF reaches, and three cells of its level further, for the interpolation."""
    values, coc = noise(1, 2, 300, 100).to(dtype), torch.full((1, 1, 300, 100), 37.0, dtype=dtype)
    coc[..., ::3, ::2] = 3.0
    coc[..., 150, 80] = radius
    values[:, 1, 150, 80] = bad
    out = splat_merged(values, coc, Disc().profile(), MIDDLE)[0]
    assert out[0].isfinite().all()
    touched = (~out[1].isfinite()).any(1).nonzero()[:, 0]
    assert len(touched) > 0
    beyond = radius + 3 * 2 ** highest_level(radius, (300, 100), MIDDLE)
    assert touched.min() >= 150 - beyond
    assert touched.max() <= 150 + beyond
    assert out[1, :, : 80 - int(beyond) - 1].isfinite().all()


@pytest.mark.parametrize(("dtype", "relative"), [(torch.float16, 1e-3), (torch.bfloat16, 1e-2)])
@pytest.mark.parametrize("normalise", [False, True])
def test_half_precision_is_computed_in_float32(dtype: torch.dtype, relative: float, normalise: bool) -> None:
    values, coc = noise(1, 3, 48, 40).to(dtype).requires_grad_(), radii(1, 48, 40).to(dtype).requires_grad_()
    kinds: dict[str, Any] = {"ones": normalise, "normalise": normalise}
    out = splat_merged(values, coc, Disc().profile(), MIDDLE, **kinds)
    assert out.dtype == dtype
    assert_close(out, splat_merged(values.float(), coc.float(), Disc().profile(), MIDDLE, **kinds), relative)
    out.float().sum().backward()
    assert values.grad is not None
    assert coc.grad is not None
    assert values.grad.dtype == coc.grad.dtype == dtype


def test_the_dtype_is_the_finer_of_the_two() -> None:
    values, coc = noise(1, 1, 40, 40), radii(1, 40, 40)
    assert splat_merged(values.float(), coc, Disc().profile(), MIDDLE).dtype == F64
    assert splat_merged(values, coc.float(), Disc().profile(), MIDDLE).dtype == F64
    assert splat_merged(values.half(), coc.float(), Disc().profile(), MIDDLE).dtype == torch.float16


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("dtype", [F32, F64])
def test_coverage_is_a_channel_of_ones(dtype: torch.dtype, channels: int) -> None:
    values, coc = noise(1, channels, 40, 50).to(dtype), radii(1, 40, 50).to(dtype)
    profile = Polygon(6).profile()
    covered = torch.cat([values, torch.ones_like(coc)], 1)
    plain = splat_merged(covered, coc, profile, PLAIN)
    assert_close(splat_merged(values, coc, profile, PLAIN, ones=True), plain, 1e-6)
    want = torch.cat([plain[:, :-1] / plain[:, -1:], plain[:, -1:]], 1)
    assert_close(splat_merged(values, coc, profile, PLAIN, ones=True, normalise=True), want, 1e-5)
    assert_close(splat_merged(covered, coc, profile, PLAIN, normalise=True), want, 1e-5)


@pytest.mark.parametrize("dtype", [F32, F64])
def test_the_coarsest_level_is_found_or_given(dtype: torch.dtype) -> None:
    values, coc = noise(1, 2, 100, 70).to(dtype), radii(1, 100, 70).to(dtype)
    profile = Disc().profile()
    found = splat_merged(values, coc, profile, COARSE)
    needed = highest_level(float(coc.abs().max()), (100, 70), COARSE)
    assert needed == 2
    assert torch.equal(splat_merged(values, coc, profile, COARSE, highest=needed), found)
    lowest = splat_merged(values, coc, profile, COARSE, highest=0)
    assert_close(lowest, exact(values, coc, Disc()), 0.02)  # radii are rounded
    assert not torch.equal(lowest, found)


def test_bad_input_is_named() -> None:
    values, coc = noise(2, 3, 4, 5), radii(2, 4, 5)
    profile = Disc().profile()
    with pytest.raises(TypeError, match=r"values: expected a tensor of shape \(B, C, H, W\), got list"):
        splat_merged([1.0], coc, profile, MIDDLE)
    with pytest.raises(ValueError, match=r"values: expected shape \(B, C, H, W\), got \(3, 4, 5\)"):
        splat_merged(values[0], coc, profile, MIDDLE)
    with pytest.raises(TypeError, match=r"values: expected a floating-point tensor, got torch.int64"):
        splat_merged(values.long(), coc, profile, MIDDLE)
    with pytest.raises(TypeError, match=r"coc: expected a tensor of shape \(2, 1, 4, 5\), got float"):
        splat_merged(values, 3.0, profile, MIDDLE)
    with pytest.raises(ValueError, match=r"coc: expected shape \(2, 1, 4, 5\), got \(2, 2, 4, 5\)"):
        splat_merged(values, coc.expand(2, 2, 4, 5), profile, MIDDLE)
    with pytest.raises(ValueError, match=r"coc: expected device cpu, got meta"):
        splat_merged(values, coc.to("meta"), profile, MIDDLE)
    with pytest.raises(TypeError, match=r"weight: expected a tensor of shape \(2, 1, 4, 5\), got float"):
        splat_merged(values, coc, profile, MIDDLE, weight=0.5)
    with pytest.raises(TypeError, match=r"weight: expected a floating-point tensor, got torch.bool"):
        splat_merged(values, coc, profile, MIDDLE, weight=coc > 0)
    with pytest.raises(ValueError, match=r"weight: expected shape \(2, 1, 4, 5\), got \(2, 4, 5\)"):
        splat_merged(values, coc, profile, MIDDLE, weight=coc[:, 0])
    with pytest.raises(ValueError, match=r"profile.knots: expected shape \(K, 3\), got \(2, 2\)"):
        splat_merged(values, coc, Profile(profile.knots[:, :2], profile.bulge), MIDDLE)
    with pytest.raises(ValueError, match=r"profile.bulge: expected shape \(\), got \(1,\)"):
        splat_merged(values, coc, Profile(profile.knots, profile.bulge[None]), MIDDLE)
