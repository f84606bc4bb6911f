"""The definitions in double, against oracles: the way through plans, bins and banks, written a second time."""

import importlib.util
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from torchbokeh import KernelSplatting, LensBlur
from torchbokeh.banks.splat import splat_bank
from torchbokeh.ops.dense import dense_points, dense_spans
from torchbokeh.ops.integrate import lattice_green
from torchbokeh.psfs.aperture import Disc
from torchbokeh.psfs.bank import PsfBank
from torchbokeh.psfs.combined import Combined, capsule
from torchbokeh.psfs.model import Labels
from torchbokeh.psfs.represent import DOMAINS, Represented, laplacian, nonzero, scanline
from torchbokeh.report.stability.cases import cases, even, slope, texture
from torchbokeh.report.stability.renderers import layers_of

spec = importlib.util.spec_from_file_location("oracles", Path(__file__).with_name("oracles.py"))
assert spec is not None
assert spec.loader is not None
oracles = importlib.util.module_from_spec(spec)
spec.loader.exec_module(oracles)

NAMES = (
    *("1e+06 beside grey", "1e+08 beside texture", "even, 0.49 px", "even, -7.3 px", "slope -9 to 9 px"),
    *("0 and 40 px by turns", "1 x 8", "3 x 5", "5 x 64"),
)
STIFF = [case for case in cases(8) if case.name in NAMES]
FADING = [(-2.2, -0.8), (-3.2, 3.7), (2.5, 3.9)]
"""Ranges of CoC at which plans pass into one another."""


def dot(side: int, channels: int = 2) -> Tensor:
    """One pixel of 1 in the middle."""
    out = torch.zeros(1, channels, side, side, dtype=torch.float64)
    out[..., side // 2, side // 2] = 1
    return out


def along(side: int, x: float, y: float) -> Tensor:
    """The same motion everywhere."""
    return torch.tensor([x, y], dtype=torch.float64).view(1, 2, 1, 1).expand(1, 2, side, side).contiguous()


def assert_composed(
    blur: LensBlur, image: Tensor, coc: Tensor, background: tuple[Tensor, Tensor] | None = None
) -> None:
    """The same to rounding, of the brightest light."""
    options = {} if background is None else {"background": background}
    got, want = blur(image, coc=coc, **options), oracles.composed(blur, image, coc, background)
    torch.testing.assert_close(got, want, rtol=1e-12, atol=1e-12 * float(image.abs().max()))


@pytest.mark.parametrize("case", STIFF, ids=lambda case: case.name)
def test_a_composition_is_what_its_plan_says(case) -> None:
    assert len(STIFF) == len(NAMES)
    image, coc = case.image, case.coc
    assert_composed(LensBlur(), image, coc)
    assert_composed(LensBlur(aperture="6-gon"), image, coc)
    assert_composed(LensBlur(), image, coc, (image.flip(-1), coc.abs()))
    assert_composed(LensBlur(), *layers_of(image, coc))


@pytest.mark.parametrize(("low", "high"), FADING)
def test_plans_that_pass_into_one_another_are_mixed(low: float, high: float) -> None:
    blur, image, coc = LensBlur(), texture(8, 8), slope(8, 8, low, high)
    assert blur.plan(image, coc=coc).fading
    assert_composed(blur, image, coc)


def test_nothing_in_front_and_nothing_at_all_are_seen_through() -> None:
    rgba, coc = layers_of(texture(8, 8), slope(8, 8, 2.0, 4.0))
    rgba[:, 0] = 0
    assert_composed(LensBlur(), rgba, coc)
    assert_composed(LensBlur(), 0 * rgba, coc)


def test_the_oracle_keeps_a_constant_and_is_over_by_hand_of_two_layers() -> None:
    flat = torch.full((1, 3, 7, 9), 0.7, dtype=torch.float64)
    torch.testing.assert_close(oracles.composed(LensBlur(), flat, slope(7, 9, -6.0, 6.0)), flat, rtol=1e-14, atol=0)
    side = 16
    alpha = (torch.arange(side) < side // 2).double().expand(1, 1, side, side)
    front = torch.cat([texture(side, side) * alpha, alpha], 1)
    back = torch.cat([texture(side, side, 1), torch.ones_like(alpha)], 1)
    rgba, coc = torch.stack([front, back], 1), torch.stack([even(side, side, -2.0), even(side, side, 3.0)], 1)
    out = oracles.composed(LensBlur(subapertures=1), rgba, coc)
    # In the middle, where no PSF reaches the border: the blurred front, and what it leaves of the blurred back.
    front, back = (dense_spans(rgba[:, k], coc[:, k], Disc().profile()) for k in (0, 1))
    want = front + (1 - front[:, 3:]) * back
    torch.testing.assert_close(out[..., 4:-4, 4:-4], want[..., 4:-4, 4:-4], rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("domain", DOMAINS)
def test_every_domain_is_undone(domain: str) -> None:
    side, psf = 21, capsule(3.0, 4.0)
    sparse = {"direct": nonzero, "scanline": scanline, "laplacian": lambda p: nonzero(laplacian(p))}[domain](psf)
    model = Combined(radius=8.0, length=16.0)
    bank = PsfBank(model, [Represented(domain, sparse)] * len(model.grid))
    bank.extents = torch.ones(len(bank), dtype=torch.float64)
    model.extent = lambda coordinates: None  # samples as they are
    out = oracles.dense_samples(dot(side), Labels(even(side, side, 3.0), motion=along(side, 4.0, 0.0)), bank)
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
    torch.testing.assert_close(oracles.dense_samples(values, labels, bank), want, rtol=0, atol=1e-12)


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
        splat_bank(values, Labels(coc, motion=motion), bank)
        - oracles.dense_bank(values, [Labels(coc, motion=motion)], bank)
    ).abs()
    place = bank.model.place(Labels(coc, motion=motion))
    number = bank.model.grid.index(place.coordinates.movedim(1, -1))
    pad = math.ceil(float(bank.reach()[number].max()) * (math.sqrt(2) if place.frame is not None else 1)) + 2
    wide = torch.nn.functional.pad
    more = None if motion is None else wide(motion, (pad,) * 4, mode="replicate")
    if not bank.model.fields:
        whole = oracles.dense_bank(
            wide(values, (pad,) * 4), [Labels(wide(coc, (pad,) * 4, mode="replicate"), motion=more)], bank
        )
        ring = torch.cat([whole[..., 0, :], whole[..., -1, :], whole[..., 0], whole[..., -1]], -1).abs().amax(-1)
        assert bool((off.amax((2, 3)) <= 4 * ring + 1e-13).all())
    assert float(off.max()) < 1e-3


def test_highlights_are_spread_evenly_over_their_capsules() -> None:
    side = 41
    for x, y in ((0.0, 0.0), (8.0, 6.0)):
        out = oracles.capsules(dot(side, 1), Labels(even(side, side, 7.0), motion=along(side, x, y)))[0, 0]
        assert out.sum().item() == pytest.approx(1, abs=1e-12)
        area = math.pi * 7**2 + 2 * 7 * math.hypot(x, y) / 1
        # Half-way along the motion the light is the chord over the way; without motion, the same on all of the disc.
        length = math.hypot(x, y)
        middle = 1 / (math.pi * 7**2) * (min(1.0, 14 / length) if length else 1.0)
        assert out[side // 2, side // 2].item() == pytest.approx(middle, rel=0.02)
        assert 0.8 * area < int((out > 0).sum()) < 1.3 * area


@pytest.mark.parametrize("name", ["stylized", "physical-lens"])
def test_a_bank_without_motion_is_its_sums(name: str) -> None:
    bank, image, coc = PsfBank.load(name), texture(10, 10), slope(10, 10, -4.0, 9.0)
    image[..., 3, 4] = 1e4
    splatting = KernelSplatting(bank=bank)
    plan = replace(splatting.plan(image, coc), surrounded=0, lit=0.0)
    got, want = splatting(image, coc, plan=plan), oracles.splatted(bank, image, coc)
    assert float((got - want).abs().sum() / want.sum()) < 1e-3  # on a torus: see the test above
