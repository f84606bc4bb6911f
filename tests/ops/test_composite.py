import doctest
import shutil
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

import torchbokeh.ops.composite
from torchbokeh.ops.composite import fill_until_full, pull_push

F32, F64 = torch.float32, torch.float64
SIZES = [(1, 1), (1, 2), (1, 17), (13, 1), (2, 3), (7, 11), (31, 37), (16, 32), (40, 56)]
DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
few = settings(deadline=None, max_examples=30)


def holes(b: int, c: int, h: int, w: int, seed: int, share: float = 0.3) -> tuple[Tensor, Tensor]:
    """Random values with the given share of known pixels, one of them always known."""
    source = torch.Generator().manual_seed(seed)
    values = torch.rand(b, c, h, w, generator=source, dtype=F64) * 4 - 2
    weight = (torch.rand(b, 1, h, w, generator=source, dtype=F64) < share).to(F64)
    weight.flatten(1)[:, seed % (h * w)] = 1
    return values, weight


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("dtype", [F32, F64])
@pytest.mark.parametrize("device", DEVICES)
def test_a_constant_stays_constant(size: tuple[int, int], dtype: torch.dtype, device: str) -> None:
    _, weight = holes(2, 1, *size, seed=4)
    values = torch.full((2, 3, *size), 0.7, dtype=dtype, device=device)
    filled = pull_push(values * weight.to(values), weight.to(values))
    assert filled.dtype == dtype
    assert torch.allclose(filled, values, rtol=1e-6)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("dtype", [F32, F64])
def test_known_values_are_kept_to_the_bit(size: tuple[int, int], dtype: torch.dtype) -> None:
    values, weight = (t.to(dtype) for t in holes(2, 2, *size, seed=5))
    filled = pull_push(values, weight)
    kept = (weight == 1).expand_as(values)
    assert torch.equal(filled[kept], values[kept])
    assert torch.equal(pull_push(values, torch.ones_like(weight)), values)


@pytest.mark.parametrize("size", [*SIZES, (64, 96), (99, 151), (5, 1023)])
def test_a_flipped_or_transposed_picture_is_filled_alike(size: tuple[int, int]) -> None:
    values, weight = holes(2, 2, *size, seed=6, share=0.1)
    filled = pull_push(values, weight)
    for dim in (2, 3):
        torch.testing.assert_close(pull_push(values.flip(dim), weight.flip(dim)).flip(dim), filled, rtol=0, atol=1e-12)
    torch.testing.assert_close(pull_push(values.mT, weight.mT).mT, filled, rtol=0, atol=1e-12)


@pytest.mark.parametrize("size", SIZES)
def test_one_known_pixel_fills_everything(size: tuple[int, int]) -> None:
    values, weight = holes(1, 2, *size, seed=size[0] * size[1] // 2, share=0.0)
    only = (values * weight).sum((2, 3), keepdim=True)
    assert torch.allclose(pull_push(values, weight), only.expand_as(values), rtol=1e-12)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::UserWarning:torch", "ignore::DeprecationWarning")  # of the compiler's own
@pytest.mark.skipif(shutil.which("g++") is None, reason="inductor needs a C++ compiler")
@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("size", [(1, 1), (2, 2), (7, 1), (1, 8), (9, 3)])
def test_gradients_are_the_same_compiled(size: tuple[int, int], threads: int) -> None:
    torch._dynamo.reset()
    before = torch.get_num_threads()
    torch.set_num_threads(threads)  # on two, inductor writes other loops
    try:
        given = [t.float().requires_grad_() for t in holes(1, 3, *size, seed=6)]
        found, wanted = (
            torch.autograd.grad(run(*given).square().sum(), given) for run in (torch.compile(pull_push), pull_push)
        )
    finally:
        torch.set_num_threads(before)
        torch._dynamo.reset()
    for one, other in zip(found, wanted, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-5)


def test_nothing_known_gives_zero() -> None:
    assert torch.equal(pull_push(torch.ones(1, 2, 5, 6), torch.zeros(1, 1, 5, 6)), torch.zeros(1, 2, 5, 6))


def test_what_is_hidden_has_no_influence() -> None:
    values, weight = holes(1, 2, 21, 18, seed=1)
    other = torch.where(weight == 1, values, 1e6)
    assert torch.equal(pull_push(other, weight), pull_push(values, weight))


def test_a_partly_known_pixel_is_mixed_with_its_surroundings() -> None:
    a, b, w = 3.0, 7.0, 0.4
    values = torch.tensor([[[[a, b]]]], dtype=F64)
    mean = (a + w * b) / (1 + w)  # the next level is one pixel, known as a whole
    want = torch.tensor([[[[a, w * b + (1 - w) * mean]]]], dtype=F64)
    assert torch.allclose(pull_push(values, torch.tensor([[[[1.0, w]]]], dtype=F64)), want, rtol=1e-12)
    # Alone in the picture it is all that is known, however little.
    assert pull_push(values[..., 1:], torch.full((1, 1, 1, 1), 1e-3, dtype=F64)).item() == pytest.approx(b)


def test_weight_fades_a_value_in() -> None:
    values, weight = holes(1, 1, 9, 12, seed=2)
    weight[..., 4, 5] = 0
    values[..., 4, 5] = 5.0
    seen = []
    for share in (0.0, 0.25, 0.5, 1.0):
        weight[..., 4, 5] = share
        seen.append(pull_push(values, weight)[..., 4, 5].item())
    assert seen == sorted(seen)
    assert seen[0] < 2
    assert seen[-1] == 5.0


def test_a_hole_is_filled_from_both_of_its_sides() -> None:
    values = torch.zeros(1, 1, 16, 64, dtype=F64)
    values[..., 32:] = 1
    weight = torch.ones_like(values)
    weight[..., 16:48] = 0
    across = pull_push(values, weight)[0, 0, 8]
    assert (across.diff() >= 0).all()
    assert across[18] < 0.25
    assert across[45] > 0.75
    assert float(across.diff().max()) < 0.2  # no edge in the middle, where the hidden one was


@few
@given(
    h=st.integers(1, 23), w=st.integers(1, 23), seed=st.integers(0, 999), soft=st.booleans(), double=st.booleans()
)  # fmt: skip
def test_filled_values_lie_among_the_known_ones(h: int, w: int, seed: int, soft: bool, double: bool) -> None:
    values, weight = holes(2, 1, h, w, seed)
    if soft:
        weight = weight * torch.rand(weight.shape, generator=torch.Generator().manual_seed(seed), dtype=F64)
    if not double:
        values, weight = values.float(), weight.float()
    filled = pull_push(values, weight)
    for k in range(2):
        known = values[k][weight[k] > 0]
        slack = 1e-5 if not double else 1e-12
        assert filled[k].min() >= known.min() - slack
        assert filled[k].max() <= known.max() + slack


@pytest.mark.parametrize("device", DEVICES)
def test_a_batch_is_its_items_one_by_one(device: str) -> None:
    values, weight = (t.to(device) for t in holes(3, 2, 19, 26, seed=7))
    one_by_one = [pull_push(values[k : k + 1], weight[k : k + 1]) for k in range(3)]
    assert torch.equal(pull_push(values, weight), torch.cat(one_by_one))


@pytest.mark.parametrize("size", [(1, 5), (3, 4)])
def test_pull_push_is_differentiable_to_values_and_weight(size: tuple[int, int]) -> None:
    seed = torch.Generator().manual_seed(9)
    values = torch.rand(1, 2, *size, generator=seed, dtype=F64, requires_grad=True)
    # Shares of the next level add up to less than 1: there they would be cut off, with a kink.
    weight = (torch.rand(1, 1, *size, generator=seed, dtype=F64) * 0.2 + 0.01).requires_grad_()
    assert torch.autograd.gradcheck(pull_push, (values, weight))


def test_gradients_stay_finite_where_nothing_is_known() -> None:
    values, weight = (t.float() for t in holes(1, 1, 12, 9, seed=3, share=0.1))
    values.requires_grad_()
    weight.requires_grad_()
    pull_push(values, weight).square().sum().backward()
    assert values.grad is not None
    assert weight.grad is not None
    assert values.grad.isfinite().all()
    assert weight.grad.isfinite().all()
    assert torch.equal(values.grad[weight == 0], torch.zeros_like(values.grad[weight == 0]))


@pytest.mark.parametrize(
    ("values", "weight", "error", "message"),
    [
        (None, torch.ones(1, 1, 3, 4), TypeError, r"values: expected a tensor of shape \(B, C, H, W\), got NoneType"),
        (torch.ones(2, 3, 4), torch.ones(1, 1, 3, 4), ValueError, r"values: expected shape .*, got \(2, 3, 4\)"),
        (torch.ones(1, 2, 3, 4), torch.ones(1, 2, 3, 4), ValueError, r"weight: expected shape \(1, 1, 3, 4\), got"),
        (torch.ones(1, 2, 3, 4), torch.ones(1, 1, 3, 5), ValueError, r"weight: expected shape \(1, 1, 3, 4\), got"),
        (torch.ones(1, 2, 3, 4), torch.ones(1, 1, 3, 4).bool(), TypeError, "weight: expected a floating-point tensor"),
    ],
)
def test_pull_push_refuses(values: Any, weight: Any, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        pull_push(values, weight)


def even(*parts: tuple[float, float]) -> list[tuple[Tensor, Tensor]]:
    """Bins of one colour and one coverage each, as pairs of premultiplied colour and coverage."""
    return [
        (torch.full((1, 3, 4, 5), colour * coverage, dtype=F64), torch.full((1, 1, 4, 5), coverage, dtype=F64))
        for colour, coverage in parts
    ]


@pytest.mark.parametrize(
    ("bins", "colour", "coverage"),
    [
        ([(0.3, 1.0)], 0.3, 1.0),
        ([(0.3, 0.2)], 0.3, 0.2),
        ([(0.3, 1.0), (0.9, 1.0)], 0.3, 2.0),
        ([(0.3, 0.5), (0.9, 0.5)], 0.6, 1.0),
        ([(0.3, 0.25), (0.9, 0.5)], 0.7, 0.75),
        ([(0.3, 0.75), (0.9, 0.75)], 0.45, 1.5),
        ([(0.3, 0.5), (0.9, 0.25), (0.5, 1.0)], 0.5, 1.75),
        ([(0.3, 0.0), (0.9, 1.0), (0.5, 1.0)], 0.9, 2.0),
        ([(0.3, 1.6), (0.9, 1.0)], 0.3, 2.6),
    ],
)
def test_bins_count_for_what_is_left_free(bins: list[tuple[float, float]], colour: float, coverage: float) -> None:
    mixed, total = fill_until_full(even(*bins))
    assert torch.allclose(mixed, torch.full_like(mixed, colour), rtol=1e-12)
    assert torch.allclose(total, torch.full_like(total, coverage), rtol=1e-12)


def test_nothing_covered_is_black_and_finite() -> None:
    mixed, total = fill_until_full(even((0.5, 0.0), (0.2, 0.0)))
    assert torch.equal(mixed, torch.zeros_like(mixed))
    assert torch.equal(total, torch.zeros_like(total))


def test_coverage_that_rounding_left_below_zero_is_none() -> None:
    _, *rest = bins = even((0.5, -1e-9), (0.2, 0.6))
    for got, want in zip(fill_until_full(bins), fill_until_full(rest), strict=True):
        assert torch.allclose(got, want, atol=1e-12)


@few
@given(seed=st.integers(0, 9999), count=st.integers(1, 5))
def test_mixing_is_a_weighted_mean(seed: int, count: int) -> None:
    source = torch.Generator().manual_seed(seed)
    colours = torch.rand(count, 1, 2, 6, 7, generator=source, dtype=F64)
    coverage = torch.rand(count, 1, 1, 6, 7, generator=source, dtype=F64)
    mixed, total = fill_until_full(list(zip(colours * coverage, coverage, strict=True)))
    assert (mixed >= colours.amin(0) - 1e-12).all()
    assert (mixed <= colours.amax(0) + 1e-12).all()
    assert torch.allclose(total, coverage.sum(0))


def test_mixing_is_differentiable() -> None:
    source = torch.Generator().manual_seed(0)
    colours = torch.rand(3, 1, 2, 3, 4, generator=source, dtype=F64, requires_grad=True)
    coverage = (torch.rand(3, 1, 1, 3, 4, generator=source, dtype=F64) * 0.9 + 0.05).requires_grad_()

    def mix(colours: Tensor, coverage: Tensor) -> tuple[Tensor, Tensor]:
        return fill_until_full(list(zip(colours, coverage, strict=True)))

    assert torch.autograd.gradcheck(mix, (colours, coverage))


def test_examples_in_the_docstrings() -> None:
    result = doctest.testmod(torchbokeh.ops.composite)
    assert result.attempted > 0
    assert result.failed == 0
