"""What a renderer is asked for: a picture and its maps, checked once, with depth turned into circles of confusion."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torchbokeh.lens.base import Lens
from torchbokeh.ops.checks import check_image, not_finite
from torchbokeh.ops.dispatch import compute_dtype, has_numbers
from torchbokeh.picture.motion import Displacements, Motion, checked_displacements
from torchbokeh.picture.sensor import Sensor
from torchbokeh.psfs.model import Labels

WIDEST = 1e5
"""Radius in px from which on radii are not told apart: such a disc covers any picture evenly. That of 1e7 px would put
less on a pixel than counts as coverage (`torchbokeh.ops.composite.TINY`)."""

Background = Tensor | tuple[Tensor, Tensor] | None
"""What callers pass as ``background``: an image, or a pair of it and its depth."""


class Optics(NamedTuple):
    """What turns maps of depth into circles of confusion.

    Attributes:
        lens: None where callers pass the CoC itself.
        margin: px on each side of a picture that lie beyond the sensor.
        max_coc: largest radius in px, or None.
        shutter: which moment of the exposure a picture with motion shows.
    """

    lens: Lens | None = None
    margin: int = 0
    max_coc: float | None = None
    shutter: str = "centre"


class Request(NamedTuple):
    """A picture and what it is blurred by.

    Attributes:
        image: ``(B, C, H, W)``, or layers ``(B, L, 4, H, W)`` of premultiplied RGBA.
        coc: its signed CoC ``(B, 1, H, W)``, or ``(B, L, 1, H, W)``, in px.
        motion: what it does while the shutter is open.
        background: what the foreground hides, as colour and, if it is known, signed CoC.
        sensor: where the picture lies on it.
        clamped: where a limit cut the CoC, or None.
        labels: all that a bank of point-spread functions is asked by, where there is one.
        optics: what turned depth into CoC.
    """

    image: Tensor
    coc: Tensor
    motion: Motion
    background: tuple[Tensor, Tensor | None] | None
    sensor: Sensor
    clamped: Tensor | None = None
    labels: Labels | None = None
    optics: Optics = Optics()

    @classmethod
    def of(
        cls,
        optics: Optics,
        image: Tensor,
        depth: object = None,
        *,
        coc: object = None,
        motion: Displacements = None,
        shutter_depth: object = None,
        background: Background = None,
    ) -> "Request":
        """Check what a caller passes; the arguments are those of `torchbokeh.LensBlur.forward`.

        Raises:
            TypeError: a map is not a floating-point tensor.
            ValueError: a shape, device or value does not fit.
        """
        layered = isinstance(image, Tensor) and image.dim() == 5
        check_image("image", image, ("B", "L", 4, "H", "W") if layered else ("B", "C", "H", "W"))
        if image.numel() and 2 * optics.margin >= min(image.shape[-2:]):
            raise ValueError(f"margin: expected less than half of {tuple(image.shape[-2:])}, got {optics.margin}")
        maps = _Maps(optics, image, Sensor((image.shape[-2], image.shape[-1]), optics.margin), coc is not None)
        if (depth is None) == (coc is None):
            raise ValueError(f"depth: expected either depth or coc, got {'neither' if coc is None else 'both'}")
        signed = maps.signed("depth", depth) if coc is None else maps.signed("coc", coc)
        limit = optics.max_coc
        clamped = None if limit is None else signed.abs() > limit
        dispersion = None if optics.lens is None else optics.lens.dispersion
        if dispersion is not None and image.shape[1] != 3 and not layered:
            raise ValueError(f"image: expected 3 channels for a lens with dispersion, got {image.shape[1]}")
        ends = None if shutter_depth is None else maps.limited("shutter_depth", shutter_depth, channels=2)
        found = Motion(checked_displacements(image, motion), ends, optics.shutter)
        behind = None
        if background is not None:
            if layered:
                raise ValueError("background: expected None for layers (make it the last layer), got a background")
            behind = maps.behind(background)
        return cls(image, maps.cut(signed), found, behind, maps.sensor, clamped, optics=optics)

    @property
    def layered(self) -> bool:
        """Whether the image is one of layers."""
        return self.image.dim() == 5

    def items(self) -> list["Request"]:
        """Those of the pictures of a batch, one by one; itself, where there is but one or none."""
        return [self] if len(self.image) < 2 else [self._item(number) for number in range(len(self.image))]

    def _item(self, number: int) -> "Request":
        def of(t: Tensor | None) -> Tensor | None:
            return None if t is None else t[number : number + 1]

        behind, lens = self.background, self.optics.lens
        return self._replace(
            image=self.image[number : number + 1],
            coc=self.coc[number : number + 1],
            motion=self.motion.mapped(lambda t: t[number : number + 1]),
            background=None if behind is None else (behind[0][number : number + 1], of(behind[1])),
            clamped=of(self.clamped),
            labels=None if self.labels is None else Labels(*map(of, self.labels)),
            optics=self.optics if lens is None else self.optics._replace(lens=lens.item(number)),
        )

    def working(self) -> "Request":
        """The same in at least float32: half precision can tell neither radii nor columns of a wide picture apart."""
        given = [t for t in (self.image, self.coc, *(self.labels or ())) if t is not None]
        dtype = compute_dtype(*given)

        def of(t: Tensor | None) -> Tensor | None:
            return None if t is None else t.to(dtype)

        behind, labels = self.background, self.labels
        return self._replace(
            image=self.image.to(dtype).contiguous(),
            coc=self.coc.to(dtype).contiguous(),
            motion=self.motion.mapped(lambda t: t.to(dtype)),
            background=None if behind is None else (behind[0].to(dtype).contiguous(), of(behind[1])),
            labels=None if labels is None else Labels(*map(of, labels)),
        )

    def answered(self, picture: Tensor, unused: Sequence[Tensor | None] = ()) -> Tensor:
        """The picture as the caller gets it: on the sensor, in the dtype of the image.

        What a plan leaves out, ``unused``, has a gradient of 0, not None: among scenes that are trained on there may be
        one that stands still, or is sharp all over.
        """
        if torch.is_grad_enabled():
            for t in unused:
                if t is not None and t.requires_grad:
                    picture = picture + t[None][:0].sum()  # nothing of it: not even what is infinite counts
        return self.sensor.crop(picture).to(self.image.dtype)


class _Maps(NamedTuple):
    """How the maps of one picture are checked and turned into signed CoC."""

    optics: Optics
    image: Tensor
    sensor: Sensor
    is_coc: bool

    def signed(self, name: str, value: object, channels: int = 1) -> Tensor:
        """The signed CoC of a map of depth or of CoC, which has the shape of the image but for its channels."""
        shape = (*self.image.shape[:-3], channels, *self.image.shape[-2:])
        checked, lens = check_image(name, value, shape, like=self.image), self.optics.lens
        if self.is_coc:
            return checked_radii(name, checked)
        if lens is None:
            raise ValueError(f"{name}: expected coc, since there is no lens, got depth")
        try:
            found = lens.coc(checked, self.sensor.width, field=self.sensor.field(checked))
        except ValueError as error:  # of a lens, it is the depth that is wrong
            if name == "depth":
                raise
            raise ValueError(f"{name}: {str(error).removeprefix('depth: ')}") from error
        return found.clamp(-WIDEST, WIDEST)

    def cut(self, coc: Tensor) -> Tensor:
        """The CoC within the limit."""
        limit = self.optics.max_coc
        return coc if limit is None else coc.clamp(-limit, limit)

    def limited(self, name: str, value: object, channels: int = 1) -> Tensor:
        """`signed`, within the limit."""
        return self.cut(self.signed(name, value, channels))

    def behind(self, background: Tensor | tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor | None]:
        """Colour and signed CoC of what the foreground hides."""
        pair = background if isinstance(background, tuple) else (background, None)
        if len(pair) != 2:
            raise ValueError(f"background: expected an image or a pair of it and its depth, got {len(pair)} values")
        colour, depth = pair
        check_image("background", colour, tuple(self.image.shape), like=self.image)
        return colour, None if depth is None else self.limited("background[1]", depth)


def checked_radii(name: str, coc: Tensor) -> Tensor:
    """Signed radii in px within `WIDEST`, after a check that they are finite; compiled code is not checked.

    Raises:
        ValueError: one of them is not finite.
    """
    if not has_numbers(coc) or not coc.numel():
        return coc
    low, high = coc.detach().aminmax()  # several times as fast as `isfinite`; NaN is both
    if not bool(low.isfinite() & high.isfinite()):
        raise ValueError(f"{name}: expected finite radii, got {not_finite(coc)}")
    return coc.clamp(-WIDEST, WIDEST) if bool((high > WIDEST) | (low < -WIDEST)) else coc
