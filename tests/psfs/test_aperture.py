import copy
import doctest
import io
import math
import pickle

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn

import torchbokeh.psfs.aperture
from torchbokeh.ops.spans import area
from torchbokeh.ops.splat import splat_spans
from torchbokeh.psfs import Aperture, Disc, Ellipse, Polygon, parse_aperture, polygon_profile

F64 = torch.float64
SHAPES = [Disc(), Ellipse(1.5, 0.3), Polygon(3), Polygon(6, 0.2), Polygon(7, -0.4, 0.5)]
few = settings(deadline=None, max_examples=30)


def area_of(shape: Aperture) -> float:
    return area(shape.profile()).item()


def highlight(shape: Aperture, radius: float = 20.0) -> Tensor:
    dot = torch.zeros(1, 1, 47, 47, dtype=F64)
    dot[..., 23, 23] = 1
    return splat_spans(dot, torch.full_like(dot, radius), shape.profile(), integrate=True)[0, 0]


def edge_points(shape: Aperture) -> Tensor:
    """Points of the outline, as complex numbers."""
    knots, bulge = shape.profile()
    share = torch.linspace(0, 1, 200, dtype=F64)[:, None]
    y, left, right = (knots[:-1] + share[..., None] * (knots[1:] - knots[:-1])).reshape(-1, 3).unbind(1)
    t = (2 * y - knots[0, 0] - knots[-1, 0]) / (knots[-1, 0] - knots[0, 0])
    arc = bulge * (1 - t * t).clamp_min(0).sqrt()
    return torch.complex(torch.cat([left - arc, right + arc]), torch.cat([y, y])).detach()


@pytest.mark.parametrize("blades", [3, 4, 5, 6, 9, 64])
@given(rotation=st.floats(-10, 10))
@few
def test_area_of_a_regular_polygon(blades: int, rotation: float) -> None:
    want = blades / 2 * math.sin(2 * math.pi / blades)
    assert area_of(Polygon(blades, rotation)) == pytest.approx(want, rel=1e-6)


@given(squeeze=st.floats(1, 5), rotation=st.floats(-10, 10))
@few
def test_area_of_an_ellipse(squeeze: float, rotation: float) -> None:
    assert area_of(Ellipse(squeeze, rotation)) == pytest.approx(math.pi / squeeze, rel=1e-4)


def test_area_of_the_disc() -> None:
    assert area_of(Disc()) == pytest.approx(math.pi, rel=1e-12)


@pytest.mark.parametrize("blades", [3, 5, 8])
def test_round_blades_make_a_disc(blades: int) -> None:
    assert area_of(Polygon(blades, 0.3, curvature=1.0)) == pytest.approx(math.pi, rel=5e-3)
    radii = Polygon(blades, 0.3, curvature=1.0).vertices().norm(dim=1)
    assert torch.allclose(radii, torch.ones_like(radii), atol=1e-6)
    difference = highlight(Polygon(blades, 0.3, curvature=1.0)) - highlight(Disc())
    assert float(difference.abs().sum()) < 0.02


@pytest.mark.parametrize("blades", [3, 4, 5, 6])
@pytest.mark.parametrize("curvature", [1e-12, 1e-9, 6e-8, 1e-6])
def test_almost_straight_blades_are_as_good_as_straight_ones(blades: int, curvature: float) -> None:
    for rotation in (0.0, math.pi / blades):
        difference = highlight(Polygon(blades, rotation, curvature)) - highlight(Polygon(blades, rotation))
        assert float(difference.abs().sum()) < 1e-4


def test_curvature_runs_from_the_straight_to_the_round_blade() -> None:
    areas = [area_of(Polygon(5, curvature=c)) for c in (0.0, 1e-6, 0.25, 0.5, 0.75, 1.0)]
    assert areas == sorted(areas)
    assert areas[1] == pytest.approx(areas[0], rel=1e-5)


@given(
    shape=st.one_of(
        st.builds(Ellipse, st.floats(1, 5), st.floats(-4, 4)),
        st.builds(Polygon, st.integers(3, 9), st.floats(-4, 4), st.floats(0, 1)),
    )
)
@few
def test_shapes_touch_the_unit_circle_from_within(shape: Aperture) -> None:
    knots = shape.profile().knots
    assert (knots[1:, 0] >= knots[:-1, 0]).all()
    reach = edge_points(shape).abs().max().item()
    assert 0.99 < reach < 1 + 1e-6


@pytest.mark.parametrize("build", [lambda r: Ellipse(2.0, r), lambda r: Polygon(3, r), lambda r: Polygon(5, r, 0.4)])
def test_rotation_turns_the_image_counter_clockwise(build: type[Aperture]) -> None:
    upright, turned = highlight(build(0.2)), highlight(build(0.2 + math.pi / 2))
    assert float((turned - upright.rot90()).abs().sum()) < 0.03
    assert float((highlight(build(0.2 + math.pi)) - upright.flip(0, 1)).abs().max()) < 1e-7
    assert float((turned - upright).abs().sum()) > 0.05


def test_a_polygon_has_a_corner_on_top_and_an_ellipse_stands_upright() -> None:
    corners = Polygon(5).vertices()
    assert torch.allclose(corners[corners[:, 1].argmin()], torch.tensor([0.0, -1.0], dtype=F64))
    image = highlight(Ellipse(2.0))
    assert int((image.sum(1) > 1e-9).sum()) == 41
    assert int((image.sum(0) > 1e-9).sum()) == 21


def test_any_convex_polygon_in_either_direction() -> None:
    corners = torch.tensor([[0.5, -0.5], [0.8, 0.1], [0.0, 0.6], [-0.7, 0.2]], dtype=F64)
    profiles = polygon_profile(corners), polygon_profile(corners.flip(0))
    assert torch.allclose(profiles[0].knots, profiles[1].knots)
    x, y = corners.unbind(1)
    shoelace = 0.5 * (x * y.roll(-1) - x.roll(-1) * y).sum().abs().item()
    assert area(profiles[0]).item() == pytest.approx(shoelace)
    want = torch.tensor([[-0.5, 0.5, 0.5], [0.1, -0.529, 0.8], [0.2, -0.7, 0.64], [0.6, 0.0, 0.0]], dtype=F64)
    assert torch.allclose(profiles[0].knots, want, atol=1e-3)


def test_polygons_are_differentiable_to_their_corners() -> None:
    corners = torch.tensor([[0.5, -0.5], [0.8, 0.1], [0.0, 0.6], [-0.7, 0.2]], dtype=F64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda c: area(polygon_profile(c)), (corners,))


@pytest.mark.parametrize("shape", SHAPES, ids=repr)
def test_survives_pickle_deepcopy_and_state_dict(shape: Aperture) -> None:
    buffer = io.BytesIO()
    torch.save(shape.state_dict(), buffer)
    buffer.seek(0)
    loaded = copy.deepcopy(shape)
    for name in loaded.state_dict():
        loaded.register_buffer(name, torch.ones(()))
    loaded.load_state_dict(torch.load(buffer))
    for twin in (pickle.loads(pickle.dumps(shape)), copy.deepcopy(shape), loaded):
        assert repr(twin) == repr(shape)
        assert all(torch.equal(a, b) for a, b in zip(twin.profile(), shape.profile(), strict=True))


@pytest.mark.parametrize("shape", SHAPES, ids=repr)
def test_follows_the_dtype_but_computes_in_double(shape: Aperture) -> None:
    want = shape.profile()
    half = copy.deepcopy(shape).to(torch.bfloat16)
    assert all(t.dtype == F64 for t in half.profile())
    assert all(torch.allclose(a, b, atol=1e-2) for a, b in zip(half.profile(), want, strict=True))
    assert all(torch.equal(a, b) for a, b in zip(shape(), want, strict=True))


@pytest.mark.parametrize("curvature", [0.0, 0.4])
def test_a_parameter_stays_one_and_learns(curvature: float) -> None:
    rotation, bend = nn.Parameter(torch.tensor(0.3)), nn.Parameter(torch.tensor(curvature))
    shape = Polygon(5, rotation, bend)
    assert shape.rotation is rotation
    assert {name for name, _ in shape.named_parameters()} == {"rotation", "curvature"}
    shape.profile().knots.square().sum().backward()
    for parameter in (rotation, bend):
        assert parameter.grad is not None
        assert parameter.grad.isfinite()
        assert parameter.grad != 0
    squeeze = nn.Parameter(torch.tensor(1.5))
    area(Ellipse(squeeze, 0.4).profile()).backward()
    assert squeeze.grad is not None
    assert squeeze.grad.item() == pytest.approx(-math.pi / 1.5**2, rel=1e-5)
    assert "1.5" in repr(Ellipse(squeeze))


def test_plain_numbers_are_no_parameters() -> None:
    shape = Polygon(5, 0.3, 0.5)
    assert not list(shape.parameters())
    assert sorted(shape.state_dict()) == ["curvature", "rotation"]
    assert not list(Disc().state_dict())
    assert repr(shape) == "Polygon(blades=5, rotation=0.3, curvature=0.5)"


def test_names() -> None:
    assert isinstance(parse_aperture("disc"), Disc)
    hexagon = parse_aperture("6-gon")
    assert isinstance(hexagon, Polygon)
    assert hexagon.blades == 6
    assert parse_aperture(hexagon) is hexagon


def test_bad_input_is_named() -> None:
    with pytest.raises(TypeError, match="blades: expected an int, got float"):
        Polygon(6.0)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="blades: expected an int, got bool"):
        Polygon(True)
    with pytest.raises(ValueError, match="blades: expected 3 to 64, got 2"):
        Polygon(2)
    with pytest.raises(ValueError, match=r"curvature: expected a number from 0 to 1, got 1\.5"):
        Polygon(6, curvature=1.5)
    with pytest.raises(ValueError, match="rotation: expected a number from -1000 to 1000, got nan"):
        Polygon(6, rotation=math.nan)
    with pytest.raises(ValueError, match=r"squeeze: expected a number from 1 to 100, got 0\.5"):
        Ellipse(0.5)
    with pytest.raises(ValueError, match=r"squeeze: expected one number, got shape \(2,\)"):
        Ellipse(torch.ones(2))
    with pytest.raises(TypeError, match="aperture: expected a name or an Aperture, got int"):
        parse_aperture(6)  # type: ignore[arg-type]
    for name in ("star", "gon", "6gon", "-3-gon"):
        with pytest.raises(ValueError, match=f"aperture: expected 'disc', 'N-gon' .*got '{name}'"):
            parse_aperture(name)
    with pytest.raises(ValueError, match="blades: expected 3 to 64, got 0"):
        parse_aperture("0-gon")
    with pytest.raises(ValueError, match=r"vertices: expected shape \(V, 2\) with V >= 3, got \(2, 2\)"):
        polygon_profile(torch.zeros(2, 2))
    dart = torch.tensor([[0.0, -1.0], [0.8, 0.8], [0.0, 0.2], [-0.8, 0.8]])
    with pytest.raises(ValueError, match="vertices: expected a convex polygon"):
        polygon_profile(dart)


def test_the_base_class_has_no_shape() -> None:
    with pytest.raises(NotImplementedError):
        Aperture().profile()


def test_examples() -> None:
    assert doctest.testmod(torchbokeh.psfs.aperture).failed == 0
