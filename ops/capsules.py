"""Dense splats of single pixels: discs along a displacement, for the few highlights whose PSF can be seen.

A sparse PSF has ripples of a hundredth of its height around it. Under a highlight of a thousand times its surroundings
they would be seen; so highlights are drawn densely, point by point.
"""

import math
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from torchbokeh.ops.checks import check_image
from torchbokeh.ops.dispatch import has_kernel, refuse_transforms
from torchbokeh.ops.points import flatten, unflatten
from torchbokeh.ops.spans import MIN_RADIUS

FINE = 2
"""Samples along each side of a pixel."""

CHUNK = 1 << 20
"""Most samples that are expanded at a time, or those of a single pixel: about 0.1 GB of scratch."""


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

    Raises:
        TypeError: an argument is not a floating-point tensor, ``pixels`` not an integer one.
        ValueError: shapes or devices do not fit, or a pixel is not in the picture.
    """
    check_image("values", values, ("B", "C", "H", "W"))
    check_image("pixels", pixels, ("N",), like=values, integer=True)
    for name, given, rest in (("radius", radius, ()), ("motion", motion, (2,)), ("centre", centre, (2,))):
        check_image(name, given, (len(pixels), *rest), like=values)
    count = values.numel() // max(values.shape[1], 1)
    if len(pixels) and not 0 <= int(pixels.min()) <= int(pixels.max()) < count:
        raise ValueError(f"pixels: expected indices of {count} pixels, got {int(pixels.min())} to {int(pixels.max())}")
    refuse_transforms("splat_capsules", values, radius, motion, centre)
    return _Capsules.apply(values, pixels, radius, motion, centre)


class _Capsules(torch.autograd.Function):
    """A splat whose backward pass draws the PSFs anew, in pieces: no graph over their samples outlives it."""

    @staticmethod
    def forward(values: Tensor, pixels: Tensor, radius: Tensor, motion: Tensor, centre: Tensor) -> Tensor:
        if has_kernel(values):
            from torchbokeh.ops.kernels import capsules as kernels

            return kernels.splat_capsules(*(t.detach() for t in (values, pixels, radius, motion, centre)))
        return _splat_capsules_torch(values, pixels, radius, motion, centre)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, ...], output: Tensor) -> None:
        ctx.save_for_backward(*inputs)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        values, pixels, *geometry = ctx.saved_tensors
        by_values, *by_geometry = _gather_capsules(grad, values, pixels, *geometry)
        return by_values, None, *by_geometry


def _splat_capsules_torch(values: Tensor, pixels: Tensor, radius: Tensor, motion: Tensor, centre: Tensor) -> Tensor:
    flat = flatten(values)
    out = torch.zeros_like(flat)
    for here, places in _pieces(pixels, radius, motion, centre):
        target, inside = _targets(pixels[here], places, values.shape)
        share = torch.where(inside, _shares(places, radius[here], motion[here], centre[here]), 0.0)
        out.index_add_(1, target.flatten(), (flat[:, pixels[here], None] * share).flatten(1))
    return unflatten(out, values)


def _gather_capsules(
    grad: Tensor, values: Tensor, pixels: Tensor, radius: Tensor, motion: Tensor, centre: Tensor
) -> list[Tensor]:
    """Gradients of ``values, radius, motion, centre``; ``grad`` is that of the picture."""
    flat, slopes = flatten(values), flatten(grad)
    by_values = torch.zeros_like(flat)
    by_geometry = [torch.zeros_like(t) for t in (radius, motion, centre)]
    for here, places in _pieces(pixels, radius, motion, centre):
        target, inside = _targets(pixels[here], places, values.shape)
        arriving = torch.where(inside, slopes[:, target], 0.0)
        with torch.enable_grad():
            leaves = [t[here].detach().requires_grad_() for t in (radius, motion, centre)]
            share = _shares(places, *leaves)
        by_values[:, pixels[here]] = (arriving * share.detach()).sum(2)
        by_share = (arriving * flat[:, pixels[here], None]).sum(0)
        for whole, part in zip(by_geometry, torch.autograd.grad(share, leaves, by_share), strict=True):
            whole[here] = part
    return [unflatten(by_values, values), *by_geometry]


def _pieces(pixels: Tensor, radius: Tensor, motion: Tensor, centre: Tensor) -> Iterator[tuple[slice, Tensor]]:
    """The pixels in groups, with the whole offsets ``(M, 2)`` that any PSF reaches."""
    if not len(pixels):
        return
    # Half a pixel more than the reach, so that the sums of all samples of a PSF are whole.
    extent = radius.detach().clamp_min(MIN_RADIUS)[:, None] + motion.detach().abs() / 2 + centre.detach().abs()
    reach = math.ceil(float(extent.max())) + 1
    at = torch.arange(-reach, reach + 1, device=pixels.device)
    v, u = torch.meshgrid(at, at, indexing="ij")
    places = torch.stack([u.flatten(), v.flatten()], 1)
    size = max(1, CHUNK // (len(places) * FINE * FINE))
    for part in range(0, len(pixels), size):
        yield slice(part, part + size), places


def _targets(pixels: Tensor, places: Tensor, shape: tuple[int, ...]) -> tuple[Tensor, Tensor]:
    """Flat indices ``(N, M)`` of the places around pixels of ``(B, C, H, W)``, and which of them are in the picture."""
    _, _, h, w = shape
    x, y = pixels[:, None] % w + places[:, 0], pixels[:, None] // w % h + places[:, 1]
    inside = (x >= 0) & (x < w) & (y >= 0) & (y < h)
    return (pixels[:, None] // (h * w) * h + y.clamp(0, h - 1)) * w + x.clamp(0, w - 1), inside


def _shares(places: Tensor, radius: Tensor, motion: Tensor, centre: Tensor) -> Tensor:
    """Share ``(N, M)`` of its light that each PSF spreads to each place, the mean of some samples."""
    steps = ((torch.arange(FINE, device=radius.device) + 0.5) / FINE - 0.5).to(radius.dtype)
    light = torch.zeros(len(radius), len(places), dtype=radius.dtype, device=radius.device)
    for dy in steps:
        for dx in steps:
            light = light + _density(places + torch.stack([dx, dy]), radius, motion, centre)
    return light / light.sum(1, keepdim=True)


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
