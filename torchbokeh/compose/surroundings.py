"""What lies beyond the border of a picture, where lights near it would show that nothing is known of it.

A splat that the border cuts is divided by what covers a pixel, so that a constant stays constant. A light near the
border would be divided likewise, and its disc shine brighter than one in the middle. So the picture is surrounded with
its own ground, continued without its lights: then every disc is whole, and the border cuts it.
"""

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from torchbokeh.compose.surfaces import COARSE, continued, with_ground_around
from torchbokeh.ops.composite import TINY
from torchbokeh.picture.request import Request
from torchbokeh.picture.samples import Samples, pixel_positions
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

    def of_samples(self, samples: Samples) -> Samples:
        """Samples, surrounded: beyond the border, through the middle of the lens at the middle of the exposure."""
        present = samples.present.to(samples.colour)
        known = torch.cat([samples.colour * present, present], 2).flatten(0, 1)
        ground = with_ground_around(known, self.width, 3).unflatten(0, present.shape[:2])
        colour, covered = ground[:, :, :3], ground[:, :, 3:]
        coc, motion, there = (
            self._edges(t.flatten(0, 1)).unflatten(0, present.shape[:2]) for t in (samples.coc, samples.motion, present)
        )
        within = samples.position - pixel_positions(samples.position)
        off, lens, time = (F.pad(t, (self.width,) * 4) for t in (within, samples.lens, samples.time))
        return Samples(
            colour=colour / covered.clamp_min(TINY),
            position=pixel_positions(colour) + off,
            lens=lens,
            time=time,
            coc=coc,
            motion=motion,
            present=(there > 0) & (covered > 0),
        )

    def cut(self, picture: Tensor) -> Tensor:
        """The part of a picture that was asked for."""
        return picture[..., self.width : -self.width, self.width : -self.width] if self.width else picture

    def _edges(self, t: Tensor) -> Tensor:
        return F.pad(t, (self.width,) * 4, mode="replicate")
