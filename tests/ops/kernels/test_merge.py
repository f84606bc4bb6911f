import math
import tracemalloc
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.nn import functional as F
from torch.utils.data import DataLoader, Dataset

from torchbokeh.ops.kernels import merge_gather
from torchbokeh.ops.kernels.merge import bank_for
from torchbokeh.ops.kernels.merge_collect import RECORD, Lanes, Levels, Picture, collect
from torchbokeh.ops.merge import MARGIN, SPREAD, Merging, level_shares, merge_cells, splat_merged, upsample
from torchbokeh.ops.system.threads import recorded, run_all, stage
from torchbokeh.psfs import Aperture, Disc, Polygon

F32, F64 = torch.float32, torch.float64
MIDDLE, COARSE = Merging(4, 0.015), Merging(2.5, 0.03)


def scene(b: int, c: int, h: int, w: int, reach: float = 60.0, seed: int = 1) -> tuple[Tensor, Tensor]:
    """Values with a few highlights, and CoC of both signs, with radii from 0 up to ``reach``: float32."""
    draw = torch.Generator().manual_seed(seed + 1000 * b + 100 * c + h)
    values = torch.rand(b, c, h, w, generator=draw)
    bright = torch.rand(b, 1, h, w, generator=draw) < 0.01
    radius = reach ** torch.empty(b, 1, h, w).uniform_(-0.3, 1, generator=draw)
    sign = torch.randint(0, 2, radius.shape, generator=draw) * 2 - 1
    radius = torch.where(torch.rand(radius.shape, generator=draw) < 0.05, 0.0, radius)
    # Where a PSF just touches a row, at 1.5, 2.5, ... px, its derivative jumps, and either side is right.
    radius = torch.where((radius % 1 - 0.5).abs() < 1 / 64, radius + 1 / 32, radius)
    return torch.where(bright, 200 * values, values), radius * sign


def weights(like: Tensor) -> Tensor:
    """Weights of 0 and between 0 and 1 for CoC of this shape; in some rows there are none."""
    draw = torch.Generator().manual_seed(like.shape[2])
    weight = (2 * torch.rand(like.shape, generator=draw) - 0.8).clamp(0, 1)
    weight[..., 3:9, :] = 0
    weight[..., 11:, : like.shape[3] // 3] = 0
    return weight


def seed_for(out: Tensor) -> Tensor:
    return torch.randn(out.shape, generator=torch.Generator().manual_seed(3))


def results(values: Tensor, coc: Tensor, *args: Any, weight: Tensor | None = None, **kinds: Any) -> tuple[Tensor, ...]:
    """The picture, and the gradients of ``values``, ``coc`` and ``weight``."""
    inputs = [t.detach().requires_grad_() for t in (values, coc, weight) if t is not None]
    out = splat_merged(*inputs[:2], *args, weight=inputs[2] if len(inputs) > 2 else None, **kinds)
    return out.detach(), *torch.autograd.grad(out, inputs, seed_for(out).to(out.dtype))


def assert_close(got: Tensor, want: Tensor, relative: float) -> None:
    got, want = got.detach().double(), want.detach().double()
    torch.testing.assert_close(got, want, rtol=0, atol=relative * float(want.abs().max()))


def assert_same_function(
    values: Tensor, coc: Tensor, *args: Any, weight: Tensor | None = None, relative: float = 2e-6, **kinds: Any
) -> None:
    """The kernel in float32 against the torch definition in float64: picture and gradients.

    A mean radius close to half a step may be rounded one way in float32 and the other way in float64. One cell in some
    thousand is such a one, which moves its light by a step: so one value in a hundred may be off by 1e-4.
    """
    got, want = (
        results(values.to(t), coc.to(t), *args, weight=None if weight is None else weight.to(t), **kinds)
        for t in (F32, F64)
    )
    for mine, theirs in zip(got, want, strict=True):
        if mine.shape == coc.shape and weight is not None:  # pixels without weight get no gradient
            mine, theirs = (t * (weight > 0) for t in (mine, theirs))
        assert (mine.dtype, theirs.dtype) == (F32, F64)
        assert mine.isfinite().all()
        off = (mine.double() - theirs).abs() / theirs.abs().max().clamp_min(1e-300)
        assert off.max() <= max(1e-4, relative)
        assert (off > relative).sum() <= 0.01 * off.numel()


# The same function as the torch definition.


@pytest.mark.parametrize("channels", [1, 2, 3, 4, 5, 8])
@pytest.mark.parametrize(("ones", "normalise"), [(False, False), (True, False), (False, True), (True, True)])
def test_the_kernel_computes_what_the_torch_definition_does(channels: int, ones: bool, normalise: bool) -> None:
    values, coc = scene(2, channels, 47, 41)
    if normalise and not ones:
        values[:, -1] = values[:, -1] * 0.5 + 0.5
    assert_same_function(values, coc, Polygon(6, 0.3).profile(), MIDDLE, ones=ones, normalise=normalise)


@pytest.mark.parametrize("channels", [1, 3, 4, 5])
@pytest.mark.parametrize(("ones", "normalise"), [(False, False), (True, False), (True, True)])
def test_weight_is_taken_as_in_the_definition(channels: int, ones: bool, normalise: bool) -> None:
    values, coc = scene(2, channels, 65, 41)
    weight = weights(coc)
    if normalise:  # where nothing is covered, the result is divided by next to nothing
        weight = weight.clamp_min(0.1)
    args = (values, coc, Polygon(5, 0.3).profile(), MIDDLE)
    assert_same_function(*args, weight=weight, ones=ones, normalise=normalise)


def test_weight_with_highlights_and_radii_beyond_the_bank(shape: Aperture) -> None:
    values, coc = scene(1, 3, 75, 41, 1e3)
    for highest in (0, 2):
        assert_same_function(values, coc, shape.profile(), MIDDLE, highest=highest, weight=weights(coc), ones=True)


@pytest.mark.parametrize("size", [(130, 31), (35, 71), (200, 1), (1, 200), (150, 3)])
def test_the_kernel_draws_every_shape_at_every_size(shape: Aperture, size: tuple[int, int]) -> None:
    assert_same_function(*scene(1, 3, *size), shape.profile(), COARSE, ones=True, normalise=True)


@pytest.mark.parametrize(("reach", "highest"), [(1e3, 0), (1e3, 1), (1e6, 0), (1e6, None)])
def test_radii_beyond_the_bank_are_drawn_as_well(shape: Aperture, reach: float, highest: int | None) -> None:
    assert_same_function(*scene(1, 3, 75, 34, reach, seed=2), shape.profile(), MIDDLE, highest=highest, ones=True)


@pytest.mark.parametrize("highest", [1, 4, 7])
@pytest.mark.parametrize("size", [(5, 7), (1, 1), (16, 3), (33, 65)])
def test_cells_may_be_larger_than_the_picture(shape: Aperture, size: tuple[int, int], highest: int) -> None:
    values, coc = scene(2, 2, *size, 900.0)
    assert_same_function(values.clamp_max(1), coc, shape.profile(), COARSE, highest=highest)


@pytest.mark.parametrize("cells", [0.2, 1.0, 10.0])
@pytest.mark.parametrize("highest", [None, 0])
def test_cells_of_any_size_serve(cells: float, highest: int | None) -> None:
    args = (*scene(1, 3, 66, 50), Polygon(5).profile(), Merging(cells, 0.1))
    assert_same_function(*args, highest=highest, ones=True)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("radius", [0.3, 6.0, 8.5, 25.0, 44.3])
def test_one_radius_for_the_whole_picture(sign: int, radius: float) -> None:
    values, coc = scene(1, 3, 66, 70)
    assert_same_function(values, torch.full_like(coc, sign * radius), Polygon(5).profile(), MIDDLE, ones=True)


def test_highlights_are_drawn_by_themselves() -> None:
    values, coc = scene(1, 3, 100, 90)
    values[:, 1, 20:80:7, 10:80:9] = -3e3
    shares = level_shares(values.double(), coc.double(), MIDDLE, 2)
    assert int(((shares[0] == 1) & (coc.abs() > 9)).sum()) > 20
    assert_same_function(values, coc, Polygon(5).profile(), MIDDLE, ones=True)


def test_values_of_either_sign_and_rows_of_nothing() -> None:
    values, coc = scene(1, 4, 90, 61)
    values -= 0.5
    values[:, :, 20:50] = 0
    values[:, :, :, :9] = 0
    assert_same_function(values, coc, Polygon(5).profile(), MIDDLE)
    nothing = results(torch.zeros_like(values), coc, Disc().profile(), MIDDLE)
    assert torch.equal(nothing[0], torch.zeros_like(values))


def test_the_adjoint_is_the_transpose(shape: Aperture) -> None:
    values, coc = scene(1, 3, 90, 61)
    values = values.clamp_max(1)  # a highlight would be one in the picture, but not in its gradient
    out, back, _ = results(values, coc, shape.profile(), MIDDLE)
    there = float((out.double() * seed_for(out)).sum())
    assert there == pytest.approx(float((values.double() * back).sum()), rel=1e-5)


def test_constant_in_constant_out() -> None:
    coc = scene(2, 1, 111, 93, 80.0)[1]
    out = splat_merged(torch.full((2, 3, 111, 93), 0.7), coc, Disc().profile(), COARSE, ones=True, normalise=True)
    assert float((out[:, :3] - 0.7).abs().max()) < 1e-5


# Bits.


def test_same_bits_for_any_number_of_threads(shape: Aperture) -> None:
    values, coc = scene(2, 5, 150, 40)
    runs = []
    for count in (1, 2, 3, 2):
        torch.set_num_threads(count)
        plain = results(values, coc, shape.profile(), MIDDLE, ones=True, normalise=True)
        runs.append((*plain, *results(values, coc, shape.profile(), MIDDLE, weight=weights(coc))))
    for other in runs[1:]:
        assert all(torch.equal(a, b) for a, b in zip(runs[0], other, strict=True))


def test_a_batch_equals_its_images_one_by_one() -> None:
    values, coc = scene(3, 5, 50, 44)
    for weight in (None, weights(coc)):
        out = splat_merged(values, coc, Polygon(7).profile(), MIDDLE, highest=1, weight=weight, ones=True)
        for n in range(3):
            mine = (None if t is None else t[n : n + 1] for t in (values, coc, weight))
            v, r, w = mine
            alone = splat_merged(v, r, Polygon(7).profile(), MIDDLE, highest=1, weight=w, ones=True)
            assert torch.equal(out[n : n + 1], alone)


@pytest.mark.parametrize("channels", [3, 5])
def test_a_channel_does_not_look_at_the_others(channels: int) -> None:
    values, coc = scene(1, channels, 50, 44)
    values = values.clamp_max(1)  # no highlights, which are bright in any channel
    together = splat_merged(values, coc, Disc().profile(), MIDDLE)
    for k in range(channels):
        alone = splat_merged(values[:, k : k + 1], coc, Disc().profile(), MIDDLE)
        assert_close(together[:, k : k + 1], alone, 1e-6)


@pytest.mark.parametrize("normalise", [False, True])
def test_the_memory_layout_does_not_matter(normalise: bool) -> None:
    values, coc = scene(2, 3, 40, 50)
    inputs = values, coc, weights(coc).clamp_min(0.1)
    profile = Disc().profile()

    def blur(values: Tensor, coc: Tensor, weight: Tensor) -> Tensor:
        return splat_merged(values, coc, profile, MIDDLE, weight=weight, ones=normalise, normalise=normalise)

    want = results(*inputs[:2], profile, MIDDLE, weight=inputs[2], ones=normalise, normalise=normalise)
    strided = [t.permute(0, 2, 3, 1).contiguous().permute(0, 3, 1, 2) for t in inputs]
    widened = [torch.stack([t, t + 1], -1)[..., 0] for t in inputs]
    for layout in (strided, widened):
        assert not layout[0].is_contiguous()
        out = blur(*(t.requires_grad_() for t in layout))
        seed = seed_for(out).mT.contiguous().mT
        assert not seed.is_contiguous()
        got = (out, *torch.autograd.grad(out, layout, seed))
        assert all(torch.equal(a, b) for a, b in zip(got, want, strict=True))
    # Inputs and a gradient that are one number, expanded.
    flat = [torch.full((), v).expand(t.shape) for v, t in zip((0.3, 13.0, 0.7), inputs, strict=True)]
    assert torch.equal(blur(*flat), blur(*(t.clone() for t in flat)))
    for by_sum, by_ones in zip(
        torch.autograd.grad(blur(*layout).sum(), layout),
        torch.autograd.grad(blur(*layout), layout, torch.ones_like(out)),
        strict=True,
    ):
        assert torch.equal(by_sum, by_ones)


def test_gradients_do_not_depend_on_what_else_is_asked_for() -> None:
    values, coc = scene(2, 3, 40, 50)
    weight = weights(coc)
    _, *all_of_them = results(values, coc, Disc().profile(), MIDDLE, weight=weight)
    for asked, want in zip((values, coc, weight), all_of_them, strict=True):
        asked.requires_grad_()
        out = splat_merged(values, coc, Disc().profile(), MIDDLE, weight=weight)
        assert torch.equal(torch.autograd.grad(out, asked, seed_for(out))[0], want)
        asked.requires_grad_(False)
    assert not splat_merged(values, coc, Disc().profile(), MIDDLE, weight=weight).requires_grad


def test_inputs_are_left_as_they_are() -> None:
    values, coc = scene(1, 3, 40, 50)
    before = values.clone(), coc.clone()
    results(values, coc, Disc().profile(), MIDDLE, ones=True, normalise=True)
    assert torch.equal(values, before[0])
    assert torch.equal(coc, before[1])


# An operator of torch.


def test_operators_keep_the_rules_of_torch() -> None:
    values, coc = (t.requires_grad_() for t in scene(1, 3, 36, 20))
    knots, bulge = Polygon(5).profile()
    weight = weights(coc).clamp_min(0.1).requires_grad_()
    for ones, normalise, factor in ((False, False, None), (True, True, weight)):
        args = (values, coc, factor, [knots, bulge], MIDDLE, 1, ones, normalise)
        torch.library.opcheck(torch.ops.torchbokeh.splat_merged.default, args)
        args = tuple(a.detach() if isinstance(a, Tensor) else a for a in args)
        out = torch.ops.torchbokeh.splat_merged(*args)
        args = (torch.rand_like(out), out if normalise else None, *args[:-2])
        torch.library.opcheck(torch.ops.torchbokeh.gather_merged.default, args)


def test_compiles_to_one_graph_for_any_size() -> None:
    def blur(values: Tensor, coc: Tensor) -> Tensor:
        return splat_merged(values, coc, Polygon(6).profile(), MIDDLE, highest=1, ones=True, normalise=True)

    compiled = torch.compile(blur, backend="aot_eager", fullgraph=True, dynamic=True)
    for size in ((35, 36), (37, 50)):
        values, coc = (t.requires_grad_() for t in scene(1, 3, *size, 12.0))
        outs = [f(values, coc) for f in (blur, compiled)]
        assert_close(outs[1], outs[0], 1e-6)
        seed = seed_for(outs[0])
        for mine, theirs in zip(*(torch.autograd.grad(o, (values, coc), seed) for o in outs), strict=True):
            assert_close(mine, theirs, 1e-6)


class Blurred(Dataset[Tensor]):
    """Samples that are splatted, and their gradients, where they are loaded."""

    def __len__(self) -> int:
        return 4

    def __getitem__(self, k: int) -> Tensor:
        parts = results(*scene(1, 3, 40 + 20 * k, 36), Disc().profile(), MIDDLE, ones=True)
        return torch.cat([t.flatten() for t in parts])


@pytest.mark.filterwarnings("ignore:.*multi-threaded.*fork.*:DeprecationWarning")
def test_works_in_forked_workers_after_the_parent_has_used_it() -> None:
    torch.set_num_threads(2)
    data = Blurred()
    here = [data[k] for k in range(len(data))]
    there = list(DataLoader(data, batch_size=None, num_workers=2, multiprocessing_context="fork", timeout=60))
    assert len(there) == len(here)
    assert all(torch.equal(a, b) for a, b in zip(here, there, strict=True))


# Extremes.


@pytest.mark.parametrize("radius", [0.0, 3.3, 9.0, 20.0, 40.0])
def test_a_highlight_leaves_no_trace_on_its_rows(shape: Aperture, radius: float) -> None:
    dot = torch.zeros(1, 4, 40, 300)
    dot[..., 20, 40] = 1e6
    out = splat_merged(dot, torch.full((1, 1, 40, 300), radius), shape.profile(), MIDDLE)
    assert float(out[..., 110:].abs().max()) < 1e-9 * float(out.max())
    # What is left is rounding of the row's own ends: it does not grow along the row.
    assert float((out[..., -1] - out[..., 110]).abs().max()) < 1e-10 * float(out.max())


@pytest.mark.parametrize("radius", [3.3, 20.0])
def test_a_highlight_does_not_drown_what_lies_beside_it(radius: float) -> None:
    values, coc = scene(1, 4, 64, 300)
    values = values.clamp_max(1)
    values[..., 20, 40] = 1e6
    coc[..., 20, 40] = radius
    out, want = (splat_merged(values.to(t), coc.to(t), Disc().profile(), MIDDLE)[..., 140:] for t in (F32, F64))
    assert_close(out, want, 2e-6)


@pytest.mark.parametrize("bad", [math.inf, -math.inf, math.nan])
def test_a_value_that_is_no_number_spoils_no_gradient_but_its_own_cell(bad: float) -> None:
    values, coc = scene(1, 3, 130, 60)
    values[0, 1, 60, 30] = bad
    coc[0, 0, 60, 30] = 20.0
    values.requires_grad_()
    coc.requires_grad_()
    out = splat_merged(values, coc, Disc().profile(), MIDDLE)
    by_values, by_coc = torch.autograd.grad(out, (values, coc), seed_for(out))
    assert by_values.isfinite().all()  # the splat is linear in them
    spoilt = (~by_coc[0, 0].isfinite()).nonzero()
    assert 1 <= len(spoilt) <= 16
    assert (spoilt // 4 == torch.tensor([15, 7])).all()


# The first pass: cells, highlights, reach.


def collected(values: Tensor, coc: Tensor, highest: int, group: int = 0, weight: Tensor | None = None) -> Levels:
    lanes = Lanes.of(group, values.shape[1], True)
    return collect(Picture.each(values, coc, weight)[0], lanes, MIDDLE, highest)


@pytest.mark.parametrize("size", [(100, 70), (129, 31), (3, 5)])
@pytest.mark.parametrize("channels", [3, 5])
@pytest.mark.parametrize("weighted", [False, True])
def test_cells_are_those_of_the_definition(size: tuple[int, int], channels: int, weighted: bool) -> None:
    highest = 3
    values, coc = scene(1, channels, *size)
    weight = weights(coc) if weighted else None
    double = None if weight is None else weight.double()
    shares = level_shares(values.double(), coc.double(), MIDDLE, highest, double)
    whole = torch.cat([values.double(), torch.ones_like(coc).double(), torch.zeros(1, 7, *size, dtype=F64)], 1)
    want = merge_cells(whole, coc.double(), shares, double)
    for group in range(-(-(channels + 1) // 4)):
        levels = collected(values, coc, highest, group, weight)
        for level in range(1, highest + 1):
            rows, columns, first = levels.sizes[level]
            records = levels.cells[RECORD * first : RECORD * (first + rows * columns)].reshape(rows, columns, RECORD)
            cells, radius = want[level]
            assert (rows, columns) == cells.shape[2:]
            assert_close(torch.from_numpy(records[..., :4]).movedim(2, 0), cells[0, 4 * group : 4 * group + 4], 1e-6)
            with np.errstate(invalid="ignore"):
                mean = np.nan_to_num(records[..., 5] / records[..., 4]) / 2**level
            smaller = np.sqrt(np.maximum(mean**2 - SPREAD, 0.25)) * np.where(records[..., 6] < 0, -1, 1)
            # Half a step, which is widest for large cells.
            np.testing.assert_allclose(smaller, radius[0, 0], rtol=5e-4, atol=1e-6)
    assert levels.cells.dtype == np.float32


def test_highlights_are_noted_and_rows_know_their_reach() -> None:
    highest = 2
    values, coc = scene(1, 3, 100, 70)
    radius = coc[0, 0].abs()
    shares = torch.stack(level_shares(values, coc, MIDDLE, highest))[:, 0, 0]
    levels = collected(values, coc, highest)
    merged_without = torch.stack(level_shares(torch.ones_like(values), coc, MIDDLE, highest))[:, 0, 0]
    lowest = merged_without[0]
    lit = torch.where(lowest < 1, (shares[0] - lowest) / (1 - lowest), 0.0)
    lit = torch.where(lit > 1e-6, lit, 0.0)
    assert levels.marks.tolist() == lit.flatten().nonzero()[:, 0].tolist()
    assert_close(torch.from_numpy(levels.lit), lit[lit > 0], 1e-5)
    assert int((lit == 1).sum()) > 5
    for level in range(highest + 1):
        used = torch.where((merged_without[level] > 0) & (lit < 1), radius, 0)
        rows = F.pad(used, (0, 0, 0, -100 % 2**level)).reshape(-1, 2**level, 70).amax((1, 2))
        assert levels.reach[level, : len(rows)].tolist() == rows.tolist()
    # A row of which nothing is on the lowest level.
    assert collected(values.clamp_max(1), torch.full_like(coc, 12.0), 1).reach[0].max() < 0


@pytest.mark.parametrize("weighted", [False, True])
def test_black_pixels_count_in_the_mean(weighted: bool) -> None:
    values, coc = scene(1, 3, 100, 70)
    values[..., 20:90, :] = 0
    values[:, 1] = 0
    weight = weights(coc) if weighted else None
    counted = torch.ones_like(coc) if weight is None else weight
    want = (values * counted).sum((0, 2, 3)) / counted.sum()
    np.testing.assert_allclose(collected(values, coc, 2, weight=weight).thresholds.means, want, rtol=1e-5)


BYTES = {"collect": 20, "forward": 24, "backward": 80}
"""Most bytes per pixel that numpy holds at a time, for each pass of four channels; see below what they are for."""


def test_memory_is_bounded() -> None:
    """Bytes per pixel beside inputs and outputs.

    * `collect`: cells of 32 bytes, a third of the pixels (10.7), and numbers of highlights (8).
    * Forward: these cells; level 1 and 2 (4 + 1); one band per thread, which does not grow with the height.
    * Backward: incoming gradient (16), cells and theirs (21), level 1 and its sums in double (4 + 8) or the sums of
      the picture in double (32, and the reach of the bank at either end).
    """
    h, w = 512, 640
    values, coc = scene(1, 3, h, w)
    coc = (coc.sign() * (coc.abs() + 30)).clamp(-60, 60)  # most of it merged
    coc[..., :200] = 3.0
    profile = Disc().profile()
    peaks = {}
    results(values[..., :64, :64], coc[..., :64, :64], profile, MIDDLE, ones=True)  # compile first

    def peak(name: str, work: Callable[[], Any]) -> Any:
        tracemalloc.start()
        try:
            done = work()
            peaks[name] = tracemalloc.get_traced_memory()[1] / (h * w)
        finally:
            tracemalloc.stop()
        return done

    levels = peak("collect", lambda: collected(values, coc, 3))
    out = peak("forward", lambda: splat_merged(values.requires_grad_(), coc, profile, MIDDLE, ones=True))
    peak("backward", lambda: out.sum().backward())
    assert all(1 < peaks[k] < BYTES[k] for k in BYTES), peaks
    kept = sum(array.nbytes for array in (levels.thresholds.means, *levels[1:]))
    assert kept < 12 * h * w


@pytest.mark.parametrize("margin", [0, MARGIN])
@pytest.mark.parametrize("size", [(1, 1), (9, 14), (64, 3), (131, 7)])
def test_gradients_go_down_a_level_by_the_transpose_of_the_interpolation(size: tuple[int, int], margin: int) -> None:
    h, w = size
    fine = torch.randn(h + 2 * margin, w + 2 * margin, 4, generator=torch.Generator().manual_seed(h))
    coarse = torch.zeros(1, 4, -(-h // 2) + 2 * MARGIN, -(-w // 2) + 2 * MARGIN, requires_grad=True)
    start = 2 * MARGIN - margin
    up = upsample(coarse)[..., start : start + fine.shape[0], start : start + fine.shape[1]] / 4
    (want,) = torch.autograd.grad(up, coarse, fine.movedim(2, 0)[None])
    got = np.full((*coarse.shape[2:], 4), np.nan, np.float32)
    for y0, y1 in ((0, 3), (3, len(got))):
        merge_gather._down(fine.numpy(), margin, got, y0, y1)
    assert_close(torch.from_numpy(got).movedim(2, 0), want[0], 1e-6)


# Work in pieces, and its time.


def test_stages_are_recorded_on_request() -> None:
    values, coc = scene(1, 3, 70, 50)

    def forward_and_backward() -> None:
        results(values, coc, Disc().profile(), MIDDLE)

    with recorded() as seconds:
        forward_and_backward()
        assert {"bank", "collect", "levels", "picture", "sums", "gather cells", "gather pixels"} <= set(seconds)
        assert all(s >= 0 for s in seconds.values())
        before = dict(seconds)
        forward_and_backward()
        assert set(seconds) == set(before)
        assert all(seconds[k] > before[k] for k in before)
    before = dict(seconds)
    forward_and_backward()
    assert seconds == before


def test_recordings_may_be_nested_and_end_with_an_error() -> None:
    done: list[int] = []
    with recorded() as outer:
        run_all(done.append, [(1,), (2,)], "one")
        with recorded() as inner, stage("two"):
            run_all(done.append, [(3,)])
        with pytest.raises(ZeroDivisionError), recorded():
            run_all(lambda k: 1 / k, [(0,)])
        run_all(done.append, [(4,)], "three")
    assert set(outer) == {"one", "three"}
    assert set(inner) == {"two", "other"}
    run_all(done.append, [(5,)], "later")
    assert "later" not in outer | inner
    assert done == [1, 2, 3, 4, 5]


@pytest.mark.parametrize("threads", [1, 2])
def test_an_error_in_a_piece_of_work_is_passed_on(threads: int) -> None:
    torch.set_num_threads(threads)
    with pytest.raises(ZeroDivisionError):
        run_all(lambda k: 1 / k, [(1,), (0,), (2,)])


@pytest.mark.parametrize("dtype", [F32, F64])
@pytest.mark.parametrize("radius", [3.0, 12.0])
def test_what_has_no_weight_may_be_no_number(dtype: torch.dtype, radius: float) -> None:
    values, coc = torch.rand(1, 3, 60, 60, dtype=dtype), torch.full((1, 1, 60, 60), radius, dtype=dtype)
    weight = torch.ones_like(coc)
    weight[..., 30, 30] = 0
    clean = splat_merged(values, coc, Disc().profile(), MIDDLE, weight=weight, ones=True)
    values[..., 30, 30] = math.nan
    leaves = [t.clone().requires_grad_() for t in (coc, weight)]
    out = splat_merged(values, leaves[0], Disc().profile(), MIDDLE, weight=leaves[1], ones=True)
    assert torch.equal(out.detach(), clean)
    assert all(g.isfinite().all() for g in torch.autograd.grad(out.sum(), leaves))


def test_the_bank_stays_small_where_nothing_is_to_be_merged() -> None:
    values, coc = scene(1, 3, 60, 50, 40.0)
    huge = MIDDLE._replace(cells=1000.0)
    bank = bank_for(Disc().profile(), huge, slopes=True)
    assert sum(t.nbytes for t in (bank.firsts, bank.ends, *bank.points)) < 2**25
    got, want = (
        splat_merged(v, c, Disc().profile(), huge) for v, c in ((values, coc), (values.double(), coc.double()))
    )
    assert_close(got, want, 2e-6)


def test_float32_under_another_default() -> None:
    values, coc = scene(1, 3, 40, 30)
    torch.set_default_dtype(F64)
    try:
        results_of = results(values, coc, Disc().profile(), MIDDLE, ones=True)
    finally:
        torch.set_default_dtype(F32)
    assert all(t.dtype == F32 for t in results_of)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"merging": MIDDLE._replace(cells=0.0)}, "merging: expected cells above 0"),
        ({"merging": MIDDLE._replace(cells=-1.0)}, "merging: expected cells above 0"),
        ({"merging": MIDDLE._replace(highlight=math.nan)}, "merging: expected cells above 0"),
        ({"highest": -1}, "highest: expected at least 0, got -1"),
        ({"coc": torch.full((1, 1, 8, 9), math.inf)}, "coc: expected finite radii, got one of inf"),
        ({"coc": torch.full((1, 1, 8, 9), math.nan)}, "coc: expected finite radii, got one of nan"),
    ],
)
def test_bad_settings_are_named(change: dict[str, Any], message: str) -> None:
    arguments = {"values": torch.rand(1, 3, 8, 9), "coc": torch.ones(1, 1, 8, 9), "merging": MIDDLE, **change}
    with pytest.raises(ValueError, match=message):
        splat_merged(profile=Disc().profile(), **arguments)
