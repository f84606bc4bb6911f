"""The baselines of defocus with motion: dense scatters of every pixel's own capsule, compiled with numba."""

import math
from collections.abc import Sequence

import numba as nb
import numpy as np
import torch
from torch import Tensor

from torchbokeh import Samples, pinhole_position
from torchbokeh.ops.composite import TINY
from torchbokeh.ops.spans import MIN_RADIUS
from torchbokeh.ops.system.threads import run_all
from torchbokeh.report.internals import pixel_positions

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
    total = _scattered(torch.cat([image, torch.ones_like(coc)], 1), coc, motion, torch.zeros_like(motion))
    return total[:, :3] / total[:, 3:]


def dense_layers(layers: Tensor, coc: Tensor, motion: Tensor) -> Tensor:
    """`dense_capsules` of every layer, put over one another, see `over_reweighted`.

    Args:
        layers: ``(1, L, 4, H, W)`` of premultiplied RGBA, front to back.
        coc: ``(1, L, 1, H, W)``.
        motion: ``(1, L, 2, H, W)``.

    Returns:
        ``(1, 3, H, W)``.
    """
    still = torch.zeros_like(motion[:, 0])
    every = zip(layers.unbind(1), coc.unbind(1), motion.unbind(1), strict=True)
    return over_reweighted([_scattered(rgba, radius, way, still) for rgba, radius, way in every])


def dense_samples(samples: Samples) -> Tensor:
    """Every sample adds its capsule about its pinhole position; divided by coverage. ``(1, 3, H, W)``."""
    shift = pinhole_position(samples) - pixel_positions(samples.position)
    total = torch.zeros_like(torch.cat([samples.colour, samples.coc], 2)[:, 0])
    for k in range(samples.colour.shape[1]):
        here = samples.present[:, k].to(samples.colour)
        rgba = torch.cat([samples.colour[:, k], torch.ones_like(here)], 1)
        # What is not present may hold anything.
        maps = (torch.where(here > 0, t[:, k], 0.0) for t in (samples.coc, samples.motion, shift))
        total = total + _scattered(torch.where(here > 0, rgba, 0.0), *maps)
    return total[:, :3] / total[:, 3:].clamp_min(TINY)


def over_reweighted(layers: Sequence[Tensor]) -> Tensor:
    """Blurred layers ``(1, 4, H, W)`` of premultiplied RGBA, front to back, over one another, as LKS takes it from Lee.

    Where splats gather, a layer covers more than all: its colour is divided by that coverage. In the end all is divided
    by what is covered, so that the border and what no splat reaches stay bright.

    Source: Lee, Kim and Choi, "Real-time depth-of-field rendering using point splatting on per-pixel layers" (2008).
    """
    colour = torch.zeros_like(layers[0][:, :3])
    left = torch.ones_like(layers[0][:, 3:])
    for layer in layers:
        covered = layer[:, 3:].clamp_min(0)
        alpha = covered.clamp(max=1)
        colour = colour + left * layer[:, :3] * (alpha / covered.clamp_min(TINY))
        left = left * (1 - alpha)
    return colour / (1 - left).clamp_min(TINY)


def _scattered(source: Tensor, coc: Tensor, motion: Tensor, shift: Tensor) -> Tensor:
    """Capsules of ``(1, 4, H, W)`` about places ``shift (1, 2, H, W)`` px from their pixels, not normalised."""
    height, width = source.shape[2:]
    radii = coc.abs()[0, 0].clamp_min(MIN_RADIUS)
    reach = math.ceil(float((radii + motion[0].norm(dim=0) / 2).max())) + 2
    threads = torch.get_num_threads()
    buffers = [np.zeros((height, width, 4), np.float32) for _ in range(threads)]
    pixels = source[0].permute(1, 2, 0).contiguous().numpy()
    maps = pixels, radii.contiguous().numpy(), motion[0].contiguous().numpy(), shift[0].contiguous().numpy()
    run_all(_scatter, [(*maps, reach, k, threads, out) for k, out in enumerate(buffers)])
    return torch.from_numpy(sum(buffers[1:], buffers[0])).permute(2, 0, 1)[None]


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
def _draw(radius, dx, dy, right, down, weights):  # type: ignore[no-untyped-def]
    """Light in the pixels around of a capsule that lies within half a pixel ``right`` and ``down`` of the middle one.

    Row by row; returns their sum, and how far they reach each way.
    """
    length = math.sqrt(dx * dx + dy * dy)
    half = length / 2
    cos, sin = (dx / length, dy / length) if length > 1e-6 else (1.0, 0.0)
    wide = int(abs(cos) * half + radius + 1 + abs(right))
    high = int(abs(sin) * half + radius + 1 + abs(down))
    fine = FINE if radius < THIN else 1
    total, k = 0.0, 0
    for v in range(-high, high + 1):
        for u in range(-wide, wide + 1):
            found = 0.0
            for i in range(fine):
                b = v + (i + 0.5) / fine - 0.5 - down
                for j in range(fine):
                    a = u + (j + 0.5) / fine - 0.5 - right
                    found += _density(a * cos + b * sin, b * cos - a * sin, radius, half)
            weights[k] = found
            total += found
            k += 1
    return total, wide, high


@nb.njit(nogil=True, fastmath=True, cache=True)
def _scatter(src, radii, motion, shift, reach, first, stride, out):  # type: ignore[no-untyped-def]
    """Rows ``first, first + stride, ...`` of ``src (H, W, 4)`` into ``out``."""
    height, width = radii.shape
    weights = np.empty((2 * reach + 1) ** 2, np.float32)
    for y in range(first, height, stride):
        for x in range(width):
            if src[y, x, 0] == 0 and src[y, x, 1] == 0 and src[y, x, 2] == 0 and src[y, x, 3] == 0:
                continue
            left, up = math.floor(shift[0, y, x] + 0.5), math.floor(shift[1, y, x] + 0.5)
            right, down = shift[0, y, x] - left, shift[1, y, x] - up
            total, wide, high = _draw(radii[y, x], motion[0, y, x], motion[1, y, x], right, down, weights)
            left, up = x + left, y + up
            scale = 1.0 / total
            red, green, blue, one = (
                src[y, x, 0] * scale,
                src[y, x, 1] * scale,
                src[y, x, 2] * scale,
                src[y, x, 3] * scale,
            )
            k = 0
            for v in range(up - high, up + high + 1):
                if v < 0 or v >= height:
                    k += 2 * wide + 1
                    continue
                for u in range(left - wide, left + wide + 1):
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
            _, wide, high = _draw(radii[y, x], motion[0, y, x], motion[1, y, x], 0.0, 0.0, weights)
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
