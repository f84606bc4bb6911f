import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.nn import functional as F

from torchbokeh.compose.composition import blurred, compose
from torchbokeh.compose.surfaces import Surface, continued, split_foreground
from torchbokeh.ops.composite import bin_weights
from torchbokeh.ops.spans import Profile, subdivide
from torchbokeh.plan.bins import FOREGROUND, SPACING, bin_centres
from torchbokeh.plan.quality import Detail
from torchbokeh.psfs import Disc

F32, F64 = torch.float32, torch.float64
few = settings(deadline=None, max_examples=40)


def lens(side: int) -> list[Profile]:
    return subdivide(Disc().profile(), side)


def surface(colour: Tensor, coc: float | Tensor, alpha: Tensor | None = None) -> Surface:
    """A surface in one bin; ``colour (B, C, H, W)`` is not yet premultiplied."""
    radii = coc if isinstance(coc, Tensor) else torch.full_like(colour[:, :1], coc)
    return Surface(colour if alpha is None else colour * alpha, alpha, radii, (float(radii.mean()),))


def grey(value: float, height: int = 40, width: int = 56) -> Tensor:
    return torch.full((1, 1, height, width), value)


def left_of(column: int, height: int = 40, width: int = 56) -> Tensor:
    """1 in the columns before ``column``, 0 from there on."""
    return (torch.arange(width) < column).float().expand(1, 1, height, width).clone()


@few
@given(low=st.floats(-80, 80), extent=st.floats(0, 160), most=st.integers(1, 12))
def test_bins_lie_evenly_from_the_nearest_to_the_farthest(low: float, extent: float, most: int) -> None:
    centres = bin_centres(low, low + extent, most)
    assert 1 <= len(centres) <= most
    if len(centres) == 1:
        assert centres[0] == pytest.approx(low + extent / 2)
        return
    steps = torch.tensor(centres, dtype=F64).diff()
    assert torch.allclose(steps, steps.mean().expand_as(steps))
    assert steps.min() > 0
    assert centres[-1] >= low + extent - 1e-6
    if extent >= 2:
        assert centres[0] == pytest.approx(low)
        assert centres[-2] < low + extent
    if 2 < len(centres) < most:
        assert steps.max() <= SPACING + 1e-9


@few
@given(low=st.floats(-80, 80), extent=st.sampled_from([1.0, 2.0, 6.0, 12.0, 18.0, 42.0]), most=st.integers(1, 12))
def test_bins_come_and_move_without_a_jump(low: float, extent: float, most: int) -> None:
    coc = torch.linspace(low, low + extent, 50, dtype=F64).view(1, 1, 1, -1)
    before, after = (bin_weights(coc, bin_centres(low, low + extent + s, most)) for s in (-1e-6, 1e-6))
    nothing = torch.zeros_like(coc)
    for k in range(max(len(before), len(after))):
        pair = [w[k] if k < len(w) else nothing for w in (before, after)]
        assert float((pair[0] - pair[1]).abs().max()) < 1e-5


@pytest.mark.parametrize(
    ("low", "high", "most", "count"),
    [(-3, -3, 8, 1), (0, 1, 8, 1), (0, 1.1, 8, 2), (0, 6, 8, 2), (0, 6.1, 8, 3), (-20, 20, 8, 8), (-20, 20, 1, 1)],
)
def test_how_many_bins_there_are(low: float, high: float, most: int, count: int) -> None:
    assert len(bin_centres(low, high, most)) == count


@few
@given(seed=st.integers(0, 999), count=st.integers(1, 9), start=st.floats(-50, 50), step=st.floats(0.5, 12))
def test_the_shares_of_a_pixel_make_up_the_whole(seed: int, count: int, start: float, step: float) -> None:
    centres = [start + k * step for k in range(count)]
    source = torch.Generator().manual_seed(seed)
    # Some pixels lie beyond the outer centres.
    coc = start - step + (count + 1) * step * torch.rand(1, 1, 5, 7, generator=source, dtype=F64)
    weights = torch.stack(bin_weights(coc, centres))
    assert (weights >= 0).all()
    assert torch.allclose(weights.sum(0), torch.ones_like(coc))
    assert ((weights > 0).sum(0) <= 2).all()
    if count > 1:
        mean = sum(w * c for w, c in zip(weights, centres, strict=True))
        assert torch.allclose(mean, coc.clamp(centres[0], centres[-1]), atol=1e-9)


def test_a_pixel_at_a_centre_is_in_that_bin_alone() -> None:
    centres = (-4.0, -1.0, 2.0)
    weights = bin_weights(torch.tensor(centres).view(1, 1, 1, 3), centres)
    assert torch.equal(torch.cat(weights).view(3, 3), torch.eye(3))


def test_a_pixel_at_an_outer_centre_takes_that_with_it() -> None:
    coc = torch.tensor([-4.0, -2.5, 0.5, 2.0], dtype=F64).view(1, 1, 1, 4).requires_grad_()
    for weight, slope in zip(bin_weights(coc, (-4.0, -1.0, 2.0)), (-1, 0, 1), strict=True):
        (got,) = torch.autograd.grad(weight.sum(), coc, retain_graph=True)
        want = {-1: [0, -1, 0, 0], 0: [0, 1, -1, 0], 1: [0, 0, 1, 0]}[slope]
        assert torch.allclose(got.flatten() * 3, torch.tensor(want, dtype=F64))


def strip(near: float = -8.0, far: float = 3.0) -> tuple[Tensor, Tensor, Tensor]:
    """A picture and its CoC with a foreground in the columns 20 to 29, and where that is."""
    image = torch.rand(1, 3, 40, 56, generator=torch.Generator().manual_seed(2))
    inside = left_of(30) - left_of(20)
    return image, torch.where(inside > 0, near, far), inside


def test_what_lies_before_the_focus_plane_is_foreground() -> None:
    steps = torch.tensor([-30.0, -2.0, -1.75, -1.5, -1.0, -0.5, 0.0, 9.0]).view(1, 1, 1, 8)
    image = torch.rand(1, 3, 1, 8, generator=torch.Generator().manual_seed(0))
    front, rest = split_foreground(image, steps, None, ((-30.0, -2.0), (-2.0, 9.0)))
    assert front.alpha is not None
    want = torch.tensor([1, 1, 0.75, 0.5, 0, 0, 0, 0]).view(1, 1, 1, 8)
    assert torch.allclose(front.alpha, want)
    assert torch.allclose(front.colour, image * want)
    assert FOREGROUND == (-2.0, -1.0)
    assert (front.centres, rest.centres) == ((-30.0, -2.0), (-2.0, 9.0))
    assert rest.alpha is None


def test_the_rest_is_filled_from_what_surrounds_the_foreground() -> None:
    image, coc, inside = strip()
    image = torch.where(inside > 0, 50.0, 0.2 + 0.1 * image)  # a foreground far brighter than anything behind
    front, rest = split_foreground(image, coc, None, ((-8.0,), (3.0,)))
    beside = F.max_pool2d(inside, 3, 1, 1)
    assert torch.equal(rest.colour[(beside == 0).expand_as(image)], image[(beside == 0).expand_as(image)])
    assert rest.colour.min() >= 0.2
    assert rest.colour.max() <= 0.3
    assert torch.allclose(rest.coc, torch.full_like(coc, 3.0))
    assert torch.allclose(front.coc, torch.full_like(coc, -8.0))
    assert front.alpha is not None
    assert torch.equal(front.alpha, inside)


def test_pixels_beside_the_foreground_hold_its_colour_and_are_replaced() -> None:
    image, coc, _ = strip()
    other = image.clone()
    other[..., 19] = 99.0
    other[..., 30] = 99.0
    bins = ((-8.0,), (3.0,))
    _, one = split_foreground(image, coc, None, bins)
    _, two = split_foreground(other, coc, None, bins)
    torch.testing.assert_close(one.colour, two.colour, rtol=0, atol=1e-6)


def test_where_the_foreground_is_beside_everything_the_rest_is_what_is_left() -> None:
    image, _, _ = strip()
    grid = (torch.arange(56) % 3 > 0).expand(1, 1, 40, 56)  # every column that is not foreground is beside it
    _, rest = split_foreground(torch.where(grid, 9.0, image), torch.where(grid, -8.0, 3.0), None, ((-8.0,), (3.0,)))
    assert rest.colour.max() <= 1
    assert rest.colour.mean() == pytest.approx(0.5, abs=0.05)
    assert torch.allclose(rest.coc, torch.full_like(rest.coc, 3.0))


@pytest.mark.parametrize("with_coc", [True, False])
def test_a_given_background_stands_in_where_something_hides_it(with_coc: bool) -> None:
    image, coc, inside = strip()
    colour, behind = torch.full_like(image, 7.0), torch.full_like(coc, 5.0)
    _, rest = split_foreground(image, coc, (colour, behind if with_coc else None), ((-8.0,), (3.0, 5.0)))
    beside = F.max_pool2d(inside, 3, 1, 1)
    assert torch.equal(rest.colour, torch.where(beside > 0, colour, image))
    assert torch.allclose(rest.coc, torch.where(beside > 0, 5.0 if with_coc else 3.0, coc))


def test_a_coc_is_continued_from_where_the_surface_is() -> None:
    _, coc, inside = strip()
    coc = torch.where(inside > 0, coc, 1e6)
    assert torch.allclose(continued(coc, inside), torch.full_like(coc, -8.0))
    assert torch.allclose(continued(coc, 0.1 * inside), torch.full_like(coc, -8.0))
    everywhere = torch.ones_like(coc)
    assert torch.equal(continued(coc, everywhere), coc)
    ramp = torch.arange(56.0).expand(1, 1, 40, 56) + 0.5
    known = 1 - inside
    filled = continued(torch.where(inside > 0, -1e9, ramp), known)
    assert torch.equal(filled[known > 0], ramp[known > 0])
    assert (filled - ramp).abs().max() < 10


def segment(distance: Tensor) -> Tensor:
    """Share of the unit disc beyond a line at this distance from its centre."""
    t = distance.clamp(-1, 1)
    return (t.acos() - t * (1 - t * t).sqrt()) / math.pi


@pytest.mark.parametrize("side", [1, 2, 3])
@pytest.mark.parametrize("radius", [2.5, 6.0, 11.3])
@pytest.mark.parametrize("upright", [True, False])
def test_the_rim_of_a_blurred_edge_is_see_through_as_the_disc_says(radius: float, side: int, upright: bool) -> None:
    """White before black: the coverage is the share of the disc that lies on the white side of the edge."""
    size = (40, 56) if upright else (56, 40)
    alpha = left_of(28) if upright else left_of(28).mT.contiguous()
    front = surface(grey(1.0, *size), -radius, alpha)
    got, covered = compose([front, surface(grey(0.0, *size), 0.0)], lens(side))
    profile = got[0, 0, 20] if upright else got[0, 0, :, 20]
    want = segment((torch.arange(56) + 0.5 - 28) / radius)
    assert torch.allclose(covered, torch.ones_like(covered), atol=1e-5)
    # A row of the disc is drawn as a rectangle of its mass: exact across rows, and along them but for round ends.
    slack = 1e-4 if not upright else 0.015 if radius < 3 else 0.002
    assert torch.allclose(profile, want, rtol=0, atol=slack)
    assert torch.allclose(profile.sum(), want.sum(), rtol=1e-5)


@pytest.mark.parametrize("side", [1, 2, 3])
@pytest.mark.parametrize("coc", [-7.3, 7.3, 0.2])
def test_a_dot_keeps_its_energy(coc: float, side: int) -> None:
    alpha = grey(0.0)
    alpha[..., 20, 28] = 1
    colour, covered = compose([surface(grey(4.0), coc, alpha), surface(grey(0.0), 9.0)], lens(side))
    assert float(colour.sum()) == pytest.approx(4.0, rel=1e-5)
    assert torch.allclose(covered, torch.ones_like(covered), atol=1e-5)
    colour, covered = compose([surface(grey(4.0), coc, alpha)], lens(side))
    assert float(colour.sum()) == pytest.approx(4.0, rel=1e-5)
    assert float(covered.sum()) == pytest.approx(1.0, rel=1e-5)


def test_in_focus_layers_are_put_over_one_another() -> None:
    source = torch.Generator().manual_seed(5)
    colours = torch.rand(3, 1, 3, 9, 11, generator=source)
    alphas = torch.rand(3, 1, 1, 9, 11, generator=source)
    colour, covered = torch.zeros(1, 3, 9, 11), torch.zeros(1, 1, 9, 11)
    for c, a in zip(colours, alphas, strict=True):
        colour = colour + (1 - covered) * a * c
        covered = covered + (1 - covered) * a
    layers = [surface(c, 0.3, a) for c, a in zip(colours, alphas, strict=True)]
    for got, want in zip(compose(layers, lens(2)), (colour, covered), strict=True):
        assert torch.allclose(got, want, atol=1e-5)


def through_a_lens(front: tuple[Tensor, Tensor, float], back: tuple[Tensor, float]) -> Tensor:
    """The mean of pinhole pictures from many points of a round lens: shift every surface, then put it over the next.

    Surfaces are rows ``(W,)``: the same everywhere along y.
    """
    colour, alpha, near = front
    fine = 8  # samples of a pixel
    u = torch.linspace(-1, 1, 403, dtype=F64)[1:-1]
    chord = (1 - u * u).sqrt()
    total = torch.zeros(len(colour) * fine, dtype=F64)

    def shifted(row: Tensor, by: float) -> Tensor:
        place = torch.arange(len(total), dtype=F64) / fine + 0.5 / fine - by
        return row.double()[place.floor().long().clamp(0, len(row) - 1)]

    for place, weight in zip(u.tolist(), chord.tolist(), strict=True):
        seen = shifted(alpha, near * place)
        behind = shifted(back[0], back[1] * place)
        total += weight * (seen * shifted(colour, near * place) + (1 - seen) * behind)
    return (total / chord.sum()).view(-1, fine).mean(1).to(colour.dtype)


def test_more_sub_apertures_come_closer_to_what_a_lens_sees() -> None:
    """Coverage of the front and colour of the back depend on the same point of the lens: one "over" forgets that."""
    stripes = (torch.arange(56) % 14 < 7).float()
    edge = left_of(28)
    near, far = -9.0, 8.0
    want = through_a_lens((torch.full((56,), 0.4), edge[0, 0, 0], near), (stripes, far))
    errors = []
    for side in (1, 2, 3, 5):
        front = surface(grey(0.4), near, edge)
        got, _ = compose([front, surface(stripes.expand(1, 1, 40, 56).clone(), far)], lens(side))
        errors.append(float((got[0, 0, 20] - want)[16:40].abs().mean()))
    one, two, three, five = errors
    assert two < 0.6 * one
    assert three < 0.3 * one
    assert five < 0.2 * one
    assert five < 0.01


def test_an_opaque_surface_stops_all_light_and_thins_out_at_the_border() -> None:
    colour, stopped, density = blurred(surface(grey(0.5), 10.0), lens(3)[0], Detail())
    assert torch.equal(stopped, torch.ones_like(stopped))
    assert torch.allclose(density[..., 12:28, 12:44], torch.ones(1, 1, 16, 32))
    assert density.min() < 1e-6  # this piece of the lens looks over the border from the corner of the picture
    assert torch.allclose(colour[density > 1e-3], grey(0.5)[density > 1e-3], rtol=1e-4)


def test_a_surface_with_holes_stops_what_it_covers() -> None:
    colour, stopped, density = blurred(surface(grey(3.0), 6.0, grey(0.25)), lens(1)[0], Detail())
    assert torch.allclose(stopped, grey(0.25), atol=1e-5)
    assert torch.allclose(colour, grey(3.0), rtol=1e-5)
    assert torch.allclose(density[..., 8:32, 8:48], torch.ones(1, 1, 24, 40))


@pytest.mark.parametrize("side", [1, 2, 3])
def test_a_foreground_hides_what_is_behind_it_at_the_border_too(side: int) -> None:
    """Some pieces of the lens see the foreground only beyond the border, where it is not known."""
    got, _ = compose([surface(grey(1.0), -11.0, grey(1.0)), surface(grey(0.0), 0.0)], lens(side))
    assert torch.allclose(got, grey(1.0), atol=1e-5)


@pytest.mark.parametrize("dtype", [F32, F64])
def test_order_counts_front_to_back(dtype: torch.dtype) -> None:
    red, blue = (surface(grey(v, 12, 14).to(dtype), 2.0) for v in (0.9, 0.1))
    for first, second, want in ((red, blue, 0.9), (blue, red, 0.1)):
        got, covered = compose([first, second], lens(2))
        assert got.dtype == dtype
        assert torch.allclose(got, torch.full_like(got, want), rtol=1e-5)
        assert torch.allclose(covered, torch.ones_like(covered))


def test_a_highlight_beside_the_foreground_does_not_make_what_is_hidden_glow() -> None:
    image, coc = torch.full((1, 3, 40, 56), 0.2), torch.full((1, 1, 40, 56), 3.0)
    coc[..., 20:30] = -8.0
    image[..., 20, 18] = 100.0
    _, rest = split_foreground(image, coc, None, ((-8.0,), (3.0,)))
    assert rest.colour[..., 20:30].max() < 0.21
    assert rest.colour[0, 0, 20, 18] == 100.0


@pytest.mark.parametrize("side", [1, 2, 3])
def test_a_half_transparent_foreground_stays_so_up_to_the_border(side: int) -> None:
    front = surface(grey(1.0), -8.0, grey(0.5))
    picture, _ = compose([front, surface(grey(0.0), 0.0)], lens(side))
    torch.testing.assert_close(picture, grey(0.5), rtol=0, atol=1e-5)
