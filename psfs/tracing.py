"""What models of traced PSFs share: where rays start, and the picture they leave."""

from functools import lru_cache

import numpy as np

from torchbokeh.psfs.arrays import Array


@lru_cache(maxsize=1)
def sobol_points(power: int, seed: int) -> Array:
    """``2**power`` points ``(2, n)`` that fill the unit square evenly: Sobol's, scrambled by a seed."""
    from scipy.stats import qmc

    points = qmc.Sobol(2, scramble=True, seed=seed).random_base2(power).T.copy()
    points.flags.writeable = False  # they are shared by all who ask for them
    return points


def splat_rays(picture: Array, x: Array, y: Array, light: Array) -> None:
    """Add the light of rays to a picture: each to the four pixels around it, bilinearly.

    What is farther out than the centres of the outermost pixels is lost.

    Args:
        picture: ``(h, w)``, odd sizes; it is changed.
        x: ``(n,)`` px from the centre of the middle pixel.
        y: likewise, downwards.
        light: ``(n,)``; rays that have none, or less, are left out.
    """
    height, width = (n // 2 for n in picture.shape)
    seen = (light > 0) & (np.abs(x) < width) & (np.abs(y) < height)
    x, y, light = x[seen], y[seen], light[seen]
    column, row = np.floor(x), np.floor(y)
    right, low = x - column, y - row
    # Sums over the few pixels that the rays reach, not over the whole picture.
    down, across = (int(np.abs(n).max(initial=0)) + 1 for n in (row, column))
    down, across = min(down, height), min(across, width)
    first = ((row + down) * (2 * across + 1) + column + across).astype(np.int64)
    window = np.zeros((2 * down + 1) * (2 * across + 1))
    for step, share in (
        (0, (1 - right) * (1 - low)),
        (1, right * (1 - low)),
        (2 * across + 1, (1 - right) * low),
        (2 * across + 2, right * low),
    ):
        window += np.bincount(first + step, share * light, len(window))
    part = picture[height - down : height + down + 1, width - across : width + across + 1]
    part += window.reshape(part.shape)


def cropped(picture: Array) -> Array:
    """A centred picture ``(C, h, w)`` without the borders that are zero in all channels, still centred."""
    y, x = (n // 2 for n in picture.shape[1:])
    rows, columns = np.nonzero((picture != 0).any(0))
    up, out = (int(np.abs(away).max(initial=0)) for away in (rows - y, columns - x))
    return picture[:, y - up : y + up + 1, x - out : x + out + 1]
