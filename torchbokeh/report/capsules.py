"""The baseline of defocus with motion: a dense scatter of every pixel's own capsule, compiled with numba."""

import math

import numba as nb
import numpy as np
import torch
from torch import Tensor

from torchbokeh.ops._threads import run_all
from torchbokeh.ops.spans import MIN_RADIUS

FINE, THIN = 3, 4.0
"""A disc of a smaller radius than ``THIN`` px is sampled at ``FINE**2`` places of each pixel."""


def dense_capsules(image: Tensor, coc: Tensor, motion: Tensor) -> Tensor:
    """Every pixel adds a disc, spread along its motion, point by point; divided by coverage.

    The density at a place is the overlap of the segment with the chord of the disc there (see
    `torchbokeh.psfs.combined.capsule`), and what a pixel spreads sums to 1. Each thread has its own buffer.

    Args:
        image: ``(1, 3, H, W)``.
        coc: ``(1, 1, H, W)`` signed radius in px; its sign does not matter.
        motion: ``(1, 2, H, W)`` displacement in px, its middle at the pixel.

    Returns:
        ``(1, 3, H, W)``.
    """
    height, width = image.shape[2:]
    radii = coc.abs()[0, 0].clamp_min(MIN_RADIUS)
    reach = math.ceil(float((radii + motion[0].norm(dim=0) / 2).max())) + 1
    source = torch.cat([image[0], torch.ones_like(radii)[None]]).permute(1, 2, 0).contiguous().numpy()
    threads = torch.get_num_threads()
    buffers = [np.zeros((height, width, 4), np.float32) for _ in range(threads)]
    maps = source, radii.numpy(), motion[0].contiguous().numpy()
    run_all(_scatter, [(*maps, reach, k, threads, out) for k, out in enumerate(buffers)])
    total = torch.from_numpy(sum(buffers[1:], buffers[0])).permute(2, 0, 1)[None]
    return total[:, :3] / total[:, 3:]


@nb.njit(nogil=True, fastmath=True, cache=True)
def _density(along, across, radius, half):  # type: ignore[no-untyped-def]
    """Light of a capsule at a place, not normalised."""
    square = radius * radius - across * across
    if square <= 0:
        return 0.0
    chord = math.sqrt(square)
    if half < 0.05:
        return 1.0 if abs(along) <= chord else 0.0
    return max(min(along + half, chord) - max(along - half, -chord), 0.0)


@nb.njit(nogil=True, fastmath=True, cache=True)
def _scatter(src, radii, motion, reach, first, stride, out):  # type: ignore[no-untyped-def]
    """Rows ``first, first + stride, ...`` of ``src (H, W, 4)`` into ``out``."""
    height, width = radii.shape
    side = 2 * reach + 1
    weights = np.empty(side * side, np.float32)
    for y in range(first, height, stride):
        for x in range(width):
            radius, dx, dy = radii[y, x], motion[0, y, x], motion[1, y, x]
            length = math.sqrt(dx * dx + dy * dy)
            half = length / 2
            cos, sin = (dx / length, dy / length) if length > 1e-6 else (1.0, 0.0)
            wide = int(abs(cos) * half + radius + 1)
            high = int(abs(sin) * half + radius + 1)
            fine = FINE if radius < THIN else 1
            total, k = 0.0, 0
            for v in range(-high, high + 1):
                for u in range(-wide, wide + 1):
                    found = 0.0
                    for i in range(fine):
                        b = v + (i + 0.5) / fine - 0.5
                        for j in range(fine):
                            a = u + (j + 0.5) / fine - 0.5
                            found += _density(a * cos + b * sin, b * cos - a * sin, radius, half)
                    weights[k] = found
                    total += found
                    k += 1
            scale = 1.0 / total
            r, g, b4, c = src[y, x, 0] * scale, src[y, x, 1] * scale, src[y, x, 2] * scale, src[y, x, 3] * scale
            k = 0
            for v in range(-high, high + 1):
                if y + v < 0 or y + v >= height:
                    k += 2 * wide + 1
                    continue
                for u in range(-wide, wide + 1):
                    if 0 <= x + u < width:
                        w = weights[k]
                        out[y + v, x + u, 0] += w * r
                        out[y + v, x + u, 1] += w * g
                        out[y + v, x + u, 2] += w * b4
                        out[y + v, x + u, 3] += w * c
                    k += 1
