"""The camera: where points come to lie in the picture, and how far a lens point moves them."""

import dataclasses
import math
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from torchbokeh import DisparityLens, ThinLens
from torchbokeh.scenes import Camera

F64 = torch.float64
few = settings(deadline=None, max_examples=60)


def lens64(focal: float, f_number: float, focus: float, sensor: float) -> ThinLens:
    return ThinLens(*(torch.tensor(v, dtype=F64) for v in (focal, f_number, focus, sensor)))


def project(camera: Camera, points: Tensor, lens: Tensor | None = None, shift: Tensor | None = None) -> Tensor:
    """Places ``(V, N, 2)`` of points ``(N, 4)``."""
    none = torch.zeros(1, 2, dtype=F64)
    matrix = camera.projection(none if lens is None else lens, none if shift is None else shift)
    out = torch.einsum("vij,nj->vni", matrix, points)
    return out[..., :2] / out[..., 2:]


focal_lengths, f_numbers = st.floats(0.01, 0.2), st.floats(0.2, 32)
focus_distances = st.floats(0.3, 100) | st.just(math.inf)


@few
@given(
    focal=focal_lengths,
    f_number=f_numbers,
    focus=focus_distances,
    seed=st.integers(0, 2**31),
    width=st.integers(1, 4000),
)
def test_a_lens_point_moves_a_point_by_its_coc(
    focal: float, f_number: float, focus: float, seed: int, width: int
) -> None:
    generator = torch.Generator().manual_seed(seed)
    camera = Camera(lens64(focal, f_number, focus, 0.036), (7, width))
    depth = torch.cat([torch.logspace(-1.5, 4, 20, dtype=F64), torch.tensor([min(focus, 1e6), torch.inf], dtype=F64)])
    aside = torch.randn(len(depth), 2, generator=generator, dtype=F64)
    finite = torch.cat([aside * depth[:, None], depth[:, None], torch.ones_like(depth)[:, None]], 1)
    sky = torch.cat([aside, torch.ones_like(depth)[:, None], torch.zeros_like(depth)[:, None]], 1)
    points = torch.where(depth[:, None].isinf(), sky, finite)
    lens = torch.rand(5, 2, generator=generator, dtype=F64) * 2 - 1
    shift = torch.zeros(5, 2, dtype=F64)
    moved = project(camera, points, lens, shift) - project(camera, points)
    want = camera.lens.coc(depth[None], width)[0][:, None] * lens[:, None]
    scale = 1 + float(want.abs().max()) + float(project(camera, points).abs().max())
    torch.testing.assert_close(moved, want, rtol=1e-9, atol=1e-12 * scale)
    if math.isfinite(focus):
        assert float(moved[:, -2].abs().max()) <= 1e-12 * scale  # in focus
    assert float(moved[:, 0].abs().max()) > 0  # and nothing else


def test_signs_are_those_of_the_circle_of_confusion() -> None:
    camera = Camera(ThinLens(0.05, 2.0, 2.0, 0.036), (10, 100))
    right = torch.tensor([[1.0, 0.0]], dtype=F64)
    points = torch.tensor([[0, 0, 1, 1], [0, 0, 2, 1], [0, 0, 4, 1], [0, 0, 1, 0]], dtype=F64)
    near, focus, far, sky = (project(camera, points, right)[0, :, 0] - 50).tolist()
    assert near < 0 < far < sky
    assert focus == pytest.approx(0, abs=1e-9)


@few
@given(focal=focal_lengths, focus=focus_distances, height=st.integers(1, 999), width=st.integers(1, 999))
def test_the_middle_of_the_lens_is_a_pinhole(focal: float, focus: float, height: int, width: int) -> None:
    camera = Camera(lens64(focal, 2.0, focus, 0.024), (height, width))
    # From the thin lens equation: the sensor stands at 1 / (1/F - 1/df).
    sensor = 1 / (1 / focal - 1 / focus)
    assert camera.focal_px == pytest.approx(sensor / (0.024 / width), rel=1e-9)
    points = torch.tensor([[0.0, 0, 3, 1], [0.3, -0.2, 1.7, 1], [0.3, -0.2, 1, 0]], dtype=F64)
    middle = torch.tensor([width / 2, height / 2], dtype=F64)
    want = middle + camera.focal_px * points[:, :2] / points[:, 2:3]
    torch.testing.assert_close(project(camera, points)[0], want, rtol=1e-9, atol=1e-9)


def test_conventions() -> None:
    near, far = (Camera(ThinLens(0.05, 2.0, focus, 0.036), (10, 100)) for focus in (0.5, math.inf))
    assert near.focal_px > far.focal_px == pytest.approx(0.05 / 0.036 * 100)  # focusing nearer enlarges the picture
    right_and_down = project(far, torch.tensor([[0.1, 0.2, 1.0, 1.0]], dtype=F64))[0, 0]
    assert right_and_down[0] > 50
    assert right_and_down[1] > 5


def test_shift_moves_the_picture_whatever_the_depth() -> None:
    camera = Camera(lens64(0.05, 2.0, 2.0, 0.036), (48, 64))
    points = torch.tensor([[0.1, 0.2, 0.5, 1], [0.1, 0.2, 5, 1], [0.1, -0.3, 1, 0]], dtype=F64)
    shift = torch.tensor([[0.25, -0.5], [3.0, 4.0]], dtype=F64)
    lens = torch.tensor([[0.3, 0.4], [-0.5, 0.1]], dtype=F64)
    moved = project(camera, points, lens, shift) - project(camera, points, lens, 0 * shift)
    torch.testing.assert_close(moved, shift[:, None].expand_as(moved), rtol=0, atol=1e-9)


def test_views_do_not_mix_and_are_double() -> None:
    camera = Camera(ThinLens(0.05, 2.0, 2.0, 0.036), (48, 64))
    lens, shift = torch.randn(4, 2), torch.randn(4, 2)
    together = camera.projection(lens, shift)
    assert together.shape == (4, 3, 4)
    assert together.dtype == F64
    for v in range(4):
        assert torch.equal(together[v : v + 1], camera.projection(lens[v : v + 1], shift[v : v + 1]))


GOOD = {"lens": ThinLens(0.05, 2.0, 2.0, 0.036), "size": (48, 64), "shutter": 0.02}


@pytest.mark.parametrize(
    ("wrong", "error", "message"),
    [
        ({"lens": DisparityLens(1.0, 0.5)}, TypeError, "lens: expected a ThinLens, got DisparityLens"),
        ({"lens": None}, TypeError, "lens: .* got NoneType"),
        ({"lens": ThinLens(0.05, torch.tensor([2.0, 4.0]), 2.0, 0.036)}, ValueError, r"lens: .* f_number .*\(2,\)"),
        ({"size": (0, 64)}, ValueError, r"size: .* got \(0, 64\)"),
        ({"size": (48, -1)}, ValueError, "size: "),
        ({"size": (48.0, 64)}, TypeError, "size: "),
        ({"size": (48,)}, TypeError, "size: "),
        ({"size": (3, 48, 64)}, TypeError, "size: "),
        ({"size": 48}, TypeError, "size: "),
        ({"shutter": -0.1}, ValueError, "shutter: .* got -0.1"),
        ({"shutter": math.inf}, ValueError, "shutter: "),
        ({"shutter": math.nan}, ValueError, "shutter: "),
    ],
)
def test_errors(wrong: dict[str, Any], error: type[Exception], message: str) -> None:
    Camera(**GOOD)
    with pytest.raises(error, match=message):
        Camera(**{**GOOD, **wrong})


def test_is_frozen_and_takes_parameters() -> None:
    camera = Camera(ThinLens(0.05, torch.nn.Parameter(torch.tensor(2.0)), 2.0, 0.036), (48, 64), shutter=0)
    assert not camera.projection(torch.ones(1, 2), torch.zeros(1, 2)).requires_grad
    with pytest.raises(dataclasses.FrozenInstanceError):
        camera.shutter = 1.0  # type: ignore[misc]
