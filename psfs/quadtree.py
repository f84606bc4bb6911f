"""A quad tree of constant squares: the representation that LKS section 7.3 compares its sparse Laplacians with."""

import heapq
from typing import NamedTuple

import numpy as np

from torchbokeh.ops.checks import check_whole
from torchbokeh.psfs.arrays import Array
from torchbokeh.psfs.sparsify import NOISE, check_picture


class Square(NamedTuple):
    """A square of a tree, in pixels of the picture; it may reach beyond it."""

    top: int
    left: int
    side: int

    def seen(self, picture: Array) -> Array:
        """What it covers of ``(C, h, w)``, as a view."""
        rows, columns = (slice(max(start, 0), max(start + self.side, 0)) for start in (self.top, self.left))
        return picture[:, rows, columns]

    def quarters(self) -> list["Square"]:
        """The four squares of half its side."""
        half = self.side // 2
        return [Square(y, x, half) for y in (self.top, self.top + half) for x in (self.left, self.left + half)]


def quadtree(psf: Array, leaves: int) -> Array:
    """A PSF of constant squares: the one of the largest squared error is split in four, again and again.

    The root is the smallest square of a power of two that holds the PSF about its centre, where it is split. A square
    takes the mean of what it covers of the picture: no light is lost. Squares that are 0 need no value and do not
    count. A split that would add more squares than are left is passed over.

    Args:
        psf: ``(C, h, w)``, odd sizes, centred, >= 0.
        leaves: how many squares, >= 1.

    Returns:
        The picture of the squares, ``(C, h, w)``. There are fewer than ``leaves`` only if that is exact, or if every
        square that is not would be split in more parts than are left, 2 at most.

    Raises:
        ValueError: ``psf`` is no PSF, or ``leaves`` is below 1.

    Source: LKS section 7.3, "Laplacian Domain".

    Example:
        >>> quadtree(np.array([[[4.0, 1.0, 1.0], [2.0, 9.0, 9.0], [2.0, 9.0, 9.0]]]), 4)[0]
        array([[4., 1., 1.],
               [2., 9., 9.],
               [2., 9., 9.]])
    """
    out = np.zeros_like(psf)
    for square in tree(psf, leaves):
        square.seen(out)[:] = square.seen(psf).mean((1, 2), keepdims=True)
    return out


def tree(psf: Array, leaves: int) -> list[Square]:
    """The squares of a `quadtree` that are not 0."""
    check_picture("psf", psf, 3)
    check_whole("leaves", leaves, 1)
    height, width = psf.shape[1:]
    half = 1 << max(height // 2, width // 2).bit_length()
    root = Square(height // 2 - half, width // 2 - half, 2 * half)
    least = NOISE * psf.max()
    done: list[Square] = []
    waiting = [(-1.0, root)]  # by falling error
    while waiting:
        _, square = heapq.heappop(waiting)
        parts = [part for part in square.quarters() if (part.seen(psf) > least).any()]
        if np.ptp(square.seen(psf), (1, 2)).max() <= least or len(done) + len(waiting) + len(parts) > leaves:
            done.append(square)
            continue
        for part in parts:
            seen = part.seen(psf)
            error = ((seen - seen.mean((1, 2), keepdims=True)) ** 2).sum()
            heapq.heappush(waiting, (-float(error), part))
    return done
