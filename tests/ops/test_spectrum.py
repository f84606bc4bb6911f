import doctest
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

import torchbokeh.ops.spectrum
from torchbokeh.ops.cie_1931 import FIRST, LAST, MATCHING, STEP
from torchbokeh.ops.sampling import halton
from torchbokeh.ops.spectrum import HIGH, LOW, Formula, Weight, linear_rgb, spectral_bands, spectral_samples, xyz

F64 = torch.float64
DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
FORMULAS: tuple[Formula, ...] = ("cie", "empirical")
few = settings(deadline=None, max_examples=30)


def peak(at: float, width: float) -> Callable[[Tensor], Tensor]:
    return lambda wavelength: (-0.5 * ((wavelength - at) / width) ** 2).exp()


def box(low: float, high: float) -> Callable[[Tensor], Tensor]:
    return lambda wavelength: ((wavelength >= low) & (wavelength <= high)).double()


WEIGHTS: dict[str, Weight] = {
    "flat": None,
    "slope": lambda w: w - LOW,
    "comb": lambda w: 1 + (w / 10).cos(),
    "peak": peak(560, 20),
    "red": lambda w: 5e30 * (w > 600),
    "violet and red": lambda w: box(LOW, 450)(w) + box(620, HIGH)(w),
    "faint": lambda w: 1e-310 + 0 * w,
}
formulas = st.sampled_from(FORMULAS)
weights = st.sampled_from(list(WEIGHTS.values())) | st.builds(peak, st.floats(LOW, HIGH), st.floats(0.05, 200))
units = st.lists(st.floats(0, 1, exclude_max=True), min_size=1, max_size=40).map(lambda u: torch.tensor(u, dtype=F64))
cuts = st.lists(st.floats(LOW, HIGH), min_size=2, max_size=20, unique=True).map(
    lambda e: torch.tensor(sorted(e), dtype=F64)
)


@pytest.fixture(params=FORMULAS)
def formula(request: pytest.FixtureRequest) -> Formula:
    return request.param


@pytest.fixture(params=WEIGHTS)
def weight(request: pytest.FixtureRequest) -> Weight:
    return WEIGHTS[request.param]


def even(count: int) -> Tensor:
    return (torch.arange(count, dtype=F64) + 0.5) / count


def bend(wavelength: Tensor) -> Tensor:
    """A smooth function, in place of a picture."""
    return (wavelength / 60).sin() + 1e-5 * (wavelength - 500).square()


def ones_or_zeros(sums: Tensor, atol: float = 1e-12) -> bool:
    return bool((((sums - 1).abs() < atol) | (sums == 0)).all())


def test_the_table_is_the_published_one() -> None:
    table = np.array(MATCHING)
    assert table.shape == (81, 3)
    assert FIRST + 80 * STEP == LAST
    assert table.min() >= 0
    # CIE 15:2004, table T.4, has six decimals and these sums.
    assert table.round(6).sum(0) == pytest.approx([21.371524, 21.371327, 21.371540], abs=1e-9)
    peaks = [(FIRST + STEP * row, table[row, k]) for k, row in enumerate(table.argmax(0))]
    assert peaks == [(600, 1.0622), (555, 1.0), (445, 1.7826)]
    # The second peak of x, and where z ends.
    assert FIRST + STEP * table[:25, 0].argmax() == 440
    assert [FIRST + STEP * row for row in np.flatnonzero(table[:, 2])[[0, -1]]] == [380, 645]


def test_equal_energy_is_white() -> None:
    total = np.array(MATCHING).sum(0)
    assert total / total.sum() == pytest.approx([1 / 3] * 3, abs=1e-3)


def test_xyz_is_the_table_and_linear_between() -> None:
    table = torch.tensor(MATCHING, dtype=F64)
    knots = torch.linspace(FIRST, LAST, 81, dtype=F64)
    assert torch.allclose(xyz(knots), table, atol=1e-15)
    assert torch.allclose(xyz(knots[:-1] + 2), torch.lerp(table[:-1], table[1:], 0.4), atol=1e-14)
    assert torch.equal(xyz(torch.tensor([-1e9, 0.0, 379.99, 780.01, 1e9, math.inf])), torch.zeros(6, 3))
    assert xyz(torch.tensor(math.nan)).isnan().all()
    assert xyz(torch.full((2, 0, 4), 500.0)).shape == (2, 0, 4, 3)


def test_cie_is_the_matching_functions_in_srgb_without_what_is_negative() -> None:
    # IEC 61966-2-1's primaries and white.
    matrix = torch.tensor(
        [[3.2404542, -1.5371385, -0.4985314], [-0.9692660, 1.8760108, 0.0415560], [0.0556434, -0.2040259, 1.0572252]],
        dtype=F64,
    )
    wavelength = torch.linspace(370, 790, 4201, dtype=F64)
    want = (xyz(wavelength) @ matrix.T).clamp_min(0)
    want = want / (want.sum(0) * 0.1 / 400)
    assert torch.allclose(linear_rgb(wavelength), want, atol=2e-3)


@pytest.mark.parametrize(
    ("wavelength", "want"),
    # Bruton's branches by hand, before the scale: 380-440, 440-490, 490-510, 510-580, 580-645, 645-780 nm.
    [
        (400.0, (0.65 * 40 / 60, 0, 0.65)),
        (430.0, (10 / 60, 0, 1)),
        (465.0, (0, 0.5, 1)),
        (505.0, (0, 1, 0.25)),
        (531.0, (0.3, 1, 0)),
        (632.0, (1, 0.2, 0)),
        (690.0, (1, 0, 0)),
        (740.0, (0.65, 0, 0)),
        (780.0, (0.3, 0, 0)),
        (380.0, (0.3, 0, 0.3)),
        (379.0, (0, 0, 0)),
        (781.0, (0, 0, 0)),
    ],
)
def test_empirical_is_bruton_s(wavelength: float, want: tuple[float, float, float]) -> None:
    # Integrals over the ramps, by hand.
    red = (0.3 * 40 * 0.5 * (1 + 1 / 3)) + 0.7 * 40 * (0.5 - 2 / 3 / 3) + 0.5 * 20 / 3 + 35 + 120 + 80 * 0.65
    green, blue = 25 + 90 + 32.5, 40 * 0.65 + 70 + 10
    scale = torch.tensor([400 / red, 400 / green, 400 / blue], dtype=F64)
    got = linear_rgb(torch.tensor(wavelength, dtype=F64), "empirical")
    assert torch.allclose(got, scale * torch.tensor(want, dtype=F64), atol=1e-12)


def test_a_flat_spectrum_is_white(formula: Formula) -> None:
    wavelength = torch.linspace(LOW, HIGH, 80_001, dtype=F64)
    rgb = linear_rgb(wavelength, formula)
    assert rgb.min() >= 0
    assert rgb.max() < 8
    mean = torch.trapezoid(rgb, wavelength, dim=0) / (HIGH - LOW)
    assert torch.allclose(mean, torch.ones(3, dtype=F64), atol=1e-8)


def test_colours_have_their_names(formula: Formula) -> None:
    rgb = linear_rgb(torch.tensor([450.0, 530.0, 650.0]), formula)
    assert rgb.argmax(1).tolist() == [2, 1, 0]
    violet = linear_rgb(torch.tensor(410.0), formula)
    assert violet[1] == 0
    assert violet[0] > 0


def test_colours_have_a_gradient(formula: Formula) -> None:
    wavelength = torch.tensor([401.0, 452.0, 503.0, 561.0, 604.0, 733.0], dtype=F64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda w: linear_rgb(w, formula), wavelength, eps=1e-4)


@few
@given(unit=units, weight=weights, formula=formulas, importance=st.booleans())
def test_samples_are_shares_of_each_channel(unit: Tensor, weight: Weight, formula: Formula, importance: bool) -> None:
    wavelength, rgb = spectral_samples(unit, weight, importance=importance, formula=formula)
    assert wavelength.shape == unit.shape
    assert rgb.shape == (*unit.shape, 3)
    assert rgb.isfinite().all()
    assert rgb.min() >= 0
    assert ones_or_zeros(rgb.sum(0))
    assert wavelength.min() >= LOW
    assert wavelength.max() <= HIGH
    # What is empty is so because no sample has light there.
    light = linear_rgb(wavelength, formula)
    if weight is not None and not importance:
        light = light * (weight(wavelength) > 0)[:, None]
    assert torch.equal(rgb.sum(0) > 0, (light > 0).any(0))


@few
@given(edges=cuts, weight=weights, formula=formulas)
def test_bands_are_shares_of_each_channel(edges: Tensor, weight: Weight, formula: Formula) -> None:
    centre, rgb = spectral_bands(edges, weight, formula)
    assert centre.shape == (len(edges) - 1,)
    assert rgb.shape == (len(edges) - 1, 3)
    assert rgb.isfinite().all()
    assert rgb.min() >= 0
    assert ones_or_zeros(rgb.sum(0))
    assert (centre >= edges[:-1]).all()
    assert (centre <= edges[1:]).all()


@few
@given(unit=units, weight=weights, importance=st.booleans(), seed=st.integers(0, 1000))
def test_the_order_of_samples_does_not_matter(unit: Tensor, weight: Weight, importance: bool, seed: int) -> None:
    order = torch.randperm(len(unit), generator=torch.Generator().manual_seed(seed))
    wavelength, rgb = spectral_samples(unit, weight, importance=importance)
    got = spectral_samples(unit[order], weight, importance=importance)
    assert torch.equal(got[0], wavelength[order])
    assert torch.allclose(got[1], rgb[order], atol=1e-14)


def test_samples_and_bands_see_the_same(weight: Weight, formula: Formula) -> None:
    centre, rgb = spectral_bands(torch.linspace(LOW, HIGH, 4001, dtype=F64), weight, formula)
    want = bend(centre) @ rgb
    # The tables turn a jump of the weight into a ramp of 0.1 nm.
    jumps = weight in (WEIGHTS["red"], WEIGHTS["violet and red"])
    for importance in (True, False):
        wavelength, rgb = spectral_samples(even(40_000), weight, importance=importance, formula=formula)
        assert torch.allclose(bend(wavelength) @ rgb, want, atol=3e-3 if jumps else 2e-4)


def test_few_bands_are_the_sums_of_many(weight: Weight, formula: Formula) -> None:
    fine, shares = spectral_bands(torch.linspace(LOW, HIGH, 4001, dtype=F64), weight, formula)
    edges = torch.tensor([LOW, 450.0, 505.1, 600.0, HIGH], dtype=F64)
    rgb = spectral_bands(edges, weight, formula)[1]
    for k in range(4):
        band = (fine > edges[k]) & (fine < edges[k + 1])
        assert torch.allclose(rgb[k], shares[band].sum(0), atol=1e-10)


@few
@given(cut=st.floats(LOW + 0.001, HIGH - 0.001), weight=weights, formula=formulas)
def test_one_more_cut_parts_light_and_its_centre(cut: float, weight: Weight, formula: Formula) -> None:
    centre, rgb = spectral_bands(torch.tensor([LOW, HIGH], dtype=F64), weight, formula)
    parts, shares = spectral_bands(torch.tensor([LOW, cut, HIGH], dtype=F64), weight, formula)
    assert torch.allclose(shares.sum(0), rgb[0], atol=1e-12)
    assert parts[0] - 1e-6 <= centre[0] <= parts[1] + 1e-6 or not shares.any(1).all()


def test_the_centre_of_light_by_hand() -> None:
    # Between 510 and 580 nm Bruton's red rises, green is flat.
    edges = torch.tensor([510.0, 580.0], dtype=F64)
    red, green = linear_rgb(torch.tensor(580.0, dtype=F64), "empirical")[:2].tolist()
    want = 510 + 70 * (red / 3 + green / 2) / (red / 2 + green)
    assert float(spectral_bands(edges, None, "empirical")[0]) == pytest.approx(want, abs=1e-4)
    narrow = torch.tensor([LOW, 555.0, HIGH], dtype=F64)
    got = spectral_bands(narrow, peak(600, 0.5))[0]
    assert got.tolist() == pytest.approx([0.5 * (LOW + 555), 600], abs=0.02)


def test_samples_are_where_the_weight_is() -> None:
    ends = torch.tensor([0.0, 1e-300, 0.5, 1 - 2**-53], dtype=F64)
    for low, high in ((500, 520), (LOW, 400), (760, HIGH), (LOW, HIGH)):
        for unit in (even(1000), ends):
            wavelength = spectral_samples(unit, box(low, high))[0]
            # The tables turn a jump of the weight into a ramp of 0.1 nm.
            assert wavelength.min() > low - 0.11
            assert wavelength.max() < high + 0.11
            assert (wavelength.diff() >= 0).all()
    quantiles = spectral_samples(even(3), peak(600, 5))[0]
    assert quantiles.tolist() == pytest.approx([600 - 5 * 0.96742, 600, 600 + 5 * 0.96742], abs=1e-3)
    assert spectral_samples(even(4), lambda w: w - LOW)[0].tolist() == pytest.approx(
        [LOW + 400 * math.sqrt(u) for u in (0.125, 0.375, 0.625, 0.875)], abs=1e-3
    )


def test_importance_takes_noise_away() -> None:
    """Of a dot that is a disc whose radius depends on the wavelength, under a peaked weight, at equal samples."""
    at = torch.arange(64, dtype=F64) - 31.5
    away, variances = torch.hypot(at, at[:, None]), []
    for importance in (True, False):
        pictures = []
        for seed in range(16):
            wavelength, rgb = spectral_samples(halton(64, seed=seed)[:, 4], peak(480, 20), importance=importance)
            radii = (10 + (650 - wavelength) / 35)[:, None, None]
            pictures.append(torch.einsum("kc,khw->chw", rgb, (radii - away + 0.5).clamp(0, 1) / radii.square()))
        variances.append(torch.stack(pictures).var(0).mean())
    assert variances[0] < 0.3 * variances[1]


def test_a_flat_weight_spreads_samples_evenly() -> None:
    for importance in (True, False):
        wavelength = spectral_samples(even(8), importance=importance)[0]
        assert torch.allclose(wavelength, LOW + 400 * even(8), atol=1e-9)


@pytest.mark.parametrize(("at", "width"), [(560.0, 10.0), (480.0, 15.0), (600.0, 5.0)])
def test_importance_lowers_the_variance_for_a_peak(at: float, width: float, formula: Formula) -> None:
    weight = peak(at, width)
    generator = torch.Generator().manual_seed(0)
    found: dict[bool, list[Tensor]] = {True: [], False: []}
    for _ in range(200):
        unit = torch.rand(64, generator=generator, dtype=F64)
        for importance, estimates in found.items():
            wavelength, rgb = spectral_samples(unit, weight, importance=importance, formula=formula)
            estimates.append(bend(wavelength) @ rgb)
    with_, without = (torch.stack(found[key]).var(0) for key in (True, False))
    main = linear_rgb(torch.tensor(at, dtype=F64), formula) > 0.2  # channels with light at the peak, not only beside it
    assert main.any()
    assert (with_[main] < 0.5 * without[main]).all()


def test_halton_points_do_better_than_chance() -> None:
    want = torch.stack([bend(w) @ rgb for w, rgb in [spectral_samples(even(100_000))]])
    for first in (0, 500, 3000):
        wavelength, rgb = spectral_samples(halton(510, first=first)[:, 4])
        assert (bend(wavelength) @ rgb - want).abs().max() < 0.03


def test_a_channel_without_light_stays_dark() -> None:
    for importance in (True, False):
        rgb = spectral_samples(even(100), box(650, 700), importance=importance)[1]
        assert rgb.sum(0).tolist() == pytest.approx([1, 0, 0], abs=1e-14)
    rgb = spectral_bands(torch.tensor([LOW, 500.0, HIGH]), box(650, 700))[1]
    assert rgb.tolist() == [[0, 0, 0], [1, 0, 0]]
    # Samples too few to meet the light.
    assert not spectral_samples(even(2), peak(600, 0.1), importance=False)[1].any()


@few
@given(at=st.floats(LOW, HIGH), width=st.floats(0.05, 1.0), formula=formulas)
def test_a_line_of_light_gives_numbers(at: float, width: float, formula: Formula) -> None:
    for importance in (True, False):
        wavelength, rgb = spectral_samples(even(16), peak(at, width), importance=importance, formula=formula)
        assert wavelength.isfinite().all()
        assert rgb.isfinite().all()
        if importance:
            assert (wavelength - at).abs().max() < 3 * width + 0.1
    centre, rgb = spectral_bands(torch.tensor([LOW, 480.0, 580.0, HIGH], dtype=F64), peak(at, width), formula)
    assert centre.isfinite().all()
    assert ones_or_zeros(rgb.sum(0))


def test_dtypes() -> None:
    for dtype, want in ((F64, F64), (torch.float32, torch.float32), (torch.float16, torch.float32)):
        some = torch.tensor([400.0, 500.0, 600.0], dtype=dtype)
        results = (xyz(some), linear_rgb(some), *spectral_bands(some), *spectral_samples(some / 1000))
        assert [r.dtype for r in results] == [want] * 6
    single, double = spectral_samples(even(16).float()), spectral_samples(even(16))
    assert torch.allclose(single[0].double(), double[0], atol=1e-4)
    assert torch.allclose(single[1].double(), double[1], atol=1e-7)
    assert spectral_samples(torch.zeros(0))[1].shape == (0, 3)


@pytest.mark.parametrize("device", DEVICES)
def test_results_stay_on_the_device_of_the_input(device: str) -> None:
    unit = even(64).to(device)
    for got, want in zip(
        spectral_samples(unit, peak(500, 30)), spectral_samples(unit.cpu(), peak(500, 30)), strict=True
    ):
        assert got.device == unit.device
        assert torch.allclose(got.cpu(), want)
    edges = torch.tensor([LOW, 500.0, HIGH], dtype=F64, device=device)
    for got, want in zip(spectral_bands(edges), spectral_bands(edges.cpu()), strict=True):
        assert got.device == unit.device
        assert torch.allclose(got.cpu(), want)


HALF = torch.tensor([0.5])
ENDS = torch.tensor([LOW, HIGH])


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: xyz(500.0), TypeError, "wavelength: expected a tensor, got float"),  # type: ignore[arg-type]
        (lambda: xyz(torch.tensor([500])), TypeError, "wavelength: expected a floating-point tensor, got torch.int64"),
        (lambda: linear_rgb(torch.tensor([500])), TypeError, "wavelength: expected a floating-point tensor"),
        (
            lambda: linear_rgb(HALF, "guess"),  # type: ignore[arg-type]
            ValueError,
            "formula: expected 'cie' or 'empirical', got 'guess'",
        ),
        (lambda: spectral_samples(torch.zeros(2, 2)), ValueError, r"unit: expected shape \(N\), got \(2, 2\)"),
        (lambda: spectral_samples(torch.tensor([1])), TypeError, "unit: expected a floating-point tensor"),
        (lambda: spectral_samples(torch.tensor([0.5, 1.0])), ValueError, r"unit: expected points in \[0, 1\), got 1"),
        (lambda: spectral_samples(torch.tensor([-0.5])), ValueError, r"unit: expected points in \[0, 1\), got -0.5"),
        (lambda: spectral_samples(torch.tensor([math.nan])), ValueError, r"unit: .* got nan"),
        (lambda: spectral_bands(torch.tensor([500.0])), ValueError, "edges: expected two or more, got 1"),
        (lambda: spectral_bands(torch.tensor([500.0, 500.0])), ValueError, "edges: expected wavelengths that strictly"),
        (lambda: spectral_bands(torch.tensor([500.0, 790.0])), ValueError, "edges: expected wavelengths that strictly"),
        (lambda: spectral_bands(torch.tensor([500.0, math.nan])), ValueError, "edges: expected wavelengths that"),
        (
            lambda: spectral_bands(torch.tensor([[500.0]])),
            ValueError,
            r"edges: expected shape \(N \+ 1\), got \(1, 1\)",
        ),
    ],
)
def test_what_does_not_fit_is_refused(call: Any, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        call()


@pytest.mark.parametrize(
    ("weight", "error", "message"),
    [
        (lambda w: 500 - w, ValueError, "weight: expected finite weights of 0 or more, got -0.1 at 500.1 nm"),
        (lambda w: torch.where(w > 700, math.nan, 1.0), ValueError, "weight: .* got nan at 700.1 nm"),
        (lambda w: torch.where(w > 700, math.inf, 1.0), ValueError, "weight: .* got inf at 700.1 nm"),
        (lambda w: 0 * w, ValueError, "weight: expected a weight above 0 somewhere from 380 to 780 nm, got 0"),
        (lambda w: w[:-1], ValueError, r"weight: expected shape \(4001,\), got \(4000,\)"),
        (lambda w: 1.0, TypeError, "weight: expected a function that gives a tensor, got float"),
    ],
)
def test_an_equaliser_that_does_not_fit_is_refused(weight: Any, error: type[Exception], message: str) -> None:
    for importance in (True, False):
        with pytest.raises(error, match=message):
            spectral_samples(HALF, weight, importance=importance)
    with pytest.raises(error, match=message):
        spectral_bands(ENDS, weight)


def test_examples_in_the_docstrings() -> None:
    result = doctest.testmod(torchbokeh.ops.spectrum)
    assert result.attempted > 0
    assert result.failed == 0
