"""Operating points: how exact a blur is, and how fast."""

from collections.abc import Sequence
from numbers import Real
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from torchbokeh.ops.composite import TINY
from torchbokeh.ops.merge import Merging


class Quality(NamedTuple):
    """One operating point.

    Attributes:
        name: what to pass as ``quality``.
        merging: how far pixels are merged by radius, see `torchbokeh.ops.merge`; ``None`` for not at all.
        error: the largest relative L1 error against the exact splat, whatever the picture: one of 1,000 random scenes
            of dots, lines, lights, text, noise and photographs may have up to a half more.
        even: the same where light is spread evenly and radii vary smoothly.
        bins: most soft bins of a surface in a composition.
        subapertures: most pieces of the lens each way where hidden content is guessed, and where it is known.
        coarse: hidden content is filled in blocks of pixels; the foreground of a plain image is one bin.
    """

    name: str
    merging: Merging | None
    error: float
    even: float
    bins: int
    subapertures: tuple[int, int]
    coarse: bool


class Detail(NamedTuple):
    """How finely surfaces are splatted and composed.

    Attributes:
        merging: how far pixels are merged by radius; ``None``: not at all.
        highest: the coarsest level that they are merged on.
        coarse: fill what is hidden, and continue maps of surfaces to where these are not, in blocks of pixels.
    """

    merging: Merging | None = None
    highest: int = 0
    coarse: bool = False

    @property
    def in_blocks(self) -> int:
        """The coarsest level of a picture of blocks of 4 x 4 pixels."""
        return max(self.highest - 2, 0)


QUALITIES = (
    Quality("exact", None, 0.0, 0.0, 8, (2, 3), False),
    Quality("high", Merging(8.0, 0.005), 0.02, 0.005, 8, (2, 3), False),
    Quality("balanced", Merging(4.0, 0.015), 0.042, 0.009, 2, (1, 2), True),
    Quality("fast", Merging(2.5, 0.03), 0.09, 0.016, 2, (1, 1), True),
)
"""All operating points, from the most exact to the fastest."""

ROUNDING = 1e-3
"""Relative L1 error where nothing is merged: radii are rounded."""

NEIGHBOURHOOD = 32
"""Pixels of a block each way, against whose mean it is told how evenly light is spread."""

STEEP = 0.5
"""Difference in px of the radii of two neighbours, above which the radius does not vary smoothly."""


def check_quality(quality: object, tolerance: object) -> None:
    """Raise an error unless ``quality`` is a name of an operating point and ``tolerance`` a number above 0 or None."""
    names = [q.name for q in QUALITIES]
    if quality not in names:
        raise ValueError(f"quality: expected one of {', '.join(map(repr, names))}, got {quality!r}")
    if tolerance is None:
        return
    if not isinstance(tolerance, Real) or isinstance(tolerance, bool):
        raise TypeError(f"tolerance: expected a number or None, got {tolerance!r}")
    if not float(tolerance) >= 0:
        raise ValueError(f"tolerance: expected a relative error of at least 0, got {tolerance}")


def predict_errors(image: Tensor, coc: Tensor) -> list[Tensor]:
    """The relative L1 error that is expected of every operating point for a scene, the largest of a batch.

    What is merged is off by `Quality.even` where light is even and radii vary smoothly, and by up to `Quality.error`
    where the light stands out of its surroundings or radii jump: then errors of the light and of the coverage that it
    is divided by do not cancel.

    Args:
        image: ``(B, ..., H, W)``.
        coc: ``(B, ..., 1, H, W)`` signed radius in px; NaN where there is nothing.
    """
    magnitude = image.abs()
    light = (
        (magnitude / magnitude.amax().clamp_min(torch.finfo(image.dtype).tiny))
        .float()
        .mean(-3)
        .reshape(-1, 1, *image.shape[-2:])
    )
    radius = coc.float().reshape_as(light)
    total = light.sum((1, 2, 3)).clamp_min(TINY)
    uneven = (_spread(light) / total + _jumps(radius)).clamp(max=1)
    errors = []
    for point in QUALITIES:
        if point.merging is None:
            errors.append(light.new_zeros(()))
            continue
        wide = (radius.abs() >= 2 * point.merging.cells).float()
        share = torch.maximum((wide * light).sum((1, 2, 3)) / total, wide.mean((1, 2, 3)))
        # A wide PSF reaches beyond the pixels that are merged.
        off = (1.5 * share).clamp(max=1) * (point.even + (point.error - point.even) * uneven)
        errors.append(off.max() + ROUNDING)
    return errors


def _spread(light: Tensor) -> Tensor:
    """How much ``(B,)`` of the light ``(B, 1, H, W)`` stands out of its block: half the sum of what is off its mean."""
    border = (0, -light.shape[3] % NEIGHBOURHOOD, 0, -light.shape[2] % NEIGHBOURHOOD)
    here = F.pad(torch.ones_like(light), border)
    padded = F.pad(light, border)
    mean = F.avg_pool2d(padded, NEIGHBOURHOOD) / F.avg_pool2d(here, NEIGHBOURHOOD)
    mean = mean.repeat_interleave(NEIGHBOURHOOD, 2).repeat_interleave(NEIGHBOURHOOD, 3)
    return ((padded - mean).abs() * here).sum((1, 2, 3)) / 2


def _jumps(radius: Tensor) -> Tensor:
    """How steeply ``(B,)`` the radius changes beyond `STEEP`: in the mean over all pixels, both ways together."""
    steps = (radius.diff(dim=d).abs().sub(STEEP).clamp_min(0).nan_to_num(0.0) for d in (2, 3))
    return sum((step.sum((1, 2, 3)) for step in steps), radius.new_zeros(())) / radius[0].numel()


def choose(quality: str, tolerance: float | None, errors: Sequence[float], largest: float) -> tuple[Quality, float]:
    """The operating point, and a bound of its relative L1 error.

    Args:
        quality: the name of one, taken where ``tolerance`` is None.
        tolerance: the largest predicted error; the fastest point that keeps to it is taken.
        errors: those of `predict_errors`; not looked at without a tolerance.
        largest: radius in px.
    """
    if tolerance is not None:
        k = max(k for k, error in enumerate(errors) if error <= tolerance)
        return QUALITIES[k], errors[k]
    point = next(q for q in QUALITIES if q.name == quality)
    if point.merging is None:
        return point, 0.0
    return point, point.error if largest >= 2 * point.merging.cells else ROUNDING
