"""N-buffers: the smallest and the largest value of any window of an image, in a few look-ups.

Décoret, "N-Buffers for efficient depth map query" (2005); used for the depth bounds of rays in section 3.4 of the
defocus and bokeh dissertation. Unlike a mip-map, every level keeps the full resolution, so that windows need not be
aligned to anything.
"""

import sys
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from torchbokeh.ops.checks import check_image, check_whole


@dataclass(frozen=True, eq=False)
class NBuffers:
    """Minima and maxima over squares of ``2^i x 2^i`` pixels, for ``i = 0 .. L-1``.

    Level i holds at pixel ``(y, x)`` the minimum and the maximum over the rows ``y .. y + 2^i - 1`` and the columns
    ``x .. x + 2^i - 1``, as far as they lie in the image. The pixel is the corner of its square, not its centre: a
    square of even size has none.

    Args:
        low: ``(L, B, 1, H, W)`` minima.
        high: ``(L, B, 1, H, W)`` maxima.

    Example:
        >>> import torch
        >>> buffers = NBuffers.build(torch.arange(25.0).reshape(1, 1, 5, 5))
        >>> low, high = buffers.square(torch.ones(1, 1, 5, 5, dtype=torch.int64))
        >>> low[0, 0, 2, 2].item(), high[0, 0, 2, 2].item()
        (6.0, 18.0)
    """

    low: Tensor
    high: Tensor

    @classmethod
    def build(cls, values: Tensor, largest: int | None = None) -> Self:
        """Build the levels one from the other, by four look-ups each.

        Args:
            values: ``(B, 1, H, W)``, infinities are welcome. Gets no gradient.
            largest: side in px of the largest window that will be asked for; saves the levels that only larger ones
                would need. Larger windows are still exact, by more look-ups.

        Raises:
            TypeError: ``values`` is not a floating-point tensor.
            ValueError: its shape does not fit, it is empty or holds NaN; ``largest`` is below 1.
        """
        b, _, h, w = check_image("values", values, ("B", 1, "H", "W")).shape
        if values.numel() == 0:
            raise ValueError(f"values: expected at least one pixel, got shape {tuple(values.shape)}")
        if largest is not None:
            check_whole("largest", largest, 1, sys.maxsize)
        if values.isnan().any():
            raise ValueError("values: expected numbers, got NaN")
        side = max(h, w) if largest is None else min(largest, max(h, w))
        levels = side.bit_length()
        low, high = (values.new_empty((levels, b, 1, h, w)) for _ in range(2))
        low[0] = high[0] = values.detach()
        for i in range(1, levels):
            for level, smaller in ((low, torch.minimum), (high, torch.maximum)):
                # Four look-ups, taken as two by two. Past the border there is nothing to add to a clipped square.
                half = min(2 ** (i - 1), h), min(2 ** (i - 1), w)
                pair = level[i - 1].clone()
                smaller(pair[..., : w - half[1]], level[i - 1][..., half[1] :], out=pair[..., : w - half[1]])
                level[i] = pair
                smaller(pair[..., : h - half[0], :], pair[..., half[0] :, :], out=level[i][..., : h - half[0], :])
        return cls(low, high)

    def square(self, half: Tensor) -> tuple[Tensor, Tensor]:
        """Minimum and maximum over ``2 half + 1`` pixels squared around each pixel, cut at the image border.

        Exact; four look-ups within the image, up to eight along its border.

        Args:
            half: ``(B, 1, H, W)`` integers of at least 0.

        Returns:
            Minimum and maximum, ``(B, 1, H, W)`` each.

        Raises:
            TypeError: ``half`` is not an integer tensor.
            ValueError: its shape or device does not fit, or it is negative.
        """
        _, b, _, h, w = self.low.shape
        check_image("half", half, (b, 1, h, w), like=self.low, integer=True)
        if (half < 0).any():
            raise ValueError(f"half: expected at least 0, got {int(half.min())}")
        half = half.long().clamp(max=max(h, w))  # beyond it, sums could overflow
        y, x = (torch.arange(n, device=half.device) for n in (h, w))
        return self.rectangle(x - half, x + half, y[:, None] - half, y[:, None] + half)

    def rectangle(self, x0: Tensor, x1: Tensor, y0: Tensor, y1: Tensor) -> tuple[Tensor, Tensor]:
        """Minimum and maximum over the columns ``x0 .. x1`` and rows ``y0 .. y1``, ends included, of each pixel.

        Exact: the rectangle is tiled with overlapping squares of the largest level that fits in, so the number of
        look-ups grows with its aspect ratio. A rectangle that reaches the lower or right border may stick out
        there, for the levels are cut at the border too.

        Args:
            x0: ``(B, 1, H, W)`` integers, clamped into the image like the other three; a rectangle beside the image
                sees the border pixels next to it.
            x1: likewise.
            y0: likewise.
            y1: likewise.

        Returns:
            Minimum and maximum, ``(B, 1, H, W)`` each.

        Raises:
            TypeError: an argument is not an integer tensor.
            ValueError: shapes or devices do not fit, or a first column or row lies behind the last one.
        """
        levels, b, _, h, w = self.low.shape
        for name, edge in (("x0", x0), ("x1", x1), ("y0", y0), ("y1", y1)):
            check_image(name, edge, (b, 1, h, w), like=self.low, integer=True)
        for name, first, last in (("x", x0, x1), ("y", y0, y1)):
            if (first > last).any():
                raise ValueError(f"{name}0: expected at most {name}1, got a larger one")
        x0, x1 = (x.long().clamp(0, w - 1) for x in (x0, x1))
        y0, y1 = (y.long().clamp(0, h - 1) for y in (y0, y1))
        fits = torch.minimum(
            (x1 - x0 + 1).masked_fill(x1 == w - 1, w + h), (y1 - y0 + 1).masked_fill(y1 == h - 1, w + h)
        )
        level = torch.zeros_like(fits)
        for i in range(1, levels):
            level += fits >= 2**i
        side = 2**level
        image = (level * b + torch.arange(b, device=level.device)[:, None, None, None]) * h
        last_x, last_y = (torch.maximum(end - side + 1, start) for start, end in ((x0, x1), (y0, y1)))
        across, down = (
            int(((last - first).add(side - 1) // side).max()) + 1 for first, last in ((x0, last_x), (y0, last_y))
        )
        low, high = self.low.flatten(), self.high.flatten()
        smallest, largest = low[(image + y0) * w + x0], high[(image + y0) * w + x0]
        for j in range(down):
            row = (image + torch.minimum(y0 + j * side, last_y)) * w
            for i in range(across):
                where = row + torch.minimum(x0 + i * side, last_x)
                smallest, largest = torch.minimum(smallest, low[where]), torch.maximum(largest, high[where])
        return smallest, largest
