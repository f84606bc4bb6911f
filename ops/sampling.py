"""Points spread evenly over a lens, the open shutter and a pixel."""

import torch
from torch import Tensor

from torchbokeh.ops.checks import check_image, check_whole
from torchbokeh.ops.spans import Profile, check_profile, edges_at, heights_above

MOST = 1 << 24
"""Points of a run of `halton`, and index of its first one, at most."""

DIMENSIONS = 6
"""Columns of `halton`: bases 2, 3, 5, 7, 11, 13."""


def halton(count: int, *, first: int = 0, seed: int | None = None) -> Tensor:
    """Points ``first`` to ``first + count`` of the Halton sequence in bases 2, 3, 5, 7, 11 and 13.

    Any run of consecutive points is spread evenly by itself. The point at the origin is left out.

    Args:
        count: how many points, >= 0.
        first: index of the first of them, >= 0.
        seed: turn the sequence by a random amount in every dimension (Cranley and Patterson, 1976), for points that
            are as even and independent of the plain ones; ``None`` for the plain ones.

    Returns:
        ``(count, 6)`` in [0, 1), double.

    Raises:
        TypeError: not an int.
        ValueError: a number out of its range.

    Example:
        >>> halton(2)[:, 0].tolist()
        [0.5, 0.25]
    """
    check_whole("count", count, 0, MOST)
    check_whole("first", first, 0, MOST)  # SciPy makes all that come before
    if seed is not None:
        check_whole("seed", seed, 0, (1 << 62) - 1)
    if count == 0:
        return torch.zeros(0, DIMENSIONS, dtype=torch.float64)
    from scipy.stats import qmc

    sequence = qmc.Halton(DIMENSIONS, scramble=False)
    sequence.fast_forward(first + 1)
    points = torch.from_numpy(sequence.random(count))
    if seed is not None:
        points = points + torch.rand(DIMENSIONS, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return points.remainder(1)


def aperture_points(profile: Profile, square: Tensor) -> Tensor:
    """Map the unit square to an aperture so that equal areas stay equal.

    Ellipses, and so the disc, take the polar map ``(sqrt(u), 2 pi v)``. Any other shape is swept row by row: u picks
    the row, by the area above it, and v the place from its left to its right edge.

    Args:
        profile: the unit shape.
        square: ``(N, 2)`` points (u, v) in [0, 1).

    Returns:
        ``(N, 2)`` points (x, y) in units of the aperture radius, in the dtype of the profile.

    Raises:
        TypeError: ``profile`` is no `Profile`, or ``square`` not a floating-point tensor.
        ValueError: ``square`` is not of shape ``(N, 2)``.

    Example:
        >>> import torch
        >>> from torchbokeh.psfs import Disc
        >>> aperture_points(Disc().profile(), torch.tensor([[0.25, 0.0]])).tolist()
        [[0.5, 0.0]]
    """
    check_profile(profile)
    check_image("square", square, ("N", 2))
    u, v = square.to(profile.knots).unbind(1)
    bottom, top = profile.knots[0, 0], profile.knots[-1, 0]
    if len(profile.knots) == 2 and bool((profile.knots[:, 1] == profile.knots[:, 2]).all()):
        across, along = u.sqrt() * (2 * torch.pi * v).cos(), u.sqrt() * (2 * torch.pi * v).sin()
        middle = torch.lerp(profile.knots[0, 1], profile.knots[1, 1], 0.5 + 0.5 * along)
        return torch.stack([middle + profile.bulge * across, torch.lerp(bottom, top, 0.5 + 0.5 * along)], 1)
    y = bottom + (top - bottom) * heights_above(profile, u)
    left, right = edges_at(profile, y)
    return torch.stack([torch.lerp(left, right, v), y], 1)


def stratified(points: Tensor) -> Tensor:
    """Replace numbers by the middles of equal strata of [0, 1) in the same order: exactly one in each.

    Args:
        points: ``(N,)``.

    Example:
        >>> stratified(torch.tensor([0.9, 0.1])).tolist()
        [0.75, 0.25]
    """
    check_image("points", points, ("N",))
    rank = points.argsort(stable=True).argsort(stable=True)
    return (rank.to(points.dtype) + 0.5) / max(len(points), 1)
