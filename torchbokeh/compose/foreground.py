"""A foreground over the rest of a plain picture, in few passes: CPU float32, without gradients."""

from collections.abc import Sequence

import torch
from torch import Tensor

from torchbokeh.compose.composition import CERTAIN
from torchbokeh.compose.surfaces import COARSE, enlarged, fill_hidden
from torchbokeh.ops.composite import TINY, pull_push
from torchbokeh.ops.dispatch import refuse_transforms
from torchbokeh.ops.merge import Merging, splat_merged
from torchbokeh.ops.spans import Profile
from torchbokeh.ops.surface import blur_surface
from torchbokeh.plan.bins import FOREGROUND
from torchbokeh.plan.quality import Detail

Bins = Sequence[tuple[float, ...]]


def foreground_over_rest(image: Tensor, coc: Tensor, bins: Bins, profile: Profile, detail: Detail) -> Tensor:
    """`compose` of `split_foreground` in blocks for the whole lens, where pixels are merged.

    Args:
        image: ``(B, C, H, W)``, at most three channels.
        coc: ``(B, 1, H, W)`` signed radius in px.
        bins: centres of those of the foreground and of the rest.
        profile: the unit shape of the PSF.
        detail: how far pixels are merged.
    """
    assert detail.merging is not None
    refuse_transforms("foreground_over_rest", image, coc, *profile)
    return _foreground_over_rest_op(image, coc, *bins, list(profile), list(detail.merging), detail.highest)


@torch.library.custom_op("torchbokeh::foreground_over_rest", mutates_args=())
def _foreground_over_rest_op(
    image: Tensor,
    coc: Tensor,
    ahead: Sequence[float],
    behind: Sequence[float],
    profile: Sequence[Tensor],
    merging: Sequence[float],
    highest: int,
) -> Tensor:
    from torchbokeh.ops.kernels import foreground as kernels

    shape, extent = Profile(*profile), Merging(*merging)
    out = torch.empty_like(image)
    for n in range(len(image)):
        scene = image[n].numpy(), coc[n, 0].numpy()
        front, known, means = kernels.split(*scene, *FOREGROUND)
        parts = torch.from_numpy(means)[None].split([1, 1, 1, 1, image.shape[1]], 1)
        share, total_coc, here, total_here, totals = parts
        known_share = share.clamp_min(TINY)
        hidden, hidden_coc = fill_hidden(totals / known_share, total_coc / known_share, share)
        rest, rest_coc = kernels.rest(*scene, known, hidden[0].numpy(), hidden_coc[0, 0].numpy())
        picture, radius = torch.from_numpy(rest)[None], torch.from_numpy(rest_coc)[None, None]
        rest_picture, density = blur_surface(picture, None, radius, behind, shape, extent, highest)
        alpha, own = torch.from_numpy(front)[None, None], coc[n : n + 1]
        colour, coverage = blur_surface(image[n : n + 1], alpha, own, ahead, shape, extent, highest)
        beside = enlarged(pull_push(total_here / here.clamp_min(TINY), here), COARSE, front.shape)
        continued = torch.where(alpha > 0, own, beside)
        whole = splat_merged(torch.ones_like(alpha), continued, shape, extent, highest=highest)
        planes = colour[0], coverage[0, 0], whole[0, 0], rest_picture[0], density[0, 0]
        kernels.over(front, CERTAIN, *(t.contiguous().numpy() for t in planes))
        out[n] = rest_picture[0]
    return out


@_foreground_over_rest_op.register_fake
def _(image: Tensor, *settings: object) -> Tensor:
    return torch.empty_like(image, memory_format=torch.contiguous_format)
