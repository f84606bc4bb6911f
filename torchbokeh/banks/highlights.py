"""What sparse PSFs would spoil: highlights that show their ripples, and the dark around bright regions."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from torchbokeh.banks.samples import BankSettings, Source, splat_samples
from torchbokeh.ops.composite import TINY
from torchbokeh.ops.highlights import LEAST_CONTRAST, ordinary_brightness
from torchbokeh.ops.splat import splat_spans
from torchbokeh.psfs.aperture import Disc
from torchbokeh.psfs.bank import PsfBank
from torchbokeh.psfs.model import Labels

BRIGHT = 0.5
"""A pixel is a highlight where its light, spread over its PSF, is this many times the mean of the picture."""

MOST = 4096
"""Highlights that are drawn densely, at most: the brightest."""

CLIPPED = 3
"""How often what is ordinary is found anew: none of many highlights shall hide another."""

CONTRAST = 100.0
"""Pixels are spread apart from others whose dark parts they outshine by this.

Sparse PSFs leave up to 6e-4 of the light of a region around it, most of them 6e-5.
"""

DARK = 0.1
"""Share of the pixels that are darker than what counts as dark."""

SAMPLES = 4096
"""Pixels that are looked at for that, about."""


def dense_highlights(
    values: Tensor, sources: Sequence[Source], ordinary: Tensor, settings: BankSettings
) -> tuple[Tensor, Tensor]:
    """What pixels spread that are so bright that the ripples of a sparse PSF would be seen.

    Args:
        values: ``(B, C, H, W)``, and last the coverage.
        sources: what is left of them in each part of the exposure, and its labels.
        ordinary: their `ordinary_light`.
        settings: the bank, and whether to interpolate between its samples.

    Returns:
        What they spread beyond what is ordinary, like ``values``, and all the rest, with the whole coverage.
    """
    bank = settings.bank
    with torch.no_grad():
        light = torch.stack([source for source, _ in sources]).mean(0)
        area = bank.model.area([part for _, part in sources], bank.reach())
        bound = ordinary * (BRIGHT * area).clamp_min(LEAST_CONTRAST)
        excess = (light.abs() / bound.clamp_min(TINY)).amax(1).flatten()
        pixels = (excess > 1).nonzero()[:, 0]
        if len(pixels) > MOST:
            pixels = excess.topk(MOST).indices.sort().values
    dense = torch.zeros_like(values)
    if not len(pixels):
        return dense, values
    only = torch.zeros_like(excess).index_fill(0, pixels, 1.0).reshape(-1, 1, *values.shape[2:]) > 0
    kept = share_of_others(light, ordinary, only, bank.values.shape[1])
    rest, bright = values * kept, [(source * (1 - kept), part) for source, part in sources]
    for source, part in bright:
        exact = bank.model.splat_exactly(source, part, pixels)
        if exact is None:
            return splat_samples(bright, settings, dense=True), rest
        dense = dense + exact
    return dense, rest


@torch.no_grad()
def share_of_others(light: Tensor, ordinary: Tensor, highlights: Tensor, count: int) -> Tensor:
    """Which share of each value is spread with all others: of highlights, what any pixel there would show.

    Without it, and without their coverage, the last ``count`` channels, there would be a hole, and ripples around it.
    """
    share = (ordinary / light.abs().clamp_min(TINY)).clamp(max=1.0)
    share = torch.cat([share[:, :-count], torch.ones_like(share[:, -count:])], 1)
    return torch.where(highlights, share, 1.0)


@torch.no_grad()
def brightness_classes(values: Tensor, count: int) -> list[Tensor]:
    """Which pixels ``(B, 1, H, W)`` are spread together: from dark to bright, none much brighter than the dark ones.

    The last ``count`` channels of ``values (B, C, H, W)`` are the coverage.
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
    """Where the PSFs of the ``bright (B, 1, H, W)`` pixels reach, likewise, by their labels in parts of an exposure."""
    out = torch.zeros_like(bright)
    for part in parts:
        for shift, radius in bank.model.support(part, bank.reach(), bright):
            out |= _discs(bright, shift, radius)
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
def ordinary_light(values: Tensor) -> Tensor:
    """What each pixel would show ``(B, C, H, W)`` were it no highlight; the last channel of ``values`` is coverage."""
    coverage = values[:, -1:].abs()
    alive = (values != 0).any(1, keepdim=True).to(values.dtype)
    mean = coverage.sum((2, 3), keepdim=True) / alive.sum((2, 3), keepdim=True).clamp_min(1)
    coverage = coverage.maximum(mean) * alive
    return ordinary_brightness(values / coverage.clamp_min(TINY), coverage, CLIPPED) * coverage
