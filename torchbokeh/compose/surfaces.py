"""From an image with depth to surfaces that are blurred and put over one another.

A *surface* is something with one depth per pixel: the picture itself, what stands in front of the focus plane, what
lies behind that, or a layer of the caller's. Each is blurred in soft bins of constant parallax (uniform in the signed
circle of confusion), and all are composed front to back, once for every sub-aperture of the lens.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn import functional as F

from torchbokeh.compose.exposure import Exposure
from torchbokeh.ops.composite import TINY, pull_push
from torchbokeh.ops.highlights import LEAST_CONTRAST, ordinary_brightness
from torchbokeh.plan.bins import FOREGROUND

COARSE = 4
"""Where pixels are merged, what is hidden is filled in blocks of this many pixels each way."""

STRIP = 32
"""From so many px along a border is it known how the picture goes on beyond it."""

CLIPPED = 3
"""How often what is ordinary at a border is found anew, so that none of many lights there hides another."""


@dataclass(frozen=True)
class Surface:
    """Something with one depth per pixel.

    Attributes:
        colour: ``(B, C, H, W)``, premultiplied by ``alpha`` where there is one.
        alpha: coverage ``(B, 1, H, W)`` in [0, 1]; ``None`` means opaque everywhere.
        coc: ``(B, 1, H, W)`` signed radius in px, continued to where ``alpha`` is 0.
        centres: centres of its bins in px of CoC, front to back.
        exposure: how it moves; ``None`` means that it stands still.
    """

    colour: Tensor
    alpha: Tensor | None
    coc: Tensor
    centres: tuple[float, ...]
    exposure: Exposure | None = None

    def continued(self, scale: int) -> "Surface":
        """The surface with its CoC and motion continued to where it is not, see `continued`."""
        if self.alpha is None:
            return self
        alpha = self.alpha
        exposure = None if self.exposure is None else self.exposure.mapped(lambda t: continued(t, alpha, scale))
        return replace(self, coc=continued(self.coc, alpha, scale), exposure=exposure)


def split_foreground(
    image: Tensor,
    coc: Tensor,
    behind: tuple[Tensor, Tensor | None] | None,
    centres: Sequence[tuple[float, ...]],
    scale: int = 1,
    exposure: Exposure | None = None,
) -> list[Surface]:
    """What stands in front of the focus plane, and the rest with the hidden part filled in.

    The rest is taken from ``behind`` where the foreground hides it, or from its surroundings by pull-push, in colour
    and in CoC. Pixels beside the foreground are replaced as well, since they hold some of its colour. Highlights are
    not spread: one beside an edge would make all that is hidden glow.

    Args:
        image: ``(B, C, H, W)``.
        coc: ``(B, 1, H, W)`` signed radius in px.
        behind: what the foreground hides, as colour and CoC; ``None`` for what is not known.
        centres: bins of the foreground and of the rest.
        scale: fill in blocks of ``scale**2`` pixels: what is hidden is smooth, and blurred in the end.
        exposure: how the picture moves; what is hidden moves as its surroundings do.
    """
    front, known = front_and_known(coc)
    colour, behind_coc = (None, None) if behind is None else behind
    if colour is None or behind_coc is None:
        filled, filled_coc = _surroundings(image, coc, front, known, scale)
        colour = filled if colour is None else colour
        behind_coc = filled_coc if behind_coc is None else behind_coc
    rest = known * image + (1 - known) * colour
    rest_coc = known * coc + (1 - known) * behind_coc
    ahead = behind_it = None
    if exposure is not None:
        weight = torch.maximum(known, 1e-9 * (1 - front))
        ahead = exposure.mapped(lambda t: continued(t, front, scale))
        behind_it = exposure.mapped(lambda t: known * t + (1 - known) * pull_push(t, weight))
    return [
        Surface(image * front, front, continued(coc, front, scale), centres[0], ahead),
        Surface(rest, None, rest_coc, centres[1], behind_it),
    ]


def front_and_known(coc: Tensor) -> tuple[Tensor, Tensor]:
    """Share ``(B, 1, H, W)`` of every pixel in the foreground, and of the rest in what is seen of it.

    What is beside the foreground holds some of its colour, so it counts as hidden.
    """
    start, stop = FOREGROUND
    front = ((stop - coc) / (stop - start)).clamp(0, 1)
    return front, 1 - F.max_pool2d(front, 3, 1, 1)


def _surroundings(image: Tensor, coc: Tensor, front: Tensor, known: Tensor, scale: int) -> tuple[Tensor, Tensor]:
    """Colour and CoC of what is hidden, filled in from its surroundings, in blocks of ``scale**2`` pixels."""
    # Where the foreground is beside everything, those pixels are all there is; elsewhere the second weight is nothing.
    weight = torch.maximum(known, 1e-9 * (1 - front))
    if scale == 1:
        return fill_hidden(image, coc, weight)
    share, total, total_coc = (block_means(t, scale) for t in (weight, weight * image, weight * coc))
    filled = fill_hidden(total / share.clamp_min(TINY), total_coc / share.clamp_min(TINY), share)
    colour, behind = (enlarged(t, scale, coc.shape[2:]) for t in filled)
    return colour, behind


def fill_hidden(image: Tensor, coc: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Fill colour and CoC by pull-push from where ``weight (B, 1, H, W)`` is; highlights do not spread."""
    ordinary = torch.maximum(weight * _ordinary(image, weight), 1e-9 * weight)
    planes = (t.flatten(0, 1)[:, None] for t in (image, ordinary))
    return pull_push(*planes).reshape(image.shape), pull_push(coc, weight)


def with_ground_around(image: Tensor, width: int, colours: int) -> Tensor:
    """A picture ``(B, C, H, W)`` and ``width`` px on each side, in which its border goes on without its highlights.

    Args:
        image: the picture.
        width: px.
        colours: how many channels are colours. What is a highlight in one is left out of all, and of coverage.
    """
    least = LEAST_CONTRAST * ordinary_brightness(image, clipped=CLIPPED)
    least = least.clamp_min(torch.finfo(image.dtype).tiny)

    def outermost(image: Tensor) -> Tensor:
        """The ground of the first row."""
        strip = image[..., :STRIP, :]
        ordinary = (2 - strip.abs() / least).clamp(0, 1)
        return pull_push(strip, ordinary[:, :colours].amin(1, keepdim=True))[..., :1, :]

    above, below = outermost(image), outermost(image.flip(-2))
    left, right = outermost(image.mT).mT, outermost(image.mT.flip(-2)).mT
    # In a corner, both borders have something to say.
    ends = [
        [
            0.5 * (row[..., k : k + 1] + column[..., i : i + 1, :])
            for column, k in ((left, 0), (right, -1 % image.shape[-1]))
        ]
        for row, i in ((above, 0), (below, -1 % image.shape[-2]))
    ]
    rows = [
        torch.cat([one.expand(*one.shape[:3], width), row, other.expand(*one.shape[:3], width)], -1)
        for row, (one, other) in zip((above, below), ends, strict=True)
    ]
    middle = torch.cat([left.expand(*left.shape[:3], width), image, right.expand(*left.shape[:3], width)], -1)
    above, below = (row.expand(-1, -1, width, -1) for row in rows)
    return torch.cat([above, middle, below], -2)


def _ordinary(image: Tensor, known: Tensor) -> Tensor:
    """Weight ``(B, C, H, W)``: 1 for ordinary values, 0 for highlights, of which none begins abruptly."""
    least = LEAST_CONTRAST * ordinary_brightness(image, known)
    ratio = (image.abs() / least.clamp_min(TINY)).clamp(max=1e4)  # keeps the power and its slope finite
    return 1 / (1 + ratio**4)


def continued(t: Tensor, alpha: Tensor, scale: int = 1) -> Tensor:
    """A map of a surface, its CoC or motion, continued from its surroundings to where the surface is not.

    Args:
        t: the map ``(B, C, H, W)``.
        alpha: coverage ``(B, 1, H, W)`` of the surface.
        scale: in blocks of ``scale**2`` pixels.
    """
    here = (alpha > 0).to(t.dtype)
    known = torch.where(here > 0, t, 0.0)
    if scale == 1:
        return torch.where(here > 0, t, pull_push(known, here))
    share, total = block_means(here, scale), block_means(known, scale)
    return torch.where(here > 0, t, enlarged(pull_push(total / share.clamp_min(TINY), share), scale, t.shape[2:]))


def block_means(t: Tensor, size: int) -> Tensor:
    """Means over blocks of ``size**2`` pixels; what a block lacks at the border is 0."""
    return F.avg_pool2d(F.pad(t, (0, -t.shape[3] % size, 0, -t.shape[2] % size)), size)


def enlarged(t: Tensor, scale: int, size: tuple[int, ...]) -> Tensor:
    """A picture of block means, interpolated bilinearly to ``size`` pixels.

    As sums and products, whose rounding, unlike that of `F.interpolate`, does not depend on the number of threads.
    """
    for dim in (2, 3):
        n = t.shape[dim]
        before = torch.cat([t.narrow(dim, 0, 1), t.narrow(dim, 0, n - 1)], dim)
        after = torch.cat([t.narrow(dim, 1, n - 1), t.narrow(dim, n - 1, 1)], dim)
        places = [(k + 0.5) / scale - 0.5 for k in range(scale)]
        parts = [t + abs(place) * ((before if place < 0 else after) - t) for place in places]
        t = torch.stack(parts, dim + 1).flatten(dim, dim + 1)
    return t[..., : size[0], : size[1]]
