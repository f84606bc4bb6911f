"""How dense the splats of a surface are: 1 where its blur is even, more or less where that varies."""

import torch
from torch import Tensor
from torch.nn import functional as F

from torchbokeh.banks.splat import splat_bank
from torchbokeh.compose.exposure import Exposure
from torchbokeh.compose.surfaces import COARSE, block_means, continued
from torchbokeh.ops.composite import TINY
from torchbokeh.ops.merge import MARGIN, splat_merged, upsample
from torchbokeh.ops.spans import Profile
from torchbokeh.plan.quality import Detail

BEYOND = 2 * MARGIN
"""Blocks of 2 x 2 pixels around a picture where `half_density` goes on."""


def enlarged_density(half: Tensor, like: Tensor) -> Tensor:
    """The density that `half_density` returns, for all pixels."""
    h, w = like.shape[2:]
    return upsample(half)[..., 2 * BEYOND : 2 * BEYOND + h, 2 * BEYOND : 2 * BEYOND + w].clamp_min(0)


def moving_density(coc: Tensor, exposure: Exposure, detail: Detail) -> Tensor:
    """`half_density` of a surface that moves; its maps are continued to where the surface is not."""
    full = block_means(torch.ones_like(coc), COARSE)

    def blocks(t: Tensor) -> Tensor:
        return F.pad(block_means(t, COARSE) / (full * COARSE), (MARGIN,) * 4, mode="replicate")

    inside = F.pad(torch.ones_like(full), (MARGIN,) * 4)
    labels = exposure.mapped(blocks).labels(blocks(coc))
    return upsample(splat_bank(inside, labels, exposure.bank, detail.merging, highest=detail.in_blocks))


def block_sums(coc: Tensor, alpha: Tensor) -> tuple[Tensor, Tensor]:
    """For blocks of ``COARSE**2`` pixels: the share with any ``alpha``, and that times CoC."""
    here = (alpha > 0).to(coc.dtype)
    return block_means(here, COARSE), block_means(here * coc, COARSE)


def half_density(share: Tensor, total: Tensor, profile: Profile, detail: Detail) -> Tensor:
    """Density of the splats of a surface without holes, for blocks of 2 x 2 pixels and `BEYOND` of them around.

    It is smooth, so it is splatted in blocks of 4 x 4. The CoC is continued to where the surface is not.

    Args:
        share: ``(B, 1, h, w)`` from `block_sums`, as is ``total``.
        total: see ``share``.
        profile: the unit shape of the PSF.
        detail: how far pixels of the whole picture are merged.
    """
    coc = F.pad(continued(total / share.clamp_min(TINY), share) / COARSE, (MARGIN,) * 4, mode="replicate")
    inside = F.pad(torch.ones_like(share), (MARGIN,) * 4)
    assert detail.merging is not None
    return upsample(splat_merged(inside, coc, profile, detail.merging, highest=detail.in_blocks))
