"""What dispersion does to a view: where light of its wavelength goes, and what it adds to each channel."""

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional as F

from torchbokeh.lens import Lens
from torchbokeh.lens.field_map import Field
from torchbokeh.picture.sensor import STEPS
from torchbokeh.views.points import Views


class Prism:
    """The dispersion of a lens for N views of given wavelengths.

    Args:
        lens: with a dispersion, of scalar parameters.
        size: ``(H, W)`` of the picture.
        wavelengths: N, in nanometres.
        rgb: ``(N, 3)``, what each view adds to each channel.
    """

    def __init__(self, lens: Lens, size: tuple[int, int], wavelengths: Sequence[float], rgb: Tensor) -> None:
        assert lens.dispersion is not None
        self.lens, self.dispersion, self.size = lens, lens.dispersion, size
        self.wavelengths = wavelengths
        self.weights = torch.cat([rgb, rgb.mean(1, keepdim=True)], 1)

    def shifts(self) -> tuple[float, float]:
        """The least and the most that the CoC of a view is above that of the reference, in px."""
        with torch.no_grad():
            field = Field.pixels(self.size, 0, torch.zeros(()))
            ends = (min(self.wavelengths), max(self.wavelengths))
            found = [self.lens.coc_shift(w, self.size[1], field).aminmax() for w in ends]
            return min(float(low) for low, _ in found), max(float(high) for _, high in found)

    def kinds(self) -> Tensor:
        """``(N,)`` int64: views of the same wavelength have the same number."""
        return torch.tensor(self.wavelengths, dtype=torch.float64).unique(return_inverse=True)[1]

    def movement(self, view: int, point: Tensor, field: Field) -> Tensor:
        """Where a view moves what is at the places of a field, ``(2, H, W)`` in px, beside what every lens does."""
        wavelength = self.wavelengths[view]
        shift = self.lens.coc_shift(wavelength, self.size[1], field).to(field.x)
        larger = self.dispersion.enlargement(wavelength, field)
        return torch.stack([shift * point[0] + larger * field.x, shift * point[1] + larger * field.y])

    def moved(self, frames: Tensor, coc: Tensor, views: Views, first: int) -> Tensor:
        """Frames ``(V, 4, H, W)`` of the views from ``first`` on, as light of their wavelengths shows them, weighted.

        Args:
            frames: as the reference wavelength shows them.
            coc: ``(V, 1, H, W)`` of what is seen in them, signed, in px.
            views: all of them.
            first: number of the first frame.
        """
        out = []
        for k in range(len(frames)):
            view = first + k
            point, shift = views.lens[view].to(frames), views.shift[view].to(frames)
            grid = self._sources(view, point, shift, coc[k : k + 1])
            picture = F.grid_sample(frames[k : k + 1], grid[None], padding_mode="border", align_corners=False)
            out.append(picture * self.weights[view].to(picture)[:, None, None])
        return torch.cat(out)

    def _sources(self, view: int, point: Tensor, shift: Tensor, coc: Tensor) -> Tensor:
        """For every pixel the place ``(H, W, 2)`` that comes to lie on it, as `grid_sample` has places."""
        height, width = self.size
        pixels = Field.pixels(self.size, 0, coc)
        goal = torch.stack([pixels.x, pixels.y])
        extent = coc.new_tensor([width, height])
        here = goal
        for _ in range(STEPS):
            grid = 2 * here.movedim(0, -1) / extent
            radius = F.grid_sample(coc, grid[None], mode="nearest", padding_mode="border", align_corners=False)[0]
            # Where the middle of the lens sees what this view shows there.
            pinhole = here - radius * point[:, None, None] - shift[:, None, None]
            here = goal - self.movement(view, point, Field(pinhole[0], pinhole[1], self.size))
        return 2 * here.movedim(0, -1) / extent
