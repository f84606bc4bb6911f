"""Operating points: how exact a blur is, and how fast."""

from collections.abc import Sequence
from numbers import Real
from typing import NamedTuple

import torch
from torch import Tensor

from torchbokeh.ops.merge import Merging


class Quality(NamedTuple):
    """One operating point.

    Attributes:
        name: what to pass as ``quality``.
        merging: how far pixels are merged by radius, see `torchbokeh.ops.merge`; ``None`` for not at all.
        error: the largest relative L1 error against the exact splat that was seen on the procedural recipes, at radii
            from 12 to 80 px. `torchbokeh report` measures it anew.
        bins: most soft bins of a surface in a composition.
        subapertures: most pieces of the lens each way where hidden content is guessed, and where it is known.
        coarse: hidden content is filled in blocks of pixels; the foreground of a plain image is one bin.
    """

    name: str
    merging: Merging | None
    error: float
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
    Quality("exact", None, 0.0, 8, (2, 3), False),
    Quality("high", Merging(8.0, 0.005), 0.006, 8, (2, 3), False),
    Quality("balanced", Merging(4.0, 0.015), 0.019, 2, (1, 2), True),
    Quality("fast", Merging(2.5, 0.03), 0.033, 2, (1, 1), True),
)
"""All operating points, from the most exact to the fastest."""


ROUNDING = 5e-4
"""Relative L1 error where nothing is merged: radii are rounded to 1/64 px."""


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


def merged_shares(coc: Tensor, quality: str, tolerance: float | None, there: Tensor | None = None) -> list[Tensor]:
    """Share of the pixels of ``coc`` whose radius is large enough to be merged, for every operating point.

    Those that `choose` will not look at are left out, as 0; so are pixels that ``there`` says are not.
    """
    radius = coc.abs()
    count: Tensor | int = radius.numel()
    if there is not None:
        radius, count = torch.where(there, radius, 0.0), there.sum().clamp_min(1)
    shares = []
    for point in QUALITIES:
        if point.merging is None or (tolerance is None and point.name != quality):
            shares.append(radius.new_zeros(()))
        else:
            shares.append((radius >= 2 * point.merging.cells).sum() / count)
    return shares


def choose(quality: str, tolerance: float | None, shares: Sequence[float]) -> tuple[Quality, float]:
    """The operating point, and its predicted relative L1 error for a scene.

    Args:
        quality: the name of one, taken where ``tolerance`` is None.
        tolerance: the largest predicted error; the fastest point that keeps to it is taken.
        shares: those of `merged_shares`: what is not merged has no error but that of `ROUNDING`.
    """
    predicted = [
        0.0 if q.merging is None else max(q.error * share, ROUNDING) for q, share in zip(QUALITIES, shares, strict=True)
    ]
    if tolerance is None:
        k = [q.name for q in QUALITIES].index(quality)
    else:
        k = max(k for k, error in enumerate(predicted) if error <= tolerance)
    return QUALITIES[k], predicted[k]
