"""Colours of single wavelengths, and a spectrum as a few weighted wavelengths: samples or bands.

Wavelengths are in nanometres. Colours are linear sRGB, scaled so that light of equal power at all wavelengths is white.
"""

from collections.abc import Callable
from functools import cache
from typing import Literal

import torch
from torch import Tensor

from torchbokeh.ops import cie_1931
from torchbokeh.ops.checks import check_flag, check_image
from torchbokeh.ops.dispatch import compute_dtype
from torchbokeh.ops.spans import working_dtype

LOW, HIGH = 380.0, 780.0
"""Ends of the visible spectrum in nanometres."""

Formula = Literal["cie", "empirical"]

Weight = Callable[[Tensor], Tensor] | None
"""A spectral equaliser: for wavelengths in nanometres of any shape, weights of 0 or more. ``None`` is flat."""

CELLS = 4000
"""Of the tables that equalisers are integrated in: 0.1 nm each, so a peak may be a few tenths narrow."""

_FALL = ((380.0, 0.3), (420.0, 1.0), (700.0, 1.0), (780.0, 0.3))
_EMPIRICAL = (
    ((380.0, 1.0), (440.0, 0.0), (510.0, 0.0), (580.0, 1.0), (780.0, 1.0)),
    ((380.0, 0.0), (440.0, 0.0), (490.0, 1.0), (580.0, 1.0), (645.0, 0.0), (780.0, 0.0)),
    ((380.0, 1.0), (490.0, 1.0), (510.0, 0.0), (780.0, 0.0)),
)
"""Bruton's formula, (wavelength, value): the intensity's fall at the ends; red, green and blue before it."""


def xyz(wavelength: Tensor) -> Tensor:
    """Colour-matching functions of the CIE 1931 standard observer (2°), interpolated linearly between 5 nm steps.

    Args:
        wavelength: ``(...)`` floating-point, in nanometres.

    Returns:
        ``(..., 3)``, >= 0; 0 outside 380 to 780 nm. In the dtype of the wavelengths, but float32 for half precision.

    Raises:
        TypeError: not a floating-point tensor.

    Source:
        CIE 018:2019.

    Example:
        >>> xyz(torch.tensor([555.0, 900.0])).tolist()[1]
        [0.0, 0.0, 0.0]
    """
    _check_wavelength(wavelength)
    return _matching(_working(wavelength)).to(compute_dtype(wavelength))


def linear_rgb(wavelength: Tensor, formula: Formula = "cie") -> Tensor:
    """Linear sRGB of light of a single wavelength, for equal power at each.

    Such colours lie outside the gamut of sRGB: their negative components are set to 0, which makes them paler. Then
    each channel is scaled so that its mean over 380 to 780 nm is 1: light of a flat spectrum is white, (1, 1, 1).

    Args:
        wavelength: ``(...)`` floating-point, in nanometres.
        formula: ``"cie"``, from the CIE 1931 standard observer; or ``"empirical"``, Bruton's ramps between six
            wavelengths, with their fall to 30 % at the ends of the spectrum. The ramps are taken as linear light:
            Bruton's exponent of 0.8, which is for showing them on a screen, is left out.

    Returns:
        ``(..., 3)``, >= 0, below 8; 0 outside 380 to 780 nm. In the dtype of the wavelengths, but float32 for
        half precision.

    Raises:
        TypeError: not a floating-point tensor.
        ValueError: an unknown formula.

    Source:
        CIE 018:2019 and IEC 61966-2-1; D. Bruton, "Approximate RGB values for visible wavelengths", 1996.

    Example:
        >>> linear_rgb(torch.tensor([530.0]), "empirical").argmax(1).tolist()
        [1]
    """
    _check_wavelength(wavelength)
    return _rgb(_working(wavelength), formula).to(compute_dtype(wavelength))


def spectral_samples(
    unit: Tensor, weight: Weight = None, *, importance: bool = True, formula: Formula = "cie"
) -> tuple[Tensor, Tensor]:
    """Wavelengths for a picture of a spectrum, one for each point of the unit interval, and what each one adds.

    The picture is ``Σ_k rgb_k * picture(λ_k)``. With points spread evenly it tends to the picture of
    :func:`spectral_bands` with fine bands, with importance and without.

    Args:
        unit: ``(N,)`` floating-point, points in [0, 1), for instance a column of `torchbokeh.ops.sampling.halton`.
        weight: the equaliser.
        importance: place the samples where the weight is, by the inverse of its cumulative; each then carries its
            colour. Otherwise they are spread evenly from 380 to 780 nm and carry weight times colour. Importance makes
            the result less noisy, except in a channel that only has light where the weight is faint: few samples get
            there.
        formula: of :func:`linear_rgb`.

    Returns:
        The wavelengths ``(N,)`` in nanometres, and their colours ``(N, 3)``, >= 0. Every column sums to 1, so that what
        is sharp keeps its colour under any equaliser; but a channel in which no sample has light, because the equaliser
        leaves none or the samples are too few to meet it, is all 0: the picture has no light in it. Both in the dtype
        of ``unit``, but float32 for half precision.

    Raises:
        TypeError: ``unit`` is not a floating-point tensor, or the equaliser gives no tensor.
        ValueError: a point outside [0, 1), a wrong shape, an unknown formula; or the equaliser is negative, infinite
            or NaN somewhere, or 0 everywhere.

    Source:
        "Efficient and Expressive Rendering for Real-Time Defocus Blur and Bokeh", 4.2.2 and 4.3.2.

    Example:
        >>> wavelengths, rgb = spectral_samples(torch.tensor([0.125, 0.375, 0.625, 0.875]))
        >>> wavelengths.tolist(), rgb.sum(0).round(decimals=4).tolist()
        ([430.0, 530.0, 630.0, 730.0], [1.0, 1.0, 1.0])
    """
    check_image("unit", unit, ["N"])
    check_flag("importance", importance)
    wrong = unit[~((unit >= 0) & (unit < 1))]
    if len(wrong) > 0:
        raise ValueError(f"unit: expected points in [0, 1), got {wrong[0].item():g}")
    points = _working(unit)
    grid, density = _equaliser(weight, points)
    if importance:
        wavelength = _inverse_cumulative(grid, density, points)
        rgb = _rgb(wavelength, formula)
    else:
        wavelength = LOW + (HIGH - LOW) * points
        rgb = _rgb(wavelength, formula) * _weights(weight, wavelength)[:, None]
    dtype = compute_dtype(unit)
    return wavelength.to(dtype), _shares(rgb).to(dtype)


def spectral_bands(edges: Tensor, weight: Weight = None, formula: Formula = "cie") -> tuple[Tensor, Tensor]:
    """A spectrum cut into bands: of each its centre of light, and what it adds to each channel.

    Args:
        edges: ``(N + 1,)`` floating-point, N >= 1, strictly ascending, in nanometres within 380 to 780.
        weight: the equaliser.
        formula: of :func:`linear_rgb`.

    Returns:
        The mean wavelengths ``(N,)`` in nanometres, by weight times the sum of the three channels; the middle of a
        band without light. And the colours ``(N, 3)``, >= 0, the integrals of weight times colour over the bands.
        Every column sums to 1; but a channel without light in any band is all 0. Both in the dtype of ``edges``, but
        float32 for half precision.

    Raises:
        TypeError: ``edges`` is not a floating-point tensor, or the equaliser gives no tensor.
        ValueError: edges that do not ascend, leave 380 to 780 nm or are fewer than two, an unknown formula; or the
            equaliser is negative, infinite or NaN somewhere, or 0 everywhere.

    Example:
        >>> centre, rgb = spectral_bands(torch.tensor([380.0, 480.0, 580.0, 780.0]))
        >>> rgb.argmax(0).tolist()  # red is mostly in the last band
        [2, 1, 0]
    """
    check_image("edges", edges, ["N + 1"])
    if len(edges) < 2:
        raise ValueError(f"edges: expected two or more, got {len(edges)}")
    inner = (edges >= LOW) & (edges <= HIGH)
    if not bool(inner.all() & (edges[1:] > edges[:-1]).all()):
        raise ValueError(
            f"edges: expected wavelengths that strictly ascend within {LOW:g} to {HIGH:g} nm, got {edges.tolist()}"
        )
    cuts = _working(edges)
    grid, density = _equaliser(weight, cuts)
    light = density[:, None] * _rgb(grid, formula)
    total = light.sum(1, keepdim=True)
    # The integrals from the low end are linear within a cell, so the bands add up to the whole, however they are cut.
    integrals = _cumulative(torch.cat([light, total, total * grid[:, None]], 1), grid)
    place = (cuts - LOW) * (CELLS / (HIGH - LOW))
    cell = place.long().clamp(0, CELLS - 1)
    parts = torch.lerp(integrals[cell], integrals[cell + 1], (place - cell)[:, None]).diff(dim=0).clamp_min(0)
    rgb, power, moment = parts[:, :3], parts[:, 3], parts[:, 4]
    lit = power > torch.finfo(power.dtype).eps * integrals[-1, 3]  # what is less is rounding of the integrals
    middle = 0.5 * (cuts[:-1] + cuts[1:])
    centre = torch.where(lit, moment / torch.where(lit, power, 1), middle)
    dtype = compute_dtype(edges)
    return centre.clamp(cuts[:-1], cuts[1:]).to(dtype), _shares(rgb).to(dtype)


def _check_wavelength(wavelength: object) -> None:
    if not isinstance(wavelength, Tensor):
        raise TypeError(f"wavelength: expected a tensor, got {type(wavelength).__name__}")
    if not wavelength.is_floating_point():
        raise TypeError(f"wavelength: expected a floating-point tensor, got {wavelength.dtype}")


def _working(values: Tensor) -> Tensor:
    """In double, where the device has it."""
    return values.to(working_dtype(values.device))


def _matching(wavelength: Tensor) -> Tensor:
    table = wavelength.new_tensor(cie_1931.MATCHING)
    place = (wavelength - cie_1931.FIRST) / cie_1931.STEP
    row = place.detach().long().clamp(0, len(table) - 2)
    values = torch.lerp(table[row], table[row + 1], (place - row)[..., None])
    outside = (wavelength < cie_1931.FIRST) | (wavelength > cie_1931.LAST)
    return values.masked_fill(outside[..., None], 0)


def _rgb(wavelength: Tensor, formula: Formula) -> Tensor:
    return _unclipped(wavelength, formula).clamp_min(0) / wavelength.new_tensor(_means(formula))


def _unclipped(wavelength: Tensor, formula: Formula) -> Tensor:
    """``(..., 3)``, before negative components are cut off and before the scale."""
    if formula == "cie":
        from kornia.color import xyz_to_rgb

        colour: Tensor = xyz_to_rgb(_matching(wavelength).reshape(-1, 3, 1, 1))
        return colour.reshape(*wavelength.shape, 3)
    if formula == "empirical":
        ramps = torch.stack([_ramp(wavelength, knots) for knots in _EMPIRICAL], -1)
        return ramps * _ramp(wavelength, _FALL)[..., None]
    raise ValueError(f"formula: expected 'cie' or 'empirical', got {formula!r}")


def _ramp(wavelength: Tensor, knots: tuple[tuple[float, float], ...]) -> Tensor:
    """Linear between the knots, 0 outside them."""
    x, y = wavelength.new_tensor(tuple(zip(*knots, strict=True)))
    k = torch.searchsorted(x, wavelength.detach().contiguous(), right=True).clamp(1, len(x) - 1)
    value = torch.lerp(y[k - 1], y[k], (wavelength - x[k - 1]) / (x[k] - x[k - 1]))
    return value.masked_fill((wavelength < x[0]) | (wavelength > x[-1]), 0)


@cache
def _means(formula: Formula) -> tuple[float, ...]:
    """Mean of each channel from `LOW` to `HIGH`, before the scale."""
    knots = torch.linspace(LOW, HIGH, len(cie_1931.MATCHING), dtype=torch.float64, device="cpu")
    value = _unclipped(knots, formula)
    if formula == "cie":
        # Linear between the knots, with the negative part cut off: of ends a > 0 > b only a triangle stays.
        above, below = value.clamp_min(0).unfold(0, 2, 1).sum(2), (-value).clamp_min(0).unfold(0, 2, 1).sum(2)
        cells = above.square() / (2 * (above + below).clamp_min(1e-300))
    else:
        # A product of two ramps, whose knots are among these: Simpson's rule is exact.
        middle = _unclipped(0.5 * (knots[1:] + knots[:-1]), formula)
        cells = (value[1:] + 4 * middle + value[:-1]) / 6
    return tuple(cells.mean(0).tolist())


def _equaliser(weight: Weight, like: Tensor) -> tuple[Tensor, Tensor]:
    """The wavelengths `LOW` to `HIGH` in equal steps and the weights there, not all of them 0."""
    grid = torch.linspace(LOW, HIGH, CELLS + 1, dtype=like.dtype, device=like.device)
    values = _weights(weight, grid)
    if not bool((values > 0).any()):
        raise ValueError(f"weight: expected a weight above 0 somewhere from {LOW:g} to {HIGH:g} nm, got 0 everywhere")
    return grid, values / values.detach().max()  # sums of the largest numbers would be infinite


def _weights(weight: Weight, wavelength: Tensor) -> Tensor:
    """The equaliser at ``(N,)`` wavelengths, checked."""
    if weight is None:
        return torch.ones_like(wavelength)
    if not callable(weight):
        raise TypeError(f"weight: expected a function of a tensor, got {type(weight).__name__}")
    values = weight(wavelength)
    if not isinstance(values, Tensor):
        raise TypeError(f"weight: expected a function that gives a tensor, got {type(values).__name__}")
    if values.shape != wavelength.shape:
        raise ValueError(f"weight: expected shape {tuple(wavelength.shape)}, got {tuple(values.shape)}")
    values = values.to(wavelength)
    wrong = ~((values >= 0) & values.isfinite())
    if bool(wrong.any()):
        value, at = values[wrong][0].item(), wavelength[wrong][0].item()
        raise ValueError(f"weight: expected finite weights of 0 or more, got {value:g} at {at:g} nm")
    return values


def _cumulative(values: Tensor, grid: Tensor) -> Tensor:
    """Integrals of ``(M, ...)`` over the first dimension from the first point of the grid to each."""
    return torch.cat([torch.zeros_like(values[:1]), torch.cumulative_trapezoid(values, grid, dim=0)])


def _inverse_cumulative(grid: Tensor, density: Tensor, points: Tensor) -> Tensor:
    area = _cumulative(density, grid)
    # Rounded up to the whole area, a point would fall beyond the last cell with any weight.
    wanted = torch.minimum(points * area[-1], area[-1] * (1 - torch.finfo(area.dtype).eps))
    k = torch.searchsorted(area.detach(), wanted.detach(), right=True).clamp(1, CELLS)
    share = (wanted - area[k - 1]) / (area[k] - area[k - 1])
    return torch.lerp(grid[k - 1], grid[k], share)


def _shares(rgb: Tensor) -> Tensor:
    """Each column by its sum; a column of zeros stays."""
    rgb = rgb / rgb.amax(0).clamp_min(torch.finfo(rgb.dtype).tiny) if len(rgb) > 0 else rgb
    total = rgb.sum(0)
    return rgb / torch.where(total > 0, total, 1)
