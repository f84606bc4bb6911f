"""The reference renderer with dispersion: views through lens, shutter and spectrum together."""

import torch
from torch import Tensor

from torchbokeh.lens import Lens
from torchbokeh.lens.dispersion import RGB, Dispersion
from torchbokeh.ops.sampling import aperture_points, halton, stratified
from torchbokeh.ops.spans import Profile
from torchbokeh.ops.spectrum import spectral_samples
from torchbokeh.renderers.accumulation import AccumulationBuffer
from torchbokeh.views.points import Views
from torchbokeh.views.prism import Prism

FINE = 256
"""Wavelengths that tell in which channels an equaliser leaves light."""


class ChromaticAccumulation(AccumulationBuffer):
    """`AccumulationBuffer` of a lens with dispersion (chapter 4 of the defocus and bokeh dissertation).

    Each view has a wavelength as well as a point of the lens: the points fill a cylinder, lens by spectrum, evenly
    (Halton, bases 2, 7 and 11). What a view of wavelength λ shows at the pinhole position p is moved by
    ``(coc(λ) - coc) v + p (m(λ) - 1)``, with v the point of the lens, and adds to the picture what the eye sees of λ;
    every channel is divided by the sum of that, so that white stays white; a channel that none of a few views
    meets takes an equal part of each of them.

    In the mode ``"rgb"`` of `Dispersion` a third of the views go to each of three wavelengths, through the same points
    of the lens: what is grey and in focus stays grey. Without dispersion it is the `AccumulationBuffer`.

    Args, techniques and errors are those of `AccumulationBuffer`; sub-samples blur every view by the radii of the
    reference, and layers share renderings within one wavelength, so not in a continuous spectrum. The dispersion is
    that of ``lens``, or of the lens of the scene's camera.

    Raises:
        TypeError: an argument of the wrong kind.
        ValueError: a value out of its range.

    Source: sections 4.2.1 and 4.2.2 of the dissertation.

    Example:
        >>> import torch
        >>> import torchbokeh as tb
        >>> lens = tb.ThinLens(0.05, 1.8, 2.0, 0.036, dispersion=tb.Dispersion("BK7", spectrum="continuous"))
        >>> buffer = tb.ChromaticAccumulation(lens, views=16)
        >>> buffer(torch.rand(1, 2, 4, 24, 32), torch.full((1, 2, 1, 24, 32), 3.0)).shape
        torch.Size([1, 4, 24, 32])
    """

    def _spread(self, lens: Lens | None, size: tuple[int, int]) -> tuple[Views, Prism | None]:
        dispersion = None if lens is None else lens.dispersion
        if lens is None or dispersion is None:
            return super()._spread(lens, size)
        for name, value in (*lens.values().items(), *dispersion.values().items()):
            if value.dim():
                raise ValueError(
                    f"lens: expected scalar parameters with dispersion, got {name} of shape {tuple(value.shape)}"
                )
        profile = self.aperture.profile()
        if dispersion.spectrum == "rgb":
            each = Views.spread(max(self.views // 3, 1), profile, first=self.first, seed=self.seed)
            views = Views(*(t.repeat(3, *[1] * (t.dim() - 1)) for t in (each.lens, each.time, each.shift)))
            wavelengths = torch.tensor(RGB, dtype=torch.float64).repeat_interleave(len(each))
            rgb = torch.eye(3, dtype=torch.float64).repeat_interleave(len(each), 0) / len(each)
        else:
            views, wavelengths, rgb = self._continuous(profile, dispersion)
        return views, Prism(lens, size, wavelengths.tolist(), rgb)

    def _continuous(self, profile: Profile, dispersion: Dispersion) -> tuple[Views, Tensor, Tensor]:
        points = halton(self.views, first=self.first, seed=self.seed)
        lens = aperture_points(profile, points[:, [0, 3]]).cpu()
        views = Views(lens, stratified(points[:, 1]) - 0.5, points[:, [2, 5]] - 0.5)
        wavelengths, rgb = spectral_samples(points[:, 4], dispersion.equaliser)
        # A channel that too few views miss takes an equal part of each; one that the equaliser leaves dark stays so.
        unit = (torch.arange(FINE, dtype=points.dtype) + 0.5) / FINE
        lit = (spectral_samples(unit, dispersion.equaliser)[1] > 0).any(0)
        return views, wavelengths, torch.where(lit & (rgb == 0).all(0), 1 / len(rgb), rgb)
