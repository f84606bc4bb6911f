"""What is ordinary in a picture, and what is a highlight before it."""

import doctest
from functools import partial

import pytest
import torch
from torch import Tensor

import torchbokeh.ops.highlights as module
from torchbokeh.ops.highlights import ordinary_brightness

noise = partial(torch.rand, 2, 3, 20, 30, dtype=torch.float64)


def test_docstring_examples() -> None:
    assert doctest.testmod(module).failed == 0


def test_it_is_the_mean_by_weight() -> None:
    generator = torch.Generator().manual_seed(0)
    values, weight = noise(generator=generator) - 0.5, noise(generator=generator)[:, :1]
    want = (values.abs() * weight).sum((2, 3)) / weight.sum((2, 3))
    torch.testing.assert_close(ordinary_brightness(values, weight)[..., 0, 0], want)


@pytest.mark.parametrize("lights", [1, 20, 60])
def test_clipped_often_highlights_do_not_count(lights: int) -> None:
    values, weight = torch.ones(1, 1, 20, 30), torch.ones(1, 1, 20, 30)
    values.view(-1)[torch.arange(lights) * 7] = 1e6

    def found(clipped: int) -> float:
        return ordinary_brightness(values, weight, clipped).item()

    assert found(0) > 1e3
    assert found(40) == pytest.approx(1, rel=4 * lights / 600 * 1.7)
    assert all(found(k + 1) < found(k) for k in range(3))


def test_what_has_no_weight_may_be_anything() -> None:
    values, weight = torch.ones(1, 2, 4, 4), torch.ones(1, 1, 4, 4)
    weight[..., 0, :] = 0
    values[..., 0, :] = torch.tensor([torch.nan, torch.inf, -torch.inf, 1e30])
    assert torch.equal(ordinary_brightness(values, weight, 2), torch.ones(1, 2, 1, 1))
    assert not ordinary_brightness(values, 0 * weight).any()


def test_it_grows_with_the_light() -> None:
    values: Tensor = noise(generator=torch.Generator().manual_seed(1))
    weight = torch.ones_like(values[:, :1])
    for clipped in (0, 3):
        one, other = ordinary_brightness(values, weight, clipped), ordinary_brightness(1e5 * values, weight, clipped)
        torch.testing.assert_close(other, 1e5 * one)
