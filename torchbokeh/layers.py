"""From an image with depth to surfaces that are blurred and put over one another.

A *surface* is something with one depth per pixel: the picture itself, what stands in front of the focus plane, what
lies behind that, or a layer of the caller's. Each is blurred in soft bins of constant parallax (uniform in the signed
circle of confusion), and all are composed front to back, once for every sub-aperture of the lens.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from torchbokeh.ops.composite import TINY, bin_weights, fill_until_full, pull_push
from torchbokeh.ops.spans import Profile, area
from torchbokeh.ops.splat import splat_spans

FOREGROUND = (-2.0, -1.0)
"""Signed CoC (px) between which a pixel passes from foreground to rest. What is sharper hides nothing."""

SPACING = 6.0
"""Distance of the bins in px of CoC. Closer ones change the picture little: what counts is what hides what."""

CERTAIN = 4.0
"""Views of a surface that splats cover to one over this count fully: splats of varying blur thin out, holes do not."""


@dataclass(frozen=True)
class Surface:
    """Something with one depth per pixel.

    Attributes:
        colour: ``(B, C, H, W)``, premultiplied by ``alpha`` where there is one.
        alpha: coverage ``(B, 1, H, W)`` in [0, 1]; ``None`` means opaque everywhere.
        coc: ``(B, 1, H, W)`` signed radius in px, continued to where ``alpha`` is 0.
        centres: centres of its bins in px of CoC, front to back.
    """

    colour: Tensor
    alpha: Tensor | None
    coc: Tensor
    centres: tuple[float, ...]


def bin_centres(low: float, high: float, most: int) -> tuple[float, ...]:
    """Evenly spaced bins for CoCs from ``low`` to ``high`` px, about `SPACING` apart and at most ``most``."""
    count = 1 if high - low <= 1 else min(most, 1 + math.ceil((high - low) / SPACING))
    if count == 1:
        return (0.5 * (low + high),)
    return tuple(low + (high - low) * k / (count - 1) for k in range(count))


def split_foreground(
    image: Tensor, coc: Tensor, behind: tuple[Tensor, Tensor | None] | None, centres: Sequence[tuple[float, ...]]
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
    """
    start, stop = FOREGROUND
    front = ((stop - coc) / (stop - start)).clamp(0, 1)
    known = 1 - F.max_pool2d(front, 3, 1, 1)
    colour, behind_coc = (None, None) if behind is None else behind
    # Where the foreground is beside everything, those pixels are all there is; elsewhere the second weight is nothing.
    last_resort = 1e-9 * (1 - front)
    if colour is None:
        weight = torch.maximum(known * _ordinary(image, known), last_resort)
        planes = (t.flatten(0, 1)[:, None] for t in (image, weight))
        colour = pull_push(*planes).reshape(image.shape)
    if behind_coc is None:
        behind_coc = pull_push(coc, torch.maximum(known, last_resort))
    rest = known * image + (1 - known) * colour
    rest_coc = known * coc + (1 - known) * behind_coc
    return [
        Surface(image * front, front, continued(coc, front), centres[0]),
        Surface(rest, None, rest_coc, centres[1]),
    ]


def _ordinary(image: Tensor, known: Tensor) -> Tensor:
    """Weight ``(B, C, H, W)``: 1 for ordinary values, 0 for highlights, far above four times the channel's mean."""
    brightness = image.abs()
    usual = 4 * (brightness * known).sum((2, 3), keepdim=True) / known.sum((2, 3), keepdim=True).clamp_min(TINY)
    ratio = (brightness / usual.clamp_min(TINY)).clamp(max=1e4)  # keeps the power and its slope finite
    return 1 / (1 + ratio**4)


def continued(coc: Tensor, alpha: Tensor) -> Tensor:
    """The CoC of a surface, continued from its surroundings to where the surface is not."""
    here = (alpha > 0).to(coc.dtype)
    return torch.where(here > 0, coc, pull_push(torch.where(here > 0, coc, 0.0), here))


def blurred(surface: Surface, profile: Profile) -> tuple[Tensor, Tensor, Tensor]:
    """One surface through one sub-aperture.

    Returns:
        The mean colour ``(B, C, H, W)``, the share ``(B, 1, H, W)`` of the light that the surface stops, and the
        density of its splats: 1 where blur is even, more or less where it varies, 0 where the picture does not know
        the surface, beyond the border or behind something else.
    """
    c = surface.colour.shape[1]
    alpha = torch.ones_like(surface.coc) if surface.alpha is None else surface.alpha
    source = torch.cat([surface.colour, alpha], 1)
    bins = []
    for weight in bin_weights(surface.coc, surface.centres):
        splat = splat_spans(source * weight, surface.coc, profile, integrate=True)
        bins.append((splat[:, :c], splat[:, c:]))
    colour, coverage = fill_until_full(bins)
    if surface.alpha is None:
        return colour, torch.ones_like(coverage), coverage
    # The same splats of a surface without holes say which part of the coverage is due to their density.
    whole = splat_spans(torch.ones_like(alpha), surface.coc, profile, integrate=True).clamp_min(0)
    return colour, (coverage / whole.clamp_min(TINY)).clamp(max=1), whole


def compose(surfaces: Sequence[Surface], pieces: Sequence[Profile]) -> tuple[Tensor, Tensor]:
    """Blur all surfaces and put them over one another, front to back, for every sub-aperture.

    Through one small piece of the lens, what is in front covers what is behind almost as in a pinhole picture; the
    mean over the pieces keeps the relation of coverage to lens position that one "over" of fully blurred surfaces
    loses. A part of the view that nothing is known of, beyond the border or behind an edge, gets no vote. Pieces are
    weighted by the density of their splats: a highlight is lit evenly, whatever the blur does around it.

    Args:
        surfaces: front to back.
        pieces: the sub-apertures, see `torchbokeh.ops.spans.subdivide`.

    Returns:
        Colour ``(B, C, H, W)``, premultiplied, and coverage ``(B, 1, H, W)``, 1 where something opaque is behind.
    """
    zero = torch.zeros_like(surfaces[0].coc)
    colour = torch.zeros_like(surfaces[0].colour)
    covered = total = zero
    for profile in pieces:
        seen = torch.zeros_like(colour)
        votes = crowd = zero
        left = zero + area(profile).to(zero.dtype)
        for surface in surfaces:
            mean, stopped, density = blurred(surface, profile)
            known = (CERTAIN * density).clamp(max=1)
            vote = left * stopped * known
            seen = seen + vote * mean
            votes = votes + vote
            crowd = crowd + vote * density
            # Where a surface is and no splat says how much it stops, the piece has no vote on what is behind either.
            absent = torch.zeros_like(known) if surface.alpha is None else (surface.alpha == 0).to(known.dtype)
            left = left * torch.lerp(absent, 1 - stopped, known)
        density = torch.where(votes > TINY, crowd / votes.clamp_min(TINY), density)
        colour = colour + density * seen
        covered = covered + density * votes
        total = total + density * (votes + left * known)
    total = total.clamp_min(TINY**2)  # the density counts twice
    return colour / total, covered / total
