"""Splatting the slow and obvious way, in double: what `torchbokeh.ops.splat` is compared with."""

import math

import torch
from torch import Tensor

from torchbokeh.ops.checks import check_image, check_kind, check_whole
from torchbokeh.ops.outline import Arcs, arcs_of, crossings, edge_at
from torchbokeh.ops.points import PointTable
from torchbokeh.ops.spans import Profile, area, check_profile, clamp_radius, edge_integrals


def dense_spans(values: Tensor, coc: Tensor, profile: Profile) -> Tensor:
    """Blur with flat convex PSFs, pixel by pixel: `splat_spans(..., integrate=True)` without its differences.

    Every PSF is drawn row by row: each output pixel gets the share of the shape that covers it. Takes time and memory
    in proportion to ``B * H * W * W`` for each of ``2 H - 1`` rows.

    Args:
        values: ``(B, C, H, W)``.
        coc: ``(B, 1, H, W)`` signed radius in px.
        profile: the unit shape of the PSF.

    Returns:
        ``(B, C, H, W)``, float64.

    Raises:
        TypeError: an argument is not a floating-point tensor.
        ValueError: shapes or devices do not fit.

    Example:
        >>> import torch
        >>> from torchbokeh.ops.dense import dense_spans
        >>> from torchbokeh.psfs import Disc
        >>> dot = torch.zeros(1, 1, 9, 9); dot[..., 4, 4] = 1
        >>> round(dense_spans(dot, torch.full_like(dot, 3.0), Disc().profile()).sum().item(), 6)
        1.0
    """
    b, _, h, w = check_image("values", values, ("B", "C", "H", "W")).shape
    check_image("coc", coc, (b, 1, h, w), like=values)
    check_profile(profile, values)
    values = values.double()
    radius = clamp_radius(coc.double().reshape(-1))
    profile = Profile(profile.knots.double(), profile.bulge.double())
    arcs, out = arcs_of(profile), torch.zeros(b * h, w, values.shape[1], dtype=torch.float64, device=values.device)
    flat, where = values.movedim(1, 3).reshape(b * h * w, -1), torch.arange(b * h * w, device=values.device)
    borders = torch.arange(w + 1, device=values.device) - 0.5
    for row in range(1 - h, h):
        ends = ((row + radius.new_tensor([[-0.5], [0.5]])) / radius).sort(0).values
        low, high = ends.clamp(profile.knots[0, 0], profile.knots[-1, 0])
        seen = (where // w % h + row >= 0) & (where // w % h + row < h) & (high > low)
        pixel = where[seen]
        x = (borders - (pixel % w)[:, None]) / radius[pixel, None]
        left, right = (_area_before(x, low[pixel], high[pixel], profile, arcs, side) for side in (0, 1))
        share = (left - right).diff(dim=1).abs() / area(profile)
        out.index_add_(0, pixel // w + row, share[..., None] * flat[pixel, None])
    return out.reshape(b, h, w, -1).movedim(3, 1).contiguous()


def _area_before(x: Tensor, low: Tensor, high: Tensor, profile: Profile, arcs: Arcs, side: int) -> Tensor:
    """Area ``(N, M)`` from an edge of the unit shape (0: left, 1: right) to ``x (N, M)``, at ``low .. high`` in y."""
    low, high = (t[:, None].expand_as(x).reshape(-1) for t in (low, high))
    flat, crossed = x.reshape(-1), []
    # Between two heights, x is beyond the left edge, or before the right one.
    for arc, end in ((2 * side, 0), (2 * side + 1, 1)):
        number = torch.full_like(flat, arc, dtype=torch.int64)
        outer = arcs.ends[arc, end].expand_as(flat)
        edge = edge_at(profile, number, outer)
        further = flat > edge if side == 0 else flat < edge
        crossed.append(torch.where(further, outer, crossings(profile, arcs, number, flat)))
    lower, upper = torch.maximum(crossed[0], low), torch.minimum(crossed[1], high)
    upper = torch.maximum(lower, upper)

    def between(one: Tensor, other: Tensor) -> Tensor:
        edges = edge_integrals(profile, other) - edge_integrals(profile, one)
        return flat * (other - one) - edges[:, side]

    found = between(lower, upper) if side == 0 else between(low, high) - between(lower, upper)
    return found.reshape(x.shape)


def dense_points(
    values: Tensor,
    index: Tensor,
    table: PointTable,
    pad: int,
    rotation: Tensor | None = None,
    position: Tensor | None = None,
) -> Tensor:
    """`splat_points`, point by point in plain Python: for a few pixels only.

    Args:
        values: ``(B, C, H, W)``.
        index: ``(B, 1, H, W)`` integers, which PSF of the table each pixel takes.
        table: the PSFs.
        pad: width in px of the border that is added on all four sides.
        rotation: ``(B, 2, 2, H, W)`` matrices that turn the offsets.
        position: ``(B, 2, H, W)`` where the centre of the PSF goes, x and y in px of the unpadded image.

    Returns:
        ``(B, C, H + 2 pad, W + 2 pad)``, float64.

    Raises:
        TypeError: ``values`` is not a floating-point tensor or ``index`` not an integer one.
        ValueError: their shapes do not fit.

    Example:
        >>> import torch
        >>> from torchbokeh.ops.dense import dense_points
        >>> from torchbokeh.ops.points import PointTable
        >>> table = PointTable(torch.tensor([[0.5, 0.0]]), torch.ones(1), torch.tensor([0, 1]))
        >>> dense_points(torch.ones(1, 1, 1, 1), torch.zeros(1, 1, 1, 1, dtype=torch.int64), table, pad=1)[0, 0, 1]
        tensor([0.0000, 0.5000, 0.5000], dtype=torch.float64)
    """
    b, c, h, w = check_image("values", values, ("B", "C", "H", "W")).shape
    check_image("index", index, (b, 1, h, w), like=values, integer=True)
    check_kind("table", table, PointTable)
    check_whole("pad", pad, 0, 1 << 12)
    out = torch.zeros(b, c, h + 2 * pad, w + 2 * pad, dtype=torch.float64)
    for n, y, x in torch.cartesian_prod(torch.arange(b), torch.arange(h), torch.arange(w)).tolist():
        psf = int(index[n, 0, y, x])
        for k in range(int(table.counts[psf]), int(table.counts[psf + 1])):
            dx, dy = table.offsets[k].tolist()
            u, v = (float(x), float(y)) if position is None else position[n, :, y, x].tolist()
            if rotation is not None:
                dx, dy = (m[0] * dx + m[1] * dy for m in rotation[n, :, :, y, x].tolist())
            u, v = u + dx + pad, v + dy + pad
            i, j = math.floor(u), math.floor(v)
            f, g = u - i, v - j
            for row, column, share in (
                (j, i, (1 - f) * (1 - g)),
                (j, i + 1, f * (1 - g)),
                (j + 1, i, (1 - f) * g),
                (j + 1, i + 1, f * g),
            ):
                if 0 <= row < out.shape[2] and 0 <= column < out.shape[3]:
                    out[n, :, row, column] += values[n, :, y, x].double() * float(table.weights[k]) * share
    return out
