import doctest
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

import torchbokeh.lens.glass
from torchbokeh.lens.glass import GLASSES, abbe_number, refractive_index, relative_focal_length

F64 = torch.float64
D = 587.5618

# n_d and Abbe number. Schott's glass catalogue, January 2017.
CATALOGUE = {
    "BK7": (1.5168, 64.17),
    "N-BK10": (1.49782, 66.95),
    "N-K5": (1.52249, 59.48),
    "N-FK5": (1.48749, 70.41),
    "N-FK51A": (1.48656, 84.47),
    "N-PK51": (1.52855, 76.98),
    "N-BAK1": (1.5725, 57.55),
    "N-BAK4": (1.56883, 55.98),
    "N-SK2": (1.60738, 56.65),
    "N-SK16": (1.62041, 60.32),
    "N-SSK8": (1.61773, 49.83),
    "N-BAF10": (1.67003, 47.11),
    "N-LAK10": (1.72003, 50.62),
    "N-LAK14": (1.6968, 55.41),
    "N-LAK22": (1.65113, 55.89),
    "N-LAF2": (1.74397, 44.85),
    "N-LASF9": (1.85025, 32.17),
    "N-LASF44": (1.8042, 46.5),
    "F2": (1.62004, 36.37),
    "N-F2": (1.62005, 36.43),
    "N-SF2": (1.64769, 33.82),
    "N-SF5": (1.67271, 32.25),
    "N-SF6": (1.80518, 25.36),
    "N-SF10": (1.72828, 28.53),
    "N-SF11": (1.78472, 25.68),
    "N-SF57": (1.84666, 23.78),
    "N-SF66": (1.92286, 20.88),
    "SF5": (1.6727, 32.21),
    "SF6": (1.80518, 25.43),
    "SF10": (1.72825, 28.41),
    "SF11": (1.78472, 25.76),
}
# Of other makes of the same material, whose batches differ: Schott's Lithosil-Q and Lithotec-CaF2, same catalogue.
OTHER_MAKES = {"fused silica": (1.45844, 67.83), "CaF2": (1.43385, 95.23)}


def test_every_glass_is_checked() -> None:
    assert set(GLASSES) == {*CATALOGUE, *OTHER_MAKES}
    assert len(GLASSES) >= 13


@pytest.mark.parametrize("glass", CATALOGUE)
def test_index_and_abbe_number_are_those_of_the_catalogue(glass: str) -> None:
    index, abbe = CATALOGUE[glass]
    assert abs(refractive_index(glass, D) - index) < 2e-5
    assert abs(abbe_number(glass) - abbe) < 0.02


@pytest.mark.parametrize("glass", OTHER_MAKES)
def test_malitson_s_materials_are_near_what_others_make(glass: str) -> None:
    index, abbe = OTHER_MAKES[glass]
    assert abs(refractive_index(glass, D) - index) < 5e-5
    assert abs(abbe_number(glass) - abbe) < 0.3


@pytest.mark.parametrize("glass", GLASSES)
def test_focal_length_grows_with_the_wavelength(glass: str) -> None:
    ratio = relative_focal_length(glass, torch.linspace(380, 780, 401, dtype=F64), 650.0)
    assert (ratio.diff() > 0).all()
    assert ratio.min() > 0.85
    assert ratio.max() < 1.02
    # From C to F it grows by about 1 / Abbe number: that is what the number is for.
    growth = relative_focal_length(glass, 656.2725, D) - relative_focal_length(glass, 486.1327, D)
    assert growth == pytest.approx(1 / abbe_number(glass), rel=0.02)


@given(glass=st.sampled_from(GLASSES), a=st.floats(310, 2300), b=st.floats(310, 2300), radius=st.floats(0.01, 10))
def test_it_is_the_lens_maker_s_equation(glass: str, a: float, b: float, radius: float) -> None:
    at_a, at_b = (1 / ((refractive_index(glass, w) - 1) * (1 / radius + 1 / 0.3)) for w in (a, b))
    assert relative_focal_length(glass, a, b) == pytest.approx(at_a / at_b, rel=1e-12)
    assert relative_focal_length(glass, a, a) == 1
    assert relative_focal_length(glass, a, b) * relative_focal_length(glass, b, a) == pytest.approx(1, rel=1e-14)


def test_numbers_and_tensors_agree() -> None:
    wavelength = torch.tensor([[400.0, 500.0], [600.0, 700.0]])
    want = torch.tensor([[relative_focal_length("F2", float(w), 650.0) for w in row] for row in wavelength])
    got = relative_focal_length("F2", wavelength, 650.0)
    assert got.dtype == torch.float32
    assert torch.allclose(got, want, rtol=1e-7, atol=0)
    assert relative_focal_length("F2", wavelength.double(), 650.0).dtype == F64
    assert relative_focal_length("F2", wavelength.half(), 650.0).dtype == torch.float32
    assert isinstance(relative_focal_length("F2", 500, 650), float)


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: abbe_number("jam"), ValueError, "glass: expected one of BK7, .* got 'jam'"),
        (lambda: relative_focal_length("jam", 500.0, 650.0), ValueError, "glass: expected one of BK7, .* got 'jam'"),
        (lambda: relative_focal_length("BK7", 200.0, 650.0), ValueError, "wavelength: .* got 200"),
        (lambda: relative_focal_length("BK7", 500.0, 0.65), ValueError, "reference: expected 310 to 2300 nm, got 0.65"),
        (lambda: relative_focal_length("BK7", torch.tensor([5]), 650.0), TypeError, "wavelength: .* got torch.int64"),
        (
            lambda: relative_focal_length("BK7", 500.0, torch.tensor(650.0)),  # type: ignore[call-overload]
            TypeError,
            "reference: expected a number, got Tensor",
        ),
    ],
)
def test_what_does_not_fit_is_refused(call: Any, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        call()


def test_examples_in_the_docstrings() -> None:
    result = doctest.testmod(torchbokeh.lens.glass)
    assert result.attempted > 0
    assert result.failed == 0
