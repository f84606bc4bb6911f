"""Dense splats of single pixels, against the closed form, and the kernel against its definition."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from torchbokeh.ops.capsules import _splat_capsules_torch, splat_capsules

F64 = torch.float64


def some(dtype: torch.dtype) -> tuple[Tensor, ...]:
    draw = torch.Generator().manual_seed(1)
    values = torch.rand(2, 3, 24, 30, dtype=dtype, generator=draw)
    pixels = torch.tensor([3, 200, 719, 720, 1000, 1439])
    radius = 6 * torch.rand(6, dtype=dtype, generator=draw)
    motion, centre = (20 * (torch.rand(6, 2, dtype=dtype, generator=draw) - 0.5) for _ in range(2))
    motion[2] = 0.0
    return values, pixels, radius, motion, centre


def test_the_kernel_is_its_definition() -> None:
    pytest.importorskip("numba")
    given = some(torch.float32)
    want = _splat_capsules_torch(*(t.double() if t.is_floating_point() else t for t in given))
    torch.testing.assert_close(splat_capsules(*given).double(), want, atol=1e-6, rtol=1e-5)


def test_a_pixel_in_the_middle_loses_nothing() -> None:
    values, pixels = torch.ones(1, 1, 61, 61, dtype=F64), torch.tensor([30 * 61 + 30])
    radius, motion = torch.tensor([5.0], dtype=F64), torch.tensor([[12.0, -9.0]], dtype=F64)
    centre = torch.tensor([[3.0, 2.0]], dtype=F64)
    out = splat_capsules(values, pixels, radius, motion, centre)[0, 0].numpy()
    assert out.sum() == pytest.approx(1)
    at = np.arange(61) - 30
    assert (out.sum(0) @ at, out.sum(1) @ at) == pytest.approx((3, 2), abs=1e-6)
    along = (at[None] - 3) * 0.8 - (at[:, None] - 2) * 0.6
    assert (out * along**2).sum() == pytest.approx(25 / 4 + 225 / 12, rel=0.01)
    still = splat_capsules(values, pixels, radius, 0 * motion, 0 * centre)[0, 0].numpy()
    assert still.max() == pytest.approx(1 / (math.pi * 25), rel=0.02)


def test_it_is_differentiable() -> None:
    values, pixels, radius, motion, centre = some(F64)
    asked = [t.clone().requires_grad_() for t in (values, radius + 0.6, motion + 0.3, centre)]
    out = splat_capsules(asked[0], pixels, *asked[1:])
    aim = torch.rand_like(out)
    grads = torch.autograd.grad((aim * out).sum(), asked)
    assert all(g.isfinite().all() for g in grads)
    other = torch.rand_like(values)
    again = splat_capsules(other, pixels, *(t.detach() for t in asked[1:]))
    torch.testing.assert_close((grads[0] * other).sum(), (aim * again).sum())


def test_no_pixel_spreads_nothing() -> None:
    values, pixels, *geometry = some(F64)
    assert float(splat_capsules(values, pixels[:0], *(t[:0] for t in geometry)).abs().max()) == 0
