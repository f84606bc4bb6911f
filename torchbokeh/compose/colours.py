"""A picture in the light of one wavelength: with its own radius and magnification, from one pinhole picture."""

import torch
from torch import Tensor
from torch.nn import functional as F

from torchbokeh.compose.surfaces import continued
from torchbokeh.lens.base import Lens
from torchbokeh.lens.field_map import Field
from torchbokeh.picture.request import Request
from torchbokeh.picture.sensor import STEPS
from torchbokeh.plan.plan import Colour


def channels_of(colour: Colour) -> list[int]:
    """The channels of a picture that a light adds to."""
    return [c for c in range(3) if colour.light.rgb[c] > 0]


def in_light(request: Request, colour: Colour) -> Request:
    """The channels of a picture, with the radii and in the size that they have in light of one wavelength.

    Args:
        request: the picture, in at least float32, and a lens that has a dispersion.
        colour: the light.
    """
    (lens, _, limit, _), sensor = request.optics, request.sensor
    assert lens is not None
    wavelength, field = colour.light.wavelength, sensor.field(request.coc)
    shift = lens.coc_shift(wavelength, sensor.width, field)

    def shifted(coc: Tensor) -> Tensor:
        moved = coc + (shift[:, None] if coc.dim() == 5 and shift.dim() == 4 else shift).to(coc.dtype)
        return moved if limit is None else moved.clamp(-limit, limit)

    channels = channels_of(colour)
    image = request.image.index_select(-3, torch.tensor(channels, device=request.image.device))
    if request.layered:
        image = torch.cat([image, request.image[:, :, 3:]], 2)
    behind = None
    if request.background is not None:
        picture, coc = request.background
        behind = picture[:, channels], None if coc is None else shifted(coc)
    motion, ends = request.motion, request.motion.shutter_coc
    motion = motion if ends is None else motion._replace(shutter_coc=shifted(ends))
    one = request._replace(image=image, coc=shifted(request.coc), motion=motion, background=behind)
    return _enlarged(one, wavelength, lens, field) if colour.enlarged else one


class Mixture:
    """A sum of pictures, each of all light or of one wavelength, channel by channel."""

    def __init__(self) -> None:
        self._whole: Tensor | None = None
        self._channels: list[Tensor | None] = [None, None, None, None]

    def add(self, part: Tensor, colour: Colour | None, share: float, *, layered: bool) -> None:
        """Add a picture.

        Args:
            part: ``(B, C, H, W)``; of one light, the channels of `channels_of`, and last the coverage of layers.
            colour: the light that it is of; None for all of it.
            share: how much it counts for.
            layered: whether its last channel is a coverage.
        """
        if colour is None:
            weighted = part if share == 1 else share * part
            self._whole = weighted if self._whole is None else self._whole + weighted
            return
        rgb = colour.light.rgb
        weights = {c: (k, rgb[c]) for k, c in enumerate(channels_of(colour))}
        if layered:
            weights[3] = part.shape[1] - 1, sum(rgb) / 3
        for c, (k, weight) in weights.items():
            one, sum_of_others = share * weight * part[:, k : k + 1], self._channels[c]
            self._channels[c] = one if sum_of_others is None else sum_of_others + one

    def total(self) -> Tensor:
        """The sum ``(B, C, H, W)``."""
        channels = [c for c in self._channels if c is not None]
        if not channels:
            assert self._whole is not None
            return self._whole
        coloured = torch.cat(channels, 1)
        return coloured if self._whole is None else coloured + self._whole


def _enlarged(request: Request, wavelength: float, lens: Lens, field: Field) -> Request:
    assert lens.dispersion is not None
    height, width = request.sensor.size
    here = field
    for _ in range(STEPS):
        scale = 1 + lens.dispersion.enlargement(wavelength, here)
        here = Field(field.x / scale, field.y / scale, request.sensor.inner)
    grid = torch.stack([2 * here.x / width, 2 * here.y / height], -1)
    grid = grid.reshape(-1, height, width, 2).expand(len(request.image), -1, -1, -1)
    alpha = request.image[:, :, -1:].flatten(0, 1) if request.layered else None

    def at(t: Tensor, mode: str = "nearest") -> Tensor:
        if alpha is not None and mode == "nearest":  # the rim of a layer takes its maps along
            t = continued(t.flatten(0, 1), alpha).view_as(t)
        flat = t.flatten(1, -3)
        return F.grid_sample(flat, grid.to(t.dtype), mode=mode, padding_mode="border", align_corners=False).view_as(t)

    behind = None
    if request.background is not None:
        colour, coc = request.background
        behind = at(colour, "bilinear"), None if coc is None else at(coc)
    motion, ends = request.motion, request.motion.shutter_coc
    moved = tuple(at(d) for d in motion.displacements)
    motion = motion._replace(displacements=moved, shutter_coc=None if ends is None else at(ends))
    return request._replace(image=at(request.image, "bilinear"), coc=at(request.coc), motion=motion, background=behind)
