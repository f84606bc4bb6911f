import math

import pytest
import torch

from torchbokeh.ops.outline import Pieces, arcs_of, mean_edge, row_pieces
from torchbokeh.ops.outline_gradient import mean_edge_gradient
from torchbokeh.ops.spans import Profile
from torchbokeh.psfs import Aperture, Disc, Ellipse, Polygon

SEEDS = 20

# Two sides of the square rise by 3e-8 of its radius only, and slopes are quotients by that.
SHAPES = {
    "disc": (Disc(), 1e-9),
    "ellipse": (Ellipse(1.8, 0.5), 1e-9),
    "triangle": (Polygon(3, 0.2), 1e-9),
    "square": (Polygon(4, math.pi / 4), 1e-6),
    "round blades": (Polygon(5, 0.4, 0.7), 1e-9),
}


@pytest.mark.parametrize("row", [-5, -1, 0, 2, 40])
@pytest.mark.parametrize("name", SHAPES)
def test_equals_the_gradient_that_autograd_finds(name: str, row: int) -> None:
    for number in range(SEEDS):
        check(*SHAPES[name], row, torch.Generator().manual_seed(100 * number + row + 9))


def check(shape: Aperture, close: float, row: int, seed: torch.Generator) -> None:
    """Compare both for random radii and random gradients of the outputs, to within ``close``."""
    radius = torch.empty(60, dtype=torch.float64).uniform_(-0.6, 4.5, generator=seed).exp2()
    coc = radius * (torch.randint(0, 2, (60,), generator=seed) * 2 - 1)
    profile = Profile(*(t.detach().clone().requires_grad_() for t in shape.profile()))
    pieces = row_pieces(coc, torch.full_like(coc, 20.5), row, profile, arcs_of(profile), 41)
    assert (len(pieces.owner) == 0) == (row == 40)
    owned = coc[pieces.owner].requires_grad_()
    # Cuts stay where they are in px, but for those at the ends of the shape.
    bottom, top = profile.knots[0, 0], profile.knots[-1, 0]
    moved = [(y, y * owned.detach() / owned) for y in pieces[2:4]]
    ends = [torch.where(y <= bottom, bottom, torch.where(y >= top, top, cut)) for y, cut in moved]
    out = mean_edge(owned, Pieces(pieces.owner, pieces.arc, *ends, pieces.column), profile)
    # The mean over a piece of almost no height is a quotient of roundings; in a splat it counts by that height.
    height = (pieces.high - pieces.low).detach()
    counts = torch.where(height > 1e-6, height, 0.0)
    grads = [torch.randn(len(owned), generator=seed, dtype=torch.float64) * counts for _ in range(2)]
    want = torch.autograd.grad(out, (owned, *profile), grads)
    got = mean_edge_gradient(owned.detach(), pieces, Profile(*(t.detach() for t in profile)), *grads)
    for mine, theirs in zip(got, want, strict=True):
        torch.testing.assert_close(mine, theirs, rtol=close, atol=close)
