"""Dense splats of single pixels: discs along a displacement, for the few highlights whose PSF can be seen.

A sparse PSF has ripples of a hundredth of its height around it. Under a highlight of a thousand times its surroundings
they would be seen; so highlights are drawn densely, point by point.
"""

import math

import torch
from torch import Tensor

from torchbokeh.ops._dispatch import has_kernel
from torchbokeh.ops.spans import MIN_RADIUS

FINE = 2
"""Samples along each side of a pixel."""

CHUNK = 1 << 22
"""Most samples that the torch path expands at a time."""


def splat_capsules(values: Tensor, pixels: Tensor, radius: Tensor, motion: Tensor, centre: Tensor) -> Tensor:
    """Spread single pixels over discs that move.

    Args:
        values: ``(B, C, H, W)``; of all pixels, only those named spread.
        pixels: ``(N,)`` int64, flat indices into ``(B, H, W)``.
        radius: ``(N,)`` in px, >= 0.
        motion: ``(N, 2)`` displacement (dx, dy) in px.
        centre: ``(N, 2)`` where the middle of the PSF lies, in px from its pixel.

    Returns:
        ``(B, C, H, W)``: every PSF sums to 1, with what falls outside the picture. Differentiable to all but
        ``pixels``.
    """
    maps = [values, radius, motion, centre]
    if has_kernel(values) and not (torch.is_grad_enabled() and any(t.requires_grad for t in maps)):
        from torchbokeh.ops import _capsule_kernels

        source, *geometry = (t.detach() for t in maps)
        return _capsule_kernels.splat_capsules(source, pixels, *geometry)
    return _splat_capsules_torch(values, pixels, radius, motion, centre)


def _splat_capsules_torch(values: Tensor, pixels: Tensor, radius: Tensor, motion: Tensor, centre: Tensor) -> Tensor:
    b, c, h, w = values.shape
    flat = values.movedim(1, 0).reshape(c, -1)
    out = torch.zeros_like(flat)
    if not len(pixels):
        return out.reshape(c, b, h, w).movedim(0, 1)
    # Half a pixel more than the reach, so that the sums of all samples of a PSF are whole.
    extent = radius.detach().clamp_min(MIN_RADIUS)[:, None] + motion.detach().abs() / 2 + centre.detach().abs()
    reach = math.ceil(float(extent.max())) + 1
    at = torch.arange(-reach, reach + 1, device=values.device)
    v, u = (t.flatten() for t in torch.meshgrid(at, at, indexing="ij"))
    steps = ((torch.arange(FINE, device=values.device) + 0.5) / FINE - 0.5).to(values.dtype)
    size = max(1, CHUNK // (len(u) * FINE * FINE))
    for part in range(0, len(pixels), size):
        here = slice(part, part + size)
        light = torch.zeros(len(pixels[here]), len(u), dtype=values.dtype, device=values.device)
        for dy in steps:
            for dx in steps:
                place = torch.stack([u + dx, v + dy], 1)
                light = light + _density(place, radius[here], motion[here], centre[here])
        light = light / light.sum(1, keepdim=True)
        x, y = pixels[here, None] % w + u, pixels[here, None] // w % h + v
        inside = (x >= 0) & (x < w) & (y >= 0) & (y < h)
        target = (pixels[here, None] // (h * w) * h + y.clamp(0, h - 1)) * w + x.clamp(0, w - 1)
        share = torch.where(inside, light, 0.0)
        spread = flat[:, pixels[here], None] * share
        out = out.index_add(1, target.flatten(), spread.flatten(1))
    return out.reshape(c, b, h, w).movedim(0, 1)


def _density(place: Tensor, radius: Tensor, motion: Tensor, centre: Tensor) -> Tensor:
    """Light ``(N, M)`` of capsules at places ``(M, 2)``, not normalised: the overlap of the way with the chord."""
    half = motion.square().sum(1).clamp_min(1e-12).sqrt()[:, None] / 2
    cos, sin = (motion / (2 * half)).unbind(1)
    still = half[:, 0] < 1e-3
    cos, sin = torch.where(still, 1.0, cos)[:, None], torch.where(still, 0.0, sin)[:, None]
    x, y = (place[None] - centre[:, None]).unbind(2)
    along, across = x * cos + y * sin, y * cos - x * sin
    chord = (radius.clamp_min(MIN_RADIUS)[:, None].square() - across.square()).clamp_min(1e-12).sqrt()
    overlap = torch.minimum(along + half, chord) - torch.maximum(along - half, -chord)
    light = torch.where(chord > 2e-6, overlap.clamp_min(0) / half.clamp_min(1e-3), 0.0)
    return torch.where(still[:, None], ((along.abs() <= chord) & (chord > 2e-6)).to(light), light)
