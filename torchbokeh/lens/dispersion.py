"""How a lens disperses light: focal length and magnification for every wavelength, and the colours it is cut into."""

import math
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from torchbokeh.lens.field_map import Field, FieldMap
from torchbokeh.lens.glass import relative_focal_length
from torchbokeh.lens.parameters import ParametricModule, check_parameter
from torchbokeh.ops.spectrum import HIGH, LOW, Weight, spectral_bands

Spectrum = Literal["rgb", "continuous"]

RGB = (650.0, 510.0, 475.0)
"""Wavelengths in nanometres that stand for red, green and blue (section 4.2.1 of the dissertation)."""

STEP = 1.0
"""Distance of two neighbouring bands of a spectrum in px, in radius or in place."""

FEWEST, MOST = 3, 64
"""Bands of a spectrum, at least and at most."""

SEEN = 0.05
"""A spread of colours of fewer px is left out."""

FAINT = 2e-3
"""A band leaves out a channel that gets less than this share of its light from it, and part of it up to twice that."""


class Light(NamedTuple):
    """Light of one wavelength.

    Attributes:
        wavelength: in nanometres.
        rgb: what it adds to each channel; over all light of a picture every channel sums to 1.
    """

    wavelength: float
    rgb: tuple[float, float, float]


class Dispersion(ParametricModule):
    """Axial and lateral chromatic aberration of a lens (chapter 4 of the defocus and bokeh dissertation).

    *Axial*: glass bends short waves more, so their focal length is shorter: ``F(λ) = F (1 + axial (f(λ) - 1))`` with
    f the relative focal length of a thin lens of that glass (4.3). Toward the border of the picture it fades as
    ``lerp(F(λ), F, A(t, theta))`` (4.7). *Lateral*: pictures of short waves are larger, by
    ``m(λ) = 1 + lateral (λ_r - λ) / λ_r L(t, theta)`` (4.8), with λ_r the reference.

    Args:
        glass: one of `torchbokeh.lens.glass.GLASSES`.
        axial: strength of the axial part: 1 is a single lens of that glass, 0 none.
        lateral: strength of the lateral part: how much larger than at the reference a wavelength of 0 would be, in the
            corners. 0.01 makes blue (475 nm) 0.27 % larger than red (650 nm) there.
        axial_map: A; ``None`` for 0, the same strength everywhere.
        lateral_map: L; ``None`` for 1, the same magnification everywhere.
        spectrum: ``"rgb"``: three wavelengths, of 650, 510 and 475 nm, one for each channel; ``"continuous"``: all of
            them from 380 to 780 nm.
        reference: λ_r in nanometres: light that is focused where the lens says, in its place.
        equaliser: weights over the wavelength in nanometres, of a continuous spectrum; ``None`` is flat.

    Raises:
        TypeError: an argument of the wrong kind.
        ValueError: an unknown glass or spectrum, a value out of its range, or an equaliser without a spectrum.

    Example:
        >>> import torchbokeh as tb
        >>> lens = tb.ThinLens(0.05, 1.8, 2.0, 0.036, dispersion=tb.Dispersion("BK7", axial=0.3, lateral=0.01))
        >>> out = tb.LensBlur(lens)(torch.rand(1, 3, 24, 32), torch.full((1, 1, 24, 32), 4.0))
    """

    axial: Tensor
    lateral: Tensor

    def __init__(
        self,
        glass: str = "BK7",
        axial: float | Tensor = 1.0,
        lateral: float | Tensor = 0.0,
        *,
        axial_map: FieldMap | None = FieldMap(),  # noqa: B008 - immutable
        lateral_map: FieldMap | None = FieldMap(),  # noqa: B008
        spectrum: Spectrum = "rgb",
        reference: float = RGB[0],
        equaliser: Weight = None,
    ) -> None:
        super().__init__()
        if not isinstance(glass, str):
            raise TypeError(f"glass: expected a name, got {type(glass).__name__}")
        relative_focal_length(glass, RGB[1], reference)
        for name, given in (("axial_map", axial_map), ("lateral_map", lateral_map)):
            if given is not None and not isinstance(given, FieldMap):
                raise TypeError(f"{name}: expected a FieldMap or None, got {type(given).__name__}")
        if spectrum not in ("rgb", "continuous"):
            raise ValueError(f"spectrum: expected 'rgb' or 'continuous', got {spectrum!r}")
        if equaliser is not None and not callable(equaliser):
            raise TypeError(f"equaliser: expected a callable or None, got {type(equaliser).__name__}")
        if equaliser is not None and spectrum == "rgb":
            raise ValueError("equaliser: expected None with spectrum 'rgb', got one")
        self.glass, self.spectrum, self.reference = glass, spectrum, float(reference)
        self.axial_map, self.lateral_map, self.equaliser = axial_map, lateral_map, equaliser
        self.keep(axial=axial, lateral=lateral)
        for name, value in self.values().items():
            check_parameter(name, value, value.isfinite(), "a finite strength")
        for end in self.wavelengths():
            good = self.relative_focal_length(end) > 0
            check_parameter("axial", self.axial, good, "a strength that leaves focal lengths above 0")

    def extra_repr(self) -> str:
        """The settings, for ``print``."""
        maps = f"axial_map={self.axial_map}, lateral_map={self.lateral_map}"
        light = f"spectrum={self.spectrum!r}, reference={self.reference:g}, equaliser={self.equaliser}"
        return f"{self.glass!r}, {super().extra_repr()}, {maps}, {light}"

    def relative_focal_length(self, wavelength: float) -> Tensor:
        """``F(λ) / F`` in the middle of the picture, of the shape of ``axial``."""
        return 1 + self.axial * (relative_focal_length(self.glass, wavelength, self.reference) - 1)

    def power(self, wavelength: float, field: Field | None = None) -> Tensor:
        """By how much the lens bends light more than at the reference, ``F / F(λ, t, theta) - 1``.

        Args:
            wavelength: λ in nanometres.
            field: where; ``None`` for the middle of the picture, or for all of it where there is no ``axial_map``.

        Returns:
            ``(H, W)`` or ``(B, 1, H, W)`` where it depends on the field, otherwise of the shape of ``axial``.
        """
        focal = self.relative_focal_length(wavelength)
        if field is not None and self.axial_map is not None:
            focal = focal.view(-1, 1, 1, 1) if focal.dim() else focal
            focal = torch.lerp(focal, torch.ones_like(focal), self.axial_map(field.t, field.theta).to(focal.dtype))
        return focal.clamp_min(0.05).reciprocal() - 1

    def enlargement(self, wavelength: float, field: Field) -> Tensor:
        """``m(λ, t, theta) - 1``, at least -0.9: ``(H, W)``, or ``(B, 1, H, W)`` for a batch of strengths."""
        strength = self.lateral.view(-1, 1, 1, 1) if self.lateral.dim() else self.lateral
        share = torch.ones_like(field.t) if self.lateral_map is None else self.lateral_map(field.t, field.theta)
        return (strength.to(field.t.dtype) * ((self.reference - wavelength) / self.reference) * share).clamp_min(-0.9)

    def wavelengths(self) -> tuple[float, float]:
        """The shortest and the longest that are seen, in nanometres."""
        return (min(RGB), max(RGB)) if self.spectrum == "rgb" else (LOW, HIGH)

    def light(self, spread: float) -> tuple[Light, ...]:
        """What a picture whose colours spread over that many px is put together from; nothing where that is not seen.

        A continuous spectrum is cut into bands that are `STEP` px wide, evenly in what the glass does, from its short
        end. The last one is as wide as what is left: new bands begin as narrow ones, and no picture jumps.
        """
        if spread < SEEN:
            return ()
        if self.spectrum == "rgb":
            return tuple(Light(w, tuple(float(k == c) for c in range(3))) for k, w in enumerate(RGB))  # type: ignore[arg-type]
        count = min(max(spread / STEP, FEWEST), MOST)
        grid = torch.linspace(LOW, HIGH, 801, dtype=torch.float64)
        power = 1 / relative_focal_length(self.glass, grid, self.reference)
        place = (power[0] - power) / (power[0] - power[-1])
        if not bool(self.axial.detach().any()):  # the lateral part is even in the wavelength itself
            place = (grid - LOW) / (HIGH - LOW)
        cuts = torch.arange(1, math.ceil(count - 1e-9), dtype=torch.float64) / count
        k = torch.searchsorted(place.contiguous(), cuts)
        inner = torch.lerp(grid[k - 1], grid[k], (cuts - place[k - 1]) / (place[k] - place[k - 1]))
        centres, rgb = spectral_bands(torch.cat([grid[:1], inner, grid[-1:]]), self.equaliser)
        rgb = rgb * (rgb / FAINT - 1).clamp(0, 1)
        rgb = rgb / rgb.sum(0).clamp_min(1e-12)
        bands = zip(centres.tolist(), rgb.tolist(), strict=True)
        return tuple(Light(w, tuple(share)) for w, share in bands if any(share))
