"""Splatting from a bank of sparse PSFs: every pixel takes its sample, in the domain in which that is sparse (LKS 6)."""

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from torchbokeh.ops.composite import TINY
from torchbokeh.ops.integrate import poisson_fft, running_sum_x
from torchbokeh.ops.merge import Merging, merged
from torchbokeh.ops.points import splat_points
from torchbokeh.ops.splat import splat_spans
from torchbokeh.psfs.aperture import Disc
from torchbokeh.psfs.bank import PsfBank
from torchbokeh.psfs.model import Labels, Place
from torchbokeh.psfs.represent import DOMAINS, Domain

_INTEGRALS: dict[Domain, Callable[[Tensor], Tensor]] = {
    "direct": lambda buffer: buffer,
    "scanline": running_sum_x,
    "laplacian": lambda buffer: poisson_fft(buffer, compact=True),
}

ROOM = 2
"""Pixels around the farthest points: what is shared with a neighbour, and the ring on which the picture vanishes."""


def packed(labels: Labels) -> Tensor:
    """The maps of labels but for the CoC, ``(B, E, H, W)``, as channels that may be averaged.

    Motion becomes ``(dx dx, dx dy, dy dy)``: a PSF spreads along a line, so that opposite directions are the same.
    """
    maps = [] if labels.depth is None else [labels.depth.reciprocal()]
    if labels.motion is not None:
        x, y = labels.motion.split(1, 1)
        maps += [x * x, x * y, y * y]
    return torch.cat(maps, 1) if maps else _needed(labels)[:, :0]


def unpacked(coc: Tensor, maps: Tensor, like: Labels) -> Labels:
    """Labels from averages of `packed`: of the same kinds as ``like``."""
    depth = motion = None
    if like.depth is not None:
        depth, maps = maps[:, :1].clamp_min(1e-12).reciprocal(), maps[:, 1:]
    if like.motion is not None:
        motion = _along(*maps.split(1, 1))
    return Labels(coc, depth, motion)


def _along(xx: Tensor, xy: Tensor, yy: Tensor) -> Tensor:
    """The displacement whose square has the given entries, as far as one has: the direction of the largest spread."""
    length = (xx + yy).clamp_min(1e-12).sqrt()
    angle = 0.5 * torch.atan2(2 * xy, torch.where((xy == 0) & (xx == yy), 1.0, xx - yy))
    return torch.cat([length * angle.cos(), length * angle.sin()], 1)


def splat_bank(
    values: Tensor,
    labels: Labels,
    bank: PsfBank,
    merging: Merging | None = None,
    *,
    highest: int = 0,
    interpolate: bool = False,
) -> Tensor:
    """Blur with the PSFs of a bank.

    Args:
        values: ``(B, C, H, W)``, what each pixel spreads, and last the coverage: ones, in as many channels as the PSFs
            have. For a coloured bank C is a multiple of 3.
        labels: what the bank's model asks for.
        bank: the PSFs.
        merging: how far to merge by the radius of ``labels.coc``; ``None``: not at all.
        highest: the coarsest level, see `torchbokeh.ops.merge.highest_level`.
        interpolate: splat the neighbouring samples of the grid as well, by their share, instead of the nearest one
            alone. Without it no gradient runs to the coordinates of the PSFs.

    Returns:
        ``(B, C, H, W)``, not divided by the coverage.

    Raises:
        ValueError: the model needs another label.
    """

    def splat(cells: Tensor, radius: Tensor | None, now: Labels, size: int) -> Tensor:
        still = bank.model.still(now)
        if still is None or radius is None:
            return _splat_places(cells, bank.model.places(now, size), bank, interpolate)
        discs = splat_spans(cells * still, radius, Disc().profile(), integrate=True)
        moving = cells * (1 - still)
        if not bool((still < 1).any()):
            return discs
        return discs + _splat_places(moving, bank.model.places(now, size), bank, interpolate)

    if merging is None or highest == 0:
        return splat(values, labels.coc, labels, 1)
    coc, maps = _needed(labels), packed(labels)

    def splat_cells(cells: Tensor, radius: Tensor, means: Tensor, size: int) -> Tensor:
        return splat(cells, radius, unpacked(radius * size, means, labels), size)

    return merged(values, coc, splat_cells, merging, highest, labels=maps)


def _needed(labels: Labels) -> Tensor:
    if labels.coc is None:
        raise ValueError("labels.coc: expected one, since pixels are merged by it, got none")
    return labels.coc


def _splat_places(values: Tensor, places: Sequence[Place], bank: PsfBank, interpolate: bool) -> Tensor:
    out = torch.zeros_like(values)
    for place in places:
        source = values if place.share is None else values * place.share
        coordinates = place.coordinates.movedim(1, -1)
        if not interpolate:
            out = out + _splat_samples(source, bank.model.grid.index(coordinates)[:, None], place, bank)
            continue
        for number, share in bank.model.grid.neighbours(coordinates):
            out = out + _splat_samples(source * share[:, None].to(source.dtype), number[:, None], place, bank)
    return out


def _splat_samples(values: Tensor, index: Tensor, place: Place, bank: PsfBank) -> Tensor:
    """Every pixel spreads one sample ``index (B, 1, H, W)``."""
    if bank.model.tints:
        # The last channels are the coverage: how much of the PSF arrives, whatever its colour.
        count = bank.values.shape[1]
        gains = bank.gains()[index[:, 0]].movedim(-1, 1).clamp_min(TINY)
        values = torch.cat([values[:, :-count], values[:, -count:] / gains], 1)
    domains = bank.domains.long()[index]
    reach = bank.reach()[index] * (1.0 if place.scale is None else place.scale.detach())
    if place.frame is not None:
        reach = reach * math.sqrt(2)  # turned by 45 degrees
    if place.offset is not None:
        reach = reach + place.offset.detach().abs().amax(1, keepdim=True)
    alive = (values.detach() != 0).any(1, keepdim=True)
    out = torch.zeros_like(values)
    for number, domain in enumerate(DOMAINS):
        here = (domains == number) & alive
        if not bool(here.any()):
            continue
        pad = math.ceil(float(reach[here].max())) + ROOM
        source = torch.where(here, values, 0.0)
        if domain == "laplacian" and place.scale is not None:
            source = source / place.scale.square()
        whole = _INTEGRALS[domain](_splat_channels(source, index, bank, domain, pad, place))
        out = out + whole[..., pad : pad + values.shape[2], pad : pad + values.shape[3]]
    return out


def _splat_channels(values: Tensor, index: Tensor, bank: PsfBank, domain: Domain, pad: int, place: Place) -> Tensor:
    position = None
    if place.offset is not None:
        rows, columns = values.shape[2:]
        y, x = torch.meshgrid(
            torch.arange(rows, device=values.device), torch.arange(columns, device=values.device), indexing="ij"
        )
        position = place.offset + torch.stack([x, y])
    colours = bank.values.shape[1]
    # Channel k of a coloured PSF spreads the channels k, k + 3, ... of the picture.
    parts = [
        splat_points(
            values[:, k::colours], index, bank.table(domain, k), pad=pad, rotation=place.frame, position=position
        )
        for k in range(colours)
    ]
    return parts[0] if colours == 1 else torch.stack(parts, 2).flatten(1, 2)
