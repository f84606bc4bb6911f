"""The motion of a picture as callers pass it: a displacement, or several, one after the other."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from torchbokeh.bank_splatting import bank_of_motion
from torchbokeh.layers import Moving
from torchbokeh.ops._checks import check_image
from torchbokeh.ops._dispatch import compute_dtype

Motion = Tensor | Sequence[Tensor] | None

ADVANCE = {"centre": 0.0, "start": 0.5}
"""Moments of the exposure that a picture may show, and by how much of its motion the middle is ahead."""


def ways(motion: Motion) -> tuple[Tensor, ...]:
    """The displacements in equal parts of the exposure, in order."""
    if motion is None:
        return ()
    return (motion,) if isinstance(motion, Tensor) else tuple(motion)


def look_at_motion(image: Tensor, motion: Motion) -> tuple[float, tuple[float, float] | None]:
    """Check the motion; return the longest way in px, and the displacement that all pixels share, if they do.

    Raises:
        TypeError: it is no floating-point tensor, and no sequence of such.
        ValueError: a shape, device or value does not fit.
    """
    if motion is None:
        return 0.0, None
    if not isinstance(motion, Tensor | Sequence):
        raise TypeError(f"motion: expected a tensor, a sequence of tensors or None, got {type(motion).__name__}")
    found = ways(motion)
    if not found:
        raise ValueError("motion: expected at least one displacement, got an empty sequence")
    for way in found:
        check_image("motion", way, (*image.shape[:-3], 2, *image.shape[-2:]), like=image)
    if image.numel() == 0:
        return 0.0, None
    with torch.no_grad():
        length = torch.stack([way.square().sum(-3) for way in found]).sqrt().sum(0).max()
        low, high = found[0].movedim(-3, 0).flatten(1).aminmax(dim=1)
        longest, *ends = torch.cat([length[None], low, high]).tolist()
    if not math.isfinite(longest):
        bad = sum(int((~way.isfinite()).sum()) for way in found)
        raise ValueError(f"motion: expected finite values, got {bad} that are not")
    same = len(found) == 1 and ends[:2] == ends[2:]
    return longest, (ends[0], ends[1]) if same else None


def moving_picture(image: Tensor, motion: Motion, shutter: str, layer: int | None = None) -> Moving | None:
    """The motion as surfaces have it, of one layer where the maps are those of several; None for none."""
    found = [way if layer is None else way[:, layer] for way in ways(motion)]
    if not found:
        return None
    dtype = compute_dtype(image, *found)
    bank = bank_of_motion(image.device)
    return Moving.along([way.to(dtype) for way in found], bank, from_start=shutter == "start")
