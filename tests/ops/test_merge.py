import doctest
import importlib.util
import math
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.func import functional_call
from torch.nn import functional as F

import torchbokeh.ops.merge
from torchbokeh.ops import dispatch
from torchbokeh.ops.highlights import LEAST_CONTRAST
from torchbokeh.ops.integrate import running_sum_x
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
    splat_merged,
    upsample,
)
from torchbokeh.ops.spans import Profile
from torchbokeh.ops.splat import PointTable, splat_points, splat_spans
from torchbokeh.psfs import Aperture, Disc, Ellipse, Polygon

F32, F64 = torch.float32, torch.float64
FINE, MIDDLE, COARSE = Merging(8, 0.005), Merging(4, 0.015), Merging(2.5, 0.03)
PLAIN = Merging(4, 1e6)
"""Merging in which nothing is a highlight."""

SHAPES = {
    "disc": Disc(),
    "ellipse": Ellipse(1.8, 0.5),
    "hexagon": Polygon(6, 0.3),
    "square": Polygon(4, math.pi / 4),
}
few = settings(deadline=None, max_examples=20)


def draw(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def noise(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(shape, generator=draw(seed), dtype=F64)


def radii(b: int, h: int, w: int, reach: float = 60.0, seed: int = 1) -> Tensor:
    """CoC of both signs, its radius evenly spread over the magnitudes from 0.3 up to ``reach``."""
    radius = reach ** torch.empty(b, 1, h, w, dtype=F64).uniform_(-0.3, 1, generator=draw(seed))
    return radius * (torch.randint(0, 2, radius.shape, generator=draw(seed + 1)) * 2 - 1)


def smooth(*shape: int, width: float, seed: int = 0) -> Tensor:
    """Noise without detail finer than about ``width`` px, from 0 to 1."""
    h, w = shape[-2:]
    square = torch.fft.fftfreq(h, dtype=F64)[:, None] ** 2 + torch.fft.rfftfreq(w, dtype=F64) ** 2
    waves = torch.fft.rfft2(torch.randn(shape, generator=draw(seed), dtype=F64)) * (-square * width**2).exp()
    picture = torch.fft.irfft2(waves, s=(h, w))
    return (picture - picture.amin()) / (picture.amax() - picture.amin())


def exact(values: Tensor, coc: Tensor, shape: Aperture) -> Tensor:
    """Without merging, in float32: far more exact than merging is, and faster than in float64."""
    return splat_spans(values.float(), coc.float(), shape.profile(), integrate=True).to(values.dtype)


def relative_l1(got: Tensor, want: Tensor) -> float:
    return float((got - want).abs().sum() / want.abs().sum())


def assert_close(got: Tensor, want: Tensor, relative: float) -> None:
    got, want = got.detach().double(), want.detach().double()
    torch.testing.assert_close(got, want, rtol=0, atol=relative * float(want.abs().max()))


def shares_of(coc: Tensor, merging: Merging = PLAIN, highest: int = 4) -> Tensor:
    """Shares ``(L+1, B, 1, H, W)`` of a picture of ones."""
    return torch.stack(level_shares(torch.ones_like(coc), coc, merging, highest))


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


# Edge cases.


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


# Gradients.


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
