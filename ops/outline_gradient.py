"""The gradient of `mean_edge` by hand: within an operator torch records no graph that could be followed back."""

import math

import torch
from torch import Tensor

from torchbokeh.ops.outline import LEAST, Pieces
from torchbokeh.ops.spans import FLAT, Profile, area, edge_slopes, knot_integrals, piece_at


def mean_edge_gradient(
    coc: Tensor, pieces: Pieces, profile: Profile, by_mean: Tensor, by_weight: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Pull gradients of the outputs of `mean_edge` back to its inputs.

    Where an outline is cut, pieces meet, and what one loses the other gains: cuts stay where they are in px. Only the
    ends of the shape move with it.

    Args:
        coc: ``(M,)`` as for `mean_edge`.
        pieces: as for `mean_edge`.
        profile: as for `mean_edge`.
        by_mean: ``(M,)`` gradient of the mean places.
        by_weight: ``(M,)`` gradient of the weights.

    Returns:
        Gradients of ``coc (M,)``, ``profile.knots (K, 3)`` and ``profile.bulge ()``.
    """
    knots, bulge = profile
    bottom, top = knots[0, 0], knots[-1, 0]
    half, middle = 0.5 * (top - bottom), 0.5 * (top + bottom)
    ends = torch.stack([pieces.low, pieces.high])
    inner = (ends > bottom) & (ends < top)
    height = pieces.high - pieces.low
    covered = height > LEAST
    safe = torch.where(covered, height, 1.0)
    left = (pieces.arc < 2)[:, None]
    chosen = torch.cat([left, ~left], 1).to(coc.dtype)
    side = torch.where(left[:, 0], -1.0, 1.0).to(coc.dtype)

    # At both ends: the edges (2, M, 2), their integrals, the semicircle and its integral.
    slopes, k = edge_slopes(knots), piece_at(knots, ends)
    dy = (ends - knots[k, 0])[..., None]
    edges = knots[k, 1:] + slopes[k] * dy
    integrals = knot_integrals(knots)[k] + dy * (knots[k, 1:] + 0.5 * slopes[k] * dy)
    t = (ends - middle) / half
    circle = (1 - t * t).clamp_min(0).sqrt()
    arcs = 0.5 * (t * circle + torch.atan2(t, circle))

    mean = ((integrals[1] - integrals[0]) * chosen).sum(1) / safe
    arc = half * (arcs[1] - arcs[0]) / safe
    unit_area = area(profile)

    # From the outputs to what they are made of: `coc * (mean -+ bulge * arc)` and `height / |coc| / area`.
    by_mean = torch.where(covered, by_mean, 0.0)
    by_weight = torch.where(covered, by_weight, 0.0)
    per_height = 1 / (coc.abs() * unit_area)
    by_coc = by_mean * (mean + side * bulge * arc) - by_weight * per_height * height / coc
    by_mean = by_mean * coc
    by_round = side * by_mean
    by_arc = bulge * by_round
    by_height = by_weight * per_height - (by_mean * mean + by_arc * arc) / safe
    by_area = -(by_weight * per_height * height).sum() / unit_area
    by_bulge = (by_round * arc).sum() + by_area * math.pi * half

    # To the ends of the pieces, and through them to the CoC or, where the shape ends, to that.
    sign = torch.tensor([[-1.0], [1.0]], dtype=coc.dtype, device=coc.device)
    by_integral = sign[..., None] * (by_mean / safe)[:, None] * chosen
    by_semicircle = sign * by_arc / safe
    by_ends = sign * by_height + (by_integral * edges).sum(2) + by_semicircle * circle
    by_coc = by_coc - (by_ends * inner * ends).sum(0) / coc
    by_half = (by_semicircle * (arcs - t * circle)).sum() + by_area * math.pi * bulge
    by_middle = -(by_semicircle * circle).sum()
    by_bottom = (by_ends * (ends <= bottom)).sum() + 0.5 * (by_middle - by_half)
    by_top = (by_ends * (ends >= top)).sum() + 0.5 * (by_middle + by_half)

    sides = torch.tensor([-1.0, 1.0], dtype=coc.dtype, device=coc.device)
    by_knots = _knots_gradient(knots, (k, dy, edges), by_integral, by_area * sides)
    by_knots[0, 0] += by_bottom
    by_knots[-1, 0] += by_top
    return by_coc, by_knots, by_bulge


def _knots_gradient(
    knots: Tensor, ends: tuple[Tensor, Tensor, Tensor], by_integral: Tensor, by_whole: Tensor
) -> Tensor:
    """Gradient of the knots by way of the integrals of the edges: up to both ends ``(2, N, 2)``, and whole ``(2,)``.

    The integral up to an end in piece k is ``before[k] + dy * (edge[k] + slope[k] * dy / 2)``. Of the ``ends``, these
    are k and ``dy``, and the edges there.
    """
    k, v, dy, edges = ends[0].reshape(-1), by_integral.reshape(-1, 2), ends[1].reshape(-1, 1), ends[2].reshape(-1, 2)
    rise, slopes = knots[1:, :1] - knots[:-1, :1], edge_slopes(knots)
    steep = rise > FLAT
    by_before = torch.zeros_like(knots[:, 1:]).index_add_(0, k, v)
    by_before[-1] += by_whole
    by_knots = torch.zeros_like(knots)
    by_knots[:, 1:].index_add_(0, k, v * dy)
    by_knots[:, 0].index_add_(0, k, -(v * edges).sum(1))
    by_slope = torch.zeros_like(slopes).index_add_(0, k, 0.5 * v * dy * dy)
    by_piece = by_before[1:].flip(0).cumsum(0).flip(0)
    by_run = torch.where(steep, by_slope / torch.where(steep, rise, 1.0), 0.0)
    by_rise = (0.5 * by_piece * (knots[1:, 1:] + knots[:-1, 1:]) - by_run * slopes).sum(1)
    by_knots[1:] += torch.cat([by_rise[:, None], 0.5 * by_piece * rise + by_run], 1)
    by_knots[:-1] += torch.cat([-by_rise[:, None], 0.5 * by_piece * rise - by_run], 1)
    return by_knots
