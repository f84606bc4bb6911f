"""The motion of a picture as callers pass it: a displacement, or several, one after the other."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from torch import Tensor

from torchbokeh.ops.checks import check_image

Displacements = Tensor | Sequence[Tensor] | None
"""What callers pass as ``motion``: ``(B, 2, H, W)``, or ``(B, L, 2, H, W)`` for layers, or several of these."""

ADVANCE = {"centre": 0.0, "start": 0.5}
"""Moments of the exposure that a picture may show, and by how much of its motion the middle is ahead."""


class Motion(NamedTuple):
    """What a picture does while the shutter is open.

    Attributes:
        displacements: (dx, dy) in px in equal parts of the exposure, in order; none where there is no such motion.
        shutter_coc: signed CoC ``(..., 2, H, W)`` in px when the shutter opens and when it closes, or None.
        shutter: which moment the picture shows, one of `ADVANCE`.
    """

    displacements: tuple[Tensor, ...] = ()
    shutter_coc: Tensor | None = None
    shutter: str = "centre"

    def __bool__(self) -> bool:
        """Whether there is any."""
        return bool(self.displacements) or self.shutter_coc is not None

    @property
    def maps(self) -> list[Tensor]:
        """All of its maps."""
        return [*self.displacements, *([] if self.shutter_coc is None else [self.shutter_coc])]

    def mapped(self, change: Callable[[Tensor], Tensor]) -> "Motion":
        """The same with all maps changed."""
        ends = None if self.shutter_coc is None else change(self.shutter_coc)
        return self._replace(displacements=tuple(map(change, self.displacements)), shutter_coc=ends)


def checked_displacements(image: Tensor, motion: Displacements) -> tuple[Tensor, ...]:
    """The displacements in order, after a check of their kind and shape.

    Raises:
        TypeError: ``motion`` is no floating-point tensor, and no sequence of such.
        ValueError: a shape or device does not fit.
    """
    if motion is None:
        return ()
    if not isinstance(motion, Tensor | Sequence):
        raise TypeError(f"motion: expected a tensor, a sequence of tensors or None, got {type(motion).__name__}")
    found = (motion,) if isinstance(motion, Tensor) else tuple(motion)
    if not found:
        raise ValueError("motion: expected at least one displacement, got an empty sequence")
    for displacement in found:
        check_image("motion", displacement, (*image.shape[:-3], 2, *image.shape[-2:]), like=image)
    return found
