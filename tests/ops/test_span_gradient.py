import pytest
import torch

from torchbokeh.ops.span_gradient import row_span_gradient
from torchbokeh.ops.spans import Profile, row_span
from torchbokeh.psfs import Aperture, Disc, Ellipse, Polygon

SHAPES = [Disc(), Ellipse(1.8, 0.5), Polygon(3, 0.2), Polygon(4, 0.785398163397), Polygon(5, 0.4, 0.7)]


@pytest.mark.parametrize("row", [-5, -1, 0, 2, 40])
@pytest.mark.parametrize("shape", SHAPES, ids=["disc", "ellipse", "triangle", "square", "round blades"])
def test_equals_the_gradient_that_autograd_finds(shape: Aperture, row: int) -> None:
    seed = torch.Generator().manual_seed(row + 9)
    radius = torch.empty(60, dtype=torch.float64).uniform_(-0.6, 4.5, generator=seed).exp2()
    coc = (radius * (torch.randint(0, 2, (60,), generator=seed) * 2 - 1)).requires_grad_()
    profile = Profile(*(t.detach().clone().requires_grad_() for t in shape.profile()))
    out = row_span(coc, row, profile)
    # The ends of a row that is not reached mean nothing; in a splat its weight of 0 cancels their gradient.
    grads = [torch.randn(60, generator=seed, dtype=torch.float64) * (out[2] > 0) for _ in range(3)]
    want = torch.autograd.grad(out, (coc, *profile), grads)
    got = row_span_gradient(coc.detach(), row, Profile(*(t.detach() for t in profile)), *grads)
    for mine, theirs in zip(got, want, strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-10, atol=1e-10)
    assert (row == 40) == (want[0].abs().sum() == 0)


def test_rows_out_of_reach_pass_nothing_on() -> None:
    ones = torch.ones(2, dtype=torch.float64)
    got = row_span_gradient(torch.tensor([2.0, -3.0], dtype=torch.float64), 9, Disc().profile(), ones, ones, ones)
    assert all(torch.equal(t, torch.zeros_like(t)) for t in got)
