"""What sparse PSFs would spoil: highlights that show their ripples, and the dark around bright regions."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from torchbokeh.banks.samples import splat_samples
from torchbokeh.ops.capsules import splat_capsules
from torchbokeh.ops.composite import TINY
from torchbokeh.ops.merge import LEAST_CONTRAST
from torchbokeh.ops.spans import MIN_RADIUS
from torchbokeh.ops.splat import splat_spans
from torchbokeh.psfs.aperture import Disc
from torchbokeh.psfs.bank import PsfBank
from torchbokeh.psfs.combined import Combined
from torchbokeh.psfs.model import Labels

BRIGHT = 0.5
"""A pixel is a highlight where its light, spread over its PSF, is this many times the mean of the picture."""

MOST = 4096
"""Highlights that are drawn densely, at most: the brightest."""

CLIPPED = 3
"""How often the mean of a picture is taken anew, without what is far above the last one."""

CONTRAST = 100.0
"""Pixels are spread apart from others whose dark parts they outshine by this.

Sparse PSFs leave up to 6e-4 of the light of a region around it, most of them 6e-5.
"""

DARK = 0.1
"""Share of the pixels that are darker than what counts as dark."""

SAMPLES = 4096
"""Pixels that are looked at for that, about."""

ALONG = 64
"""Discs that the support of a moving one is made up of, at most."""

Lit = tuple[Tensor, Labels]
"""What each pixel spreads in a part of the exposure, and by which labels."""


def dense_highlights(
    values: Tensor, lit: Sequence[Lit], ordinary: Tensor, bank: PsfBank, interpolate: bool
) -> tuple[Tensor, Tensor]:
    """What pixels spread that are so bright that the ripples of a sparse PSF would be seen.

    Args:
        values: ``(B, C, H, W)``, and last the coverage.
        lit: what is left of them in each part of the exposure, and its labels.
        ordinary: what `usual` says of their mean.
        bank: the PSFs.
        interpolate: see `torchbokeh.banks.splat.splat_bank`.

    Returns:
        What they spread beyond what is ordinary, like ``values``, and all the rest, with the whole coverage.
    """
    count = bank.values.shape[1]
    with torch.no_grad():
        light = torch.stack([one for one, _ in lit]).mean(0)
        bound = ordinary * (BRIGHT * _area([part for _, part in lit], bank)).clamp_min(LEAST_CONTRAST)
        excess = (light.abs() / bound.clamp_min(TINY)).amax(1).flatten()
        pixels = (excess > 1).nonzero()[:, 0]
        if len(pixels) > MOST:
            pixels = excess.topk(MOST).indices.sort().values
    if not len(pixels):
        return torch.zeros_like(values), values
    only = torch.zeros_like(excess).index_fill(0, pixels, 1.0).reshape(-1, 1, *values.shape[2:]) > 0
    kept = share_of_others(light, ordinary, only, count)
    rest, lit = values * kept, [(one * (1 - kept), part) for one, part in lit]
    if not isinstance(bank.model, Combined):
        return splat_samples(lit, bank, 1, interpolate, dense=True), rest

    def of(t: Tensor) -> Tensor:
        return t.movedim(1, -1).flatten(0, 2)[pixels]

    dense = torch.zeros_like(values)
    for one, part in lit:
        way = of(torch.zeros_like(values[:, :2]) if part.motion is None else part.motion)
        centre = torch.zeros_like(way) if part.offset is None else of(part.offset)
        dense = dense + splat_capsules(one, pixels, of(needed(part))[:, 0].abs(), way, centre)
    return dense, rest


@torch.no_grad()
def share_of_others(light: Tensor, ordinary: Tensor, highlights: Tensor, count: int) -> Tensor:
    """Which share of each value is spread with all others: of highlights, what any pixel there would show.

    Without it, and without their coverage, the last ``count`` channels, there would be a hole, and ripples around it.
    """
    share = (ordinary / light.abs().clamp_min(TINY)).clamp(max=1.0)
    share = torch.cat([share[:, :-count], torch.ones_like(share[:, -count:])], 1)
    return torch.where(highlights, share, 1.0)


def light_of(values: Tensor, count: int) -> Tensor:
    """The values without their coverage, the last ``count`` channels."""
    return torch.cat([values[:, :-count], torch.zeros_like(values[:, -count:])], 1)


@torch.no_grad()
def tiers(values: Tensor, count: int) -> list[Tensor]:
    """Which pixels ``(B, 1, H, W)`` are spread together: from dark to bright, none much brighter than the dark ones.

    Args:
        values: ``(B, C, H, W)``, and last the coverage.
        count: how many channels of that there are.
    """
    if values.shape[1] == count:
        return [torch.ones_like(values[:, :1], dtype=torch.bool)]
    light, coverage = values[:, :-count].abs().amax(1, keepdim=True), values[:, -1:].abs()
    share = coverage / coverage.amax((1, 2, 3), keepdim=True).clamp_min(TINY)
    colour = light / share.clamp(1e-6, 1.0)  # never less than the light: the dark pixels are not above themselves
    left = torch.ones_like(light, dtype=torch.bool)
    every = max(light[0].numel() // SAMPLES, 1)
    found = []
    while True:
        seen = torch.where(left & (light > 0), colour, torch.inf).flatten(1)[:, ::every].sort(1).values
        place = (DARK * seen.isfinite().sum(1, keepdim=True)).long()
        dark = seen.gather(1, place)[..., None, None]
        over = left & (light > CONTRAST * dark)
        found.append(left & ~over)
        if not bool(over.any()):
            return found
        left = over


@torch.no_grad()
def support(bright: Tensor, parts: Sequence[Labels], bank: PsfBank) -> Tensor:
    """Where the PSFs of the ``bright (B, 1, H, W)`` pixels reach, likewise.

    Args:
        bright: which spread.
        parts: their labels in each part of the exposure.
        bank: the PSFs.
    """
    out = torch.zeros_like(bright)
    if not isinstance(bank.model, Combined):
        for part in parts:
            for place in bank.model.places(part):
                reach = bank.reach()[bank.model.grid.index(place.coordinates.movedim(1, -1))][:, None].to(torch.float32)
                reach = math.sqrt(2) * reach * (1.0 if place.scale is None else place.scale)
                shift = 0.0 if place.offset is None else place.offset.square().sum(1, keepdim=True).sqrt()
                out |= _discs(bright, torch.zeros_like(reach).expand(-1, 2, -1, -1), reach + shift + 1)
        return out
    for part in parts:
        radius = needed(part).abs().float()
        motion = torch.zeros_like(radius).expand(-1, 2, -1, -1) if part.motion is None else part.motion.float()
        offset = torch.zeros_like(motion) if part.offset is None else part.offset.float()
        length = motion.square().sum(1, keepdim=True).sqrt()
        count = min(1 + math.ceil(float((length / radius.clamp_min(1.0))[bright].max())), ALONG)
        step = length / max(count - 1, 1)
        cover = (radius.square() + step.square() / 4).sqrt() + 1
        for k in range(count):
            out |= _discs(bright, offset + (k / max(count - 1, 1) - 0.5) * motion, cover)
    return out


def _discs(bright: Tensor, shift: Tensor, radius: Tensor) -> Tensor:
    """Where discs around shifted pixels reach; of several that come to lie on one pixel, the largest counts."""
    b, _, h, w = bright.shape
    n, _, y, x = bright.nonzero(as_tuple=True)
    # From the picture's nearest pixel, what lies beyond its border reaches at least as far into it.
    column = (x + shift[:, :1][bright]).round().long().clamp(0, w - 1)
    row = (y + shift[:, 1:][bright]).round().long().clamp(0, h - 1)
    far = torch.zeros(b * h * w, device=bright.device)
    far.scatter_reduce_(0, (n * h + row) * w + column, radius[bright].to(far.dtype).clamp(max=math.hypot(h, w)), "amax")
    far = far.view(b, 1, h, w)
    return splat_spans((far > 0).float(), far, Disc().profile(), integrate=True) > 1e-3 / (h * w)


@torch.no_grad()
def usual(values: Tensor) -> Tensor:
    """What each pixel would show ``(B, C, H, W)`` were it no highlight: none raises it, so that none hides another."""
    brightness, coverage = values.abs(), values[:, -1:].abs()
    alive = (values != 0).any(1, keepdim=True).to(values.dtype)
    mean = coverage.sum((2, 3), keepdim=True) / alive.sum((2, 3), keepdim=True).clamp_min(1)
    coverage = coverage.maximum(mean) * alive
    total = coverage.sum((2, 3), keepdim=True).clamp_min(TINY)
    found = brightness.sum((2, 3), keepdim=True) / total
    for _ in range(CLIPPED):
        found = brightness.minimum(LEAST_CONTRAST * found * coverage).sum((2, 3), keepdim=True) / total
    return found * coverage


def _area(parts: Sequence[Labels], bank: PsfBank) -> Tensor:
    """About how many pixels the light of each is spread over, ``(B, 1, H, W)``."""
    if not isinstance(bank.model, Combined):
        places = [place for part in parts for place in bank.model.places(part)]
        reach = [bank.reach()[bank.model.grid.index(p.coordinates.movedim(1, -1))][:, None] for p in places]
        scales = [1.0 if p.scale is None else p.scale for p in places]
        return torch.stack([(r * s).square() for r, s in zip(reach, scales, strict=True)]).mean(0)
    radius = torch.stack([needed(p).abs().clamp_min(MIN_RADIUS) for p in parts]).mean(0)
    ways = [p.motion for p in parts if p.motion is not None]
    length = torch.stack([way.square().sum(1, keepdim=True).sqrt() for way in ways]).sum(0)
    return radius * (math.pi * radius + 2 * length) / len(parts)


def needed(labels: Labels) -> Tensor:
    """The CoC of labels that must have one."""
    if labels.coc is None:
        raise ValueError("labels.coc: expected one, since pixels are merged by it, got none")
    return labels.coc
