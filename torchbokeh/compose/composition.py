"""Surfaces, blurred and put over one another."""

from collections.abc import Sequence
from functools import partial

import torch
from torch import Tensor

from torchbokeh.banks.splat import splat_bank
from torchbokeh.compose.surfaces import Surface
from torchbokeh.ops.composite import TINY, bin_weights, fill_until_full
from torchbokeh.ops.merge import splat_merged
from torchbokeh.ops.spans import Profile, area
from torchbokeh.ops.splat import splat_spans
from torchbokeh.ops.surface import blur_surface
from torchbokeh.plan.quality import Detail

CERTAIN = 4.0
"""Views of a surface that splats cover to one over this count fully: splats of varying blur thin out, holes do not."""


def blur_one_layer(image: Tensor, coc: Tensor, profile: Profile, detail: Detail) -> Tensor:
    """Splat ``image (B, C, H, W)`` with ``coc (B, 1, H, W)`` in px and divide by the coverage."""
    if detail.merging is None:
        out = splat_spans(torch.cat([image, torch.ones_like(coc)], 1), coc, profile, integrate=True)
        return out[:, :-1] / out[:, -1:].clamp_min(TINY)
    return splat_merged(image, coc, profile, detail.merging, highest=detail.highest, ones=True, normalise=True)[:, :-1]


def blurred(surface: Surface, profile: Profile, detail: Detail) -> tuple[Tensor, Tensor, Tensor]:
    """One surface through one sub-aperture, exact or merged by radius, for `compose`.

    Returns:
        The mean colour ``(B, C, H, W)``, the share ``(B, 1, H, W)`` of the light that the surface stops, and the
        density of its splats: 1 where blur is even, more or less where it varies, 0 where the picture does not know
        the surface, beyond the border or behind something else.
    """
    alpha, coc, exposure, (merging, highest, _) = surface.alpha, surface.coc, surface.exposure, detail
    if merging is not None and exposure is None:
        plain = surface.colour if alpha is None else surface.colour / alpha.clamp_min(TINY)
        colour, coverage = blur_surface(plain, alpha, coc, surface.centres, profile, merging, highest)
        if alpha is None:
            return colour, torch.ones_like(coverage), coverage
        whole = splat_merged(torch.ones_like(alpha), coc, profile, merging, highest=highest).clamp_min(0)
        return colour, (coverage / whole.clamp_min(TINY)).clamp(max=1), whole

    if exposure is None:
        splat = partial(splat_spans, coc=coc, profile=profile, integrate=True)
    else:
        splat = partial(splat_bank, labels=exposure.labels(coc), bank=exposure.bank, merging=merging, highest=highest)
    source = torch.cat([surface.colour, torch.ones_like(coc) if alpha is None else alpha], 1)
    splats = [splat(source * weight) for weight in bin_weights(coc, surface.centres)]
    colour, coverage = fill_until_full([(bin[:, :-1], bin[:, -1:]) for bin in splats])
    if exposure is not None:
        # Where a huge blur leaves hardly anything, sparse PSFs leave rounding alone, and the mean is not one any more.
        plain = torch.where(source[:, -1:] > 0, source[:, :-1] / source[:, -1:].clamp_min(TINY), 0.0)
        colour = colour.clamp(plain.amin((2, 3), True), plain.amax((2, 3), True))
    if alpha is None:
        return colour, torch.ones_like(coverage), coverage
    # The same splats of a surface without holes say which part of the coverage is due to their density.
    whole = splat(torch.ones_like(alpha)).clamp_min(0)
    return colour, (coverage / whole.clamp_min(TINY)).clamp(max=1), whole


def compose(
    surfaces: Sequence[Surface],
    pieces: Sequence[Profile],
    detail: Detail = Detail(),  # noqa: B008 - immutable
) -> tuple[Tensor, Tensor]:
    """Blur all surfaces and put them over one another, front to back, for every sub-aperture.

    Through one small piece of the lens, what is in front covers what is behind almost as in a pinhole picture; the
    mean over the pieces keeps the relation of coverage to lens position that one "over" of fully blurred surfaces
    loses. A part of the view that nothing is known of, beyond the border or behind an edge, gets no vote; nor do what
    stops light before it and what lets it through, in the same proportion. Pieces are weighted by the density of their
    splats: a highlight is lit evenly, whatever the blur does around it.

    Args:
        surfaces: front to back.
        pieces: the sub-apertures, see `torchbokeh.ops.spans.subdivide`.
        detail: how finely.

    Returns:
        Colour ``(B, C, H, W)``, premultiplied, and coverage ``(B, 1, H, W)``, 1 where something opaque is behind.
    """
    zero = torch.zeros_like(surfaces[0].coc)
    colour = torch.zeros_like(surfaces[0].colour)
    covered = total = zero
    for profile in pieces:
        seen, votes, densities, left, told = torch.zeros_like(colour), zero, zero, zero + 1, zero + 1
        last = len(surfaces) - 1
        for number in range(last, -1, -1):  # from the back, as each has to know what is told of all behind it
            surface = surfaces[number]
            mean, stopped, density = blurred(surface, profile, detail)
            known = (CERTAIN * density).clamp(max=1)
            vote = stopped * known * (stopped + (1 - stopped) * told)
            # Where a surface is and no splat says how much it stops, the piece has no vote on what is behind either.
            absent = torch.zeros_like(known) if surface.alpha is None else (surface.alpha == 0).to(known.dtype)
            passing = absent * (known if number == last else 1) + known * (1 - stopped - absent)
            seen = vote * mean + passing * seen
            votes, densities = vote + passing * votes, vote * density + passing * densities
            left, told = passing * left, absent * told + (1 - absent) * known * (stopped + (1 - stopped) * told)
            if number == last:
                behind = density
        weight = area(profile).to(zero.dtype)
        density = weight * torch.where(votes > TINY, densities / votes.clamp_min(TINY), behind)
        colour = colour + density * seen
        covered = covered + density * votes
        total = total + density * (votes + left)
    total = total.clamp_min(TINY**2)  # the density counts twice
    return colour / total, covered / total
