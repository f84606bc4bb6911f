import math
from collections.abc import Callable
from itertools import pairwise

import pytest
import torch
from torch import Tensor
from torch.func import functional_call

from torchbokeh.ops.spans import Profile, area, edges_at, heights_above, piece_at, subdivide
from torchbokeh.ops.splat import splat_spans
from torchbokeh.psfs import Aperture, Disc, Ellipse, Polygon

F64 = torch.float64
SHAPES = {
    "disc": Disc(),
    "ellipse": Ellipse(2.0, 0.7),
    "triangle": Polygon(3, 0.2),
    "square": Polygon(4, math.pi / 4),
    "hexagon": Polygon(6),
    "round blades": Polygon(5, 0.4, 0.6),
}


@pytest.fixture(params=SHAPES)
def shape(request: pytest.FixtureRequest) -> Aperture:
    return SHAPES[request.param]


def blurred(values: Tensor, coc: Tensor, profile: Profile) -> Tensor:
    return splat_spans(values, coc, profile, integrate=True)


def sum_of_pieces(values: Tensor, coc: Tensor, profile: Profile, side: int) -> Tensor:
    """The mean over the pieces, each weighted by its area."""
    pieces = subdivide(profile, side)
    return torch.stack([area(p) * blurred(values, coc, p) for p in pieces]).sum(0) / sum(area(p) for p in pieces)


def test_edges_of_the_disc_are_its_circle() -> None:
    y = torch.linspace(-0.99, 0.99, 41, dtype=F64)
    left, right = edges_at(Disc().profile(), y)
    assert torch.allclose(right, (1 - y * y).sqrt(), atol=1e-12)
    assert torch.equal(left, -right)


def test_half_the_area_ends_half_way_up_what_is_symmetric() -> None:
    parts = torch.tensor([0.0, 1.0, 2.0], dtype=F64)
    assert torch.allclose(heights_above(Disc().profile(), parts, 2), parts / 2, atol=1e-9)


def test_heights_lie_in_the_piece_above_the_last_knot_that_they_reach() -> None:
    knots = torch.tensor([[-1.0, 0, 0], [0.0, -1, 1], [1.0, 0, 0]], dtype=F64)
    assert piece_at(knots, torch.tensor([-1.0, -0.5, 0.0, 1.0], dtype=F64)).tolist() == [0, 0, 1, 1]


def test_the_width_between_the_edges_makes_up_the_area(shape: Aperture) -> None:
    knots, _ = profile = shape.profile()
    bottom, top = float(knots[0, 0]), float(knots[-1, 0])
    y = bottom + (top - bottom) * (torch.arange(20_000, dtype=F64) + 0.5) / 20_000
    left, right = edges_at(profile, y)
    assert (left < right).all()
    assert float((right - left).mean()) * (top - bottom) == pytest.approx(float(area(profile)), rel=1e-5)


def test_edges_at_the_corners_of_a_polygon_are_the_corners() -> None:
    knots, _ = profile = SHAPES["hexagon"].profile()  # the highest and the lowest corner stand alone
    left, right = edges_at(profile, knots[:, 0].clone())
    assert torch.allclose(torch.stack([left, right], 1), knots[:, 1:], atol=1e-9)


@pytest.mark.parametrize("side", [2, 3, 5])
def test_the_pieces_are_equally_large(shape: Aperture, side: int) -> None:
    whole = float(area(shape.profile()))
    pieces = subdivide(shape.profile(), side)
    assert len(pieces) == side**2
    for piece in pieces:
        # A round edge becomes 47 chords in every row of pieces.
        assert float(area(piece)) == pytest.approx(whole / side**2, rel=4e-4)
    assert sum(float(area(p)) for p in pieces) == pytest.approx(whole, rel=3e-4)


@pytest.mark.parametrize("side", [2, 3])
def test_the_pieces_tile_the_shape(shape: Aperture, side: int) -> None:
    pieces = subdivide(shape.profile(), side)
    rows = [pieces[k : k + side] for k in range(0, len(pieces), side)]
    for row in rows:
        for one, other in pairwise(row):  # a cut along a column: what reaches it goes on beyond it
            assert torch.equal(one.knots[:, 0], other.knots[:, 0])
            assert float(other.knots[:, 1].amin()) == pytest.approx(float(one.knots[:, 2].amax()), abs=1e-12)
        widths = sum(piece.knots[:, 2] - piece.knots[:, 1] for piece in row)
        left, right = edges_at(shape.profile(), row[0].knots[:, 0])
        torch.testing.assert_close(widths, right - left, rtol=0, atol=1e-9)
    for lower, upper in pairwise(rows):
        assert float(lower[0].knots[-1, 0]) == pytest.approx(float(upper[0].knots[0, 0]), abs=1e-12)
    assert float(rows[0][0].knots[0, 0]) == pytest.approx(float(shape.profile().knots[0, 0]))
    assert float(rows[-1][0].knots[-1, 0]) == pytest.approx(float(shape.profile().knots[-1, 0]))


@pytest.mark.parametrize("side", [2, 3, 5])
def test_pieces_are_convex(shape: Aperture, side: int) -> None:
    for piece in subdivide(shape.profile(), side):
        y, left, right = piece.knots.T
        filled = right - left > 1e-9  # where a row is empty, both edges lie on the cut
        rise = y[filled].diff().clamp_min(1e-9)
        assert ((left[filled].diff() / rise).diff() > -1e-5).all()
        assert ((right[filled].diff() / rise).diff() < 1e-5).all()


@pytest.mark.parametrize("side", [2, 3])
@pytest.mark.parametrize("radius", [-4.0, 8.0])
def test_the_splats_of_the_pieces_add_up_to_that_of_the_shape(shape: Aperture, side: int, radius: float) -> None:
    dot = torch.zeros(1, 1, 21, 23, dtype=F64)
    dot[..., 10, 11] = 1
    coc = torch.full_like(dot, radius)
    difference = sum_of_pieces(dot, coc, shape.profile(), side) - blurred(dot, coc, shape.profile())
    # A row that a cut runs through is drawn as two rectangles, where that of the whole shape is one.
    assert float(difference.abs().sum()) < 0.008


@pytest.mark.parametrize("side", [2, 3])
def test_nothing_is_lost_where_the_sides_are_straight_along_a_cut(side: int) -> None:
    seed = torch.Generator().manual_seed(3)
    values = torch.rand(1, 2, 14, 18, generator=seed, dtype=F64)
    coc = torch.rand(1, 1, 14, 18, generator=seed, dtype=F64) * 16 - 8
    profile = SHAPES["square"].profile()
    assert torch.allclose(sum_of_pieces(values, coc, profile, side), blurred(values, coc, profile), atol=1e-12)


def test_one_piece_is_the_shape_itself(shape: Aperture) -> None:
    profile = shape.profile()
    (piece,) = subdivide(profile, 1)
    assert piece is profile


def test_more_chords_come_closer_to_the_disc() -> None:
    profile = Disc().profile()
    missing = [math.pi - sum(float(area(p)) for p in subdivide(profile, 2, samples)) for samples in (6, 12, 24, 48)]
    assert all(0 < finer < 0.4 * coarser for coarser, finer in pairwise(missing))


def turned(rotation: Tensor, curvature: Tensor) -> Profile:
    return functional_call(Polygon(5, 0.3, 0.5), {"rotation": rotation, "curvature": curvature}, ())


def stretched(squeeze: Tensor, rotation: Tensor) -> Profile:
    return functional_call(Ellipse(1.8, 0.5), {"squeeze": squeeze, "rotation": rotation}, ())


@pytest.mark.parametrize(("shape_of", "at"), [(turned, (0.35, 0.55)), (stretched, (1.7, 0.6))])
def test_gradients_reach_the_parameters_of_the_shape(shape_of: Callable[..., Profile], at: tuple[float, ...]) -> None:
    seed = torch.Generator().manual_seed(3)
    values = torch.rand(1, 1, 9, 10, generator=seed, dtype=F64)
    coc = torch.full_like(values, 3.3)
    pattern = torch.randn(4, 1, 9, 10, generator=seed, dtype=F64)

    def seen(*settings: Tensor) -> Tensor:
        pieces = subdivide(shape_of(*settings), 2)
        return (pattern * torch.cat([area(p) * blurred(values, coc, p) for p in pieces])).sum()

    settings = [torch.tensor(v, dtype=F64, requires_grad=True) for v in at]
    assert torch.autograd.gradcheck(seen, settings)
    for slope in torch.autograd.grad(seen(*settings), settings):
        assert slope.abs() > 1e-2


def test_a_shape_is_cut_into_at_least_one_piece() -> None:
    with pytest.raises(ValueError, match="side: expected at least 1, got 0"):
        subdivide(Disc().profile(), 0)
