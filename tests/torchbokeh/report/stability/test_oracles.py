"""Plain sums that stiff cases are compared with: against closed forms, and against pictures made by hand."""

import math

import pytest
import torch
from torch import Tensor

from torchbokeh.banks.splat import splat_bank
from torchbokeh.ops.dense import dense_points, dense_spans
from torchbokeh.ops.integrate import lattice_green
from torchbokeh.psfs.aperture import Disc
from torchbokeh.psfs.bank import PsfBank
from torchbokeh.psfs.combined import Combined, capsule
from torchbokeh.psfs.model import Labels
from torchbokeh.psfs.represent import DOMAINS, Represented, laplacian, nonzero, scanline
from torchbokeh.renderers.lens_blur import LensBlur
from torchbokeh.report.stability.cases import even, slope, texture
from torchbokeh.report.stability.oracles import (
    Sheet,
    composed,
    filled,
    gathered,
    gone_on,
    over,
    shares,
    splatted,
    viewed,
)
from torchbokeh.report.stability.splats import capsules, dense_bank, dense_samples


def dot(side: int, channels: int = 2) -> Tensor:
    """One pixel of 1 in the middle."""
    out = torch.zeros(1, channels, side, side, dtype=torch.float64)
    out[..., side // 2, side // 2] = 1
    return out


def layers(side: int) -> tuple[Tensor, Tensor]:
    """A left half in front of a whole layer, and their CoC: 2 px before the focus and 3 px behind it."""
    alpha = (torch.arange(side) < side // 2).double().expand(1, 1, side, side)
    front, back = (
        torch.cat([texture(side, side) * alpha, alpha], 1),
        torch.cat([texture(side, side, 1), alpha * 0 + 1], 1),
    )
    return torch.stack([front, back], 1), torch.stack([even(side, side, -2.0), even(side, side, 3.0)], 1)


def along(side: int, x: float, y: float) -> Tensor:
    """The same motion everywhere."""
    return torch.tensor([x, y], dtype=torch.float64).view(1, 2, 1, 1).expand(1, 2, side, side).contiguous()


@pytest.mark.parametrize("quality", ["exact", "balanced"])
@pytest.mark.parametrize("low", [-6.0, 1.0])
def test_a_constant_stays_constant(quality: str, low: float) -> None:
    image = torch.full((1, 3, 7, 9), 0.7, dtype=torch.float64)
    coc = slope(7, 9, low, 6.0)
    out = composed(LensBlur(quality=quality), image, coc)
    torch.testing.assert_close(out, image, rtol=1e-14, atol=0)


def test_a_constant_stays_constant_in_motion_and_with_banks() -> None:
    image, coc = torch.full((1, 3, 10, 10), 0.7, dtype=torch.float64), slope(10, 10, -4.0, 5.0)
    way = along(10, 4.0, -3.0)
    for out in (
        composed(LensBlur(), image, coc, way),
        gathered(image, coc, way),
        splatted(PsfBank.load("physical-lens"), image, coc),
    ):
        torch.testing.assert_close(out, image, rtol=1e-12, atol=0)


def test_one_opaque_sheet_is_a_plain_dense_splat() -> None:
    image, coc = texture(9, 11), slope(9, 11, 1.0, 4.0)
    sheet = Sheet(image, torch.ones_like(coc), coc, (), (2.5,), opaque=True)
    colour, covered = over([sheet], [Disc().profile()], lambda v, r, _, profile: dense_spans(v, r, profile))
    plain = dense_spans(torch.cat([image, torch.ones_like(coc)], 1), coc, Disc().profile())
    torch.testing.assert_close(colour, plain[:, :-1] / plain[:, -1:], rtol=1e-14, atol=0)
    assert bool((covered == 1).all())


def test_two_layers_with_an_even_blur_are_over_by_hand() -> None:
    side = 16
    rgba, coc = layers(side)
    out = composed(LensBlur(subapertures=1), rgba, coc)
    # In the middle, where no PSF reaches the border: the blurred front, and what it leaves of the blurred back.
    front, back = (dense_spans(rgba[:, k], coc[:, k], Disc().profile()) for k in (0, 1))
    want = front + (1 - front[:, 3:]) * back
    torch.testing.assert_close(out[..., 4:-4, 4:-4], want[..., 4:-4, 4:-4], rtol=1e-13, atol=1e-13)


def test_nothing_in_front_and_nothing_at_all_are_seen_through() -> None:
    rgba, coc = layers(8)
    rgba[:, 0] = 0
    back = composed(LensBlur(), rgba, coc)
    torch.testing.assert_close(back, composed(LensBlur(), rgba[:, 1:], coc[:, 1:]), rtol=1e-14, atol=0)
    assert bool((composed(LensBlur(), 0 * rgba, coc) == 0).all())


def test_a_sharp_foreground_edge_hides_what_is_behind_it() -> None:
    image, coc = texture(12, 12), even(12, 12, 0.0)
    coc[..., :6] = -3.0
    out = composed(LensBlur(), image, coc)
    # 4 px from the edge the disc of the front does not reach, so that what is sharp stays.
    torch.testing.assert_close(out[..., 10:], image[..., 10:], rtol=1e-13, atol=0)
    assert float((out[..., 6:9] - image[..., 6:9]).abs().max()) > 0.01


def test_shares_are_hats_that_sum_to_one() -> None:
    coc = torch.tensor([-3.0, -2.0, 0.5, 1.0, 3.0, 9.0], dtype=torch.float64).view(1, 1, 1, -1)
    hats = torch.cat(shares(coc, (-2.0, 1.0, 4.0), 1.0), 1)[0, :, 0].T
    want = [[1, 0, 0], [1, 0, 0], [1 / 6, 5 / 6, 0], [0, 1, 0], [0, 1 / 3, 2 / 3], [0, 0, 1]]
    torch.testing.assert_close(hats, torch.tensor(want, dtype=torch.float64))
    steep = torch.cat(shares(coc, (-2.0, 1.0, 4.0), 0.25), 1)[0, :, 0].T
    torch.testing.assert_close(steep[2], torch.tensor([0, 1, 0], dtype=torch.float64))
    torch.testing.assert_close(steep.sum(1), torch.ones(6, dtype=torch.float64))


def test_a_bin_counts_for_what_those_in_front_leave_free() -> None:
    bins = [
        torch.tensor([c * a, a], dtype=torch.float64).view(1, 2, 1, 1) for c, a in ((5.0, 0.5), (1.0, 0.7), (9.0, 1.0))
    ]
    colour, coverage = filled(bins)
    assert colour.item() == pytest.approx(0.5 * 5 + 0.5 * 1)
    assert coverage.item() == pytest.approx(2.2)


def test_a_map_goes_on_where_the_sheet_is_not() -> None:
    coc, alpha = even(6, 6, 4.0), torch.zeros(1, 1, 6, 6, dtype=torch.float64)
    alpha[..., 2:4, 2:4] = 0.5
    torch.testing.assert_close(gone_on(torch.where(alpha > 0, coc, 99.0), alpha), coc)


@pytest.mark.parametrize("domain", DOMAINS)
def test_every_domain_is_undone(domain: str) -> None:
    side, psf = 21, capsule(3.0, 4.0)
    sparse = {"direct": nonzero, "scanline": scanline, "laplacian": lambda p: nonzero(laplacian(p))}[domain](psf)
    model = Combined(radius=8.0, length=16.0)
    bank = PsfBank(model, [Represented(domain, sparse)] * len(model.grid))
    bank.extents = torch.ones(len(bank), dtype=torch.float64)
    model.extent = lambda coordinates: None  # samples as they are
    out = dense_samples(dot(side), Labels(even(side, side, 3.0), motion=along(side, 4.0, 0.0)), bank)
    picture = torch.zeros(side, side, dtype=torch.float64)
    height, width = psf.shape[1:]
    top, left = (side - height) // 2, (side - width) // 2
    picture[top : top + height, left : left + width] = torch.from_numpy(psf[0])
    torch.testing.assert_close(out[0, 0], picture, rtol=0, atol=1e-7)  # a bank holds float32


def test_points_land_where_the_plain_loop_puts_them() -> None:
    side, shift = 7, 9
    bank = PsfBank.load("combined")
    values, coc, way = dot(side), even(side, side, 4.0), along(side, 7.0, 5.0)
    labels = Labels(coc, motion=way)
    place, number = bank.model.place(labels), None
    number = bank.model.grid.index(place.coordinates.movedim(1, -1))
    ratio = bank.model.extent(place.coordinates.movedim(1, -1)) / bank.extents[number]
    frame = place.frame * ratio[:, None, None]
    buffer = dense_points(values / ratio[:, None] ** 2, number[:, None], bank.table("laplacian"), shift, rotation=frame)
    rows, columns = (torch.arange(n) - shift for n in buffer.shape[2:])
    green = lattice_green(side + shift + 1, side + shift + 1)
    at = torch.arange(side)
    y, x = (at[:, None] - rows).abs(), (at[:, None] - columns).abs()
    want = torch.einsum("bcyx,vuyx->bcvu", buffer, green[y[:, None, :, None], x[None, :, None, :]])
    torch.testing.assert_close(dense_samples(values, labels, bank), want, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("name", "radius", "way"),
    [
        ("combined", 2.0, (5.0, -3.0)),
        ("combined", 6.0, (12.0, 0.0)),
        ("physical-lens", 8.0, None),
        ("stylized", 9.0, None),
    ],
)
def test_a_bank_differs_from_its_sums_by_what_is_left_on_the_border_of_its_buffer(name, radius, way) -> None:
    side, bank = 12, PsfBank.load(name)
    count = bank.values.shape[1]
    values = torch.cat([texture(side, side), torch.ones(1, count, side, side, dtype=torch.float64)], 1)
    coc = slope(side, side, 0.8 * radius, radius)
    motion = None if way is None else along(side, *way)
    off = (
        splat_bank(values, Labels(coc, motion=motion), bank) - dense_bank(values, [Labels(coc, motion=motion)], bank)
    ).abs()
    place = bank.model.place(Labels(coc, motion=motion))
    number = bank.model.grid.index(place.coordinates.movedim(1, -1))
    pad = math.ceil(float(bank.reach()[number].max()) * (math.sqrt(2) if place.frame is not None else 1)) + 2
    wide = torch.nn.functional.pad
    more = None if motion is None else wide(motion, (pad,) * 4, mode="replicate")
    if not bank.model.fields:
        whole = dense_bank(
            wide(values, (pad,) * 4), [Labels(wide(coc, (pad,) * 4, mode="replicate"), motion=more)], bank
        )
        ring = torch.cat([whole[..., 0, :], whole[..., -1, :], whole[..., 0], whole[..., -1]], -1).abs().amax(-1)
        assert bool((off.amax((2, 3)) <= 4 * ring + 1e-13).all())
    assert float(off.max()) < 1e-3


def test_highlights_are_spread_evenly_over_their_capsules() -> None:
    side = 41
    for x, y in ((0.0, 0.0), (8.0, 6.0)):
        out = capsules(dot(side, 1), Labels(even(side, side, 7.0), motion=along(side, x, y)))[0, 0]
        assert out.sum().item() == pytest.approx(1, abs=1e-12)
        area = math.pi * 7**2 + 2 * 7 * math.hypot(x, y) / 1
        # Half-way along the motion the light is the chord over the way; without motion, the same on all of the disc.
        length = math.hypot(x, y)
        middle = 1 / (math.pi * 7**2) * (min(1.0, 14 / length) if length else 1.0)
        assert out[side // 2, side // 2].item() == pytest.approx(middle, rel=0.02)
        assert 0.8 * area < int((out > 0).sum()) < 1.3 * area


def test_views_of_one_sharp_layer_are_that_layer_and_of_a_far_one_its_disc() -> None:
    rgba = torch.cat([texture(9, 9), torch.ones(1, 1, 9, 9, dtype=torch.float64)], 1)[:, None]
    torch.testing.assert_close(viewed(rgba, even(9, 9, 0.0)[:, None], 8), rgba[:, 0])
    light = torch.cat([dot(21, 3), torch.ones(1, 1, 21, 21, dtype=torch.float64)], 1)[:, None]
    out = viewed(light, even(21, 21, 5.0)[:, None], 128)[0, 0]
    disc = dense_spans(dot(21, 1), even(21, 21, 5.0), Disc().profile())[0, 0]
    assert out.sum().item() == pytest.approx(1, abs=1e-12)
    # Looked up bilinearly, and so blurred by another pixel.
    assert float((out - disc).abs().sum()) < 0.25
    y, x = torch.meshgrid(torch.arange(21) - 10, torch.arange(21) - 10, indexing="ij")
    assert float(out[torch.hypot(y.double(), x.double()) > 7].abs().max()) == 0


def test_a_pan_moves_a_picture_by_its_way() -> None:
    image, coc = dot(15, 3), even(15, 15, 0.0)
    out = composed(LensBlur(), image, coc, along(15, 6.0, 0.0))[0, 0]
    assert out[7, 4:11].sum().item() > 0.7
    torch.testing.assert_close(out[7, 5:10], torch.full((5,), out[7, 7].item(), dtype=torch.float64), rtol=0.01, atol=0)
    assert float(out[:6].abs().max()) == 0


@pytest.mark.parametrize(("low", "high"), [(-2.2, -0.8), (-3.2, 3.7), (2.5, 3.9)])
def test_plans_that_pass_into_one_another_are_mixed(low: float, high: float) -> None:
    blur, image, coc = LensBlur(), texture(8, 8), slope(8, 8, low, high)
    assert blur.plan(image, coc=coc).fading
    torch.testing.assert_close(composed(blur, image, coc), blur(image, coc=coc), rtol=1e-13, atol=1e-13)


def test_layers_may_move_each_on_its_way() -> None:
    rgba, coc = layers(10)
    motion = torch.stack([along(10, 5.0, 2.0), along(10, -4.0, 0.0)], 1)
    for shutter in ("centre", "start"):
        blur = LensBlur(shutter=shutter)
        off = (composed(blur, rgba, coc, motion) - blur(rgba, coc=coc, motion=motion)).abs()
        assert float(off.mean()) < 1e-4
