"""What textures are painted with: lattices, noise and colours."""

import math

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from torchbokeh.ops.checks import check_size


def lattice(size: tuple[int, int], pixels: float, angle: float) -> tuple[Tensor, int]:
    """Coordinates ``(2, H, W)`` in cells of some pixels, turned about the middle, and a bound: all lie in
    [3, bound - 3]."""
    height, width = check_size(size)
    extent = math.ceil(math.hypot(height, width) / pixels) + 6
    y, x = ((torch.arange(n) + (0.5 - 0.5 * n)) / pixels for n in (height, width))
    cos, sin = math.cos(angle), math.sin(angle)
    u, v = x * cos - y[:, None] * sin, x * sin + y[:, None] * cos
    return torch.stack([u, v]) + 0.5 * extent, extent


def fractal(
    size: tuple[int, int],
    draw: np.random.Generator,
    octaves: int,
    cells: float,
    roughness: float,
    shift: Tensor | None = None,
) -> Tensor:
    """Octaves of bicubic value noise ``(H, W)``, stretched to [0, 1]; each octave is turned another way."""
    height, width = check_size(size)
    total, weight = torch.zeros(1, 1, height, width), 1.0
    for octave in range(octaves):
        pixels = max(size) / (cells * 2**octave)
        if octave and pixels < 2:
            break
        uv, extent = lattice(size, pixels, draw.uniform(0, 2 * math.pi))
        if shift is not None:
            uv = uv + shift * min(2**octave, 2)
        table = torch.from_numpy(draw.uniform(-1, 1, (1, 1, extent, extent)).astype(np.float32))
        where = (uv * (2 / (extent - 1)) - 1).movedim(0, -1)[None]
        total += weight * F.grid_sample(table, where, "bicubic", padding_mode="reflection", align_corners=True)
        weight *= roughness
    low, high = torch.aminmax(total)
    return ((total - low) / (high - low).clamp(min=1e-6))[0, 0]


def ramp(values: Tensor, colours: Tensor) -> Tensor:
    """Colours ``(3, H, W)`` for values in [0, 1], between the colours ``(K, 3)`` of a ramp."""
    at = values * (len(colours) - 1)
    low = at.floor().clamp(max=len(colours) - 2)
    index = low.long()
    return torch.lerp(colours.T[:, index], colours.T[:, index + 1], at - low)


def linear_hsv(hsv: np.ndarray) -> Tensor:
    """Linear RGB ``(K, 3)`` of display HSV ``(K, 3)``, all in [0, 1], the hue in turns."""
    from kornia.color import hsv_to_rgb, rgb_to_linear_rgb

    pixels = torch.from_numpy(hsv * [2 * math.pi, 1, 1]).float().T.reshape(3, -1, 1)
    return rgb_to_linear_rgb(hsv_to_rgb(pixels))[:, :, 0].T.contiguous()


def draw_palette(draw: np.random.Generator, count: int) -> Tensor:
    """Colours ``(count, 3)``, linear, that go together: neighbours of one hue, some of its opposite."""
    spread = draw.choice([0.03, 0.08, 0.15, 0.4])
    hue = draw.uniform() + draw.normal(0, spread, count) + 0.5 * (draw.uniform(size=count) < 0.15)
    # Few things are vivid: most colours are greyish, and the darker the more saturated they may be.
    saturation = draw.beta(2, 3.5, count) * draw.uniform(0.4, 1)
    value = draw.permutation((np.arange(count) + draw.uniform(0, 1, count)) / count) * 0.82 + 0.14
    return linear_hsv(np.stack([hue % 1, saturation * (1.2 - 0.6 * value), value], 1))


def draw_contrast(draw: np.random.Generator, count: int) -> Tensor:
    """A ground and inks ``(count, 3)``, linear, that stand out from it."""
    hsv = np.stack([draw.uniform(0, 1, count), draw.uniform(0.2, 0.9, count), draw.uniform(0.05, 0.4, count)], 1)
    hsv[0] = draw.uniform(), 0.35 * draw.beta(1, 2.5), draw.uniform(0.75, 0.97)
    if draw.uniform() < 0.3:
        hsv[:, 2] = 1 - hsv[:, 2] * [0.85, *[0.6] * (count - 1)]
        hsv[0, 1] += 0.3
    return linear_hsv(hsv)
