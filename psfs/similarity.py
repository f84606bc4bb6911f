"""How near a sparse PSF comes to the dense one."""

from typing import NamedTuple

import numpy as np

from torchbokeh.psfs.arrays import Array
from torchbokeh.psfs.model import FRAME

NEAR = 8
"""Pixels around a PSF that belong to its neighbourhood."""


class Score(NamedTuple):
    """Error of a PSF.

    Attributes:
        ssim: structural similarity in the neighbourhood of the PSF, both scaled by the dense one's maximum.
        ssim_frame: the same in the whole frame of `FRAME` pixels, as LKS takes it: what is empty counts as right.
        l1: sum of absolute differences over the sum of the dense one, in the neighbourhood.
    """

    ssim: float
    ssim_frame: float
    l1: float


def centred(picture: Array, size: tuple[int, int]) -> Array:
    """A centred picture ``(C, h, w)`` of odd sizes, cut or padded with zeros to others."""
    for axis, wanted in zip((1, 2), size, strict=True):
        have = picture.shape[axis]
        cut = max((have - wanted) // 2, 0)
        picture = np.take(picture, range(cut, have - cut), axis)
        add = max((wanted - have) // 2, 0)
        picture = np.pad(picture, [(add, add) if k == axis else (0, 0) for k in range(3)])
    return picture


def neighbourhood(psf: Array) -> tuple[int, int]:
    """Height and width of the neighbourhood of a PSF ``(C, h, w)``."""
    return psf.shape[1] + 2 * NEAR, psf.shape[2] + 2 * NEAR


def similarity(psf: Array, other: Array) -> float:
    """Structural similarity of two centred PSFs, in the size of ``other``: the mean over the channels."""
    from skimage.metrics import structural_similarity

    psf = centred(psf, other.shape[1:])
    top = psf.max(initial=1e-300)
    return float(structural_similarity(psf / top, other / top, data_range=1.0, channel_axis=0))


def score(psf: Array, near: Array) -> Score:
    """Compare a dense PSF ``(C, h, w)`` with what stands for it in its `neighbourhood`."""
    ssim = similarity(psf, near)
    frame = max(FRAME**2, near.shape[1] * near.shape[2])
    inner = near.shape[1] * near.shape[2]
    wanted = centred(psf, near.shape[1:])
    l1 = float(np.abs(near - wanted).sum() / wanted.sum())
    return Score(ssim, (ssim * inner + frame - inner) / frame, l1)
