"""Glass of a lens: how strongly it bends light of each wavelength, and the focal lengths that follow."""

from numbers import Real
from typing import overload

import torch
from torch import Tensor

from torchbokeh.ops.sellmeier import HIGH, LOW, SELLMEIER, refractive_index
from torchbokeh.ops.spans import working_dtype

__all__ = ["GLASSES", "abbe_number", "refractive_index", "relative_focal_length"]

GLASSES = tuple(SELLMEIER)
"""Names of the known glasses."""

D, F, C = 587.5618, 486.1327, 656.2725
"""Fraunhofer's lines d (helium), F and C (hydrogen) in nanometres."""


def abbe_number(glass: str) -> float:
    """Abbe number ``(n_d - 1) / (n_F - n_C)``: the larger, the less a lens of this glass splits colours.

    Args:
        glass: one of `GLASSES`.

    Returns:
        About 20 for a dense flint to 95 for calcium fluoride.

    Raises:
        ValueError: an unknown glass.

    Example:
        >>> round(abbe_number("BK7"), 2)
        64.17
    """
    return (refractive_index(glass, D) - 1) / (refractive_index(glass, F) - refractive_index(glass, C))


@overload
def relative_focal_length(glass: str, wavelength: float, reference: float) -> float: ...
@overload
def relative_focal_length(glass: str, wavelength: Tensor, reference: float) -> Tensor: ...
def relative_focal_length(glass: str, wavelength: float | Tensor, reference: float) -> float | Tensor:
    """Focal length of a thin lens at a wavelength over that at the reference, ``(n(λ_r) - 1) / (n(λ) - 1)``.

    The lens maker's equation, ``1 / F(λ) = (n(λ) - 1) (1 / R_1 - 1 / R_2)``, with the surfaces fixed: the radii
    cancel. In visible light it grows with the wavelength.

    Args:
        glass: one of `GLASSES`.
        wavelength: λ in nanometres, 310 to 2300; a number, or a floating-point tensor of any shape.
        reference: λ_r, alike; a number.

    Returns:
        Above 0, near 1 for visible light. A number for a number; for a tensor one of its shape and dtype, but float32
        for half precision.

    Raises:
        TypeError: a wavelength is not a number or floating-point tensor.
        ValueError: an unknown glass, or a wavelength out of range.

    Source:
        "Efficient and Expressive Rendering for Real-Time Defocus Blur and Bokeh", (4.3).

    Example:
        >>> round(relative_focal_length("BK7", 475.0, 650.0), 4)
        0.9834
    """
    if not isinstance(reference, Real) or isinstance(reference, bool):
        raise TypeError(f"reference: expected a number, got {type(reference).__name__}")
    if not LOW <= reference <= HIGH:
        raise ValueError(f"reference: expected {LOW:g} to {HIGH:g} nm, got {reference:g}")
    power = refractive_index(glass, reference) - 1
    if not isinstance(wavelength, Tensor):
        return power / (refractive_index(glass, wavelength) - 1)
    if not wavelength.is_floating_point():
        raise TypeError(f"wavelength: expected a floating-point tensor, got {wavelength.dtype}")
    # In double: focal lengths differ by a percent, an index in float32 would lose too much of that.
    index = refractive_index(glass, wavelength.to(working_dtype(wavelength.device)))
    return (power / (index - 1)).to(torch.promote_types(wavelength.dtype, torch.float32))
