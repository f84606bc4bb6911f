"""Fill what is hidden, mix what is blurred, and put surfaces over one another.

Everything here is normalised by coverage: a colour is always a weighted mean of colours, so a constant picture stays
constant whatever the weights are, at silhouettes, between bins and at the image border.
"""

from collections.abc import Sequence
from itertools import pairwise
from numbers import Real

import torch
from torch import Tensor

from torchbokeh.ops.checks import check_image, check_number
from torchbokeh.ops.dispatch import only_definitions

TINY = 1e-12
"""Coverage below this counts as none; far below what one pixel of a PSF of radius 1e5 covers."""


def pull_push(values: Tensor, weight: Tensor) -> Tensor:
    """Fill holes smoothly from their surroundings (Gortler et al., "The Lumigraph", 1996, section 3.3.2).

    Pull: the known values are averaged over ever larger blocks. Push: on the way back, what a level lacks in weight
    is taken from the next coarser one, interpolated bilinearly. Blocks lie evenly in a picture of any size: a flipped
    or transposed picture is filled with the flipped or transposed values.

    Args:
        values: ``(B, C, H, W)``.
        weight: ``(B, 1, H, W)`` in [0, 1]: 1 keeps a value, 0 replaces it.

    Returns:
        ``(B, C, H, W)``, a weighted mean of known values everywhere; 0 where a whole picture has no weight.

    Raises:
        TypeError: an argument is not a floating-point tensor.
        ValueError: shapes or devices do not fit.

    Example:
        >>> import torch
        >>> hole = torch.ones(1, 1, 8, 8); hole[..., 2:5, 3:6] = 0
        >>> pull_push(torch.full((1, 3, 8, 8), 0.7), hole).unique().numel()
        1
    """
    b, _, h, w = check_image("values", values, ("B", "C", "H", "W")).shape
    check_image("weight", weight, (b, 1, h, w), like=values)
    return _pull_push_op(values, weight) if only_definitions() else _pull_push(values, weight)


def _halved(t: Tensor, dim: int) -> Tensor:
    """Sums of pairs along ``dim``, the same from both ends.

    Of an odd number, one in two is in the middle of a sum, and gives half of itself to both sides.
    """
    n = t.shape[dim]
    if n == 1:
        return t
    pieces: list[slice] = [slice(None)] * t.ndim
    first, second = (t[(*pieces[:dim], slice(k, None, 2))] for k in (0, 1))
    if n % 2 == 0:
        return first + second
    none, half = torch.zeros_like(t.narrow(dim, 0, 1)), 0.5 * second
    return first + (torch.cat([none, half], dim) + torch.cat([half, none], dim))


def _doubled(t: Tensor, dim: int, n: int) -> Tensor:
    """Back to ``n`` along ``dim``, interpolated linearly between the centres of what `_halved` has summed."""
    m = t.shape[dim]
    if n == 1:
        return t
    after = torch.cat([t.narrow(dim, 1, m - 1), t.narrow(dim, m - 1, 1)], dim)
    if n % 2:
        pair = [t, t + 0.5 * (after - t)]  # not lerp, which rounds by where threads divide the work
    else:
        before = torch.cat([t.narrow(dim, 0, 1), t.narrow(dim, 0, m - 1)], dim)
        pair = [t + 0.25 * (side - t) for side in (before, after)]
    return torch.stack(pair, dim + 1).flatten(dim, dim + 1).narrow(dim, 0, n)


def _pull_push(values: Tensor, weight: Tensor) -> Tensor:
    levels = [(values * weight, weight)]
    while max(levels[-1][1].shape[-2:]) > 1:
        known, share = (_halved(_halved(t, 2), 3) for t in levels[-1])
        full = share.clamp(max=1)
        levels.append((known * (full / share.clamp_min(TINY)), full))
    known, share = levels.pop()
    filled = known / share.clamp_min(TINY)
    for known, share in reversed(levels):
        up = _doubled(_doubled(filled, 2, known.shape[2]), 3, known.shape[3])
        filled = known + (1 - share) * up
    return filled


@torch.library.custom_op("torchbokeh::pull_push", mutates_args=())
def _pull_push_op(values: Tensor, weight: Tensor) -> Tensor:
    """What is exported as one operator, since the number of levels depends on the size; without a gradient."""
    return _pull_push(values, weight)


@_pull_push_op.register_fake
def _(values: Tensor, weight: Tensor) -> Tensor:
    return torch.empty_like(values, memory_format=torch.contiguous_format)


def check_centres(centres: object) -> None:
    """Raise an error unless ``centres`` are numbers, at least one."""
    if not isinstance(centres, Sequence) or not all(isinstance(c, Real) for c in centres):
        raise TypeError(f"centres: expected a sequence of numbers, got {centres!r}")
    if not centres:
        raise ValueError("centres: expected at least one, got none")


def fill_until_full(bins: Sequence[tuple[Tensor, Tensor]]) -> tuple[Tensor, Tensor]:
    """Mix the blurred bins of one surface, front to back, until a pixel is covered.

    The bins are parts of one surface, so their coverages add up before they occlude: a bin counts for what the bins
    in front of it have left free.

    Args:
        bins: pairs of a colour ``(B, C, H, W)``, weighted by coverage, and that coverage ``(B, 1, H, W)``.

    Returns:
        The mean colour ``(B, C, H, W)`` and the sum of all coverages ``(B, 1, H, W)``, which varying blur may raise
        above 1.

    Raises:
        TypeError: not pairs of floating-point tensors.
        ValueError: no bin, or shapes or devices that do not fit.
    """
    if not isinstance(bins, Sequence) or not all(isinstance(pair, tuple) and len(pair) == 2 for pair in bins):
        raise TypeError(f"bins: expected a sequence of pairs of tensors, got {type(bins).__name__}")
    if not bins:
        raise ValueError("bins: expected at least one, got none")
    b, _, h, w = check_image("bins", bins[0][0], ("B", "C", "H", "W")).shape
    for colour, coverage in bins:
        check_image("bins", colour, tuple(bins[0][0].shape), like=bins[0][0])
        check_image("bins", coverage, (b, 1, h, w), like=colour)
    mixed, total = (torch.zeros_like(t) for t in bins[0])
    taken = total
    for colour, coverage in bins:
        coverage = coverage.clamp_min(0)
        counts = torch.minimum(coverage, (1 - taken).clamp_min(0))
        mixed = mixed + colour * (counts / coverage.clamp_min(TINY))
        taken = taken + counts
        total = total + coverage
    return mixed / taken.clamp_min(TINY), total


def bin_weights(coc: Tensor, centres: Sequence[float], blend: float = 1.0) -> list[Tensor]:
    """Share of every pixel in every bin; the shares of a pixel sum to 1.

    Args:
        coc: ``(B, 1, H, W)`` signed radius in px.
        centres: evenly spaced centres of the bins in px of CoC.
        blend: how much of the way from one centre to the next pixels pass over on: with 1, the shares are hats.

    Returns:
        One ``(B, 1, H, W)`` for each centre.

    Raises:
        TypeError: an argument of the wrong kind.
        ValueError: a shape that does not fit, no centre, or ``blend`` out of its range.
    """
    check_image("coc", coc, ("B", 1, "H", "W"))
    check_centres(centres)
    check_number("blend", blend, 1e-6, 1e6)
    if len(centres) == 1:
        return [torch.ones_like(coc)]
    spacing, last = centres[1] - centres[0], len(centres) - 1
    if coc.requires_grad:
        # The outer bins lie at the smallest and the largest CoC of the scene and move with what has them, the sky say:
        # its shares do not change, so no gradient runs through them.
        place = (coc - centres[0]) / spacing
        coc = torch.where((place - 0.5 * last).abs() < 0.5 * last - 1e-4, coc, coc.detach())
    # What has passed on beyond each bin.
    slope = 1 / (spacing * blend)
    beyond = [coc.mul(slope).add_(0.5 - slope * (centres[0] + (k + 0.5) * spacing)).clamp_(0, 1) for k in range(last)]
    return [1 - beyond[0], *(a - b for a, b in pairwise(beyond)), beyond[-1]]
