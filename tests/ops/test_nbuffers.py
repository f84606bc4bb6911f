import doctest
import math
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.nn import functional as F

import torchbokeh.ops.nbuffers
from torchbokeh.ops.nbuffers import NBuffers

F32, F64 = torch.float32, torch.float64
SIZES = [(1, 1), (1, 17), (13, 1), (2, 3), (7, 11), (16, 16), (17, 33), (5, 40)]
DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
few = settings(deadline=None, max_examples=40)


def image(b: int, h: int, w: int, seed: int = 0, dtype: torch.dtype = F32) -> Tensor:
    return torch.randn(b, 1, h, w, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def integers(low: int, high: int, b: int, h: int, w: int, seed: int = 1) -> Tensor:
    return torch.randint(low, high, (b, 1, h, w), generator=torch.Generator().manual_seed(seed))


def look(values: Tensor, x0: Tensor, x1: Tensor, y0: Tensor, y1: Tensor) -> tuple[Tensor, Tensor]:
    """Minimum and maximum of every rectangle, pixel by pixel."""
    b, _, h, w = values.shape
    low, high = torch.empty_like(values), torch.empty_like(values)
    for n, y, x in torch.cartesian_prod(torch.arange(b), torch.arange(h), torch.arange(w)).tolist():
        left, right = (min(max(int(t[n, 0, y, x]), 0), w - 1) for t in (x0, x1))
        top, bottom = (min(max(int(t[n, 0, y, x]), 0), h - 1) for t in (y0, y1))
        window = values[n, 0, top : bottom + 1, left : right + 1]
        low[n, 0, y, x], high[n, 0, y, x] = window.min(), window.max()
    return low, high


def assert_same(got: tuple[Tensor, Tensor], want: tuple[Tensor, Tensor]) -> None:
    assert torch.equal(got[0], want[0])
    assert torch.equal(got[1], want[1])


@pytest.mark.parametrize("size", SIZES)
def test_levels_hold_the_squares_below_and_to_the_right(size: tuple[int, int]) -> None:
    values = image(2, *size)
    buffers = NBuffers.build(values)
    assert len(buffers.low) == len(buffers.high) == max(size).bit_length()
    y, x = (t.expand_as(values) for t in torch.meshgrid(*(torch.arange(n) for n in size), indexing="ij"))
    for i in range(len(buffers.low)):
        want = look(values, x, x + 2**i - 1, y, y + 2**i - 1)
        assert_same((buffers.low[i], buffers.high[i]), want)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("dtype", [F32, F64])
@pytest.mark.parametrize("device", DEVICES)
def test_squares_of_one_size_are_those_of_max_pooling(size: tuple[int, int], dtype: torch.dtype, device: str) -> None:
    values = image(2, *size, dtype=dtype).to(device)
    buffers = NBuffers.build(values)
    for half in (0, 1, 2, 3, 5, 8, 40):
        high = F.max_pool2d(values, 2 * half + 1, stride=1, padding=half)
        low = -F.max_pool2d(-values, 2 * half + 1, stride=1, padding=half)
        got = buffers.square(torch.full(values.shape, half, device=device))
        assert got[0].dtype == got[1].dtype == dtype
        assert_same(got, (low, high))


@few
@given(h=st.integers(1, 19), w=st.integers(1, 19), reach=st.integers(0, 25), seed=st.integers(0, 999))
def test_squares_of_any_size_are_exact(h: int, w: int, reach: int, seed: int) -> None:
    values, half = image(2, h, w, seed), integers(0, reach + 1, 2, h, w, seed)
    y, x = torch.meshgrid(torch.arange(h), torch.arange(w), indexing="ij")
    assert_same(NBuffers.build(values).square(half), look(values, x - half, x + half, y - half, y + half))


@few
@given(h=st.integers(1, 19), w=st.integers(1, 19), seed=st.integers(0, 999), largest=st.integers(1, 30))
def test_rectangles_are_exact_with_any_number_of_levels(h: int, w: int, seed: int, largest: int) -> None:
    values = image(2, h, w, seed)
    x0, y0 = integers(-4, w + 4, 2, h, w, seed), integers(-4, h + 4, 2, h, w, seed + 1)
    x1, y1 = x0 + integers(0, w + 4, 2, h, w, seed + 2), y0 + integers(0, h + 4, 2, h, w, seed + 3)
    want = look(values, x0, x1, y0, y1)
    assert_same(NBuffers.build(values).rectangle(x0, x1, y0, y1), want)
    assert_same(NBuffers.build(values, largest).rectangle(x0, x1, y0, y1), want)


def test_only_the_levels_that_are_needed_are_built() -> None:
    values = image(1, 40, 50)
    assert [len(NBuffers.build(values, n).low) for n in (1, 2, 3, 4, 7, 8, 1000)] == [1, 2, 2, 3, 3, 4, 6]


def test_infinities_are_values_like_others() -> None:
    values = image(1, 9, 9)
    values[..., 4, 4], values[..., 0, 8] = math.inf, -math.inf
    low, high = NBuffers.build(values).square(torch.full(values.shape, 1))
    assert (high == math.inf).sum() == 9
    assert (low == -math.inf).sum() == 4


def test_windows_beyond_any_integer_are_the_whole_image() -> None:
    values = image(1, 6, 5)
    low, high = NBuffers.build(values).square(torch.full(values.shape, 2**63 - 1))
    assert (low == values.min()).all()
    assert (high == values.max()).all()


def test_the_input_is_left_alone_and_a_batch_is_its_items() -> None:
    values, half = image(3, 12, 7), integers(0, 9, 3, 12, 7)
    before = values.clone()
    got = NBuffers.build(values.requires_grad_()).square(half)
    assert not got[0].requires_grad
    assert torch.equal(values, before)
    items = [NBuffers.build(values[k : k + 1]).square(half[k : k + 1]) for k in range(3)]
    assert_same(got, (torch.cat([i[0] for i in items]), torch.cat([i[1] for i in items])))


@pytest.mark.parametrize(
    ("values", "largest", "error", "message"),
    [
        (None, None, TypeError, r"values: expected a tensor of shape \(B, 1, H, W\), got NoneType"),
        (torch.ones(1, 2, 3, 4), None, ValueError, r"values: expected shape \(B, 1, H, W\), got \(1, 2, 3, 4\)"),
        (torch.ones(1, 1, 3, 4).long(), None, TypeError, "values: expected a floating-point tensor"),
        (torch.ones(1, 1, 0, 4), None, ValueError, "values: expected at least one pixel"),
        (torch.full((1, 1, 3, 4), math.nan), None, ValueError, "values: expected numbers, got NaN"),
        (torch.ones(1, 1, 3, 4), 0, ValueError, "largest: expected at least 1, got 0"),
    ],
)
def test_build_refuses(values: Any, largest: int | None, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        NBuffers.build(values, largest)


def test_queries_refuse() -> None:
    buffers = NBuffers.build(image(1, 3, 4))
    zero = torch.zeros(1, 1, 3, 4, dtype=torch.int64)
    with pytest.raises(TypeError, match="half: expected an integer tensor"):
        buffers.square(zero.float())
    with pytest.raises(ValueError, match=r"half: expected shape \(1, 1, 3, 4\), got \(1, 1, 4, 3\)"):
        buffers.square(zero.mT)
    with pytest.raises(ValueError, match="half: expected at least 0, got -2"):
        buffers.square(zero - 2)
    with pytest.raises(ValueError, match="x0: expected at most x1"):
        buffers.rectangle(zero + 1, zero, zero, zero)
    with pytest.raises(ValueError, match="y0: expected at most y1"):
        buffers.rectangle(zero, zero, zero + 1, zero)
    with pytest.raises(ValueError, match="y1: expected shape"):
        buffers.rectangle(zero, zero, zero, zero[0])


def test_examples_in_the_docstrings() -> None:
    result = doctest.testmod(torchbokeh.ops.nbuffers)
    assert result.attempted > 0
    assert result.failed == 0
