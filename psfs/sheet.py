"""A contact sheet of a bank: what its samples look like."""

import numpy as np
import torch
from torch import Tensor

from torchbokeh.psfs.arrays import Array
from torchbokeh.psfs.bank import PsfBank
from torchbokeh.psfs.refit import drawn
from torchbokeh.psfs.represent import laplacian
from torchbokeh.psfs.similarity import centred, neighbourhood
from torchbokeh.psfs.table import integrated

GAP = 4
"""Pixels between the pictures."""

BRIGHT = 30.0
"""What is more than so many times as bright as the median is shown as bright as that."""

ERROR = 10.0
"""Factor of the error in the last column."""


def contact_sheet(bank: PsfBank, count: int, tile: int) -> Tensor:
    """Some samples, evenly chosen, one per row.

    Columns: the dense pre-filtered PSF; its Laplacian; the points that stand for it; what they integrate to; ten times
    the difference. Each row has its own scale: white is the maximum of the PSF, or `BRIGHT` times its median; in the
    other columns red is positive and blue negative.

    Args:
        bank: the bank.
        count: rows.
        tile: height and width of a picture in px.

    Returns:
        ``(1, 3, h, w)``, linear, in [0, 1].
    """
    numbers = np.unique(np.linspace(0, len(bank) - 1, count).round().astype(int))
    rows = [np.concatenate([_framed(p, tile) for p in _pictures(bank, int(k))], 2) for k in numbers]
    return torch.from_numpy(np.concatenate(rows, 1)).float()[None]


def _pictures(bank: PsfBank, number: int) -> list[Array]:
    """The five pictures ``(3, h, w)`` of a sample."""
    psf = bank.model.prefiltered(*bank.model.grid.box(number))
    represented = bank.sample(number)
    size = neighbourhood(psf)
    dense, near = centred(psf, size), integrated(represented, size)
    reach = int(np.abs(represented.sparse.points).max(initial=0))
    points = drawn(represented.sparse, (reach, reach))
    top = _white_point(dense)
    return [
        _white(dense / top),
        _signed(centred(laplacian(psf), size)),
        _signed(centred(points, size)),
        _white(near / top),
        _signed((near - dense) / top * ERROR, 1.0),
    ]


def _white_point(picture: Array) -> float:
    """The largest value, unless it outshines the rest, as the light in the middle of a glow does."""
    return float(min(picture.max(), BRIGHT * np.median(picture[picture > 0])))


def _white(picture: Array) -> Array:
    return np.broadcast_to(np.clip(picture, 0, 1), (3, *picture.shape[1:]))


def _signed(picture: Array, top: float | None = None) -> Array:
    """Red above 0, blue below, square roots so that small values are seen."""
    mean = picture.mean(0)
    strength = np.clip(np.abs(mean) / (top or _white_point(np.abs(mean))), 0, 1) ** 0.5
    return np.stack([np.where(mean > 0, strength, 0), 0.3 * strength, np.where(mean < 0, strength, 0)])


def _framed(picture: Array, tile: int) -> Array:
    """Scaled to fit a tile, keeping its proportions and the largest value of each block: single points stay visible."""
    height, width = picture.shape[1:]
    side = max(height, width)
    square = centred(picture, (side | 1, side | 1))[:, :side, :side]
    pixel = (np.arange(tile) * side) // tile
    if side <= tile:
        out = square[:, pixel][:, :, pixel]
    else:
        out = np.maximum.reduceat(np.maximum.reduceat(square, pixel, 1), pixel, 2)
    return np.pad(out, ((0, 0), (0, GAP), (0, GAP)), constant_values=0.2)
