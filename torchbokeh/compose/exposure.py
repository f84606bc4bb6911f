"""What a surface does while the shutter is open, in parts along straight lines."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchbokeh.banks.splat import bank_of_motion
from torchbokeh.picture.motion import Motion
from torchbokeh.psfs.bank import PsfBank
from torchbokeh.psfs.model import Labels


class ExposurePart(NamedTuple):
    """A part of a motion, along a line.

    Attributes:
        motion: displacement ``(B, 2, H, W)``, (dx, dy) in px.
        offset: where its middle is seen from the pixel, likewise; ``None`` for at the pixel itself.
        coc: ``(B, 1, H, W)`` radius in px meanwhile; ``None`` for that of the surface.
    """

    motion: Tensor
    offset: Tensor | None = None
    coc: Tensor | None = None


class Exposure(NamedTuple):
    """How a surface moves while the shutter is open.

    Attributes:
        parts: what it does in equal parts of the exposure.
        bank: the PSFs of defocus with motion, see `torchbokeh.psfs.Combined`.
    """

    parts: tuple[ExposurePart, ...]
    bank: PsfBank

    @classmethod
    def along(cls, displacements: Sequence[Tensor], bank: PsfBank, *, from_start: bool) -> "Exposure":
        """The motion along displacements, of a picture that shows the start of the exposure, or its middle."""
        if len(displacements) == 1 and not from_start:
            return cls((ExposurePart(displacements[0]),), bank)
        starts = [torch.zeros_like(displacements[0])]
        for displacement in displacements:
            starts.append(starts[-1] + displacement)
        half = len(displacements) // 2
        origin = starts[0 if from_start else half]
        if len(displacements) % 2 and not from_start:
            origin = origin + displacements[half] / 2
        pairs = zip(displacements, starts[:-1], strict=True)
        return cls(tuple(ExposurePart(d, start + d / 2 - origin) for d, start in pairs), bank)

    def approaching(self, ends: Tensor) -> "Exposure":
        """The same while the radius changes, evenly in time, from one end ``(B, 2, H, W)`` to the other, signed."""
        start, stop = ends.split(1, 1)
        count = len(self.parts)
        step = (stop - start) / count
        # Within a part the mean square of the radius is more than the square of its mean.
        middles = [start + (k + 0.5) * step for k in range(count)]
        radii = [(r.square() + step.square() / 12).clamp_min(1e-12).sqrt() for r in middles]
        return self._replace(parts=tuple(p._replace(coc=r) for p, r in zip(self.parts, radii, strict=True)))

    def mapped(self, change: Callable[[Tensor], Tensor]) -> "Exposure":
        """The same with all maps changed."""

        def of(t: Tensor | None) -> Tensor | None:
            return None if t is None else change(t)

        return self._replace(parts=tuple(ExposurePart(change(p.motion), of(p.offset), of(p.coc)) for p in self.parts))

    def labels(self, coc: Tensor) -> list[Labels]:
        """What the bank wants to know of a surface of that CoC."""
        return [Labels(coc if p.coc is None else p.coc, motion=p.motion, offset=p.offset) for p in self.parts]


def exposed(motion: Motion, count: int) -> Exposure | None:
    """The motion as surfaces have it, or None for none.

    Args:
        motion: of a picture, or of one layer.
        count: into how many parts each displacement is cut, where the radius changes.
    """
    if not motion:
        return None
    ends = motion.shutter_coc
    whole = motion.displacements or tuple(torch.zeros_like(t) for t in motion.maps)
    cut = [displacement / count for displacement in whole for _ in range(count)]
    exposure = Exposure.along(cut, bank_of_motion(cut[0].device), from_start=motion.shutter == "start")
    return exposure if ends is None else exposure.approaching(ends)
