"""What lies beyond the border of a picture, where lights near it would show that nothing is known of it.

A splat that the border cuts is divided by what covers a pixel, so that a constant stays constant. A light near the
border would be divided likewise, and its disc shine brighter than one in the middle. So the picture is surrounded with
its own ground, continued without its lights: then every disc is whole, and the border cuts it.
"""

from typing import NamedTuple

from torch import Tensor
from torch.nn import functional as F

from torchbokeh.compose.surfaces import COARSE, continued, with_ground_around
from torchbokeh.picture.request import Request
from torchbokeh.psfs.model import Labels


class Surrounding(NamedTuple):
    """Pixels that are added on each side of a picture."""

    width: int

    def of(self, request: Request) -> Request:
        """A request, surrounded: colours by their ground, maps by their values at the border."""
        if not self.width:
            return request
        image, coc, motion, behind = request.image, request.coc, request.motion, request.background
        if request.layered:
            alpha = image[:, :, -1:].flatten(0, 1)

            def map_of(t: Tensor) -> Tensor:
                return self._edges(continued(t.flatten(0, 1), alpha, COARSE)).unflatten(0, t.shape[:2])

            colours = with_ground_around(image.flatten(0, 1), self.width, image.shape[2] - 1).unflatten(
                0, image.shape[:2]
            )
            return request._replace(image=colours, coc=map_of(coc), motion=motion.mapped(map_of))
        if behind is not None:
            behind = (
                with_ground_around(behind[0], self.width, image.shape[1]),
                None if behind[1] is None else self._edges(behind[1]),
            )
        labels = request.labels
        return request._replace(
            image=with_ground_around(image, self.width, image.shape[1]),
            coc=self._edges(coc),
            motion=motion.mapped(self._edges),
            background=behind,
            labels=None if labels is None else Labels(*(None if t is None else self._edges(t) for t in labels)),
        )

    def cut(self, picture: Tensor) -> Tensor:
        """The part of a picture that was asked for."""
        return picture[..., self.width : -self.width, self.width : -self.width] if self.width else picture

    def _edges(self, t: Tensor) -> Tensor:
        return F.pad(t, (self.width,) * 4, mode="replicate")
