"""The disc as a table of numbers, for the baselines that need one."""

import math

import numpy as np

from torchbokeh.ops.spans import MIN_RADIUS

_SUBROWS = 16


def disc(radius: float) -> np.ndarray:
    """A flat disc on the pixel grid, by the share of each pixel that it covers.

    Exact along one axis with 16 lines per pixel along the other, the mean of both. Radii below half a pixel give the
    identity.

    Args:
        radius: in px, >= 0.

    Returns:
        ``(2n+1, 2n+1)`` float64 that sums to 1, the centre in the middle.

    Example:
        >>> disc(0.2).tolist()
        [[1.0]]
        >>> disc(3.0).shape
        (7, 7)
    """
    if radius <= MIN_RADIUS:
        return np.ones((1, 1))
    n = math.ceil(radius - 0.5)
    column = np.arange(-n, n + 1)
    y = column[:, None] + (np.arange(_SUBROWS) + 0.5) / _SUBROWS - 0.5
    half = np.sqrt(np.maximum(radius**2 - y**2, 0.0))[..., None]
    covered = np.minimum(half, column + 0.5) - np.maximum(-half, column - 0.5)
    psf = np.maximum(covered, 0.0).mean(1)
    psf = psf + psf.T
    return psf / psf.sum()
