import pytest
import torch

from torchbokeh.ops.outline import Pieces, arcs_of, mean_edge, row_pieces
from torchbokeh.ops.outline_gradient import mean_edge_gradient
from torchbokeh.ops.spans import Profile
from torchbokeh.psfs import Aperture, Disc, Ellipse, Polygon

SHAPES = [Disc(), Ellipse(1.8, 0.5), Polygon(3, 0.2), Polygon(4, 0.785398163397), Polygon(5, 0.4, 0.7)]


@pytest.mark.parametrize("row", [-5, -1, 0, 2, 40])
@pytest.mark.parametrize("shape", SHAPES, ids=["disc", "ellipse", "triangle", "square", "round blades"])
def test_equals_the_gradient_that_autograd_finds(shape: Aperture, row: int) -> None:
    seed = torch.Generator().manual_seed(row + 9)
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
    counted = pieces.high - pieces.low > 1e-6
    grads = [torch.randn(len(owned), generator=seed, dtype=torch.float64) * counted for _ in range(2)]
    want = torch.autograd.grad(out, (owned, *profile), grads)
    got = mean_edge_gradient(owned.detach(), pieces, Profile(*(t.detach() for t in profile)), *grads)
    for mine, theirs in zip(got, want, strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-9, atol=1e-9)
