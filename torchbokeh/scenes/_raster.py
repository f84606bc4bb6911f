"""Polygons and lines to coverage, exactly."""

import numpy as np
import torch
from torch import Tensor

from torchbokeh.ops.checks import check_size


def fill(size: tuple[int, int], *outlines: np.ndarray) -> Tensor:
    """Exact coverage of each pixel by closed polygons.

    Args:
        size: (H, W) in pixels.
        outlines: arrays ``(V, 2)`` of corners (x, y) in pixels, (0, 0) being the upper left corner of the upper
            left pixel; they may reach beyond the picture. Outlines that turn the same way add up to at most
            full coverage, an outline that turns the other way cuts a hole.

    Returns:
        ``(1, H, W)`` float32 in [0, 1].

    Raises:
        TypeError: ``size`` is not two integers.
        ValueError: a size below 1, or an outline is not ``(V, 2)`` or not finite.

    Example:
        >>> fill((1, 2), np.array([[0.5, 0], [2, 0], [2, 1], [0.5, 1]])).tolist()
        [[[0.5, 1.0]]]
    """
    height, width = check_size(size)
    for outline in outlines:
        if outline.ndim != 2 or outline.shape[1] != 2 or not np.isfinite(outline).all():
            raise ValueError(f"outlines: expected finite corners of shape (V, 2), got shape {outline.shape}")
    if not outlines:
        return torch.zeros(1, height, width)
    start = np.concatenate(outlines).astype(np.float64)
    end = np.concatenate([np.roll(outline, -1, 0) for outline in outlines]).astype(np.float64)
    for axis in (1, 0):
        start, end = _split(start, end, axis)
    # Each piece now lies in one pixel: what is to its right in that pixel, and all further pixels, change by
    # the height it spans. Pieces outside are pushed to the border: above and below they then span nothing.
    column = np.clip(np.floor(0.5 * (start[:, 0] + end[:, 0])), 0, width).astype(np.int64)
    row = np.clip(np.floor(0.5 * (start[:, 1] + end[:, 1])), 0, height - 1).astype(np.int64)
    rise = np.clip(end[:, 1], 0, height) - np.clip(start[:, 1], 0, height)
    part = rise * np.clip(0.5 * (start[:, 0] + end[:, 0]) - column, 0, 1)
    cell = row * (width + 2) + column
    steps = np.bincount(cell, rise - part, height * (width + 2)) + np.bincount(cell + 1, part, height * (width + 2))
    winding = np.cumsum(steps.reshape(height, width + 2), axis=1)[:, :width]
    # Rounding, so that what is empty is exactly 0 and what is full exactly 1.
    return torch.from_numpy(np.minimum(np.abs(np.round(winding, 6)), 1).astype(np.float32))[None]


def stroke(points: np.ndarray, width: float | np.ndarray) -> np.ndarray:
    """The outline of a line of some width, with butt ends, for :func:`fill`.

    Args:
        points: ``(V, 2)`` with V >= 2, along the line, in pixels; bends should be gentle from point to point.
        width: in pixels, one number or one per point.

    Returns:
        ``(2 V, 2)`` corners.

    Raises:
        ValueError: ``points`` is not ``(V, 2)`` with V >= 2.

    Example:
        >>> stroke(np.array([[0.0, 0.5], [2.0, 0.5]]), 1.0).tolist()
        [[0.0, 1.0], [2.0, 1.0], [2.0, 0.0], [0.0, 0.0]]
    """
    if points.ndim != 2 or points.shape[1] != 2 or len(points) < 2:
        raise ValueError(f"points: expected shape (V, 2) with V >= 2, got {points.shape}")
    along = np.gradient(points, axis=0)
    across = np.stack([-along[:, 1], along[:, 0]], 1) / np.maximum(np.hypot(*along.T), 1e-9)[:, None]
    side = 0.5 * np.broadcast_to(width, len(points))[:, None] * across
    return np.concatenate([points + side, (points - side)[::-1]])


def _split(start: np.ndarray, end: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Cut line segments ``(N, 2)`` wherever they cross a whole number along ``axis``."""
    low, high = np.minimum(start, end)[:, axis], np.maximum(start, end)[:, axis]
    first = np.floor(low) + 1
    pieces = np.maximum(np.ceil(high) - first, 0).astype(np.int64) + 1
    which = np.repeat(np.arange(len(start)), pieces)
    step = np.arange(len(which)) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    begin, length = start[which], (end - start)[which]
    # From the lower end upwards, which for a falling segment is from its end to its start.
    falls = length[:, axis] < 0
    cut = first[which] + step - np.array([[1], [0]])
    share = (cut - begin[:, axis]) / np.where(length[:, axis] == 0, 1, length[:, axis])
    lower = np.where(step == 0, falls, share[0])
    upper = np.where(step == pieces[which] - 1, ~falls, share[1])
    near, far = np.where(falls, upper, lower), np.where(falls, lower, upper)
    return begin + near[:, None] * length, begin + far[:, None] * length
