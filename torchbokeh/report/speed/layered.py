"""Layered convolution, a baseline: cut the picture into layers of equal blur, convolve each, put them together.

The layers are hard bins, uniform in CoC. Each layer's premultiplied colour and its alpha are convolved with the disc of
the bin's centre, by FFT or directly.
"""

import math
from collections.abc import Callable

import torch
from scipy.fft import next_fast_len
from torch import Tensor
from torch.nn import functional as F

from torchbokeh.ops.spans import MIN_RADIUS
from torchbokeh.report.speed.discs import disc

Convolution = Callable[[Tensor, Tensor], Tensor]

TINY = 1e-6
BLOCK = 51
"""Side of the largest kernel of a direct convolution that is not cut into blocks."""


def fft_convolution(planes: Tensor, kernel: Tensor) -> Tensor:
    """Convolve by FFT, with zeros beyond the border and sizes that the FFT is fast for.

    Args:
        planes: ``(B, C, H, W)``.
        kernel: ``(2n+1, 2n+1)``.

    Returns:
        ``(B, C, H, W)``.
    """
    height, width = planes.shape[2:]
    n = kernel.shape[0] // 2
    # The kernel reaches n pixels to either side: n zeros between the last and the first row keep the two apart.
    size = next_fast_len(height + n, real=True), next_fast_len(width + n, real=True)
    size = max(size[0], 2 * n + 1), max(size[1], 2 * n + 1)
    centred = F.pad(kernel, (0, size[1] - 2 * n - 1, 0, size[0] - 2 * n - 1)).roll((-n, -n), (0, 1))
    spectrum = torch.fft.rfft2(planes, s=size).mul_(torch.fft.rfft2(centred))
    return torch.fft.irfft2(spectrum, s=size)[..., :height, :width]


def direct_convolution(planes: Tensor, kernel: Tensor) -> Tensor:
    """Convolve point by point, with zeros beyond the border; shapes as for `fft_convolution`.

    The planes are the batch of a convolution with one channel, several times faster than a grouped one in torch; and a
    large kernel is cut into blocks, since torch has no fast code for those above a radius of about 30 px.
    """
    b, c, h, w = planes.shape
    side = kernel.shape[0]
    padded = F.pad(planes.reshape(b * c, 1, h, w), (side // 2,) * 4)
    out = torch.zeros_like(planes).reshape(b * c, 1, h, w)
    turned = kernel.flip(0, 1)
    for y in range(0, side, BLOCK):
        for x in range(0, side, BLOCK):
            block = turned[y : y + BLOCK, x : x + BLOCK]
            bottom, right = y + h + block.shape[0] - 1, x + w + block.shape[1] - 1
            out += F.conv2d(padded[..., y:bottom, x:right], block[None, None])
    return out.reshape(b, c, h, w)


def bins(coc: Tensor, count: int) -> list[tuple[Tensor, float]]:
    """Hard bins of equal width in CoC that hold at least one pixel.

    Args:
        coc: ``(1, 1, H, W)`` in px, all finite.
        count: the number of bins, empty ones included.

    Returns:
        Where each bin is, ``(1, 1, H, W)`` bool, and the CoC of its centre, from the smallest CoC up.
    """
    low, high = (value.item() for value in coc.aminmax())
    width = max((high - low) / count, 1e-6)
    index = ((coc - low) / width).long().clamp(0, count - 1)
    return [(index == k, low + (k + 0.5) * width) for k in index.unique().tolist()]


def layered(
    image: Tensor, coc: Tensor, *, layers: int, join: str = "over, normalised", convolve: Convolution = fft_convolution
) -> Tensor:
    """Blur a picture in layers.

    Args:
        image: ``(1, 3, H, W)``.
        coc: ``(1, 1, H, W)`` signed radius in px, positive behind the focus plane.
        layers: the number of bins; empty ones cost nothing.
        join: how the layers come together. ``"over"``: bins of the signed CoC, put over one another from the back to
            the front. ``"over, normalised"``: the same, divided by the alpha that comes out. ``"sum, normalised"``:
            bins of the radius, added up and divided by their coverage, which is what one layer of splats is.
        convolve: `fft_convolution` or `direct_convolution`.

    Returns:
        ``(1, 3, H, W)``.

    Raises:
        ValueError: ``join`` is none of the three.
    """
    if join not in ("over", "over, normalised", "sum, normalised"):
        raise ValueError(f"join: expected over, 'over, normalised' or 'sum, normalised', got {join!r}")
    added = join == "sum, normalised"
    rgba = torch.cat([image, torch.ones_like(coc)], 1)
    out = torch.zeros_like(rgba)
    for inside, centre in reversed(bins(coc.abs() if added else coc, layers)):
        layer = rgba * inside
        if abs(centre) > MIN_RADIUS:
            layer = convolve(layer, torch.from_numpy(disc(abs(centre))).to(layer))
        out = layer + out if added else layer + (1 - layer[:, 3:]) * out
    return out[:, :3] if join == "over" else out[:, :3] / out[:, 3:].clamp_min(TINY)


def layer_work(coc: Tensor, layers: int) -> tuple[float, float]:
    """Multiplications that `layered` needs for its four planes, with FFTs and directly.

    Args:
        coc: ``(1, 1, H, W)`` signed radius in px.
        layers: the number of bins.
    """
    height, width = coc.shape[2:]
    by_fft = direct = 0.0
    for _, centre in bins(coc, layers):
        side = 2 * math.ceil(max(abs(centre) - 0.5, 0)) + 1
        cells = (height + side // 2) * (width + side // 2)
        by_fft += 9 * 2.5 * cells * math.log2(cells)  # four planes there and back, and the kernel
        direct += 4 * height * width * side**2
    return by_fft, direct
