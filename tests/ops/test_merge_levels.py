"""Levels of merging, their cells, and how these become a picture again."""

import importlib.util
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch.nn import functional as F

from torchbokeh.ops.highlights import LEAST_CONTRAST
from torchbokeh.ops.merge import (
    EVEN,
    FADE,
    FEWEST,
    LIT,
    MARGIN,
    ROUNDED_TO,
    SPREAD,
    STEPS,
    Merging,
    highest_level,
    level_shares,
    merge_cells,
    merged,
    upsample,
)

# pytest puts no folder on the path: the helper beside this file is loaded by its place.
spec = importlib.util.spec_from_file_location("merging", Path(__file__).with_name("_merging.py"))
merging_scenes = importlib.util.module_from_spec(spec)
spec.loader.exec_module(merging_scenes)

F32, F64 = merging_scenes.F32, merging_scenes.F64
FINE, MIDDLE, COARSE, PLAIN = merging_scenes.FINE, merging_scenes.MIDDLE, merging_scenes.COARSE, merging_scenes.PLAIN
few = merging_scenes.few
noise, radii = merging_scenes.noise, merging_scenes.radii
shares_of = merging_scenes.shares_of


# How many levels there are.


@pytest.mark.parametrize("merging", [FINE, MIDDLE, COARSE])
def test_a_level_is_there_as_soon_as_a_radius_belongs_to_it(merging: Merging) -> None:
    size = (1 << 20, 7)
    assert highest_level(0.0, size, merging) == 0
    for level in range(1, 12):
        border = merging.cells * 2**level
        assert highest_level(border, size, merging) == level
        assert highest_level(border * 0.999, size, merging) == level - 1
        # Neither too few levels, nor one that stays empty.
        shares = shares_of(torch.full((1, 1, 1, 1), border * 1.01, dtype=F64), merging, level)
        assert float(shares[level]) > 0
        assert float(shares_of(torch.full((1, 1, 1, 1), border * 0.999, dtype=F64), merging, level)[level]) == 0


@pytest.mark.parametrize("radius", [1e6, 1e30, 1e300])
def test_the_picture_bounds_the_levels(radius: float) -> None:
    for side, most in ((1, 0), (FEWEST, 0), (2 * FEWEST - 1, 0), (2 * FEWEST, 1), (1024, 6), (5000, 8)):
        assert highest_level(radius, (side, 3), MIDDLE) == most
        assert highest_level(radius, (3, side), MIDDLE) == most
    assert highest_level(radius, (0, 0), MIDDLE) == 0


# Which level a pixel belongs to.


@given(
    st.lists(st.floats(-1e30, 1e30), min_size=1, max_size=12),
    st.sampled_from([FINE, MIDDLE, COARSE]),
    st.integers(0, 6),
    st.booleans(),
)
@few
def test_shares_sum_to_one(coc: list[float], merging: Merging, highest: int, double: bool) -> None:
    radius = torch.tensor(coc, dtype=F64 if double else F32).reshape(1, 1, 1, -1)
    values = noise(1, 3, 1, len(coc)).to(radius.dtype) ** 8
    shares = level_shares(values, radius, merging, highest)
    assert len(shares) == highest + 1
    assert all(s.shape == radius.shape and s.dtype == values.dtype for s in shares)
    torch.testing.assert_close(sum(shares), torch.ones_like(radius), rtol=0, atol=1e-6)
    together = torch.stack(shares)
    assert together.min() >= 0
    assert int((together > 0).sum(0).max()) <= 3
    used = torch.stack(level_shares(torch.ones_like(values), radius, merging, highest)) > 0
    assert int(used.sum(0).max()) <= 2
    # Where there are two, they are neighbours.
    assert torch.equal(used[:-1] & used[1:], used[:-1] & (used.cumsum(0)[-1] == 2) & (used.cumsum(0)[:-1] == 1))
    for mine, theirs in zip(shares, level_shares(values, -radius, merging, highest), strict=True):
        assert torch.equal(mine, theirs)


def test_between_the_borders_a_pixel_belongs_to_one_level() -> None:
    for level in range(1, 5):
        low = PLAIN.cells * 2**level
        inside = torch.linspace(low * (1 + FADE), 2 * low, 9, dtype=F64).reshape(1, 1, 1, -1)
        assert torch.equal(shares_of(inside)[level], torch.ones_like(inside))
        fading = torch.linspace(low, low * (1 + FADE), 9, dtype=F64).reshape(1, 1, 1, -1)
        wanted = torch.linspace(0, 1, 9, dtype=F64).reshape(1, 1, 1, -1)
        torch.testing.assert_close(shares_of(fading)[level], wanted)
        torch.testing.assert_close(shares_of(fading)[level - 1], 1 - wanted)
    # The coarsest level has no upper end.
    assert float(shares_of(torch.full((1, 1, 1, 1), 1e9, dtype=F64))[4]) == 1


def test_shares_are_continuous_in_the_radius() -> None:
    steps = 4001
    sweep = torch.linspace(0.9 * 2 * PLAIN.cells, 1.3 * 16 * PLAIN.cells, steps, dtype=F64)
    change = shares_of(sweep.reshape(1, 1, 1, -1)).diff(dim=-1).abs()
    # A share goes from 0 to 1 within FADE of the least radius, which is smallest for level 1.
    assert float(change.max()) <= float(sweep[1] - sweep[0]) / (FADE * 2 * PLAIN.cells) * (1 + 1e-9)
    assert float(change.sum()) == pytest.approx(8)  # each of four borders is crossed once, by two levels


def test_highlights_stay_on_the_lowest_level() -> None:
    radius = 40.0
    values = torch.ones(1, 2, 100, 100, dtype=F64)
    bound = MIDDLE.highlight * radius**2
    assert bound > LEAST_CONTRAST
    # The mean rises with what is put in: channel by channel x / mean = bound.
    values[0, 1] = 0.0
    just = bound * (1e4 - 1) / (1e4 - bound)
    for factor, level in ((0.999 * LIT, 3), (1.001, 0), (1e6, 0)):
        for sign in (1, -1):
            values[0, 0, 50, 50] = sign * factor * just
            shares = torch.stack(level_shares(values, torch.full((1, 1, 100, 100), radius, dtype=F64), MIDDLE, 3))
            assert float(shares[level, 0, 0, 50, 50]) == 1
            others = shares.clone()
            others[:, 0, 0, 50, 50] = shares[:, 0, 0, 0, 0]
            assert torch.equal(others[3], torch.ones_like(others[3]))


def test_a_highlight_has_some_contrast_whatever_its_radius() -> None:
    values = torch.ones(1, 1, 100, 100, dtype=F64)
    coc = torch.full((1, 1, 100, 100), 2.0 * MIDDLE.cells * 1.2, dtype=F64)
    merging = Merging(MIDDLE.cells, 1e-9)
    for value, share in ((0.99 * LIT * LEAST_CONTRAST, 1), (1.01 * LEAST_CONTRAST, 0)):
        values[0, 0, 3, 4] = value * (1e4 - 1) / (1e4 - value)
        assert float(level_shares(values, coc, merging, 1)[1][0, 0, 3, 4]) == share


def test_a_light_that_grows_becomes_a_highlight_gradually() -> None:
    coc, lowest = torch.full((1, 1, 100, 100), 40.0, dtype=F64), []
    for value in torch.linspace(15, 30, 501, dtype=F64):
        values = torch.ones(1, 1, 100, 100, dtype=F64)
        values[..., 50, 50] = value
        shares = torch.stack(level_shares(values, coc, MIDDLE, 3))[:, 0, 0, 50, 50]
        assert float(shares.sum()) == pytest.approx(1)
        assert float(shares[1:3].sum()) == 0
        lowest.append(float(shares[0]))
    assert lowest[0] == 0
    assert lowest[-1] == 1
    assert np.diff(lowest).min() >= 0
    assert np.diff(lowest).max() < 0.01


def test_a_highlight_is_bright_for_its_own_picture_and_channel() -> None:
    values = torch.ones(2, 2, 64, 64, dtype=F64)
    values[1, 1] = 1e4
    values[0, 1, 5, 6] = values[1, 1, 7, 8] = 1e4
    lowest = level_shares(values, torch.full((2, 1, 64, 64), 12.0, dtype=F64), MIDDLE, 1)[0]
    assert lowest.nonzero().tolist() == [[0, 0, 5, 6]]


def test_the_mean_is_that_of_all_pixels_by_their_weight() -> None:
    values, coc = torch.zeros(1, 2, 64, 64, dtype=F64), torch.full((1, 1, 64, 64), 12.0, dtype=F64)
    values[:, 0, 3, 4] = 1e-3  # a light before black is a highlight, as it is before any other dark ground
    assert level_shares(values, coc, MIDDLE, 1)[0].nonzero().tolist() == [[0, 0, 3, 4]]
    values[..., :8, :8] = 1
    here = torch.zeros_like(coc)
    here[..., :8, :8] = 1  # pixels without weight are not there, and are no ground
    assert level_shares(values, coc, MIDDLE, 1, here)[0].max() == 0
    values[:, 0, 3, 4] = 100
    assert level_shares(values, coc, MIDDLE, 1, here)[0].nonzero().tolist() == [[0, 0, 3, 4]]
    # Weight makes it usual, or leaves it alone with nothing to be compared with.
    weight = torch.ones_like(coc)
    weight[..., 3, 4] = 1e5
    assert level_shares(values, coc, MIDDLE, 1, weight)[0].max() == 0
    weight = torch.zeros_like(coc)
    weight[..., :2, :8] = 1e-9
    assert level_shares(values, coc, MIDDLE, 1, weight)[0].nonzero().tolist() == [[0, 0, 3, 4]]
    assert torch.stack(level_shares(values, coc, MIDDLE, 1, 0 * weight)).isfinite().all()


def test_shares_pass_no_gradient_on() -> None:
    values, coc, weight = (t.requires_grad_() for t in (noise(1, 1, 40, 40), radii(1, 40, 40), noise(1, 1, 40, 40)))
    assert not any(s.requires_grad for s in level_shares(values, coc, MIDDLE, 2, weight))


# The cells.


def round_radius(radius: float) -> float:
    """To steps of even ``1 / radius`` up to `EVEN`, then of even roots; no radius of the identity, and no large one."""
    if not 0.5 < radius < ROUNDED_TO:
        return radius
    if radius < EVEN:
        return 1 / (2 - round(STEPS * (2 - 1 / radius)) / STEPS)
    last = STEPS * (2 - 1 / EVEN)
    number = round(last + STEPS * 2 / EVEN**1.5 * (math.sqrt(radius) - math.sqrt(EVEN)))
    return (math.sqrt(EVEN) + (number - last) / STEPS * EVEN**1.5 / 2) ** 2


def slow_cells(values: np.ndarray, coc: np.ndarray, weights: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """`merge_cells` of one picture ``(C, H, W)``, pixel by pixel, with what each counts for on each level."""
    c, height, width = values.shape
    levels = []
    for level, share in enumerate(weights):
        rows, columns = math.ceil(height / 2**level), math.ceil(width / 2**level)
        total, radius = np.zeros((c, rows, columns)), np.zeros((rows, columns))
        for row in range(rows):
            for column in range(columns):
                weight = reach = signed = 0.0
                for y in range(row * 2**level, min((row + 1) * 2**level, height)):
                    for x in range(column * 2**level, min((column + 1) * 2**level, width)):
                        total[:, row, column] += share[y, x] * values[:, y, x]
                        weight += share[y, x]
                        reach += share[y, x] * abs(coc[y, x])
                        signed += share[y, x] * coc[y, x]
                mean = reach / weight / 2**level if weight > 0 else 0.0
                if level > 0:
                    mean = math.sqrt(max(mean**2 - SPREAD, 0.25))  # what interpolation will add
                mean = round_radius(mean)
                radius[row, column] = -mean if signed < 0 else mean
        levels.append((total, radius))
    return levels


@pytest.mark.parametrize("size", [(1, 1), (5, 7), (8, 16), (17, 3), (13, 21)])
@pytest.mark.parametrize("weighted", [False, True])
def test_cells_are_the_sums_of_their_pixels(size: tuple[int, int], weighted: bool) -> None:
    values, coc = noise(2, 3, *size) - 0.3, radii(2, *size)
    weight = (3 * noise(2, 1, *size, seed=8) - 1).clamp_min(0) if weighted else None
    shares = level_shares(values, coc, MIDDLE, 4, weight)
    got = merge_cells(values, coc, shares, weight)
    assert len(got) == 5
    for n in range(2):
        counts = torch.stack(shares) if weight is None else torch.stack(shares) * weight
        want = slow_cells(values[n].numpy(), coc[n, 0].numpy(), counts[:, n, 0].numpy())
        for level, (total, radius) in enumerate(want):
            torch.testing.assert_close(got[level][0][n], torch.from_numpy(total), rtol=0, atol=1e-12)
            torch.testing.assert_close(got[level][1][n, 0], torch.from_numpy(radius), rtol=0, atol=1e-12)


@given(st.integers(1, 40), st.integers(1, 40), st.integers(0, 5), st.booleans())
@few
def test_every_level_keeps_its_total(h: int, w: int, highest: int, double: bool) -> None:
    dtype = F64 if double else F32
    values, coc = noise(1, 2, h, w, seed=h).to(dtype), radii(1, h, w, 300.0, seed=w).to(dtype)
    shares = level_shares(values, coc, COARSE, highest)
    levels = merge_cells(values, coc, shares)
    for level, (share, (cells, radius)) in enumerate(zip(shares, levels, strict=True)):
        assert cells.shape[2:] == radius.shape[2:] == (math.ceil(h / 2**level), math.ceil(w / 2**level))
        torch.testing.assert_close(cells.sum((2, 3)), (share * values).sum((2, 3)), rtol=1e-5, atol=1e-5)
    whole = sum(cells.double().sum((2, 3)) for cells, _ in levels)
    torch.testing.assert_close(whole, values.double().sum((2, 3)), rtol=1e-5, atol=1e-5)


def test_a_cell_has_the_radius_of_its_pixels_in_cells() -> None:
    values = noise(1, 1, 8, 8)
    for level, radius in ((1, 10.0), (2, -20.0), (3, 40.0)):
        shares = [torch.full_like(values, float(k == level)) for k in range(4)]
        _, got = merge_cells(values, torch.full_like(values, radius), shares)[level]
        want = math.copysign(round_radius(math.sqrt((radius / 2**level) ** 2 - SPREAD)), radius)
        torch.testing.assert_close(got, torch.full_like(got, want), rtol=1e-14, atol=0)


def test_the_sign_of_a_cell_is_the_one_that_prevails() -> None:
    coc = torch.full((1, 1, 4, 4), 10.0, dtype=F64)
    coc[..., :2, :2] = torch.tensor([[9.0, -10.0], [-10.0, 10.0]])
    coc[..., 2:, :2] = torch.tensor([[9.0, 10.0], [-10.0, -9.5]])
    _, radius = merge_cells(torch.ones_like(coc), coc, shares_of(coc, Merging(4, 1e6), 1).unbind())[1]
    assert radius.sign()[0, 0].tolist() == [[-1, 1], [-1, 1]]
    assert radius.abs()[0, 0, 0, 1].item() == pytest.approx(round_radius(math.sqrt(25 - SPREAD)), rel=1e-14)
    empty = merge_cells(torch.ones_like(coc), torch.zeros_like(coc), shares_of(torch.zeros_like(coc)).unbind())[2]
    assert torch.equal(empty[0], torch.zeros_like(empty[0]))
    assert torch.equal(empty[1], torch.full_like(empty[1], 0.5))


# Interpolation.


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (6, 1), (5, 8)])
def test_interpolation_keeps_the_total_and_is_never_negative(size: tuple[int, int]) -> None:
    coarse = noise(2, 3, *size)
    fine = upsample(coarse)
    assert fine.shape == (2, 3, 2 * size[0], 2 * size[1])
    torch.testing.assert_close(fine.sum((2, 3)), 4 * coarse.sum((2, 3)))
    assert fine.min() >= coarse.min()
    assert fine.max() <= coarse.max()
    assert torch.equal(upsample(torch.ones_like(coarse)), torch.ones_like(fine))


def test_ramps_are_met_exactly() -> None:
    y, x = torch.meshgrid(*[torch.arange(14, dtype=F64)] * 2, indexing="ij")
    ramp = 0.3 + 1.7 * x - 0.4 * y + 0.05 * x * y
    got = upsample(F.avg_pool2d(ramp[None, None], 2))[0, 0]
    torch.testing.assert_close(got[1:-1, 1:-1], ramp[1:-1, 1:-1], rtol=1e-12, atol=1e-12)


def test_interpolation_is_linear_and_looks_no_further_than_one_cell() -> None:
    one, other = noise(1, 2, 6, 7), noise(1, 2, 6, 7, seed=1)
    torch.testing.assert_close(upsample(2 * one - 3 * other), 2 * upsample(one) - 3 * upsample(other))
    dot = torch.zeros(1, 1, 9, 9, dtype=F64)
    dot[..., 4, 4] = 1
    halves = torch.tensor([0, 0, 0, 0, 0, 0, 0, 1, 3, 3, 1, 0, 0, 0, 0, 0, 0, 0], dtype=F64) / 4
    torch.testing.assert_close(upsample(dot)[0, 0], halves[:, None] * halves)


def test_the_gradient_of_interpolation_is_its_transpose() -> None:
    coarse, fine = noise(1, 1, 4, 5).requires_grad_(), noise(1, 1, 8, 10, seed=1)
    out = upsample(coarse)
    (back,) = torch.autograd.grad(out, coarse, fine)
    assert float((back * coarse.detach()).sum()) == pytest.approx(float((out.detach() * fine).sum()))
    assert torch.autograd.gradcheck(upsample, (coarse,))


# The whole, for any PSF.


def slow_upsample(coarse: np.ndarray) -> np.ndarray:
    """`upsample` of ``(h, w)``: the line through the centres of two cells, at the quarter point next to each."""

    def along(lines: np.ndarray) -> np.ndarray:
        n = lines.shape[1]
        places = (np.arange(2 * n) + 0.5) / 2 - 0.5
        return np.stack([np.interp(places, np.arange(n), line) for line in lines])

    return along(along(coarse).T).T


@pytest.mark.parametrize("size", [(8, 16), (13, 11), (1, 40), (3, 2)])
def test_levels_are_interpolated_and_added_in_their_places(size: tuple[int, int]) -> None:
    """A splat that blurs by a hat of three cells, against an independent sum over levels without margins to crop."""
    values, coc, highest = noise(1, 1, *size), radii(1, *size), 3
    hat = torch.tensor([1.0, 2.0, 1.0], dtype=F64) / 4

    def blur(v: Tensor, r: Tensor) -> Tensor:
        return F.conv2d(v, (hat[:, None] * hat)[None, None], padding=1)

    want = np.zeros(size)
    wide = 6 * 2**highest  # far enough for nothing to depend on what lies beyond
    for level, (cells, _) in enumerate(merge_cells(values, coc, level_shares(values, coc, MIDDLE, highest))):
        border = wide >> level
        picture = blur(F.pad(cells, (border,) * 4), cells)[0, 0].numpy()
        if level == 0:
            want += picture[border : border + size[0], border : border + size[1]]
            continue
        for _ in range(level):
            picture = slow_upsample(picture) / 4
        want += picture[wide : wide + size[0], wide : wide + size[1]]
    got = merged(values, coc, blur, MIDDLE, highest)
    torch.testing.assert_close(got[0, 0], torch.from_numpy(want), rtol=0, atol=1e-12)


def test_every_level_is_splatted_once_with_its_margin_and_its_radii() -> None:
    values, coc = noise(1, 2, 37, 50), radii(1, 37, 50)
    seen = []

    def splat(v: Tensor, r: Tensor) -> Tensor:
        seen.append((tuple(v.shape), tuple(r.shape), float(r.abs().max())))
        return v

    merged(values, coc, splat, PLAIN, 2)
    sizes = [(37, 50), (19 + 2 * MARGIN, 25 + 2 * MARGIN), (10 + 2 * MARGIN, 13 + 2 * MARGIN)]
    assert sorted(s[:2] for s in seen) == sorted(((1, 2, *s), (1, 1, *s)) for s in sizes)
    for shape, _, largest in seen:
        level = sizes.index(shape[2:])
        assert largest <= (PLAIN.cells * 2 * (1 + FADE) if level < 2 else 15) * (1 + 3e-4)
