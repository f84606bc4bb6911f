"""Surfaces in bins: the fused kernels against the torch definition, and the definition against mathematics."""

import doctest

import pytest
import torch
from torch import Tensor

import torchbokeh.ops.composite
from torchbokeh.ops.composite import bin_weights, fill_until_full
from torchbokeh.ops.merge import Merging, highest_level, splat_merged
from torchbokeh.ops.surface import BLEND, blur_surface
from torchbokeh.psfs import Disc, Polygon

MERGINGS = (Merging(8.0, 0.005), Merging(2.5, 0.03))
CENTRES = ((5.0,), (-20.0, 20.0), (-20.0, 0.0, 20.0))


def scene(b: int, c: int, h: int, w: int) -> tuple[Tensor, Tensor, Tensor]:
    seed = torch.Generator().manual_seed(h * 100 + c)
    colour = torch.rand(b, c, h, w, generator=seed)
    coc = (torch.rand(b, 1, h, w, generator=seed) * 2 - 1) * 160
    coc = torch.nn.functional.avg_pool2d(coc, 9, 1, 4)
    weight = (torch.rand(b, 1, h, w, generator=seed) * 1.3 - 0.3).clamp_min(0)
    weight[:, :, : h // 3] = 0
    return colour, coc, weight


def highest(coc: Tensor, merging: Merging) -> int:
    return highest_level(float(coc.abs().max()), (coc.shape[2], coc.shape[3]), merging)


@pytest.mark.parametrize("centres", CENTRES)
@pytest.mark.parametrize("merging", MERGINGS)
@pytest.mark.parametrize("covered", [False, True])
@pytest.mark.parametrize("shape", [Disc(), Polygon(5)], ids=["disc", "pentagon"])
@pytest.mark.parametrize("size", [(1, 3, 90, 131), (2, 1, 130, 40), (1, 2, 7, 5)])
def test_kernel_equals_definition(
    size: tuple[int, int, int, int], shape: Disc, covered: bool, merging: Merging, centres: tuple[float, ...]
) -> None:
    colour, coc, weight = scene(*size)
    profile, top = shape.profile(), highest(coc, merging)
    got, want = (
        blur_surface(colour.to(t), weight.to(t) if covered else None, coc.to(t), centres, profile, merging, top)
        for t in (torch.float32, torch.float64)
    )
    torch.testing.assert_close(got[1], want[1].float(), rtol=0, atol=1e-5)
    # A colour is a quotient, so it counts where there is some coverage.
    inside = (want[1] > 1e-3).float()
    # Single cells may round their mean radius to the other side.
    difference = ((got[0] - want[0].float()) * inside).abs()
    assert difference.max() < 2e-3
    assert difference.mean() < 1e-6


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_any_number_of_threads_gives_the_same_bits(threads: int) -> None:
    colour, coc, weight = scene(1, 3, 140, 90)
    arguments = (colour, weight, coc, CENTRES[2], Disc().profile(), MERGINGS[1], 3)
    want = blur_surface(*arguments)
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        got = blur_surface(*arguments)
    finally:
        torch.set_num_threads(before)
    assert torch.equal(got[0], want[0])
    assert torch.equal(got[1], want[1])


def test_a_batch_is_its_pictures_one_by_one() -> None:
    colour, coc, weight = scene(3, 3, 70, 60)
    rest = (CENTRES[2], Disc().profile(), MERGINGS[1], 2)
    whole = blur_surface(colour, weight, coc, *rest)
    for n in range(3):
        one = slice(n, n + 1)
        part = blur_surface(colour[one], weight[one], coc[one], *rest)
        assert torch.equal(part[0], whole[0][one])
        assert torch.equal(part[1], whole[1][one])


def test_gradients_take_the_definition() -> None:
    colour, coc, weight = scene(1, 3, 60, 50)
    leaves = [t.clone().requires_grad_() for t in (colour, weight, coc)]
    settings = (CENTRES[2], Disc().profile(), MERGINGS[1], 2)
    out = blur_surface(*leaves, *settings)
    without = blur_surface(colour, weight, coc, *settings)
    torch.testing.assert_close(out[0].detach() * out[1].detach(), without[0] * without[1], atol=1e-4, rtol=0)
    seed = torch.Generator().manual_seed(1)
    (out[0] * out[1] * torch.rand(out[0].shape, generator=seed)).sum().backward()
    assert all(leaf.grad is not None and leaf.grad.isfinite().all() and leaf.grad.any() for leaf in leaves)


def test_one_bin_is_the_merged_splat() -> None:
    colour, coc, weight = scene(1, 3, 80, 70)
    mean, coverage = blur_surface(colour, weight, coc, (0.0,), Disc().profile(), MERGINGS[1], 2)
    splat = splat_merged(colour, coc, Disc().profile(), MERGINGS[1], highest=2, weight=weight, ones=True)
    # Interpolation between cells overshoots a little where coverage ends; bins count from 0 on.
    torch.testing.assert_close(coverage, splat[:, 3:].clamp_min(0), atol=1e-6, rtol=0)
    covered = (coverage > 1e-3).expand_as(mean)
    torch.testing.assert_close((mean * coverage)[covered], splat[:, :3][covered], atol=1e-5, rtol=0)


@pytest.mark.parametrize("blend", [1.0, BLEND])
def test_bin_weights_sum_to_one_and_bins_far_away_get_nothing(blend: float) -> None:
    coc = torch.linspace(-50, 50, 1001)[None, None, None]
    centres = (-30.0, -10.0, 10.0, 30.0)
    weights = bin_weights(coc, centres, blend)
    torch.testing.assert_close(sum(weights), torch.ones_like(coc))
    for centre, weight in zip(centres, weights, strict=True):
        assert weight.min() >= 0
        assert weight[(coc - centre).abs() < 10 * (1 - blend)].eq(1).all()
        inner = (coc > -30) & (coc < 30) & ((coc - centre).abs() > 10 * (1 + blend) + 1e-3)
        assert weight[inner].eq(0).all()


def test_the_bin_in_front_covers_what_is_behind() -> None:
    colour = torch.zeros(1, 1, 64, 64)
    colour[..., 32:] = 1
    coc = torch.full_like(colour, 20.0)
    coc[..., 32:] = 0
    # A sharp half in front of a blurred one: nothing of what is behind comes through it.
    mean, _ = blur_surface(colour, None, coc, (0.0, 20.0), Disc().profile(), MERGINGS[0], 1)
    assert mean[..., 33:].min() > 0.999
    flat, _ = blur_surface(colour, None, coc, (10.0,), Disc().profile(), MERGINGS[0], 1)
    assert flat[..., 33:40].min() < 0.9


def test_the_bins_of_the_definition_are_those_of_fill_until_full() -> None:
    colour, coc, _ = (t.double() for t in scene(1, 3, 40, 30))
    merging = Merging(1000.0, 1.0)
    mean, total = blur_surface(colour, None, coc, (-20.0, 20.0), Disc().profile(), merging, 0)
    bins = []
    for weight in bin_weights(coc, (-20.0, 20.0), BLEND):
        source = torch.cat([colour * weight, weight], 1)
        splat = torchbokeh.ops.splat.splat_spans(source, coc, Disc().profile(), integrate=True)
        bins.append((splat[:, :3], splat[:, 3:]))
    want = fill_until_full(bins)
    torch.testing.assert_close(mean, want[0], atol=2e-2, rtol=0)  # radii are rounded to 1/64 px
    torch.testing.assert_close(total, want[1], atol=2e-2, rtol=0)


def test_examples() -> None:
    assert doctest.testmod(torchbokeh.ops.composite).failed == 0
