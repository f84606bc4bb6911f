import doctest
import math
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

import torchbokeh.ops.sellmeier
from torchbokeh.ops.sellmeier import HIGH, LOW, SELLMEIER, refractive_index

F64 = torch.float64


def bk7(micrometres: float) -> float:
    square = micrometres**2
    first = 1.03961212 * square / (square - 0.00600069867)
    second = 0.231792344 * square / (square - 0.0200179144)
    return math.sqrt(1 + first + second + 1.01046945 * square / (square - 103.560653))


@pytest.mark.parametrize(
    # Schott's data sheet of N-BK7, 517642.251.
    ("wavelength", "index"),
    [
        *((312.6, 1.54862), (334.1, 1.54272), (365.0, 1.53627), (404.7, 1.53024), (435.8, 1.52668)),
        *((480.0, 1.52283), (486.1, 1.52238), (546.1, 1.51872), (587.6, 1.51680), (589.3, 1.51673)),
        *((632.8, 1.51509), (643.8, 1.51472), (656.3, 1.51432), (706.5, 1.51289), (852.1, 1.50980)),
        *((1014.0, 1.50731), (1060.0, 1.50669), (1529.6, 1.50091), (1970.1, 1.49495)),
    ],
)
def test_bk7_is_that_of_the_data_sheet(wavelength: float, index: float) -> None:
    assert abs(refractive_index("BK7", wavelength) - index) < 2e-5


@given(wavelength=st.floats(LOW, HIGH))
def test_the_equation_is_sellmeier_s(wavelength: float) -> None:
    assert refractive_index("BK7", wavelength) == pytest.approx(bk7(wavelength / 1000), abs=1e-14)


def test_the_rounded_coefficients_of_the_source_agree_with_bk7() -> None:
    b, c = SELLMEIER["BK7"]
    assert [round(x, 3) for x in b] == [1.040, 0.232, 1.010]
    assert [round(x, 3) for x in c] == [0.006, 0.020, 103.561]


@pytest.mark.parametrize("glass", SELLMEIER)
def test_the_index_falls_all_the_way(glass: str) -> None:
    index = refractive_index(glass, torch.linspace(LOW, HIGH, 2000, dtype=F64))
    assert (index.diff() < 0).all()
    assert index.min() > 1.4
    assert index.max() < 2.3


@pytest.mark.parametrize("glass", SELLMEIER)
def test_a_tensor_gives_what_numbers_give(glass: str) -> None:
    wavelength = torch.linspace(LOW, HIGH, 30, dtype=F64).reshape(2, 15)
    want = torch.tensor([[refractive_index(glass, float(w)) for w in row] for row in wavelength], dtype=F64)
    assert torch.allclose(refractive_index(glass, wavelength), want, atol=1e-14, rtol=0)


def test_dtypes_and_shapes() -> None:
    assert isinstance(refractive_index("SF6", 500), float)
    for dtype, want in ((F64, F64), (torch.float32, torch.float32), (torch.float16, torch.float32)):
        assert refractive_index("SF6", torch.tensor(500.0, dtype=dtype)).dtype == want
    assert refractive_index("SF6", torch.zeros(0, 3)).shape == (0, 3)


def test_it_has_a_gradient() -> None:
    wavelength = torch.tensor([400.0, 550.0, 1000.0], dtype=F64, requires_grad=True)

    def index(at: Tensor) -> Tensor:
        return refractive_index("N-SF11", at)

    assert torch.autograd.gradcheck(index, wavelength, eps=1e-3, atol=1e-10)


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: refractive_index("jam", 500.0), ValueError, r"glass: expected one of BK7, .*, CaF2, got 'jam'"),
        (lambda: refractive_index("BK7", 309.9), ValueError, "wavelength: expected 310 to 2300 nm, got 309.9"),
        (lambda: refractive_index("BK7", 0.55), ValueError, "wavelength: expected 310 to 2300 nm, got 0.55"),
        (lambda: refractive_index("BK7", math.nan), ValueError, "wavelength: .* got nan"),
        (lambda: refractive_index("BK7", torch.tensor([500.0, 2301.0])), ValueError, "wavelength: .* got 2301"),
        (lambda: refractive_index("BK7", torch.tensor(math.nan)), ValueError, "wavelength: .* got nan"),
        (lambda: refractive_index("BK7", torch.tensor([500])), TypeError, "wavelength: .* got torch.int64"),
        (lambda: refractive_index("BK7", "red"), TypeError, "wavelength: expected a number or a tensor, got str"),  # type: ignore[call-overload]
    ],
)
def test_what_does_not_fit_is_refused(call: Any, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        call()


def test_examples_in_the_docstrings() -> None:
    result = doctest.testmod(torchbokeh.ops.sellmeier)
    assert result.attempted > 0
    assert result.failed == 0
