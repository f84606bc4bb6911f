"""A surface, blurred in soft bins of its radius that occlude each other, merged by radius."""

from collections.abc import Sequence

import torch
from torch import Tensor

from torchbokeh.ops.checks import check_image, check_kind, check_whole
from torchbokeh.ops.composite import bin_weights, check_centres, fill_until_full
from torchbokeh.ops.dispatch import has_kernel, refuse_transforms
from torchbokeh.ops.merge import MOST_LEVELS, Merging, splat_merged
from torchbokeh.ops.spans import Profile, check_profile

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

    Raises:
        TypeError: an argument of the wrong kind.
        ValueError: shapes or devices do not fit, or ``highest`` is out of its range.
    """
    b, _, h, w = check_image("colour", colour, ("B", "C", "H", "W")).shape
    check_image("coc", coc, (b, 1, h, w), like=colour)
    if weight is not None:
        check_image("weight", weight, (b, 1, h, w), like=colour)
    check_centres(centres)
    check_profile(profile, colour)
    check_kind("merging", merging, Merging)
    check_whole("highest", highest, 0, MOST_LEVELS)
    refuse_transforms("blur_surface", colour, weight, coc, *profile)
    hats = [None] if len(centres) == 1 else bin_weights(coc, centres, BLEND)
    weights = [hat if weight is None else weight if hat is None else hat * weight for hat in hats]
    asked = torch.is_grad_enabled() and any(
        t is not None and t.requires_grad for t in (colour, weight, coc, profile.knots, profile.bulge)
    )
    if has_kernel(colour) and colour.shape[1] <= 3 and colour.numel() and not asked:
        out = _blur_surface_op(colour, coc, weights, profile, merging, highest)
        return out[0], out[1]
    bins = []
    for share in weights:
        splat = splat_merged(colour, coc, profile, merging, highest=highest, weight=share, ones=True)
        bins.append((splat[:, :-1], splat[:, -1:]))
    return fill_until_full(bins)


@torch.library.custom_op("torchbokeh::blur_surface", mutates_args=())
def _blur_surface_op(
    colour: Tensor,
    coc: Tensor,
    weights: Sequence[Tensor | None],
    profile: Sequence[Tensor],
    merging: Sequence[float],
    highest: int,
) -> list[Tensor]:
    from torchbokeh.ops.kernels import surface as kernels

    return [*kernels.blur_surface(colour, coc, weights, Profile(*profile), Merging(*merging), highest)]


@_blur_surface_op.register_fake
def _(colour: Tensor, coc: Tensor, *settings: object) -> list[Tensor]:
    return [torch.empty_like(t, memory_format=torch.contiguous_format) for t in (colour, coc)]
