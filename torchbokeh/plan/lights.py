"""Lights near the border of a picture: those whose discs lie where the border cuts others.

A pixel is divided by what covers it, which is little within a radius of the border.
"""

import torch
from torch import Tensor

from torchbokeh.ops.composite import TINY
from torchbokeh.ops.dispatch import compute_dtype
from torchbokeh.ops.highlights import LEAST_CONTRAST
from torchbokeh.ops.spans import MIN_RADIUS

SHOWN = 0.03
"""A light shows at the border where it is brighter than what is ordinary by this times its squared radius in px: spread
over its disc, it then stands out by 1 %."""

BRIGHTER = (1.0, 2.0)
"""Lights, in units of those that begin to show, between which the surroundings of a picture come in."""


@torch.no_grad()
def lights_at_border(image: Tensor, coc: Tensor, largest: float, moved: float = 0.0) -> float:
    """How bright the brightest light near the border is, in units of one that begins to show; 0 for none.

    Args:
        image: ``(B, C, H, W)``, or layers ``(B, L, 4, H, W)`` of premultiplied RGBA.
        coc: ``(B, 1, H, W)`` or ``(B, L, 1, H, W)`` signed radius in px.
        largest: radius in px.
        moved: how far in px anything moves while the shutter is open.
    """
    if largest + moved <= MIN_RADIUS:
        return 0.0
    light = image.flatten(0, -4).to(compute_dtype(image)).contiguous().abs()  # sums do not depend on strides
    light, weight = (light[:, :3], light[:, 3:]) if image.dim() == 5 else (light, torch.ones_like(light[:, :1, :1, :1]))
    ordinary = light.mean((2, 3), keepdim=True) / weight.mean((2, 3), keepdim=True).clamp_min(TINY)
    contrast = (light / ordinary.clamp_min(torch.finfo(light.dtype).tiny)).amax(1)
    item, row, column = (contrast > LEAST_CONTRAST).nonzero(as_tuple=True)
    if not len(item):
        return 0.0
    radius = coc.reshape(contrast.shape)[item, row, column].to(light.dtype).abs()
    bound = (SHOWN * radius.square()).clamp_min(LEAST_CONTRAST)
    height, width = image.shape[-2:]
    away = torch.stack([row, height - 1 - row, column, width - 1 - column]).amin(0) + 0.5
    near = (away < radius + largest + moved) & (radius + moved > MIN_RADIUS)
    return float(torch.where(near, contrast[item, row, column] / bound, 0.0).max())
