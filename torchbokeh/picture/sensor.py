"""Where a picture lies on the sensor."""

from typing import NamedTuple

from torch import Tensor

from torchbokeh.lens.field_map import Field

STEPS = 4
"""Steps to the place that something moves to a pixel, parallax or magnification, by a fixed point: each leaves an error
that is smaller by the slope of the movement."""


class Sensor(NamedTuple):
    """A picture and the sensor in it.

    Attributes:
        size: ``(H, W)`` of the picture in px.
        margin: px on each side of the picture that lie beyond the sensor.
    """

    size: tuple[int, int]
    margin: int = 0

    @property
    def width(self) -> int:
        """Of the sensor in px: what a lens asks for."""
        return self.size[1] - 2 * self.margin

    @property
    def inner(self) -> tuple[int, int]:
        """``(H, W)`` of the sensor in px."""
        return self.size[0] - 2 * self.margin, self.width

    def field(self, like: Tensor) -> Field:
        """Where the pixels of the picture are, in the dtype and on the device of ``like``."""
        return Field.pixels(self.size, self.margin, like)

    def crop(self, picture: Tensor) -> Tensor:
        """The part of a picture ``(..., H, W)`` that lies on the sensor."""
        if not self.margin:
            return picture
        return picture[..., self.margin : -self.margin, self.margin : -self.margin]
