"""Shapes of flat convex point-spread functions.

A flat PSF is a convex shape, scaled by the circle of confusion and filled evenly: every pixel gets the share of it that
the shape covers. So its mass is exact for every radius, and it changes continuously with the CoC. How the shape is
taken apart into pixels stands in `torchbokeh.ops.outline`.
"""

import math
from itertools import pairwise
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchbokeh.ops.checks import check_image, check_kind, check_whole

MIN_RADIUS = 0.5
"""Below this radius (px) a PSF lies within its own pixel: the splat is the identity."""


class Profile(NamedTuple):
    """A convex unit shape: ``left(y) <= x <= right(y)`` for ``y`` between the first and the last knot.

    The edges run linearly from knot to knot; a semi-ellipse of half-width ``bulge`` over the whole height is
    taken off the left and added to the right edge. A polygon has ``bulge`` 0, an ellipse has two knots. The
    shape is scaled by the signed CoC, so a foreground PSF (negative CoC) is point-mirrored, as in a camera.

    Attributes:
        knots: ``(K, 3)`` rows ``(y, left, right)``, ascending in y, K >= 2, in units of the CoC radius.
        bulge: scalar tensor >= 0, in units of the CoC radius.
    """

    knots: Tensor
    bulge: Tensor


def working_dtype(device: torch.device) -> torch.dtype:
    """The dtype of geometry and running sums: double, where the device has it."""
    return torch.float32 if device.type == "mps" else torch.float64


def check_profile(profile: Profile, like: Tensor | None = None) -> None:
    """Raise an error unless ``profile`` is one, on the device of ``like``."""
    check_kind("profile", profile, Profile)
    check_image("profile.knots", profile.knots, ("K", 3), like=like)
    check_image("profile.bulge", profile.bulge, (), like=like)


class _Semicircle(torch.autograd.Function):
    """``∫_0^t sqrt(1 - u²) du`` for |t| <= 1; its derivative is finite where autograd's would not be."""

    @staticmethod
    def forward(t: Tensor) -> Tensor:
        height = (1 - t * t).clamp_min(0).sqrt()
        return 0.5 * (t * height + torch.atan2(t, height))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor], output: Tensor) -> None:
        ctx.save_for_backward(*inputs)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        (t,) = ctx.saved_tensors
        return grad * (1 - t * t).clamp_min(0).sqrt()


FLAT = 1e-9
"""Knots whose heights differ by no more are of equal height."""


def edge_slopes(knots: Tensor) -> Tensor:
    """Slopes ``(K-1, 2)`` of the left and right edge between the knots; 0 between knots of equal height."""
    rise = knots[1:, :1] - knots[:-1, :1]
    flat = rise <= FLAT
    return torch.where(flat, 0.0, (knots[1:, 1:] - knots[:-1, 1:]) / torch.where(flat, 1.0, rise))


def piece_at(knots: Tensor, y: Tensor) -> Tensor:
    """The numbers of the knots that the heights ``y`` lie above, from 0 to K-2: of the pieces of the edges there."""
    heights = knots[:, 0].detach().contiguous()
    return (torch.searchsorted(heights, y.detach().contiguous(), right=True) - 1).clamp(0, len(knots) - 2)


def knot_integrals(knots: Tensor) -> Tensor:
    """Integrals ``(K, 2)`` of the piecewise linear left and right edge from the first knot to each."""
    pieces = 0.5 * (knots[1:, 1:] + knots[:-1, 1:]) * (knots[1:, :1] - knots[:-1, :1])
    return torch.cat([torch.zeros_like(knots[:1, 1:]), pieces.cumsum(0)])


def area(profile: Profile) -> Tensor:
    """Area of the unit shape (the disc has pi)."""
    knots, bulge = profile
    left, right = knot_integrals(knots)[-1]
    return right - left + 0.5 * math.pi * bulge * (knots[-1, 0] - knots[0, 0])


def edge_integrals(profile: Profile, y: Tensor) -> Tensor:
    """Integrals ``(N, 2)`` of the left and the right edge from the first knot up to the heights ``y`` ``(N,)``."""
    knots, bulge = profile
    k = piece_at(knots, y)
    dy = (y - knots[k, 0])[:, None]
    straight = knot_integrals(knots)[k] + dy * (knots[k, 1:] + 0.5 * edge_slopes(knots)[k] * dy)
    bottom, top = knots[0, 0], knots[-1, 0]
    half, middle = 0.5 * (top - bottom), 0.5 * (top + bottom)
    arc = bulge * half * _Semicircle.apply((y - middle) / half)
    return straight + torch.stack([-arc, arc], 1)


def clamp_radius(coc: Tensor) -> Tensor:
    """Signed CoC with its radius raised to at least ``MIN_RADIUS`` (0 counts as positive)."""
    radius = coc.abs().clamp_min(MIN_RADIUS)
    return torch.where(coc < 0, -radius, radius)


def edges_at(profile: Profile, y: Tensor) -> tuple[Tensor, Tensor]:
    """Left and right edge of the unit shape at the heights ``y`` ``(N,)``, which lie between its knots."""
    knots, bulge = profile
    k = piece_at(knots, y)
    left, right = (knots[k, 1:] + edge_slopes(knots)[k] * (y - knots[k, 0])[:, None]).unbind(1)
    bottom, top = knots[0, 0], knots[-1, 0]
    t = (2 * y - bottom - top) / (top - bottom)
    arc = bulge * (1 - t * t).clamp_min(1e-30).sqrt()
    return left - arc, right + arc


def heights_above(profile: Profile, parts: Tensor, of: int = 1) -> Tensor:
    """Where ``(N,)`` in the height of the unit shape, from 0 to 1, so many ``parts (N,)`` ``of`` its area end."""
    bottom, top = profile.knots[0, 0], profile.knots[-1, 0]
    heights = torch.linspace(0, 1, 4097, dtype=profile.knots.dtype, device=profile.knots.device)
    left, right = edges_at(profile, bottom + (top - bottom) * heights)
    below = torch.cat([heights[:1], torch.cumulative_trapezoid(right - left, heights)])
    wanted = below[-1] * parts / of
    k = torch.searchsorted(below.detach(), wanted.detach(), right=True).clamp(1, len(below) - 1)
    part = (wanted - below[k - 1]) / (below[k] - below[k - 1]).clamp_min(1e-30)
    return torch.lerp(heights[k - 1], heights[k], part)


def subdivide(profile: Profile, side: int, samples: int = 48) -> list[Profile]:
    """Cut a shape into ``side * side`` pieces of equal area: sub-apertures, each with its own PSF.

    Cuts run along rows, and across at columns, so every piece is again convex and together they make up the shape.
    Curved edges become chains of ``samples`` chords.

    Args:
        profile: the whole shape.
        side: pieces per direction; 1 gives the shape itself, with nothing lost.
        samples: knots of each piece.

    Returns:
        The pieces, row by row. Their area is ``area(profile) / side**2`` to within 0.04 %.

    Raises:
        TypeError: an argument of the wrong kind.
        ValueError: ``side`` or ``samples`` is out of its range.
    """
    check_profile(profile)
    check_whole("side", side, 1, 256)
    check_whole("samples", samples, 2, 1 << 16)
    if side == 1:
        return [profile]
    bottom, top = profile.knots[0, 0], profile.knots[-1, 0]
    inner_cuts = heights_above(profile, torch.arange(1, side).to(profile.knots), side)
    cuts = torch.cat([bottom.new_zeros(1), inner_cuts, bottom.new_ones(1)])
    pieces = []
    for start, stop in pairwise(cuts):
        # Knots crowd towards the ends, as the edge of a disc turns there.
        t = 0.5 - 0.5 * torch.linspace(0, torch.pi, samples, dtype=cuts.dtype, device=cuts.device).cos()
        y = bottom + (top - bottom) * (start + (stop - start) * t)
        inner = profile.knots[1:-1, 0]
        y = torch.cat([y, inner[(inner > y[0]) & (inner < y[-1])]])
        y = y[y.detach().argsort()]
        left, right = edges_at(profile, y)
        columns = [_column_with(y, left, right, k / side) for k in range(1, side)]
        for one, other in pairwise([left.amin(), *columns, right.amax()]):
            edge = (t.maximum(one).minimum(other) for t in (left, right))
            pieces.append(Profile(torch.stack([y, *edge], 1), torch.zeros_like(profile.bulge)))
    return pieces


def _column_with(y: Tensor, left: Tensor, right: Tensor, share: float) -> Tensor:
    """The x that such a share of the area between two edges, given at the heights ``y``, is left of."""

    def beside(x: Tensor) -> Tensor:
        return torch.trapezoid(right.minimum(x) - left.minimum(x), y)

    wanted = share * torch.trapezoid(right - left, y)
    with torch.no_grad():
        low, high = left.amin(), right.amax()
        for _ in range(60):
            x = 0.5 * (low + high)
            low, high = torch.where(beside(x) < wanted, x, low), torch.where(beside(x) < wanted, high, x)
        width = torch.trapezoid(((left < x) & (x < right)).to(x), y).clamp_min(FLAT)
    return x - (beside(x) - wanted) / width  # hardly moves it, and lets gradients through
