"""Splatting samples of a bank: every pixel takes the nearest, in the domain in which that is sparse (LKS 6.2)."""

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial, reduce
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F
from torch.nn.utils.rnn import pad_sequence

from torchbokeh.ops.checks import MOST_PIXELS
from torchbokeh.ops.composite import TINY
from torchbokeh.ops.integrate import poisson_fft, running_sum_x
from torchbokeh.ops.points import splat_points
from torchbokeh.psfs.bank import PsfBank
from torchbokeh.psfs.model import Labels, Place, field_of, scaled
from torchbokeh.psfs.represent import DOMAINS, Domain

_INTEGRALS: dict[Domain, Callable[[Tensor], Tensor]] = {
    "direct": lambda buffer: buffer,
    "scanline": running_sum_x,
    "laplacian": lambda buffer: poisson_fft(buffer, compact=True),
}

LISTED = 0.5
"""Where fewer than this share of the pixels spread anything, they are put on a list, and the others cost nothing."""

ROW = 64
"""Pixels in a row of such a list."""

ROOM = 2
"""Pixels around the farthest points: what is shared with a neighbour, and the ring on which the picture vanishes."""


class Canvas(NamedTuple):
    """What pixels are splatted into.

    Attributes:
        size: ``(H, W)`` of the picture.
        pixels: ``(B, 2, h, w)`` where in it the pixels of a list are: x and y in px. None: they are the picture.
    """

    size: tuple[int, int]
    pixels: Tensor | None


def spreading(values: Tensor) -> Tensor:
    """Which pixels of ``(B, C, H, W)`` spread anything, ``(B, H, W)``: all where a gradient asks what they would."""
    if torch.is_grad_enabled() and values.requires_grad:
        return torch.ones_like(values[:, 0], dtype=torch.bool)
    return (values != 0).any(1)


def _listed(values: Tensor, labels: Labels, alive: Tensor) -> tuple[Tensor, Labels, Canvas]:
    """The pixels ``alive (B, H, W)`` of a picture alone, in order, in rows of `ROW`."""
    _, height, width = alive.shape
    numbers = pad_sequence([a.nonzero()[:, 0] for a in alive.flatten(1)], batch_first=True, padding_value=-1)
    numbers = F.pad(numbers, (0, -numbers.shape[1] % ROW), value=-1)
    there, numbers = (numbers >= 0)[:, None], numbers.clamp_min(0)[:, None]

    def picked(t: Tensor) -> Tensor:
        return t.flatten(2).gather(2, numbers.expand(-1, t.shape[1], -1))

    def in_rows(t: Tensor) -> Tensor:
        return t.unflatten(2, (-1, ROW))

    found = Labels(*(None if t is None else in_rows(picked(t)) for t in labels))
    pixels = torch.cat([numbers % width, numbers // width], 1).to(values.dtype)
    return in_rows(picked(values) * there), found, Canvas((height, width), in_rows(pixels))


def located(labels: Labels, bank: PsfBank, like: Tensor) -> Labels:
    """Labels of a whole picture, with the place of each pixel where PSFs depend on it: before any are left out."""
    return labels._replace(field=field_of(like)) if bank.model.fields and labels.field is None else labels


def splat_samples(
    sources: Sequence[tuple[Tensor, Labels]],
    bank: PsfBank,
    size: int = 1,
    interpolate: bool = False,
    *,
    dense: bool = False,
) -> Tensor:
    """Splat pictures with the PSFs of their labels, and add them up.

    Args:
        sources: pairs of values ``(B, C, H, W)``, of blocks of ``size`` px, and labels. All have the same shape.
        bank: the PSFs.
        size: side of a pixel of the values in px of the labels.
        interpolate: splat the neighbouring samples of the grid as well, by their share.
        dense: draw the PSFs pixel by pixel, with nothing beyond their reach: for few bright pixels.

    Returns:
        ``(B, C, H, W)``.
    """
    found = [
        d for values, labels in sources for d in _drawn(values, located(labels, bank, values), bank, size, interpolate)
    ]
    return _together(found, bank, dense)


class _Drawn(NamedTuple):
    """Samples that are to be splatted: each pixel of ``values (B, C, h, w)`` spreads ``numbers (B, 1, h, w)``."""

    values: Tensor
    numbers: Tensor
    place: Place
    canvas: Canvas


def _drawn(values: Tensor, labels: Labels, bank: PsfBank, size: int, interpolate: bool) -> Iterator[_Drawn]:
    alive = spreading(values)
    canvas = Canvas((values.shape[2], values.shape[3]), None)
    if bool(alive.any()) and int(alive.sum((1, 2)).max()) < LISTED * alive[0].numel():
        values, labels, canvas = _listed(values, labels, alive)
    grid = bank.model.grid
    for place in bank.model.places(labels, size):
        if labels.offset is not None:
            shift = labels.offset / size
            place = place._replace(offset=shift if place.offset is None else place.offset + shift)
        source = values if place.share is None else values * place.share
        coordinates = place.coordinates.movedim(1, -1)
        extent = bank.model.extent(coordinates)
        chosen = grid.neighbours(coordinates) if interpolate else [(grid.index(coordinates), None)]
        for number, share in chosen:
            weighed = source if share is None else source * share[:, None].to(source.dtype)
            drawn = place
            if extent is not None:
                ratio = extent / bank.extents.to(extent)[number]
                drawn = scaled(place, ratio[:, None].to(source.dtype))._replace(offset=place.offset)
            yield _Drawn(weighed, number[:, None], drawn, canvas)


def _together(drawn: Sequence[_Drawn], bank: PsfBank, dense: bool) -> Tensor:
    """All samples of a domain go into one buffer, which is integrated once."""
    (height, width), first = drawn[0].canvas.size, drawn[0].values
    out = first.new_zeros(*first.shape[:2], height, width)
    used = [d.numbers[:, 0][spreading(d.values)].bincount(minlength=len(bank)) > 0 for d in drawn]
    if dense:
        # Points that are turned or enlarged would leave gaps between pixels.
        fine = max(1 if d.place.frame is None else math.ceil(2 * _stretch(d.place) / math.sqrt(2)) for d in drawn)
        bank = bank.dense(torch.stack(used).any(0), fine)
    reach, domains = bank.reach(), bank.domains
    for number, domain in enumerate(DOMAINS):
        here = [(d, u & (domains == number)) for d, u in zip(drawn, used, strict=True)]
        here = [(d, u) for d, u in here if bool(u.any())]
        if not here:
            continue
        pad = max(math.ceil(float(reach[u].max()) * _stretch(d.place) + _shift(d.place)) + ROOM for d, u in here)
        if (height + 2 * pad) * (width + 2 * pad) > MOST_PIXELS:
            raise ValueError(
                f"coc: expected PSFs of a bank that need at most {MOST_PIXELS} pixels with what they reach, "
                f"got PSFs that reach {pad} px beyond {width} x {height} pixels; clamp the CoC or the motion"
            )
        buffer = reduce(torch.add, (_splat_channels(d, bank, domain, pad) for d, _ in here))
        out = out + _INTEGRALS[domain](buffer)[..., pad : pad + height, pad : pad + width]
    return out


def _stretch(place: Place) -> float:
    """How much farther a place takes the points of a PSF along an axis: turned by 45 degrees, a corner lies farther."""
    turn = 1.0 if place.frame is None else math.sqrt(2)
    return turn if place.scale is None else turn * float(place.scale.detach().max())


def _shift(place: Place) -> float:
    return 0.0 if place.offset is None else float(place.offset.detach().abs().max())


def _splat_channels(drawn: _Drawn, bank: PsfBank, domain: Domain, pad: int) -> Tensor:
    values, index, place, canvas = drawn
    colours = bank.values.shape[1]
    if bank.model.tints:
        # The last channels are the coverage: how much of the PSF arrives, whatever its colour.
        gains = bank.gains()[index[:, 0]].movedim(-1, 1).clamp_min(TINY)
        values = torch.cat([values[:, :-colours], values[:, -colours:] / gains], 1)
    if domain == "laplacian" and place.scale is not None:
        values = values / place.scale.square()
    position = canvas.pixels
    if place.offset is not None:
        if position is None:
            rows, columns = (torch.arange(n, device=values.device) for n in values.shape[2:])
            position = torch.stack(torch.meshgrid(columns, rows, indexing="xy"))
        position = place.offset + position
    size = None if canvas.pixels is None else canvas.size
    splat = partial(splat_points, pad=pad, rotation=place.frame, position=position, size=size)
    # Channel k of a coloured PSF spreads the channels k, k + 3, ... of the picture.
    parts = [splat(values[:, k::colours], index, bank.table(domain, k)) for k in range(colours)]
    return parts[0] if colours == 1 else torch.stack(parts, 2).flatten(1, 2)
