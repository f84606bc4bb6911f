"""numba kernel of `splat_capsules` for CPU float32: the same numbers as the torch definition, faster."""

import math

import numba as nb
import numpy as np
import torch
from torch import Tensor

from torchbokeh.ops.capsules import FINE
from torchbokeh.ops.points import flatten, unflatten
from torchbokeh.ops.spans import MIN_RADIUS


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _splat(flat, pixels, radius, motion, centre, height, width, out):  # type: ignore[no-untyped-def]
    """Splat pixels of ``flat (C, B*H*W)`` into ``out``, which is like it."""
    channels = flat.shape[0]
    for n in range(len(pixels)):
        r, dx, dy = max(radius[n], MIN_RADIUS), motion[n, 0], motion[n, 1]
        cx, cy = centre[n, 0], centre[n, 1]
        half = math.sqrt(dx * dx + dy * dy) / 2
        still = half < 1e-3
        cos, sin = (1.0, 0.0) if still else (dx / (2 * half), dy / (2 * half))
        wide = int(r + abs(dx) / 2 + abs(cx)) + 2
        high = int(r + abs(dy) / 2 + abs(cy)) + 2
        light = np.zeros((2 * high + 1, 2 * wide + 1))
        total = 0.0
        for v in range(-high, high + 1):
            for u in range(-wide, wide + 1):
                found = 0.0
                for i in range(FINE):
                    y = v + (i + 0.5) / FINE - 0.5 - cy
                    for j in range(FINE):
                        x = u + (j + 0.5) / FINE - 0.5 - cx
                        along, across = x * cos + y * sin, y * cos - x * sin
                        square = r * r - across * across
                        if square <= 0.0:
                            continue
                        chord = math.sqrt(square)
                        if still:
                            found += 1.0 if abs(along) <= chord else 0.0
                        else:
                            found += max(min(along + half, chord) - max(along - half, -chord), 0.0) / half
                light[v + high, u + wide] = found
                total += found
        p = pixels[n]
        x0, y0, start = p % width, p // width % height, p // (width * height) * width * height
        for v in range(max(-high, -y0), min(high, height - 1 - y0) + 1):
            for u in range(max(-wide, -x0), min(wide, width - 1 - x0) + 1):
                share = light[v + high, u + wide] / total
                if share > 0.0:
                    o = start + (y0 + v) * width + x0 + u
                    for k in range(channels):
                        out[k, o] += share * flat[k, p]


def splat_capsules(values: Tensor, pixels: Tensor, radius: Tensor, motion: Tensor, centre: Tensor) -> Tensor:
    """`torchbokeh.ops.capsules.splat_capsules` for CPU float32, on one thread."""
    flat = flatten(values).contiguous()
    out = np.zeros(flat.shape)
    geometry = (t.double().contiguous().numpy() for t in (radius, motion, centre))
    _splat(flat.numpy(), pixels.numpy(), *geometry, *values.shape[2:], out)
    return unflatten(torch.from_numpy(out), values)
