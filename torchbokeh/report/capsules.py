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


def filter_capsules(image: Tensor, coc: Tensor, motion: Tensor) -> Tensor:
    """The filter of LKS: every pixel is the mean of the picture under its own capsule, as if all around were like it.

    Arguments and result are those of `dense_capsules`.
    """
    height, width = image.shape[2:]
    radii = coc.abs()[0, 0].clamp_min(MIN_RADIUS)
    reach = math.ceil(float((radii + motion[0].norm(dim=0) / 2).max())) + 1
    source = torch.cat([image[0], torch.ones_like(radii)[None]]).permute(1, 2, 0).contiguous().numpy()
    out = np.empty((height, width, 4), np.float32)
    maps = source, radii.numpy(), motion[0].contiguous().numpy()
    threads = torch.get_num_threads()
    run_all(_gather, [(*maps, reach, k, threads, out) for k in range(threads)])
    total = torch.from_numpy(out).permute(2, 0, 1)[None]
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
def _draw(radius, dx, dy, weights):  # type: ignore[no-untyped-def]
    """Light of a capsule in the pixels around, row by row; returns their sum, and how far they reach each way."""
    length = math.sqrt(dx * dx + dy * dy)
    half = length / 2
    cos, sin = (dx / length, dy / length) if length > 1e-6 else (1.0, 0.0)
    wide, high = int(abs(cos) * half + radius + 1), int(abs(sin) * half + radius + 1)
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
    return total, wide, high


@nb.njit(nogil=True, fastmath=True, cache=True)
def _scatter(src, radii, motion, reach, first, stride, out):  # type: ignore[no-untyped-def]
    """Rows ``first, first + stride, ...`` of ``src (H, W, 4)`` into ``out``."""
    height, width = radii.shape
    weights = np.empty((2 * reach + 1) ** 2, np.float32)
    for y in range(first, height, stride):
        for x in range(width):
            total, wide, high = _draw(radii[y, x], motion[0, y, x], motion[1, y, x], weights)
            scale = 1.0 / total
            red, green, blue, one = (
                src[y, x, 0] * scale,
                src[y, x, 1] * scale,
                src[y, x, 2] * scale,
                src[y, x, 3] * scale,
            )
            k = 0
            for v in range(y - high, y + high + 1):
                if v < 0 or v >= height:
                    k += 2 * wide + 1
                    continue
                for u in range(x - wide, x + wide + 1):
                    if 0 <= u < width:
                        w = weights[k]
                        out[v, u, 0] += w * red
                        out[v, u, 1] += w * green
                        out[v, u, 2] += w * blue
                        out[v, u, 3] += w * one
                    k += 1


@nb.njit(nogil=True, fastmath=True, cache=True)
def _gather(src, radii, motion, reach, first, stride, out):  # type: ignore[no-untyped-def]
    """Rows ``first, first + stride, ...`` of ``out (H, W, 4)`` from all of ``src``."""
    height, width = radii.shape
    weights = np.empty((2 * reach + 1) ** 2, np.float32)
    for y in range(first, height, stride):
        for x in range(width):
            _, wide, high = _draw(radii[y, x], motion[0, y, x], motion[1, y, x], weights)
            red = green = blue = one = 0.0
            k = 0
            for v in range(y - high, y + high + 1):
                for u in range(x - wide, x + wide + 1):
                    if 0 <= v < height and 0 <= u < width:
                        w = weights[k]
                        red += w * src[v, u, 0]
                        green += w * src[v, u, 1]
                        blue += w * src[v, u, 2]
                        one += w * src[v, u, 3]
                    k += 1
            out[y, x, 0], out[y, x, 1], out[y, x, 2], out[y, x, 3] = red, green, blue, one
