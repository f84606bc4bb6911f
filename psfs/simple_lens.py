"""`SimpleLens`: the disc of a thin lens (LKS table 1)."""

from collections.abc import Sequence

from torchbokeh.ops.checks import check_number
from torchbokeh.ops.spans import MIN_RADIUS
from torchbokeh.psfs.arrays import Array
from torchbokeh.psfs.combined import capsule, of_radius
from torchbokeh.psfs.model import FRAME, Axis, Labels, Place, PsfModel


class RadiusModel(PsfModel):
    """A model whose one coordinate is the CoC radius beyond half a pixel, in px."""

    def place(self, labels: Labels) -> Place:
        """The radius of every pixel; needs ``coc``. Larger PSFs are scaled from the largest."""
        if labels.coc is None:
            raise ValueError(f"{self.name}: expected coc, got none")
        return of_radius(self, labels.coc.abs())

    def places(self, labels: Labels, size: int = 1) -> list[Place]:
        """The PSF in blocks is a smaller one."""
        return [self.place(labels if labels.coc is None else Labels(coc=labels.coc / size))]


class SimpleLens(RadiusModel):
    """The disc of confusion of a thin lens. Its one coordinate is the CoC radius beyond half a pixel, in px.

    Renderers splat discs by rows, in closed form and without a bank (`torchbokeh.ops.splat.splat_spans`); this model is
    there for comparison with LKS. Larger discs are scaled from the largest.

    Args:
        radius: largest radius that is sampled, in px: from 1 to half of `FRAME`.

    Raises:
        TypeError: not a number.
        ValueError: out of its range.

    Example:
        >>> psf = SimpleLens().dense((9.5,))
        >>> psf.shape, (314.159 * psf[0, 10, 10]).round(3).item()
        ((1, 21, 21), 1.0)
    """

    name = "simple-lens"
    symmetry = "octants"

    def __init__(self, radius: float = 100.0) -> None:
        radius = check_number("radius", radius, 1, FRAME / 2)
        self.axes = (Axis("radius", "px", radius - MIN_RADIUS, 2.0, 100 * 101 // 2),)

    def settings(self) -> dict[str, float | int | str]:
        """The largest radius."""
        return {"radius": self.axes[0].bound + MIN_RADIUS}

    def dense(self, coordinates: Sequence[float]) -> Array:
        """The light of a disc on every pixel."""
        return capsule(coordinates[0] + MIN_RADIUS, 0.0)
