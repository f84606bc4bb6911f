"""Cards and backdrops: where their texels are in space at which time, and what they refuse."""

import math
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from torch import Tensor

from torchbokeh.scenes import Backdrop, Sprite
from torchbokeh.scenes.sprite import place, rotation_matrix

F64 = torch.float64
few = settings(deadline=None, max_examples=60)
numbers = st.floats(-10, 10)
vectors = st.tuples(numbers, numbers, numbers)
tiny = st.floats(-1e-6, 1e-6)


@few
@given(vector=vectors | st.tuples(tiny, tiny, tiny) | st.just((0.0, 0.0, 0.0)) | st.just((math.pi, 0.0, 0.0)))
def test_rotation_matrix(vector: tuple[float, ...]) -> None:
    got = rotation_matrix(torch.tensor(vector, dtype=F64))
    np.testing.assert_allclose(got, Rotation.from_rotvec(vector).as_matrix(), rtol=0, atol=1e-14)
    np.testing.assert_allclose(got @ got.T, np.eye(3), rtol=0, atol=1e-14)


def test_rotation_matrices_in_batches() -> None:
    vectors = torch.randn(2, 5, 3, dtype=F64, generator=torch.Generator().manual_seed(0))
    got = rotation_matrix(vectors)
    assert got.shape == (2, 5, 3, 3)
    for i in range(2):
        for j in range(5):
            torch.testing.assert_close(got[i, j], rotation_matrix(vectors[i, j]), rtol=0, atol=1e-15)


def test_a_quarter_turn_about_the_optical_axis_takes_right_to_down() -> None:
    turn = rotation_matrix(torch.tensor([0.0, 0.0, math.pi / 2], dtype=F64))
    torch.testing.assert_close(turn @ torch.tensor([1.0, 0, 0], dtype=F64), torch.tensor([0.0, 1, 0], dtype=F64))


def at(matrix: Tensor, s: float, t: float) -> Tensor:
    return matrix @ torch.tensor([s, t, 1.0], dtype=F64)


@few
@given(
    position=vectors,
    size=st.tuples(st.floats(0.01, 10), st.floats(0.01, 10)),
    rotation=vectors,
    velocity=vectors,
    angular=vectors,
    time=st.floats(-1, 1),
    texels=st.tuples(st.integers(1, 9), st.integers(1, 9)),
)
def test_place_of_a_card(
    position: tuple[float, float, float],
    size: tuple[float, float],
    rotation: tuple[float, float, float],
    velocity: tuple[float, float, float],
    angular: tuple[float, float, float],
    time: float,
    texels: tuple[int, int],
) -> None:
    h, w = texels
    card = Sprite(torch.ones(4, h, w), position, size, rotation, velocity, angular)
    matrix = place([card], None, torch.tensor([time], dtype=F64))
    assert matrix.shape == (1, 1, 4, 3)
    assert matrix.dtype == F64
    # First turned as it stands at time 0, then by its spin, about axes of space; its centre goes straight on.
    turn = Rotation.from_rotvec(np.array(angular) * time) * Rotation.from_rotvec(rotation)
    for s, t in ((0, 0), (w, 0), (0.3 * w, 0.8 * h), (w / 2, h / 2)):
        local = np.array([(s / w - 0.5) * size[0], (t / h - 0.5) * size[1], 0.0])
        want = np.array(position) + time * np.array(velocity) + turn.apply(local)
        got = at(matrix[0, 0], s, t)
        np.testing.assert_allclose(got[:3], want, rtol=0, atol=1e-11)
        assert got[3] == 1


@pytest.mark.parametrize("distance", [3.0, 0.5, math.inf])
def test_place_of_a_backdrop(distance: float) -> None:
    behind = Backdrop(torch.ones(3, 4, 10), distance, width=0.7)
    card = Sprite(torch.ones(4, 2, 2), (0.0, 0.0, 1.0), (1.0, 1.0))
    times = torch.tensor([-0.5, 0.5])
    matrix = place([card, card], behind, times)
    assert matrix.shape == (2, 3, 4, 3)
    assert torch.equal(matrix[:, :2], place([card, card], None, times))
    assert torch.equal(matrix[0, 2], matrix[1, 2])  # it stands still
    for s, t in ((0, 0), (10, 4), (5, 2), (7, -3)):
        # 10 texels are 0.7 wide at a distance of 1, and a texel is a square; the middle is straight ahead.
        direction = torch.tensor([(s - 5) * 0.07, (t - 2) * 0.07, 1.0], dtype=F64)
        got = at(matrix[0, 2], s, t)
        assert got[3] == (0 if math.isinf(distance) else 1)
        torch.testing.assert_close(got[:3], direction * (1 if math.isinf(distance) else distance))


def test_nothing_to_place() -> None:
    assert place([], None, torch.zeros(3)).shape == (3, 0, 4, 3)
    assert place([], Backdrop(torch.ones(3, 1, 1)), torch.zeros(3)).shape == (3, 1, 4, 3)


SPRITE = {"texture": torch.ones(4, 2, 2), "position": (0.0, 0.0, 1.0), "size": (1.0, 1.0)}
BACKDROP = {"texture": torch.ones(3, 2, 2)}
NAN, INF = math.nan, math.inf


@pytest.mark.parametrize(
    ("kind", "wrong", "error", "message"),
    [
        *((Sprite, {"texture": t}, e, m) for t, e, m in [
            (torch.ones(3, 2, 2), ValueError, r"texture: expected shape \(4, h, w\), got \(3, 2, 2\)"),
            (torch.ones(1, 4, 2, 2), ValueError, "texture: "),
            (torch.ones(4, 0, 2), ValueError, "texture: expected at least one texel"),
            (torch.ones(4, 2, 2, dtype=torch.uint8), TypeError, "texture: .* got torch.uint8"),
            ([[1.0]], TypeError, "texture: .* got list"),
            (-torch.ones(4, 2, 2), ValueError, "texture: expected finite radiance"),
            (torch.full((4, 2, 2), NAN), ValueError, "texture: expected finite radiance"),
            (torch.full((4, 2, 2), INF), ValueError, "texture: expected finite radiance"),
            (torch.full((4, 2, 2), 1.5), ValueError, "texture: expected coverage"),
        ]),
        *((Sprite, {name: v}, ValueError, f"{name}: expected three finite numbers, got")
          for name in ("position", "rotation", "velocity", "angular_velocity")
          for v in [(0.0, 0.0), (0.0, 0.0, NAN), (INF, 0.0, 0.0), (0.0,) * 4]),
        *((Sprite, {"size": v}, ValueError, "size: expected a width and a height")
          for v in [(1.0,), (1.0, 0.0), (-1.0, 1.0), (INF, 1.0), (NAN, 1.0)]),
        *((Sprite, {name: v}, TypeError, f"{name}: expected a tuple of numbers, got")
          for name in ("position", "size") for v in [0.5, ("a", "b"), None]),
        *((Sprite, {"emission": v}, ValueError, "emission: ") for v in (-1.0, INF, NAN)),
        (Backdrop, {"texture": torch.ones(4, 2, 2)}, ValueError, r"texture: expected shape \(3, h, w\)"),
        (Backdrop, {"texture": torch.ones(3, 2, 0)}, ValueError, "texture: expected at least one texel"),
        (Backdrop, {"texture": torch.ones(3, 2, 2).long()}, TypeError, "texture: "),
        *((Backdrop, {"distance": v}, ValueError, "distance: ") for v in (0.0, -1.0, NAN)),
        *((Backdrop, {"width": v}, ValueError, "width: ") for v in (0.0, -1.0, INF, NAN)),
    ],
)  # fmt: skip
def test_errors(kind: type, wrong: dict[str, Any], error: type[Exception], message: str) -> None:
    good = SPRITE if kind is Sprite else BACKDROP
    kind(**good)
    with pytest.raises(error, match=message):
        kind(**{**good, **wrong})
