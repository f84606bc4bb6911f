import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from torchbokeh.ops.outline import arcs_of, crossings, edge_at, row_pieces
from torchbokeh.ops.spans import MIN_RADIUS, Profile, clamp_radius
from torchbokeh.ops.splat import splat_spans
from torchbokeh.psfs import Aperture, Disc, Ellipse, Polygon

SHAPES = {
    "disc": Disc(),
    "ellipse": Ellipse(1.8, 0.0),
    "ellipse leaning": Ellipse(2.0, 0.7),
    "triangle": Polygon(3, 0.2),
    "square": Polygon(4, math.pi / 4),
    "hexagon": Polygon(6),
    "round blades": Polygon(5, 0.4, 0.6),
}
RADII = [*np.linspace(0.5, 3.0, 40), *np.geomspace(3.1, 60.0, 20)]
few = settings(deadline=None, max_examples=15)


@pytest.fixture(params=SHAPES)
def shape(request: pytest.FixtureRequest) -> Aperture:
    return SHAPES[request.param]


def true_edges(shape: Aperture, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Left and right end of the unit shape on the lines at height ``y``, not a number where they miss it."""
    with np.errstate(invalid="ignore", divide="ignore"):
        if isinstance(shape, Polygon):
            corners = shape.vertices().numpy()
            x0, y0 = corners.T[..., None]
            x1, y1 = np.roll(corners, -1, 0).T[..., None]
            x = np.where((y0 <= y) != (y1 <= y), x0 + (x1 - x0) * (y - y0) / (y1 - y0), np.nan)
            missed = np.isnan(x).all(0)
            x = np.where(missed, 0, x)
            ends = np.fmin.reduce(x), np.fmax.reduce(x)
            return tuple(np.where(missed, np.nan, e) for e in ends)
        width, angle = 1.0, 0.0
        if isinstance(shape, Ellipse):
            width, angle = 1 / float(shape.squeeze), float(shape.rotation)
        # |(across / width, along)| = 1 for the point (x, y) seen along the axes: a quadratic equation in x.
        cos, sin = math.cos(angle), math.sin(angle)
        a = (cos / width) ** 2 + sin**2
        b = -y * cos * sin * (1 / width**2 - 1)
        c = (y * sin / width) ** 2 + (y * cos) ** 2 - 1
        root = np.sqrt(b * b - a * c)
        return (-b - root) / a, (-b + root) / a


def true_area(shape: Aperture) -> float:
    y = (np.arange(200_000) + 0.5) / 100_000 - 1
    left, right = true_edges(shape, y)
    return float(np.nansum(right - left) / 100_000)


def rounded_sail() -> Profile:
    """A shape of one's own: knots, and arcs over them."""
    knots = torch.tensor(
        [[-0.7, -0.1, 0.2], [-0.2, -0.4, 0.3], [0.1, -0.45, 0.35], [0.8, -0.2, 0.0]], dtype=torch.float64
    )
    return Profile(knots, torch.tensor(0.25, dtype=torch.float64))


def psfs(coc: Tensor, profile: Profile, reach: int = 10) -> Tensor:
    """The PSFs as images ``(N, 2 reach + 1, 2 reach + 1)``."""
    dot = torch.zeros(len(coc), 1, 2 * reach + 1, 2 * reach + 1, dtype=coc.dtype)
    dot[..., reach, reach] = 1
    return splat_spans(dot, coc[:, None, None, None].expand_as(dot), profile, integrate=True)[:, 0]


def coverage(left: np.ndarray, right: np.ndarray, reach: int, steps: int) -> np.ndarray:
    """Share of each pixel between two edges, of the mass of all, from ``steps`` lines to a row: nan is not covered."""
    column = np.arange(-reach, reach + 1) - 0.5
    overlap = np.minimum(right[:, None], column + 1) - np.maximum(left[:, None], column)
    picture = np.nan_to_num(overlap).clip(0).reshape(2 * reach + 1, steps, -1).mean(1)
    return picture / picture.sum()


@pytest.mark.parametrize("coc", [0.5, 0.6, 0.885, 1.3, 2.0, 5.3, -0.7, -1.5, -4.7])
def test_every_pixel_gets_the_share_of_the_shape_that_covers_it(shape: Aperture, coc: float) -> None:
    steps, reach = 2000, 7
    y = (np.arange((2 * reach + 1) * steps) + 0.5) / steps - reach - 0.5
    ends = [coc * e for e in true_edges(shape, y / coc)]
    want = coverage(np.minimum(*ends), np.maximum(*ends), reach, steps)
    for dtype in (torch.float32, torch.float64):
        got = psfs(torch.tensor([coc], dtype=dtype), shape.profile(), reach)[0].double().numpy()
        assert np.abs(got - want).sum() < 1e-3


@pytest.mark.parametrize("coc", [0.7, 1.9, 4.4, -3.3])
def test_a_shape_of_knots_and_arcs_is_covered_as_well(coc: float) -> None:
    steps, reach, profile = 2000, 5, rounded_sail()
    y = (torch.arange((2 * reach + 1) * steps, dtype=torch.float64) + 0.5) / steps - reach - 0.5
    bottom, top = profile.knots[[0, -1], 0]
    inside = (y / coc > bottom) & (y / coc < top)
    # Both ends of such a shape are arcs; knots and arcs are told apart here without the code under test.
    height = (y / coc).clamp(bottom, top).numpy()
    t = (2 * height - float(bottom + top)) / float(top - bottom)
    arc = float(profile.bulge) * np.sqrt(np.clip(1 - t * t, 0, None))
    sides = [np.interp(height, profile.knots[:, 0].numpy(), profile.knots[:, k].numpy()) for k in (1, 2)]
    ends = [np.where(inside, coc * e, np.nan) for e in (sides[0] - arc, sides[1] + arc)]
    want = coverage(np.minimum(*ends), np.maximum(*ends), reach, steps)
    for dtype in (torch.float32, torch.float64):
        got = psfs(torch.tensor([coc], dtype=dtype), profile, reach)[0].double().numpy()
        assert np.abs(got - want).sum() < 1e-3


@pytest.mark.parametrize(("dtype", "relative"), [(torch.float32, 1e-5), (torch.float64, 1e-10)])
def test_a_disc_is_the_same_along_rows_and_along_columns(dtype: torch.dtype, relative: float) -> None:
    for radius in RADII if dtype == torch.float32 else RADII[::4]:
        psf = psfs(torch.tensor([radius, -radius], dtype=dtype), Disc().profile(), math.ceil(radius) + 1).double()
        assert float((psf - psf.transpose(1, 2)).abs().sum()) < 2 * relative
        assert torch.allclose(psf.sum((1, 2)), torch.ones(2, dtype=torch.float64), rtol=0, atol=relative)


@pytest.mark.parametrize("radius", [0.6, 0.93, 2.2, 7.4, 31.0])
def test_a_polygon_turned_by_a_quarter_is_the_picture_turned(radius: float) -> None:
    coc, reach = torch.tensor([radius], dtype=torch.float64), math.ceil(radius) + 1
    for blades in (3, 5, 6):
        upright, turned = (psfs(coc, Polygon(blades, 0.3 + k * math.pi / 2).profile(), reach)[0] for k in (0, 1))
        assert float((turned - upright.rot90()).abs().sum()) < 1e-6


@given(radius=st.floats(MIN_RADIUS, 60.0), name=st.sampled_from(list(SHAPES)), behind=st.booleans())
@few
def test_the_pixels_hold_a_mass_of_one(radius: float, name: str, behind: bool) -> None:
    coc = torch.tensor([radius if behind else -radius], dtype=torch.float64)
    reach = math.ceil(radius) + 1
    psf = psfs(coc, SHAPES[name].profile(), reach)[0]
    assert float(psf.min()) > -1e-10
    assert float(psf.sum()) == pytest.approx(1, abs=1e-10)
    place = torch.arange(-reach, reach + 1, dtype=torch.float64)
    # The centre of mass lies within the circle.
    assert float((psf.sum(0) @ place) ** 2 + (psf.sum(1) @ place) ** 2) < radius**2


def test_rows_out_of_reach_have_no_pieces(shape: Aperture) -> None:
    coc = torch.tensor([0.5, 3.0, -7.4], dtype=torch.float64)
    for row in (-9, 8, 500):
        pieces = row_pieces(coc, torch.full_like(coc, 9.5), row, shape.profile(), arcs_of(shape.profile()), 19)
        assert all(len(t) == 0 for t in pieces)


def test_the_smallest_psf_stays_within_its_pixel(shape: Aperture) -> None:
    psf = psfs(torch.tensor([MIN_RADIUS, -MIN_RADIUS], dtype=torch.float64), shape.profile(), 2)
    assert torch.allclose(psf[:, 2, 2], torch.ones(2, dtype=torch.float64))


def test_a_foreground_psf_is_mirrored_at_its_centre(shape: Aperture) -> None:
    behind, front = psfs(torch.tensor([4.3, -4.3], dtype=torch.float64), shape.profile())
    assert torch.allclose(front, behind.flip(0, 1), atol=1e-12)


@pytest.mark.parametrize("radius", [0.5, 1.0, 1.5, 2.0, 7.5, 8.0])
def test_the_psf_moves_no_faster_than_its_radius(shape: Aperture, radius: float) -> None:
    step = torch.tensor([1e-2, 1e-3, 1e-4, 1e-5, 1e-6], dtype=torch.float64)
    moved = (psfs(radius + step, shape.profile()) - psfs(radius + 0 * step, shape.profile())).abs().sum((1, 2))
    assert (moved < 4 * step / radius).all()
    if radius > MIN_RADIUS:
        moved = (psfs(radius - step, shape.profile()) - psfs(radius + 0 * step, shape.profile())).abs().sum((1, 2))
        assert (moved < 4 * step / radius).all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_slopes_stay_finite_where_outlines_touch_pixels(shape: Aperture, dtype: torch.dtype) -> None:
    touching = torch.tensor([0.5, 1.0, 1.5, 2.5, -2.5], dtype=dtype, requires_grad=True)
    weights = torch.rand(21, 21, generator=torch.Generator().manual_seed(0), dtype=dtype)
    (slope,) = torch.autograd.grad((psfs(touching, shape.profile()) * weights).sum(), touching)
    assert slope.isfinite().all()
    assert slope[1:].abs().max() < 4


def test_the_outline_is_where_it_is_crossed(shape: Aperture) -> None:
    for profile in (shape.profile(), rounded_sail()):
        arcs = arcs_of(profile)
        share = torch.linspace(0.02, 0.98, 25, dtype=torch.float64)
        for k in range(4):
            arc = torch.full((25,), k)
            y = arcs.ends[k, 0] + share * (arcs.ends[k, 1] - arcs.ends[k, 0])
            x = edge_at(profile, arc, y)
            found = crossings(profile, arcs, arc, x)
            # Within a level edge, y says little of x.
            off = torch.minimum((found - y).abs(), (edge_at(profile, arc, found) - x).abs())
            assert off.max() < 1e-12
            turn = edge_at(profile, arc[:1], arcs.ends[k, 1 - k % 2][None])
            assert (x >= turn - 1e-12).all() if k < 2 else (x <= turn + 1e-12).all()


def test_clamp_radius_keeps_the_sign() -> None:
    coc = torch.tensor([-3.0, -0.1, 0.0, 0.2, 0.5, 7.0])
    assert clamp_radius(coc).tolist() == [-3.0, -0.5, 0.5, 0.5, 0.5, 7.0]
