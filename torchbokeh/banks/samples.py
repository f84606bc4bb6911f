"""Splatting samples of a bank: every pixel takes the nearest, in the domain in which that is sparse (LKS 6.2)."""

import math
from collections.abc import Callable, Iterator, Sequence
from functools import partial
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
from torchbokeh.psfs.model import Labels, Place, scaled
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

Source = tuple[Tensor, Labels]
"""What each pixel spreads, ``(B, C, H, W)``, and the labels that its PSF is chosen by."""


class BankSettings(NamedTuple):
    """How a picture is splatted with a bank.

    Attributes:
        bank: the PSFs.
        interpolate: splat the neighbouring samples of the grid as well, by their share.
        clip: clip PSFs to the picture, see `torchbokeh.psfs.model.PsfModel.clipped`.
    """

    bank: PsfBank
    interpolate: bool
    clip: bool


class _Chosen(NamedTuple):
    """Each pixel of ``values (B, C, h, w)`` spreads the sample ``numbers (B, 1, h, w)``, turned and scaled as placed.

    Its centre goes to ``position (B, 2, h, w)`` in the picture; None: to the pixel itself.
    """

    values: Tensor
    numbers: Tensor
    place: Place
    position: Tensor | None


def spreading(values: Tensor) -> Tensor:
    """Which pixels of ``(B, C, H, W)`` spread anything, ``(B, H, W)``: all where a gradient asks what they would."""
    if torch.is_grad_enabled() and values.requires_grad:
        return torch.ones_like(values[:, 0], dtype=torch.bool)
    return (values != 0).any(1)


def splat_samples(sources: Sequence[Source], settings: BankSettings, size: int = 1, *, dense: bool = False) -> Tensor:
    """Splat pictures with the PSFs of their labels, and add them up.

    All samples of a domain go into one buffer, which is integrated once.

    Args:
        sources: the pictures, of blocks of ``size`` px. All have the same shape.
        settings: the bank, and whether to interpolate between its samples.
        size: side of a pixel of the values in px of the labels.
        dense: draw the PSFs pixel by pixel, with nothing beyond their reach: for few bright pixels.

    Returns:
        ``(B, C, H, W)``.

    Raises:
        ValueError: what the PSFs reach needs too large a buffer.
    """
    shape, bank = sources[0][0].shape, settings.bank
    canvas = shape[2], shape[3]
    chosen = [c for source in sources for c in _chosen(*source, settings, size)]
    used = [c.numbers[:, 0][spreading(c.values)].bincount(minlength=len(bank)) > 0 for c in chosen]
    if dense:
        # Points that are turned or enlarged would leave gaps between pixels.
        fine = max(1 if c.place.frame is None else math.ceil(2 * _stretch(c.place) / math.sqrt(2)) for c in chosen)
        bank = bank.dense(torch.stack(used).any(0), fine)
    reach, colours, out = bank.reach(), bank.values.shape[1], chosen[0].values.new_zeros(shape)
    for number, domain in enumerate(DOMAINS):
        here = [(c, u & (bank.domains == number)) for c, u in zip(chosen, used, strict=True)]
        here = [(c, u) for c, u in here if bool(u.any())]
        pad = _padding([(c.place, float(reach[u].max())) for c, u in here], canvas) if here else 0
        buffer: Tensor | None = None
        for c, _ in here:
            weights = _weights(c, bank, domain)
            size_there = None if c.position is None else canvas
            splat = partial(splat_points, pad=pad, rotation=c.place.frame, position=c.position, size=size_there)
            # Channel k of a coloured PSF spreads the channels k, k + 3, ... of the picture.
            parts = [splat(weights[:, k::colours], c.numbers, bank.table(domain, k)) for k in range(colours)]
            part = parts[0] if colours == 1 else torch.stack(parts, 2).flatten(1, 2)
            buffer = part if buffer is None else buffer + part
        if buffer is not None:
            out = out + _INTEGRALS[domain](buffer)[..., pad : pad + canvas[0], pad : pad + canvas[1]]
    return out


def _chosen(values: Tensor, labels: Labels, settings: BankSettings, size: int) -> Iterator[_Chosen]:
    bank, alive, pixels = settings.bank, spreading(values), None
    if bool(alive.any()) and int(alive.sum((1, 2)).max()) < LISTED * alive[0].numel():
        values, labels, pixels = _listed(values, labels, alive)
    grid = bank.model.grid
    for place in bank.model.places(labels, size):
        if labels.offset is not None:
            shift = labels.offset / size
            place = place._replace(offset=shift if place.offset is None else place.offset + shift)
        position = pixels
        if place.offset is not None:
            rows, columns = (torch.arange(n, device=values.device) for n in values.shape[2:])
            whole = torch.stack(torch.meshgrid(columns, rows, indexing="xy"))
            position = place.offset + (whole if pixels is None else pixels)
        source = values if place.share is None else values * place.share
        coordinates = place.coordinates.movedim(1, -1)
        extent = bank.model.extent(coordinates)
        nearest = grid.neighbours(coordinates) if settings.interpolate else [(grid.index(coordinates), None)]
        for number, share in nearest:
            weighed = source if share is None else source * share[:, None].to(source.dtype)
            drawn = place
            if extent is not None:
                ratio = extent / bank.extents.to(extent)[number]
                drawn = scaled(place, ratio[:, None].to(source.dtype))._replace(offset=place.offset)
            yield _Chosen(weighed, number[:, None], drawn, position)


def _listed(values: Tensor, labels: Labels, alive: Tensor) -> tuple[Tensor, Labels, Tensor]:
    """The pixels ``alive (B, H, W)`` of a picture alone, in order, in rows of `ROW`; and where they are, x and y."""
    width = alive.shape[2]
    numbers = pad_sequence([a.nonzero()[:, 0] for a in alive.flatten(1)], batch_first=True, padding_value=-1)
    numbers = F.pad(numbers, (0, -numbers.shape[1] % ROW), value=-1)
    there, numbers = (numbers >= 0)[:, None], numbers.clamp_min(0)[:, None]

    def picked(t: Tensor) -> Tensor:
        return t.flatten(2).gather(2, numbers.expand(-1, t.shape[1], -1))

    def in_rows(t: Tensor) -> Tensor:
        return t.unflatten(2, (-1, ROW))

    found = Labels(*(None if t is None else in_rows(picked(t)) for t in labels))
    pixels = torch.cat([numbers % width, numbers // width], 1).to(values.dtype)
    return in_rows(picked(values) * there), found, in_rows(pixels)


def _padding(reaches: Sequence[tuple[Place, float]], size: tuple[int, int]) -> int:
    """Px that a buffer is wider than its picture on each side, for samples that reach as far where they are placed."""
    height, width = size
    shifts = [0.0 if p.offset is None else float(p.offset.detach().abs().max()) for p, _ in reaches]
    pad = max(math.ceil(r * _stretch(p) + s) + ROOM for (p, r), s in zip(reaches, shifts, strict=True))
    if (height + 2 * pad) * (width + 2 * pad) > MOST_PIXELS:
        raise ValueError(
            f"coc: expected PSFs of a bank that need at most {MOST_PIXELS} pixels with what they reach, "
            f"got PSFs that reach {pad} px beyond {width} x {height} pixels; clamp the CoC or the motion"
        )
    return pad


def _stretch(place: Place) -> float:
    """How much farther a place takes the points of a PSF along an axis: turned by 45 degrees, a corner lies farther."""
    turn = 1.0 if place.frame is None else math.sqrt(2)
    return turn if place.scale is None else turn * float(place.scale.detach().max())


def _weights(chosen: _Chosen, bank: PsfBank, domain: Domain) -> Tensor:
    """What the points of each sample are multiplied by, ``(B, C, h, w)``."""
    values, colours = chosen.values, bank.values.shape[1]
    if bank.model.tints:
        # The last channels are the coverage: how much of the PSF arrives, whatever its colour.
        gains = bank.gains()[chosen.numbers[:, 0]].movedim(-1, 1).clamp_min(TINY)
        values = torch.cat([values[:, :-colours], values[:, -colours:] / gains], 1)
    if domain == "laplacian" and chosen.place.scale is not None:
        values = values / chosen.place.scale.square()
    return values
