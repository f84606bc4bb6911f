import numpy as np
import pytest
import torch
from torch import Tensor

from torchbokeh.ops.kernels.outline import shape_of
from torchbokeh.ops.kernels.radius_bank import RadiusBank, number_of, radius_bank, radius_of
from torchbokeh.ops.merge import EVEN, ROUNDED_TO, STEPS, rounded
from torchbokeh.ops.spans import MIN_RADIUS
from torchbokeh.ops.splat import splat_spans
from torchbokeh.psfs import Aperture, Disc, Ellipse, Polygon

F64 = torch.float64


def bank_of(shape: Aperture, largest: float = 9.0, slopes: bool = False) -> RadiusBank:
    return radius_bank(largest, shape_of(shape.profile()), slopes=slopes)


def drawn(bank: RadiusBank, k: int, table: np.ndarray, reach: int = 12) -> np.ndarray:
    """PSF ``k`` of a bank as a picture, in plain Python."""
    psf = np.zeros((2 * reach + 1, 2 * reach + 3))
    for point in range(bank.starts[bank.ends[k]], bank.starts[bank.ends[k + 1] - 1]):
        row, *columns = bank.points.places[point, :3]
        row += bank.firsts[k]
        for y in {row, -row} if bank.shape.level else {row}:
            psf[reach + y, reach + columns[0]] += table[point]
            if bank.shape.even:
                psf[reach + y, reach + columns[1]] -= table[point]
    return psf.cumsum(1)[:, : 2 * reach + 1]


def dots(coc: Tensor, reach: int = 12) -> tuple[Tensor, Tensor]:
    side = 2 * reach + 1
    values = torch.zeros(len(coc), 1, side, side, dtype=F64)
    values[..., reach, reach] = 1
    return values, coc[:, None, None, None].expand_as(values)


def radii_of(numbers: list[int]) -> Tensor:
    return torch.tensor([radius_of(k) for k in numbers], dtype=F64)


def test_numbers_are_those_of_the_rounded_radii() -> None:
    radius = torch.cat([torch.linspace(0.5, 20, 4001, dtype=F64), torch.tensor([EVEN, 31 + 1 / 3], dtype=F64)])
    got = torch.tensor([radius_of(number_of(float(r))) for r in radius], dtype=F64)
    torch.testing.assert_close(got, rounded(radius), rtol=1e-13, atol=0)
    torch.testing.assert_close(rounded(got), got, rtol=1e-13, atol=0)
    step = torch.minimum(radius.square(), EVEN**1.5 * radius.sqrt()) / STEPS
    assert ((got - radius).abs() < 0.51 * step).all()
    assert (4 * (got - radius).abs() <= 1.01e-3 * radius).all()
    assert number_of(0.0) == number_of(MIN_RADIUS) == 0
    kept = torch.tensor([0.0, 0.3, MIN_RADIUS, ROUNDED_TO, 1e4 + 1 / 3], dtype=F64)
    assert torch.equal(rounded(kept), kept)


def test_weights_change_little_from_one_psf_to_the_next(shape: Aperture) -> None:
    bank = bank_of(shape)
    for k in range(0, int(number_of(9.0)), 61):
        change = drawn(bank, k + 1, bank.points.weights) - drawn(bank, k, bank.points.weights)
        assert np.abs(change).max() < 2e-4


@pytest.mark.parametrize("sign", [1, -1])
def test_a_bank_holds_the_psfs_of_its_radii(shape: Aperture, sign: int) -> None:
    bank = bank_of(shape)
    count = int(number_of(9.0)) + 1
    assert len(bank.firsts) == (2 * count if bank.mirrored else count)
    assert len(bank.ends) == len(bank.firsts) + 1
    assert bank.points.slopes.shape == (0,)
    numbers = [*range(0, count, 977), count - 1]
    want = splat_spans(*dots(sign * radii_of(numbers)), shape.profile(), integrate=True)
    for k, psf in zip(numbers, want, strict=True):
        got = drawn(bank, k + (bank.mirrored if sign < 0 else 0), bank.points.weights)
        np.testing.assert_allclose(got, psf[0], rtol=0, atol=2e-9 * float(psf.max()))  # that of the fit of the circle
        assert got.sum() == pytest.approx(1, abs=1e-10)
    # A column further than the radius, and one for what is rounded.
    assert np.abs(bank.points.places[:, 1:3]).max() <= bank.reach <= 9 + 2


def test_only_a_shape_without_symmetry_has_a_mirrored_half() -> None:
    for symmetric in (Disc(), Ellipse(1.8, 0.5), Polygon(6, 0.3), Polygon(4)):
        assert bank_of(symmetric).mirrored == 0
    for blades in (3, 5, 7):
        bank = bank_of(Polygon(blades, 0.2))
        assert bank.mirrored == len(bank.firsts) // 2
        for k in (1500, 9000, 17000):
            front, behind = (drawn(bank, k + start, bank.points.weights) for start in (bank.mirrored, 0))
            np.testing.assert_allclose(front, behind[::-1, ::-1], atol=1e-12)
            assert np.abs(front - behind).max() > 1e-4


@pytest.mark.parametrize("sign", [1, -1])
def test_slopes_are_derivatives_by_the_radius(shape: Aperture, sign: int) -> None:
    bank = bank_of(shape, slopes=True)
    assert bank.points.slopes.shape == bank.points.weights.shape
    step = 1e-5
    radius = torch.tensor([0.55, 1.2, 2.36, 5.2, 6.27, 8.8], dtype=F64)
    numbers = [int(number_of(float(r))) for r in radius]
    radius = radii_of(numbers)
    ends = [splat_spans(*dots(sign * (radius + d)), shape.profile(), integrate=True) for d in (step, -step)]
    want = (ends[0] - ends[1])[:, 0] / (2 * step)
    for k, slope in zip(numbers, want, strict=True):
        got = drawn(bank, k + (bank.mirrored if sign < 0 else 0), bank.points.slopes)
        np.testing.assert_allclose(got, slope, rtol=0, atol=1e-5 * float(slope.abs().max()))
        assert np.abs(got).max() > 0
    assert np.abs(drawn(bank, 0, bank.points.slopes)).max() == 0  # up to MIN_RADIUS, the PSF stays as it is
