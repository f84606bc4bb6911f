"""What a highlight is: what is far brighter than the ordinary pixels of its picture.

Merging leaves highlights out, as the edges of their PSFs can be seen; banks draw them densely, as the ripples of sparse
PSFs would show; and what is hidden is not filled with them, or one beside an edge would make it glow. Each asks for as
much contrast as it needs, but for no less than `LEAST_CONTRAST`.
"""

import torch
from torch import Tensor

from torchbokeh.ops.composite import TINY

LEAST_CONTRAST = 4.0
"""A highlight is at least this many times as bright as what is ordinary."""


def ordinary_brightness(values: Tensor, weight: Tensor | None = None, clipped: int = 0) -> Tensor:
    """The mean magnitude of every channel.

    Args:
        values: ``(B, C, H, W)``; what has no weight may be anything.
        weight: ``(B, 1, H, W)`` >= 0, by which a pixel counts: black ones do as well, or lights before black would be
            no highlights. ``None``: all count alike.
        clipped: how often the mean is taken anew, without what is above `LEAST_CONTRAST` times the last one: then many
            highlights do not hide one another. Each costs a pass over the picture.

    Returns:
        ``(B, C, 1, 1)``.

    Example:
        >>> picture = torch.ones(1, 1, 10, 10)
        >>> picture[..., 3, 4] = 1000.0
        >>> [round(ordinary_brightness(picture, clipped=n).item(), 2) for n in (0, 1, 2)]
        [10.99, 1.43, 1.05]
    """
    if weight is None:
        magnitude = values.abs()
        found = magnitude.mean((2, 3), keepdim=True)
        for _ in range(clipped):
            found = magnitude.minimum(LEAST_CONTRAST * found).mean((2, 3), keepdim=True)
        return found
    magnitude = torch.where(weight > 0, values.abs(), 0.0)
    total = weight.sum((2, 3), keepdim=True).clamp_min(TINY)
    found = (magnitude * weight).sum((2, 3), keepdim=True) / total
    for _ in range(clipped):
        found = (magnitude.minimum(LEAST_CONTRAST * found) * weight).sum((2, 3), keepdim=True) / total
    return found
