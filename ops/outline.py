"""The outline of a flat PSF, cut where it crosses from one pixel into the next.

A PSF gives every pixel the share of it that the shape covers. Along a row, the differences of that are what the left
and the right edge leave behind: a piece of an edge that stays within one pixel counts by its height, in that column and
in the next, by its mean place between both. So the outline is cut at the borders of rows and of columns, and nothing is
lost: a disc is as exact along columns as it is along rows.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from torchbokeh.ops.spans import Profile, area, edge_integrals, edge_slopes, edges_at, piece_at

LEAST = 1e-12
"""Parts of the outline that are no higher, in units of the radius, are left out."""


class Arcs(NamedTuple):
    """The outline in four arcs, on each of which x only falls or only rises with y.

    These are the left edge down to its leftmost point and from there on, then the right edge up to its rightmost point
    and from there on. Left edges are convex: one of them falls first. Right edges are taken with the opposite sign.

    Attributes:
        ends: ``(4, 2)`` first and last y of each arc, in units of the radius.
        pieces: ``(4, 2)`` int64, the first and the last of the pieces between knots that it lies on.
        keys: ``(4 K,)``, ascending: x at the knots of each arc, so that one search finds a piece.
        offset: scalar tensor, the distance of the keys of two arcs.
    """

    ends: Tensor
    pieces: Tensor
    keys: Tensor
    offset: Tensor


class Pieces(NamedTuple):
    """Pieces of outlines, each within one column of one row.

    Attributes:
        owner: ``(M,)`` int64, whose outline it is.
        arc: ``(M,)`` int64, on which of its arcs, see `Arcs`.
        low: ``(M,)`` least y, in units of the signed radius.
        high: ``(M,)`` largest y.
        column: ``(M,)`` in the dtype of ``low``: the whole column it lies in; -1 left of the picture, W right of it.
    """

    owner: Tensor
    arc: Tensor
    low: Tensor
    high: Tensor
    column: Tensor


def _turned(x: Tensor, arc: Tensor) -> Tensor:
    """x of left edges as it is, of right edges with the opposite sign: in both cases a convex function of y."""
    return torch.where(arc < 2, x, -x)


def edge_at(profile: Profile, arc: Tensor, y: Tensor) -> Tensor:
    """x ``(M,)`` of the outline on the arcs ``arc (M,)`` at the heights ``y (M,)``."""
    left, right = edges_at(profile, y)
    return torch.where(arc < 2, left, right)


def arcs_of(profile: Profile) -> Arcs:
    """The arcs of a shape. No gradient runs through them: where an outline is cut changes nothing."""
    knots, bulge = (t.detach() for t in profile)
    bottom, top = knots[0, 0], knots[-1, 0]
    half, middle = 0.5 * (top - bottom), 0.5 * (top + bottom)
    ends, pieces, keys = [], [], []
    for side in (0, 2):
        # The extreme of each piece between knots, then of all.
        arc = torch.full((len(knots) - 1,), side, device=knots.device)
        tilt = _turned(edge_slopes(knots)[:, side // 2] * half, arc)
        extreme = middle - half * tilt / (tilt.square() + bulge.square()).sqrt().clamp_min(LEAST)
        extreme = torch.minimum(torch.maximum(extreme, knots[:-1, 0]), knots[1:, 0])
        turn = extreme[_turned(edge_at(Profile(knots, bulge), arc, extreme), arc).argmin()]
        # What is no higher than rounding is left out: the other arc then has to begin where the shape does.
        turn = torch.where(turn - bottom > LEAST, torch.where(top - turn > LEAST, turn, top), bottom)
        ends += [torch.stack([bottom, turn]), torch.stack([turn, top])]
        # The pieces just below and just above it.
        below = torch.searchsorted(knots[:, 0].contiguous(), turn) - 1
        pieces += [torch.stack([torch.zeros_like(below), below.clamp_min(0)])]
        above = piece_at(knots, turn)
        pieces += [torch.stack([above, torch.full_like(above, len(knots) - 2)])]
        arc = torch.full((len(knots),), side, device=knots.device)
        for sign, at in ((-1, knots[:, 0].clamp(max=turn)), (1, knots[:, 0].clamp(min=turn))):
            keys.append(sign * _turned(edge_at(Profile(knots, bulge), arc, at), arc))
    table = torch.stack(keys)
    offset = 2 * (table.amax() - table.amin()) + 1
    table = table + offset * torch.arange(4, device=knots.device)[:, None]
    return Arcs(torch.stack(ends), torch.stack(pieces), table.flatten().cummax(0).values, offset)


def crossings(profile: Profile, arcs: Arcs, arc: Tensor, x: Tensor) -> Tensor:
    """The heights y at which the arcs ``arc (M,)`` cross ``x (M,)``: where their edges turn if they lie all beyond it.

    What lies further than the first end of a falling or the last end of a rising edge is crossed anywhere.
    """
    knots, bulge = (t.detach() for t in profile)
    bottom, top = knots[0, 0], knots[-1, 0]
    half, middle = 0.5 * (top - bottom), 0.5 * (top + bottom)
    rising = 2 * (arc % 2) - 1
    signed = _turned(x, arc)
    key = rising * signed + arcs.offset * arc
    number = torch.searchsorted(arcs.keys, key, right=True) - 1
    turn = arcs.keys[arc * len(knots) + (len(knots) - 1) * (1 - arc % 2)]
    piece = torch.minimum(torch.maximum(number - arc * len(knots), arcs.pieces[arc, 0]), arcs.pieces[arc, 1])
    slope, start = edge_slopes(knots)[piece, arc // 2], knots[piece, 1 + arc // 2]
    # The line less the arc is x: `tilt * t - bulge * sqrt(1 - t²) = beyond`, with t from -1 to 1 over the height.
    tilt = _turned(slope * half, arc)
    beyond = signed - _turned(start + slope * (middle - knots[piece, 0]), arc)
    square = (tilt.square() + bulge.square()).clamp_min(LEAST**2)
    root = (square - beyond.square()).clamp_min(0).sqrt()
    y = middle + half * (tilt * beyond + rising * bulge * root) / square
    # A level piece has its x at any height: it must not leave its knots.
    y = torch.minimum(torch.maximum(y, knots[piece, 0]), knots[piece + 1, 0])
    y = torch.where(rising * key < rising * turn, arcs.ends[arc, 1 - arc % 2], y)
    return torch.minimum(torch.maximum(y, arcs.ends[arc, 0]), arcs.ends[arc, 1])


def row_pieces(coc: Tensor, x: Tensor, row: int, profile: Profile, arcs: Arcs, width: int) -> Pieces:
    """Cut the outlines of PSFs, in one image row, at the borders of columns.

    Args:
        coc: ``(N,)`` signed radii in px, not 0.
        x: ``(N,)`` where the centres lie, in px from the left border of the picture.
        row: offset of the image row from the centre of the PSF.
        profile: the unit shape, in the dtype of ``coc``.
        arcs: those of the shape.
        width: columns of the picture; the outline is not cut beyond it.

    Returns:
        All pieces that are not empty.
    """
    borders = (row + torch.tensor([[-0.5], [0.5]], dtype=coc.dtype, device=coc.device)) / coc
    borders = borders.sort(0).values
    low = torch.maximum(borders[0], arcs.ends[:, :1])
    high = torch.minimum(borders[1], arcs.ends[:, 1:])
    arc, owner = (high - low > LEAST).nonzero(as_tuple=True)
    low, high, radius, centre = low[arc, owner], high[arc, owner], coc[owner], x[owner]
    ends = (centre + radius * edge_at(profile, arc, y) for y in (low, high))
    first, last = (end.floor().clamp(-1, width) for end in ends)
    count = (last - first).abs() + 1
    most = int(count.max()) if len(count) else 0
    of, number = (torch.arange(most, device=coc.device) < count[:, None]).nonzero(as_tuple=True)
    step = (last - first).sign()[of]
    column = first[of] + step * number
    entered = column + (step < 0)
    cut = crossings(profile, arcs, arc[of], (entered - centre[of]) / radius[of])
    # As in `arcs_of`: what is left out is the beginning or the end of the piece beside it.
    cut = torch.where(cut - low[of] > LEAST, torch.where(high[of] - cut > LEAST, cut, high[of]), low[of])
    start = torch.where(number == 0, low[of], cut)
    stop = torch.where(number == count[of] - 1, high[of], start.roll(-1))
    return Pieces(owner[of], arc[of], start, stop, column)


def mean_edge(coc: Tensor, pieces: Pieces, profile: Profile) -> tuple[Tensor, Tensor]:
    """Mean place and weight of pieces.

    Args:
        coc: ``(M,)`` signed radius of the PSF of each piece, in px.
        pieces: from `row_pieces`.
        profile: the unit shape.

    Returns:
        The mean x ``(M,)`` in px from the centre of the PSF, and the height (px) divided by the area (px²) ``(M,)``.
    """
    height = pieces.high - pieces.low
    sides = edge_integrals(profile, pieces.high) - edge_integrals(profile, pieces.low)
    mean = sides.gather(1, pieces.arc[:, None] // 2)[:, 0] / height.clamp_min(LEAST)
    return coc * mean, height / (coc.abs() * area(profile))
