"""Many views of layers: each is warped by the parallax of its own pixels."""

import math

import torch
from torch import Tensor
from torch.nn import functional as F

from torchbokeh.compose.surfaces import continued
from torchbokeh.compose.surroundings import Surrounding
from torchbokeh.lens.field_map import Field
from torchbokeh.ops.planes import pixel_centres
from torchbokeh.ops.raycast import subsample_blur
from torchbokeh.picture.motion import Motion
from torchbokeh.picture.request import Request
from torchbokeh.picture.sensor import STEPS, Sensor
from torchbokeh.plan.decide import passed
from torchbokeh.plan.lights import BRIGHTER, lights_at_border
from torchbokeh.views.points import Views
from torchbokeh.views.prism import Prism
from torchbokeh.views.setup import Bounds, ViewSettings, scheduled

LEVELS = 8


class Layer:
    """One layer, ready to be warped into views.

    Args:
        rgba: ``(B, 4, H, W)`` premultiplied.
        coc: ``(B, 1, H, W)`` signed, px.
        motion: ``(B, 2, H, W)`` px over the open shutter, or ``None``.
        levels: how many levels of detail are needed.
    """

    def __init__(self, rgba: Tensor, coc: Tensor, motion: Tensor | None, levels: int) -> None:
        alpha = rgba[:, 3:]
        parts = [continued(coc, alpha)]
        if motion is not None:
            parts += [continued(motion[:, c : c + 1], alpha) for c in (0, 1)]
        self.field = torch.cat(parts, 1)
        self.even = bool((self.field.detach().amax((2, 3)) - self.field.detach().amin((2, 3)) < 1e-3).all())
        self.levels = [rgba]
        while len(self.levels) < levels and max(self.levels[-1].shape[2:]) > 1:
            odd = (0, self.levels[-1].shape[3] % 2, 0, self.levels[-1].shape[2] % 2)
            self.levels.append(F.avg_pool2d(F.pad(self.levels[-1], odd, mode="replicate"), 2))

    def view(self, lens: Tensor, time: float, level: int, more: Tensor | None) -> tuple[Tensor, Tensor]:
        """The layer as one view has it: RGBA ``(B, 4, H, W)`` and its signed CoC ``(B, 1, H, W)``.

        ``more (2, H, W)`` is how far in px it moves pixels beside.
        """
        h, w = self.field.shape[2:]
        x, y = pixel_centres((h, w), self.field)
        pixel = torch.stack([x, y], -1).expand(len(self.field), h, w, 2)
        moves = self.field
        if more is not None:
            moves = torch.cat([self.field, more.to(self.field).expand(len(self.field), -1, -1, -1)], 1)
        here, field = pixel, moves
        # The point that comes to lie on a pixel solves `here + parallax(here) = pixel`.
        for _ in range(1 if self.even and more is None else STEPS):
            move = field[:, :1] * lens[:, None, None]
            if self.field.shape[1] == 3:
                move = move + field[:, 1:3] * time
            if more is not None:
                move = move + field[:, -2:]
            here = pixel - move.movedim(1, -1)
            field = _at(moves, here, 1)
        return _at(self.levels[level], here, 2**level), field[:, :1]


def _at(image: Tensor, place: Tensor, texel: int) -> Tensor:
    """Bilinear look-up at ``(B, H, W, 2)`` places (x, y) in px of an image whose pixels are ``texel`` px wide."""
    extent = place.new_tensor([image.shape[3], image.shape[2]]) * texel
    return F.grid_sample(image, 2 * place / extent - 1, padding_mode="border", align_corners=False)


def accumulate_layers(
    layers: Tensor, coc: Tensor, motion: Tensor | None, views: Views, prism: Prism | None, settings: ViewSettings
) -> Tensor:
    """The mean of the views ``(B, 4, H, W)``, or their sum in the colours of a prism.

    See `torchbokeh.AccumulationBuffer` and `torchbokeh.ChromaticAccumulation`.
    """
    b, _, _, h, w = layers.shape
    if layers.numel() == 0:
        return layers.new_zeros(b, 4, h, w)
    if b > 1:
        # What an item may share, leave out or be surrounded with does not depend on the others.
        moved = [None] * b if motion is None else motion.split(1)
        each = zip(layers.split(1), coc.split(1), moved, strict=True)
        return torch.cat([accumulate_layers(*one, views, prism, settings) for one in each])
    there = layers[:, :, 3:].detach() > 0
    largest = float(torch.where(there, coc, 0.0).detach().abs().max())
    farthest = 0.0 if motion is None else float(torch.where(there, motion, 0.0).detach().norm(dim=2).max())
    lit = passed(lights_at_border(layers.detach(), coc.detach(), largest, farthest), BRIGHTER)
    if not lit:
        return _accumulated(layers, coc, motion, views, prism, settings)
    around = Surrounding(min(math.ceil(largest + farthest), min(h, w) // 2))
    request = around.of(Request(layers, coc, Motion(() if motion is None else (motion,)), None, Sensor((h, w))))
    maps = request.image, request.coc, motion if motion is None else request.motion.displacements[0]
    whole = around.cut(_accumulated(*maps, views, prism, settings, around.width))
    if lit == 1:
        return whole
    return lit * whole + (1 - lit) * _accumulated(layers, coc, motion, views, prism, settings)


def _accumulated(
    layers: Tensor,
    coc: Tensor,
    motion: Tensor | None,
    views: Views,
    prism: Prism | None,
    settings: ViewSettings,
    margin: int = 0,
) -> Tensor:
    h, w = layers.shape[3:]
    # The pixels of the input are means already: shifting them would only blur them once more.
    views = Views(views.lens, views.time, torch.zeros_like(views.shift))
    kept, limits = _bounds(layers, coc, motion)
    views, level, parents, offsets = scheduled(views, limits, prism, settings, by_wavelength=True)
    parents = torch.arange(len(views))[:, None].expand_as(level) if parents is None else parents
    ready = [
        Layer(layers[:, k], coc[:, k], None if motion is None else motion[:, k], int(level[:, i].max()) + 1)
        for i, k in enumerate(kept)
    ]
    last = {(i, p): v for v, row in enumerate(parents.tolist()) for i, p in enumerate(row)}
    copies: dict[tuple[int, int], tuple[Tensor, Tensor]] = {}
    total = torch.zeros_like(layers[:, 0])
    field = Field.pixels((h, w), margin, coc)
    for v in range(len(views)):
        left = torch.ones_like(total[:, 3:])
        picture, front, most_seen = torch.zeros_like(total), torch.zeros_like(left), torch.zeros_like(left)
        for i, layer in enumerate(ready):
            key = (i, int(parents[v, i]))
            if key not in copies:
                point = views.lens[key[1]].to(layers)
                more = None if prism is None else prism.movement(key[1], point, field)
                copies[key] = layer.view(point, float(views.time[key[1]]), int(level[key[1], i]), more)
            rgba, radius = copies[key]
            if last[key] == v:
                del copies[key]
            picture = picture + left * rgba
            if settings.subsamples:
                visible = left * rgba[:, 3:]
                # Where nothing is seen, the last layer stands for it: no surface in focus that hides what is blurred
                front = torch.where(visible >= most_seen, radius, front)
                most_seen = torch.maximum(most_seen, visible)
            left = left * (1 - rgba[:, 3:])
        picture = subsample_blur(picture, front, offsets.to(picture)) if settings.subsamples else picture
        total = total + (picture if prism is None else picture * prism.weights[v].to(picture)[:, None, None])
    return total / len(views) if prism is None else total


@torch.no_grad()
def _bounds(layers: Tensor, coc: Tensor, motion: Tensor | None) -> tuple[list[int], Bounds]:
    """Which layers hold anything, and the bounds of those."""
    there = layers[:, :, 3:] > 0
    low = torch.where(there, coc, torch.inf).movedim(1, 0).flatten(1).amin(1).double().cpu()
    high = torch.where(there, coc, -torch.inf).movedim(1, 0).flatten(1).amax(1).double().cpu()
    speed = torch.zeros_like(low)
    if motion is not None:
        speed = (motion.norm(dim=2, keepdim=True) * there).movedim(1, 0).flatten(1).amax(1).double().cpu()
    kept = (low <= high).nonzero()[:, 0].tolist()
    coarsest = torch.full((len(kept),), min(LEVELS, max(layers.shape[3:]).bit_length()) - 1, dtype=low.dtype)
    return kept, Bounds(low[kept], high[kept], speed[kept], torch.ones_like(coarsest), coarsest)
