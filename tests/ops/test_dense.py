import doctest

import pytest
import torch

import torchbokeh.ops.dense
from torchbokeh.ops.dense import dense_points, dense_spans
from torchbokeh.ops.points import PointTable
from torchbokeh.psfs import Disc, polygon_profile


def test_a_square_psf_counted_by_hand() -> None:
    # A square from -3/4 to 3/4: the middle pixel lies within, of its neighbours a quarter.
    square = polygon_profile(torch.tensor([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]], dtype=torch.float64))
    dot = torch.zeros(1, 1, 3, 5)
    dot[..., 1, 1] = 9
    out = dense_spans(dot, torch.full_like(dot, 0.75), square)
    line = torch.tensor([0.25, 1.0, 0.25, 0.0, 0.0], dtype=torch.float64)
    assert torch.allclose(out[0, 0], 4 * line * line[:3, None])


def test_spans_leave_the_image_without_trace() -> None:
    dot = torch.zeros(1, 2, 3, 5)
    dot[..., 0, 0] = 1
    out = dense_spans(dot, torch.full((1, 1, 3, 5), -4.0), Disc().profile())
    assert out.dtype == torch.float64
    assert torch.allclose(out[..., 1, 1], torch.full((), 1 / (16 * torch.pi), dtype=torch.float64))
    assert 0.2 < float(out[0, 0].sum()) < 0.35


def test_points_counted_by_hand() -> None:
    values = torch.tensor([[[[2.0, 10.0]]]])
    table = PointTable(torch.tensor([[1.0, 0.0], [0.25, 0.5]]), torch.tensor([3.0, 1.0]), torch.tensor([0, 1, 2]))
    index = torch.tensor([[[[0, 1]]]])
    out = dense_points(values, index, table, pad=1)
    want = [[0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 6.0 + 3.75, 1.25], [0.0, 0.0, 3.75, 1.25]]
    assert out[0, 0].tolist() == want
    turn = torch.tensor([[0.0, -1.0], [1.0, 0.0]]).reshape(1, 2, 2, 1, 1).expand(1, 2, 2, 1, 2)
    place = torch.tensor([[[[0.0, 0.0]], [[0.0, -1.0]]]])
    out = dense_points(values, index, table, pad=1, rotation=turn, position=place)
    want = [[3.75, 3.75, 0.0, 0.0], [1.25, 1.25, 0.0, 0.0], [0.0, 6.0, 0.0, 0.0]]
    assert out[0, 0].tolist() == want


def test_bad_input_is_named() -> None:
    values = torch.zeros(1, 2, 3, 4)
    table = PointTable(torch.zeros(1, 2), torch.ones(1), torch.tensor([0, 1]))
    with pytest.raises(ValueError, match=r"values: expected shape \(B, C, H, W\)"):
        dense_spans(values[0], values[:, :1], Disc().profile())
    with pytest.raises(ValueError, match=r"coc: expected shape \(1, 1, 3, 4\)"):
        dense_spans(values, values, Disc().profile())
    with pytest.raises(TypeError, match="index: expected an integer tensor"):
        dense_points(values, values[:, :1], table, pad=0)


def test_examples() -> None:
    assert doctest.testmod(torchbokeh.ops.dense).failed == 0
