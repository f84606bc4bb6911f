"""Pictures whose pixels are merged by radius, beside those where none are."""

import doctest
import importlib.util
import math
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st
from torch import Tensor

import torchbokeh.ops.merge
from torchbokeh.ops import dispatch
from torchbokeh.ops.integrate import running_sum_x
from torchbokeh.ops.merge import FADE, Merging, merged, splat_merged
from torchbokeh.ops.splat import PointTable, splat_points
from torchbokeh.psfs import Aperture, Disc, Polygon

# pytest puts no folder on the path: the helper beside this file is loaded by its place.
spec = importlib.util.spec_from_file_location("merging", Path(__file__).with_name("_merging.py"))
merging_scenes = importlib.util.module_from_spec(spec)
spec.loader.exec_module(merging_scenes)

F32, F64 = merging_scenes.F32, merging_scenes.F64
FINE, MIDDLE, COARSE, PLAIN = merging_scenes.FINE, merging_scenes.MIDDLE, merging_scenes.COARSE, merging_scenes.PLAIN
SHAPES, few = merging_scenes.SHAPES, merging_scenes.few
noise, radii, smooth = merging_scenes.noise, merging_scenes.radii, merging_scenes.smooth
exact, relative_l1, assert_close = merging_scenes.exact, merging_scenes.relative_l1, merging_scenes.assert_close


def flat_picture_error(coc: Tensor, merging: Merging, shape: Aperture, weight: Tensor | None = None) -> float:
    flat = torch.full((len(coc), 2, *coc.shape[2:]), 0.7, dtype=coc.dtype)
    out = splat_merged(flat, coc, shape.profile(), merging, weight=weight, ones=True, normalise=True)
    return float((out[:, :2] / 0.7 - 1).abs().max())


@given(
    size=st.tuples(st.integers(1, 70), st.integers(1, 70)),
    reach=st.floats(1, 60),
    name=st.sampled_from(list(SHAPES)),
    merging=st.sampled_from([FINE, MIDDLE, COARSE]),
    seed=st.integers(0, 99),
)
@few
def test_constant_in_constant_out_for_radii_of_all_kinds(
    size: tuple[int, int], reach: float, name: str, merging: Merging, seed: int
) -> None:
    coc = radii(2, *size, reach, seed) if seed % 2 else reach * noise(2, 1, *size, seed=seed)
    assert flat_picture_error(coc, merging, SHAPES[name]) < 1e-9
    assert flat_picture_error(coc, merging, SHAPES[name], noise(2, 1, *size, seed=seed) + 0.1) < 1e-9


@given(
    split=st.integers(1, 63),
    one=st.floats(-4, 4),
    other=st.floats(-4, 4),
    across=st.booleans(),
    name=st.sampled_from(list(SHAPES)),
    merging=st.sampled_from([FINE, MIDDLE, COARSE]),
)
@example(split=40, one=4.0, other=1.3, across=True, name="disc", merging=MIDDLE)
@example(split=40, one=-3.0, other=1.3, across=False, name="square", merging=COARSE)
@few
def test_constant_in_constant_out_where_a_blur_meets_a_wide_one(
    split: int, one: float, other: float, across: bool, name: str, merging: Merging
) -> None:
    """Two radii up to 1e4 px: where the wider one spreads, next to nothing covers the picture."""
    coc = torch.empty(1, 1, 64, 64, dtype=F64)
    coc[:, :, :split] = math.copysign(10 ** abs(one), one)
    coc[:, :, split:] = math.copysign(10 ** abs(other), other)
    assert flat_picture_error(coc.mT if across else coc, merging, SHAPES[name]) < 1e-6


@pytest.mark.parametrize("merging", [FINE, MIDDLE, COARSE])
@pytest.mark.parametrize("name", SHAPES)
def test_energy_is_kept_within_the_picture(name: str, merging: Merging) -> None:
    values, coc = noise(2, 3, 157, 170), radii(2, 157, 170, 30.0)
    # The widest PSF, three cells of the coarsest level on top.
    border = 30 + 3 * 8
    inside = torch.zeros_like(values)
    inside[..., border:-border, border:-border] = 1
    values = values * inside
    out = splat_merged(values, coc, SHAPES[name].profile(), merging)
    torch.testing.assert_close(out.sum((2, 3)), values.sum((2, 3)), rtol=1e-10, atol=0)


@pytest.mark.parametrize("dtype", [F32, F64])
def test_linear_in_the_values(dtype: torch.dtype) -> None:
    one, coc = noise(1, 2, 45, 70).to(dtype), radii(1, 45, 70).to(dtype)
    other = noise(1, 2, 45, 70, seed=7).to(dtype)

    def blur(values: Tensor) -> Tensor:
        return splat_merged(values, coc, Polygon(5).profile(), PLAIN)

    assert_close(blur(2 * one - 3 * other), 2 * blur(one) - 3 * blur(other), 1e-5 if dtype == F32 else 1e-12)
    assert torch.equal(blur(torch.zeros_like(one)), torch.zeros_like(one))


@pytest.mark.parametrize("dims", [(2,), (3,), (2, 3)])
def test_a_mirrored_scene_gives_the_mirrored_picture(dims: tuple[int, ...]) -> None:
    """A disc has no direction, and cells of a picture of whole cells lie the same way from either side."""
    values, coc = noise(1, 2, 40, 64), radii(1, 40, 64)
    out = splat_merged(values, coc, Disc().profile(), MIDDLE, highest=3)
    turned = splat_merged(values.flip(dims), coc.flip(dims), Disc().profile(), MIDDLE, highest=3)
    assert_close(turned, out.flip(dims), 1e-12)


def test_a_scene_moved_by_whole_cells_gives_the_moved_picture() -> None:
    values, coc = torch.zeros(1, 1, 96, 120, dtype=F64), radii(1, 96, 120, 24.0)
    values[..., 32:56, 40:64] = noise(1, 1, 24, 24)
    out = splat_merged(values, coc, Polygon(7).profile(), PLAIN, highest=2)
    moved = splat_merged(values.roll((8, 4), (2, 3)), coc.roll((8, 4), (2, 3)), Polygon(7).profile(), PLAIN, highest=2)
    assert_close(moved, out.roll((8, 4), (2, 3)), 1e-12)


def test_weight_is_a_factor_of_the_values() -> None:
    values, coc, weight = noise(2, 3, 45, 70), radii(2, 45, 70), noise(2, 1, 45, 70, seed=8)
    profile = Polygon(5).profile()

    def blur(weight: Tensor | None) -> Tensor:
        return splat_merged(values, coc, profile, PLAIN, weight=weight, ones=True)

    assert_close(blur(torch.ones_like(coc)), blur(None), 1e-12)
    assert_close(blur(3 * weight), 3 * blur(weight), 1e-12)
    assert torch.equal(blur(0 * weight), torch.zeros_like(blur(None)))
    one = torch.full_like(coc, 13.0)  # one radius: it does not matter which pixels a mean is taken over
    factor = splat_merged(values, one, profile, PLAIN, weight=weight)
    assert_close(factor, splat_merged(weight * values, one, profile, PLAIN), 1e-12)


@pytest.mark.parametrize("dtype", [F32, F64])
def test_pixels_without_weight_get_no_gradient(dtype: torch.dtype) -> None:
    inputs = [t.to(dtype) for t in (noise(1, 3, 60, 70), radii(1, 60, 70), smooth(1, 1, 60, 70, width=9.0))]
    inputs[2] = (inputs[2] - 0.5).clamp_min(0)
    out = splat_merged(
        *(t.requires_grad_() for t in inputs[:2]), Disc().profile(), MIDDLE, weight=inputs[2].requires_grad_()
    )
    for back in torch.autograd.grad(out, inputs, noise(*out.shape, seed=5).to(dtype)):
        assert (back[(inputs[2] == 0).expand_as(back)] == 0).all()
        assert back.abs().max() > 0


@pytest.mark.parametrize("dtype", [F32, F64])
def test_pixels_without_weight_do_not_take_part(dtype: torch.dtype) -> None:
    values, coc = noise(1, 3, 60, 70).to(dtype), radii(1, 60, 70).to(dtype)
    weight = (smooth(1, 1, 60, 70, width=9.0) > 0.5).to(dtype)
    outs = []
    for junk in (0.3, 1e3):
        v, r = torch.where(weight > 0, values, junk), torch.where(weight > 0, coc, 0.03 * junk)
        v.requires_grad_()
        r.requires_grad_()
        out = splat_merged(v, r, Disc().profile(), MIDDLE, highest=2, weight=weight, ones=True)
        back = torch.autograd.grad(out, (v, r), noise(*out.shape, seed=5).to(dtype))
        outs.append((out.detach(), *back))
    for mine, theirs in zip(*outs, strict=True):
        assert_close(mine, theirs, 1e-6)
    want = exact(torch.cat([values, torch.ones_like(coc)], 1) * weight, coc, Disc())
    assert relative_l1(outs[0][0], want) < 0.03


BOUNDS = {FINE: 0.004, MIDDLE: 0.008, COARSE: 0.012}
"""Relative L1 against the exact splat, normalised. Cells are 1/8, 1/4 and 1/2.5 of a radius or finer, so the PSF is
wrong in about that share of its rim; over a picture these errors mostly cancel. Found: a fifth to 0.7 of this."""


def coc_maps(h: int, w: int) -> dict[str, Tensor]:
    steps = torch.full((1, 1, h, w), 3.0, dtype=F64)
    steps[..., w // 3 :] = -21.0
    steps[..., h // 2 :, w // 2 :] = 45.0
    return {
        "constant": torch.full((1, 1, h, w), 30.0, dtype=F64),
        "smooth": smooth(1, 1, h, w, width=30.0, seed=3) * 60 - 20,
        "steps": steps,
        "noise": noise(1, 1, h, w, seed=2) * 80 - 40,
    }


@pytest.mark.parametrize("merging", [FINE, MIDDLE, COARSE], ids=["8 cells", "4 cells", "2.5 cells"])
@pytest.mark.parametrize("name", ["disc", "hexagon"])
def test_close_to_the_exact_splat(name: str, merging: Merging) -> None:
    h, w = 96, 128
    values = torch.cat([smooth(1, 2, h, w, width=8.0), noise(1, 1, h, w), torch.ones(1, 1, h, w, dtype=F64)], 1)
    for coc in coc_maps(h, w).values():
        want = exact(values, coc, SHAPES[name])
        want = want[:, :3] / want[:, 3:]
        got = splat_merged(values, coc, SHAPES[name].profile(), merging, normalise=True)[:, :3]
        assert relative_l1(got, want) < BOUNDS[merging]
        assert float((got - want).abs().max()) < 4 * BOUNDS[merging]  # found: 2.7


def test_the_error_falls_with_the_cells() -> None:
    values, coc = noise(1, 2, 96, 128), coc_maps(96, 128)["smooth"]
    want = exact(values, coc, Disc())
    errors = [
        relative_l1(splat_merged(values, coc, Disc().profile(), Merging(cells, 0.01)), want)
        for cells in (1.5, 2.5, 4, 8, 16)
    ]
    assert all(finer < 0.7 * coarser for coarser, finer in pairwise(errors)), errors
    # With nothing to merge, what is left are the rounded radii.
    assert relative_l1(splat_merged(values, coc, Disc().profile(), Merging(64, 0.01)), want) < 1e-4


def test_highlights_look_as_they_do_without_merging() -> None:
    values, coc = 0.1 * noise(1, 3, 96, 128), torch.full((1, 1, 96, 128), 30.0, dtype=F64)
    values[..., 48, 64] = 500.0
    want = exact(values, coc, Disc())
    got = splat_merged(values, coc, Disc().profile(), COARSE)
    assert float((got - want).abs().max()) < 0.01 * float(want.max())
    blunt = splat_merged(values, coc, Disc().profile(), COARSE._replace(highlight=1e6))
    assert float((blunt - want).abs().max()) > 0.1 * float(want.max())


@pytest.mark.parametrize(("merging", "most"), [(FINE, 1.25), (MIDDLE, 1.25), (COARSE, 1.25)])
def test_nothing_pops_while_the_focus_is_pulled(merging: Merging, most: float) -> None:
    """Step by step across the first level border, the picture changes hardly more than the exact one.

    Steps are of 1/16 px. The two levels differ by the blur of interpolation, which the smaller radius only makes up for
    in its second moment, and that difference comes in over the fade: steps are a fifth larger to a third smaller.
    Without `FADE`, the worst step is 2.6 to 5.5 times the exact one.
    """
    border = int(16 * 2 * merging.cells)
    sweep = torch.arange(border - 4, int(border * (1 + FADE)) + 4, dtype=F64) / 16
    coc = sweep[:, None, None, None].expand(-1, 1, 48, 64)
    values = noise(1, 1, 48, 64).expand(len(sweep), -1, -1, -1)
    frames = splat_merged(values, coc, Disc().profile(), merging, highest=1), exact(values, coc, Disc())
    mine, theirs = (f.diff(dim=0).abs().mean((1, 2, 3)) for f in frames)
    assert float((mine / theirs).max()) < most
    assert float((mine / theirs).min()) > 0.6


@pytest.mark.parametrize("dtype", [F32, F64])
def test_small_radii_move_as_smoothly_as_in_the_exact_splat(dtype: torch.dtype) -> None:
    """With steps of 1/64 px at all radii, a step of 0.001 px changed a pixel by 0.05, and a mean picture by 2 %."""
    dots = (noise(1, 1, 32, 32) < 0.05).to(dtype).expand(64, -1, -1, -1)
    for start in (0.47, 0.59, 0.7, 1.0, 2.0, 7.97):
        sweep = start + 1e-3 * torch.arange(64, dtype=dtype)
        coc = sweep[:, None, None, None].expand_as(dots)
        got = splat_merged(dots, coc, Disc().profile(), FINE)
        want = exact(dots, coc, Disc())
        assert relative_l1(got, want) < 1e-3
        assert float(got.diff(dim=0).abs().max()) < float(want.diff(dim=0).abs().max()) + 1e-3


def ring_table(largest: float, steps: int) -> PointTable:
    """Soap-bubble PSFs of the radii ``0, 1/steps, ...``, bright at the rim and on the right, then mirrored ones."""
    reach = math.ceil(largest) + 1
    axis = torch.arange(-reach, reach + 1, dtype=F64)
    offsets, weights, counts = [], [], [0]
    for sign in (1, -1):
        for k in range(math.ceil(largest * steps) + 1):
            radius = max(k / steps, 0.5)
            distance = (axis[:, None] ** 2 + axis**2).sqrt()
            psf = (radius + 0.5 - distance).clamp(0, 1) * (1 + 3 * (distance / radius) ** 4)
            psf *= 1 + sign * 0.5 * (axis / radius).clamp(-1, 1)
            y, x = psf.nonzero().unbind(1)
            offsets.append(torch.stack([axis[x], axis[y]], 1))
            weights.append(psf[y, x] / psf.sum())
            counts.append(counts[-1] + len(x))
    return PointTable(torch.cat(offsets), torch.cat(weights), torch.tensor(counts))


def ring_splat(largest: float, steps: int, domain: str) -> Callable[[Tensor, Tensor], Tensor]:
    """Splat such PSFs point by point, or in the domain of differences along x."""
    table = ring_table(largest, steps)
    mirrored, pad = (len(table.counts) - 1) // 2, math.ceil(largest) + 2
    if domain == "scanline":
        # Every point becomes a pair: it begins at its column and ends at the next.
        offsets = torch.stack([table.offsets, table.offsets + torch.tensor([1.0, 0.0])], 1).reshape(-1, 2)
        weights = torch.stack([table.weights, -table.weights], 1).reshape(-1)
        table = PointTable(offsets, weights, 2 * table.counts)

    def splat(values: Tensor, radius: Tensor) -> Tensor:
        index = (radius.abs() * steps).round().long() + mirrored * (radius < 0)
        out = splat_points(values, index, table, pad=pad)
        out = running_sum_x(out) if domain == "scanline" else out
        return out[..., pad:-pad, pad:-pad]

    return splat


@pytest.mark.parametrize("domain", ["direct", "scanline"])
def test_any_psf_in_any_domain_can_be_merged(domain: str) -> None:
    values = torch.cat([smooth(1, 2, 64, 80, width=4.0), torch.ones(1, 1, 64, 80, dtype=F64)], 1)
    coc = smooth(1, 1, 64, 80, width=20.0, seed=4) * 44 - 22
    want = ring_splat(24.0, 4, "direct")(values, coc)
    got = merged(values, coc, ring_splat(10.0, 8, domain), MIDDLE, 2)
    # Radii are those of the table: an eighth of a cell, 1/2 px, of up to 22 px, beside the error of merging.
    assert relative_l1(got[:, :2] / got[:, 2:], want[:, :2] / want[:, 2:]) < 0.01
    flipped = merged(values, -coc, ring_splat(10.0, 8, domain), MIDDLE, 2)
    assert relative_l1(flipped, want) > 0.1  # the sign is passed on


def test_without_numba_the_torch_path_takes_over_and_says_so_once(monkeypatch: pytest.MonkeyPatch) -> None:
    values, coc = noise(1, 3, 40, 34).float(), radii(1, 40, 34).float()
    profile = Disc().profile()
    want = splat_merged(values, coc, profile, MIDDLE, ones=True)
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *a: None if name == "numba" else find(name, *a))
    for name in ("merge", "splat"):
        monkeypatch.setattr(torchbokeh.ops.kernels, name, None)
    dispatch.numba_is_there.cache_clear()
    try:
        with pytest.warns(UserWarning, match=r"numba is not installed.*pip install torchbokeh\[cpu\]"):
            assert_close(splat_merged(values, coc, profile, MIDDLE, ones=True), want, 1e-5)
        splat_merged(values, coc, profile, MIDDLE)  # a second warning would be an error
    finally:
        monkeypatch.undo()
        dispatch.numba_is_there.cache_clear()


def test_examples() -> None:
    assert doctest.testmod(torchbokeh.ops.merge).failed == 0
