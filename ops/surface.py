"""A surface, blurred in soft bins of its radius that occlude each other, merged by radius."""

from collections.abc import Sequence

import torch
from torch import Tensor

from torchbokeh.ops._dispatch import has_kernel
from torchbokeh.ops.composite import bin_weights, fill_until_full
from torchbokeh.ops.merge import Merging, splat_merged
from torchbokeh.ops.spans import Profile

BLEND = 0.25
"""Part of the way between two bins on which pixels belong to both: every such pixel is splatted twice."""


def blur_surface(
    colour: Tensor,
    weight: Tensor | None,
    coc: Tensor,
    centres: Sequence[float],
    profile: Profile,
    merging: Merging,
    highest: int,
) -> tuple[Tensor, Tensor]:
    """Splat a surface in soft bins of its radius and mix them front to back, see `fill_until_full`.

    Args:
        colour: ``(B, C, H, W)``, not premultiplied.
        weight: coverage ``(B, 1, H, W)``; ``None`` for 1.
        coc: ``(B, 1, H, W)`` signed radius in px.
        centres: centres of the bins in px, front to back, see `bin_weights`, with `BLEND`.
        profile: the unit shape of the PSF.
        merging: how far to merge, see `torchbokeh.ops.merge`.
        highest: the coarsest level.

    Returns:
        The mean colour ``(B, C, H, W)`` and the sum of all coverages ``(B, 1, H, W)``, which varying blur may raise
        above 1. Differentiable to all tensors.
    """
    hats = [None] if len(centres) == 1 else bin_weights(coc, centres, BLEND)
    weights = [hat if weight is None else weight if hat is None else hat * weight for hat in hats]
    asked = torch.is_grad_enabled() and any(
        t is not None and t.requires_grad for t in (colour, weight, coc, profile.knots, profile.bulge)
    )
    if has_kernel(colour) and colour.shape[1] <= 3 and colour.numel() and not asked:
        from torchbokeh.ops import _surface_kernels

        return _surface_kernels.blur_surface(colour, coc, weights, profile, merging, highest)
    bins = []
    for share in weights:
        splat = splat_merged(colour, coc, profile, merging, highest=highest, weight=share, ones=True)
        bins.append((splat[:, :-1], splat[:, -1:]))
    return fill_until_full(bins)
