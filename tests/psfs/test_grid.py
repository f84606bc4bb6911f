"""The nested grid and its remapping: every box found again, boxes that cover the space, interpolation."""

import doctest
import itertools
import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import torchbokeh.psfs.grid
from torchbokeh.psfs.grid import NestedGrid

F64 = torch.float64


def grid(cells: tuple[int, ...]) -> NestedGrid:
    n = len(cells)
    return NestedGrid([50.0, 3.0, 1.0, 7.0][:n], [2.0, 1.0, 0.5, 1.3][:n], cells)


def test_the_example_of_the_paper_has_28_boxes() -> None:
    assert len(NestedGrid((1.0, 1.0), (1.0, 1.0), (9, 9))) == 28


@given(st.lists(st.integers(1, 24), min_size=1, max_size=3).map(tuple))
@settings(max_examples=60, deadline=None)
def test_boxes_cover_the_space_once(cells: tuple[int, ...]) -> None:
    boxes = torch.tensor(grid(cells).boxes(), dtype=F64)
    volumes = (boxes[:, 1] - boxes[:, 0]).prod(1)
    assert volumes.sum() == math.prod(cells)
    assert bool((volumes > 0).all())
    assert len(boxes) == len(grid(cells))


@given(st.lists(st.integers(1, 24), min_size=1, max_size=4).map(tuple), st.integers(0, 2**31))
@settings(max_examples=60, deadline=None)
def test_every_box_is_found_from_anywhere_in_it(cells: tuple[int, ...], seed: int) -> None:
    space = grid(cells)
    corners = torch.tensor(space.boxes(), dtype=F64)
    share = torch.rand(corners[:, 0].shape, dtype=F64, generator=torch.Generator().manual_seed(seed))
    inside = corners[:, 0] + (1e-6 + (1 - 2e-6) * share) * (corners[:, 1] - corners[:, 0])
    assert torch.equal(space.index(space.unmap(inside)), torch.arange(len(space)))
    assert torch.equal(space.index(space.centres()), torch.arange(len(space)))


def test_the_first_and_the_last_box_hold_the_corners() -> None:
    space = grid((9, 12))
    ends = torch.tensor([[0.0, 0.0], [50.0, 3.0], [1e9, 1e9]])
    assert space.index(ends).tolist() == [0, len(space) - 1, len(space) - 1]
    low, high = space.box(0)
    assert low == (0.0, 0.0)
    assert high == pytest.approx((50 / 81, 3 / 12))


def test_small_coordinates_get_more_boxes() -> None:
    space = NestedGrid((100.0,), (2.0,), (5050,))
    assert len(space) == 100
    widths = [high[0] - low[0] for low, high in (space.box(k) for k in range(len(space)))]
    assert all(a < b for a, b in itertools.pairwise(widths))


@pytest.mark.parametrize("cells", [(55,), (30,), (12, 9)])
def test_shares_of_neighbours_sum_to_one_and_are_differentiable(cells: tuple[int, ...]) -> None:
    space = grid(cells)
    place = torch.rand(200, len(cells), dtype=F64, generator=torch.Generator().manual_seed(3)) * torch.tensor(
        space.bounds, dtype=F64
    )
    found = space.neighbours(place.requires_grad_())
    shares = torch.stack([share for _, share in found])
    assert len(found) == 2 ** len(cells)
    assert float(shares.detach().min()) >= 0
    torch.testing.assert_close(shares.sum(0), torch.ones(200, dtype=F64))
    (grad,) = torch.autograd.grad(shares[0].sum(), place)
    assert float(grad.abs().max()) > 0


def test_in_one_dimension_interpolation_is_linear_in_the_remapped_coordinate() -> None:
    space = NestedGrid((1.0,), (1.0,), (28,))
    middles = space.remap(space.centres())[:, 0]
    place = torch.linspace(float(middles[0]), float(middles[-1]), 400, dtype=F64) / 28
    got = sum(share * middles[number] for number, share in space.neighbours(place[:, None]))
    torch.testing.assert_close(got, place * 28)


def test_within_a_level_interpolation_is_linear_in_every_coordinate() -> None:
    space = NestedGrid((1.0, 1.0), (1.0, 1.0), (12, 12))
    middles = space.remap(space.centres())
    place = torch.stack([torch.full((50,), 0.4), torch.linspace(3.6, 11.4, 50)], 1).double()  # a column of level 0
    got = sum(share[:, None] * middles[number] for number, share in space.neighbours(place / 12))
    torch.testing.assert_close(got[:, 1], place[:, 1])


def test_bad_arguments_are_named() -> None:
    with pytest.raises(ValueError, match="betas: expected 2 entries like bounds, got 1"):
        NestedGrid((1.0, 1.0), (1.0,), (4, 4))
    with pytest.raises(ValueError, match="cells: expected finite numbers above 0"):
        NestedGrid((1.0,), (1.0,), (0,))
    with pytest.raises(ValueError, match="cells: expected whole numbers"):
        NestedGrid((1.0,), (1.0,), (2.5,))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="cells: expected a product of at most 16777216, got 25000000"):
        NestedGrid((1.0, 1.0), (1.0, 1.0), (5000, 5000))
    with pytest.raises(ValueError, match=r"number: expected 0 to 8, got 9"):
        NestedGrid((1.0,), (1.0,), (40,)).box(9)
    with pytest.raises(ValueError, match=r"coordinates: expected shape \(\.\.\., 2\)"):
        grid((3, 3)).index(torch.zeros(4, 3))


def test_examples() -> None:
    assert doctest.testmod(torchbokeh.psfs.grid).failed == 0
