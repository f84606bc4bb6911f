import numpy as np
import pytest
import torch
from torch import Tensor

from torchbokeh.ops.kernels.radius_bank import RadiusBank, radius_bank
from torchbokeh.ops.kernels.splat import shape_of
from torchbokeh.ops.merge import STEPS
from torchbokeh.ops.splat import splat_spans
from torchbokeh.psfs import Aperture, Disc, Ellipse, Polygon

F64 = torch.float64


def bank_of(shape: Aperture, largest: float = 9.0, slopes: bool = False) -> RadiusBank:
    return radius_bank(largest, STEPS, shape_of(shape.profile()), slopes=slopes)


def drawn(bank: RadiusBank, k: int, table: np.ndarray, reach: int = 12) -> np.ndarray:
    """PSF ``k`` of a bank as a picture, in plain Python."""
    psf = np.zeros((2 * reach + 1, 2 * reach + 3))
    for row in range(bank.ends[k], bank.ends[k + 1]):
        y = reach + bank.firsts[k] + row - bank.ends[k]
        for end in range(2):
            column = reach + bank.rows.columns[row, end]
            psf[y, column : column + 2] += table[row, 2 * end : 2 * end + 2]
    return psf.cumsum(1)[:, : 2 * reach + 1]


def dots(coc: Tensor, reach: int = 12) -> tuple[Tensor, Tensor]:
    side = 2 * reach + 1
    values = torch.zeros(len(coc), 1, side, side, dtype=F64)
    values[..., reach, reach] = 1
    return values, coc[:, None, None, None].expand_as(values)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_bank_holds_the_psfs_of_its_radii(shape: Aperture, sign: int) -> None:
    bank = bank_of(shape)
    count = 9 * STEPS + 1
    assert len(bank.firsts) == (2 * count if bank.mirrored else count)
    assert len(bank.ends) == len(bank.firsts) + 1
    assert bank.rows.slopes.shape == (0, 4)
    numbers = [*range(0, count, 37), count - 1]
    want = splat_spans(*dots(sign * torch.tensor(numbers, dtype=F64) / STEPS), shape.profile(), integrate=True)
    for k, psf in zip(numbers, want, strict=True):
        got = drawn(bank, k + (bank.mirrored if sign < 0 else 0), bank.rows.weights)
        np.testing.assert_allclose(got, psf[0], rtol=0, atol=1e-9 * float(psf.max()))
        assert got.sum() == pytest.approx(1, abs=1e-10)
    # A column further than the radius, the next one that each end adds to, and one for what is rounded.
    assert np.abs(bank.rows.columns).max() + 1 <= bank.reach <= 9 + 2


def test_only_a_shape_without_symmetry_has_a_mirrored_half() -> None:
    for symmetric in (Disc(), Ellipse(1.8, 0.5), Polygon(6, 0.3), Polygon(4)):
        assert bank_of(symmetric).mirrored == 0
    for blades in (3, 5, 7):
        bank = bank_of(Polygon(blades, 0.2))
        assert bank.mirrored == len(bank.firsts) // 2
        for k in (40, 300, 500):
            front, behind = (drawn(bank, k + start, bank.rows.weights) for start in (bank.mirrored, 0))
            np.testing.assert_allclose(front, behind[::-1, ::-1], atol=1e-12)
            assert np.abs(front - behind).max() > 1e-4


@pytest.mark.parametrize("sign", [1, -1])
def test_slopes_are_derivatives_by_the_radius(shape: Aperture, sign: int) -> None:
    bank = bank_of(shape, slopes=True)
    assert bank.rows.slopes.shape == bank.rows.weights.shape
    step = 1e-5
    numbers = [35, 77, 151, 333, 401, 563]
    radius = torch.tensor(numbers, dtype=F64) / STEPS
    ends = [splat_spans(*dots(sign * (radius + d)), shape.profile(), integrate=True) for d in (step, -step)]
    want = (ends[0] - ends[1])[:, 0] / (2 * step)
    for k, slope in zip(numbers, want, strict=True):
        got = drawn(bank, k + (bank.mirrored if sign < 0 else 0), bank.rows.slopes)
        np.testing.assert_allclose(got, slope, rtol=0, atol=1e-5 * float(slope.abs().max()))
        assert np.abs(got).max() > 0
    for k in (0, 10, 32):  # up to MIN_RADIUS, the PSF stays as it is
        assert np.abs(drawn(bank, k, bank.rows.slopes)).max() == 0
