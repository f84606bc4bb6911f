"""The motion of a picture as callers pass it: a displacement, or several, one after the other."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from torchbokeh.banks.splat import bank_of_motion
from torchbokeh.compose.surfaces import Moving
from torchbokeh.ops.checks import check_image
from torchbokeh.ops.dispatch import compute_dtype
from torchbokeh.ops.spans import working_dtype

Motion = Tensor | Sequence[Tensor] | None

ADVANCE = {"centre": 0.0, "start": 0.5}
"""Moments of the exposure that a picture may show, and by how much of its motion the middle is ahead."""


def ways(motion: Motion) -> tuple[Tensor, ...]:
    """The displacements in equal parts of the exposure, in order."""
    if motion is None:
        return ()
    return (motion,) if isinstance(motion, Tensor) else tuple(motion)


def check_motion(image: Tensor, motion: Motion) -> None:
    """Check the kind and the shape of a motion.

    Raises:
        TypeError: it is no floating-point tensor, and no sequence of such.
        ValueError: a shape or device does not fit.
    """
    if motion is not None and not isinstance(motion, Tensor | Sequence):
        raise TypeError(f"motion: expected a tensor, a sequence of tensors or None, got {type(motion).__name__}")
    found = ways(motion)
    if motion is not None and not found:
        raise ValueError("motion: expected at least one displacement, got an empty sequence")
    for way in found:
        check_image("motion", way, (*image.shape[:-3], 2, *image.shape[-2:]), like=image)


def look_at_motion(
    image: Tensor, motion: Motion, ends: Tensor | None = None
) -> tuple[float, tuple[float, float] | None, float]:
    """The longest way in px, the displacement that all pixels share, if they do, and the largest change of a radius.

    Args:
        image: the picture.
        motion: as `check_motion` found it good.
        ends: signed radius in px when the shutter opens and when it closes.

    Raises:
        ValueError: the motion is not finite.
    """
    found = ways(motion)
    if image.numel() == 0 or (not found and ends is None):
        return 0.0, None, 0.0
    with torch.no_grad():
        work = working_dtype(image.device)  # in half precision the square of 300 px is infinite already
        change = image.new_zeros(1) if ends is None else ends.diff(dim=-3).abs().max()[None]
        look = [change]
        if found:
            length = torch.stack([way.to(work).square().sum(-3) for way in found]).sqrt().sum(0).max()
            look += [length[None], *found[0].movedim(-3, 0).flatten(1).aminmax(dim=1)]
        numbers = torch.cat([t.to(image.device, work) for t in look]).tolist()
        change_by, longest, *limits = numbers if found else [*numbers, 0.0]
    if not math.isfinite(longest):
        bad = sum(int((~way.isfinite()).sum()) for way in found)
        raise ValueError(f"motion: expected finite values, got {bad} that are not")
    same = len(found) == 1 and limits[:2] == limits[2:]
    return longest, (limits[0], limits[1]) if same else None, change_by


def moving_picture(
    image: Tensor, motion: Motion, ends: Tensor | None, parts: int, shutter: str, layer: int | None = None
) -> Moving | None:
    """The motion as surfaces have it, of one layer where the maps are those of several; None for none.

    Args:
        image: the picture.
        motion: its motion.
        ends: signed CoC ``(..., 2, H, W)`` in px when the shutter opens and when it closes.
        parts: into how many each displacement is cut, where there are ends.
        shutter: one of `ADVANCE`.
        layer: which one.
    """
    found: Sequence[Tensor] = ways(motion)
    if not found and ends is None:
        return None
    if not found and ends is not None:
        found = [torch.zeros_like(ends)]
    dtype = compute_dtype(image, *found)

    def of(t: Tensor) -> Tensor:
        return (t if layer is None else t[:, layer]).to(dtype)

    cut = [of(way) / parts for way in found for _ in range(parts)]
    moving = Moving.along(cut, bank_of_motion(image.device), from_start=shutter == "start")
    return moving if ends is None else moving.approaching(of(ends))
