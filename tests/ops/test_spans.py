import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from torchbokeh.ops.spans import MIN_RADIUS, Profile, clamp_radius, row_span
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


@pytest.mark.parametrize("coc", [0.5, 0.8, 2.0, 5.3, -1.5, -4.7])
def test_a_row_has_the_mean_edges_and_the_share_of_the_true_shape(shape: Aperture, coc: float) -> None:
    steps = 4000
    density = 1 / (true_area(shape) * coc**2)
    for row in range(-7, 8):
        y = row - 0.5 + (np.arange(steps) + 0.5) / steps
        ends = [coc * e for e in true_edges(shape, y / coc)]
        left, right = np.minimum(*ends), np.maximum(*ends)
        covered = ~np.isnan(left)
        got = row_span(torch.tensor([coc], dtype=torch.float64), row, shape.profile())
        assert float(got[2]) == pytest.approx(covered.mean() * density, abs=2e-3 * density)
        if covered.mean() > 0.01:
            assert float(got[0]) == pytest.approx(left[covered].mean(), abs=3e-3)
            assert float(got[1]) == pytest.approx(right[covered].mean(), abs=3e-3)


@given(radius=st.floats(MIN_RADIUS, 300.0), name=st.sampled_from(list(SHAPES)), behind=st.booleans())
@few
def test_the_rows_hold_a_mass_of_one(radius: float, name: str, behind: bool) -> None:
    coc = torch.tensor([radius if behind else -radius], dtype=torch.float64)
    profile = SHAPES[name].profile()
    reach = math.ceil(radius) + 1
    mass, moment = torch.zeros(1, dtype=torch.float64), torch.zeros(1, dtype=torch.float64)
    for row in range(-reach, reach + 1):
        left, right, weight = row_span(coc, row, profile)
        assert (left <= right).all()
        assert weight >= 0
        mass += weight * (right - left)
        moment += weight * (right - left) * (left + right) / 2
    assert float(mass) == pytest.approx(1, abs=1e-10)
    assert abs(float(moment)) < radius  # the centre of mass lies within the circle


def test_rows_out_of_reach_have_no_weight_and_finite_ends(shape: Aperture) -> None:
    coc = torch.tensor([0.5, 3.0, -7.4], dtype=torch.float64)
    for row in (-9, 8, 500):
        left, right, weight = row_span(coc, row, shape.profile())
        assert torch.equal(weight, torch.zeros(3, dtype=torch.float64))
        assert left.isfinite().all()
        assert right.isfinite().all()


def test_the_smallest_psf_stays_within_its_pixel(shape: Aperture) -> None:
    coc = torch.tensor([MIN_RADIUS, -MIN_RADIUS], dtype=torch.float64)
    left, right, weight = row_span(coc, 0, shape.profile())
    assert (left >= -0.5).all()
    assert (right <= 0.5).all()
    assert torch.allclose(weight * (right - left), torch.ones(2, dtype=torch.float64))


def test_a_foreground_psf_is_mirrored_at_its_centre(shape: Aperture) -> None:
    behind, front = torch.tensor([4.3], dtype=torch.float64), torch.tensor([-4.3], dtype=torch.float64)
    for row in range(-5, 6):
        left, right, weight = row_span(behind, row, shape.profile())
        mirrored = row_span(front, -row, shape.profile())
        assert torch.allclose(torch.cat(mirrored), torch.cat([-right, -left, weight]), atol=1e-12)


def psfs(coc: Tensor, profile: Profile, reach: int = 10) -> Tensor:
    """The PSFs as images ``(N, 2 reach + 1, 2 reach + 1)``."""
    column = torch.arange(-reach, reach + 1, dtype=coc.dtype)
    rows = []
    for row in range(-reach, reach + 1):
        left, right, weight = (t[:, None] for t in row_span(coc, row, profile))
        overlap = torch.minimum(right, column + 0.5) - torch.maximum(left, column - 0.5)
        rows.append(overlap.clamp_min(0) * weight)
    return torch.stack(rows, 1)


@pytest.mark.parametrize("radius", [0.5, 1.0, 1.5, 2.0, 7.5, 8.0])
def test_the_psf_moves_no_faster_than_its_radius(shape: Aperture, radius: float) -> None:
    step = torch.tensor([1e-2, 1e-3, 1e-4, 1e-5, 1e-6], dtype=torch.float64)
    moved = (psfs(radius + step, shape.profile()) - psfs(radius + 0 * step, shape.profile())).abs().sum((1, 2))
    assert (moved < 4 * step / radius).all()
    if radius > MIN_RADIUS:
        moved = (psfs(radius - step, shape.profile()) - psfs(radius + 0 * step, shape.profile())).abs().sum((1, 2))
        assert (moved < 4 * step / radius).all()


def test_gradients_match_finite_differences_and_stay_finite_at_edges(shape: Aperture) -> None:
    coc = torch.tensor([0.61, 2.3, 5.77, -3.3], dtype=torch.float64, requires_grad=True)
    profile = shape.profile()

    def edges(coc: Tensor, row: int) -> Tensor:
        left, right, weight = row_span(coc, row, profile)
        return torch.stack([left * weight, right * weight])

    for row in (-2, 0, 3):
        assert torch.autograd.gradcheck(lambda c, row=row: edges(c, row), (coc,))
    touching = torch.tensor([0.5, 1.0, 1.5, 2.5, -2.5], dtype=torch.float64, requires_grad=True)
    for row in range(-3, 4):
        (slope,) = torch.autograd.grad(edges(touching, row).sum(), touching)
        assert slope.isfinite().all()


def test_clamp_radius_keeps_the_sign() -> None:
    coc = torch.tensor([-3.0, -0.1, 0.0, 0.2, 0.5, 7.0])
    assert clamp_radius(coc).tolist() == [-3.0, -0.5, 0.5, 0.5, 0.5, 7.0]
