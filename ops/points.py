"""Splatting tables of points: the *spreadlets* of Leimkühler et al., "Laplacian Kernel Splatting for Efficient
Depth-of-field and Motion Blur Synthesis or Reconstruction" (2018), sections 6.1 and 6.2.
"""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchbokeh.ops.checks import check_image, check_kind, check_pixels, check_size
from torchbokeh.ops.dispatch import compute_dtype, has_kernel, refuse_second, refuse_transforms
from torchbokeh.ops.spans import working_dtype

CHUNK = 1 << 20
"""Most points that the torch path expands at a time: about 0.5 GB of scratch for four channels."""

_MARGIN = 2  # rows and columns around the torch path's buffer that catch what lands outside


class PointTable(NamedTuple):
    """K point-spread functions as lists of points, one after the other (LKS section 6.1: P, V and C).

    Attributes:
        offsets: ``(P, 2)`` points as (dx, dy) in px from the centre of their PSF; y runs downwards.
        weights: ``(P,)`` what each point adds per unit of the pixel's value.
        counts: ``(K+1,)`` integers from 0 up to P; PSF ``i`` owns the points ``counts[i] .. counts[i+1]-1``.
    """

    offsets: Tensor
    weights: Tensor
    counts: Tensor


class Placement(NamedTuple):
    """Where the PSFs go: ``rotation``, ``position`` and ``pad`` of `splat_points`, as far as they are given."""

    rotation: Tensor | None
    position: Tensor | None
    pad: int


def splat_points(
    values: Tensor,
    index: Tensor,
    table: PointTable,
    *,
    pad: int,
    rotation: Tensor | None = None,
    position: Tensor | None = None,
    size: tuple[int, int] | None = None,
) -> Tensor:
    """Splat a PSF from a table for every pixel (LKS section 6.2).

    Each pixel adds ``value * weight`` at ``position + rotation @ offset + pad`` for all points of its PSF. A target
    between pixels is shared bilinearly by the four around it, so whole targets are exact. Points that land outside
    the padded buffer are dropped: pad by at least the reach of the PSFs, or a later integration smears what is
    missing over the image. Pixels whose values are all zero cost nothing.

    Args:
        values: ``(B, C, H, W)``, what each pixel spreads.
        index: ``(B, 1, H, W)`` integers, which PSF of the table each pixel takes.
        table: the PSFs.
        pad: width in px of the border that is added on all four sides.
        rotation: ``(B, 2, 2, H, W)`` matrices that turn (or scale) the offsets of each pixel. Default: none.
        position: ``(B, 2, H, W)`` where the centre of the PSF goes, x and y in px of the unpadded image, 0 being the
            centre of its first pixel. Default: the pixel itself. LKS calls this y'. Must be finite.
        size: ``(H', W')`` of the picture that is splatted into, where ``values`` are a list of pixels in any shape and
            ``position`` says where they go. Default: that of ``values``.

    Returns:
        ``(B, C, H' + 2 pad, W' + 2 pad)`` in the dtype of ``values`` (half precision is computed in float32).
        Differentiable to ``values``, ``offsets``, ``weights``, ``rotation`` and ``position``; at a whole target the
        derivative to its place is the one towards larger coordinates.

    Raises:
        TypeError: an argument has the wrong type or kind of dtype.
        ValueError: shapes or devices do not fit, ``pad`` is negative, ``counts`` does not run from 0 up to P,
            ``index`` points outside the table, or ``size`` comes without ``position``.

    Example:
        >>> import torch
        >>> from torchbokeh.ops.splat import PointTable, splat_points
        >>> plus = torch.tensor([[0.0, -1.0], [-1.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
        >>> table = PointTable(plus, torch.full((4,), 0.25), torch.tensor([0, 4]))
        >>> splat_points(torch.ones(1, 1, 1, 1), torch.zeros(1, 1, 1, 1, dtype=torch.int64), table, pad=1)[0, 0]
        tensor([[0.0000, 0.2500, 0.0000],
                [0.2500, 0.0000, 0.2500],
                [0.0000, 0.2500, 0.0000]])
    """
    b, _, h, w = check_image("values", values, ("B", "C", "H", "W")).shape
    check_image("index", index, (b, 1, h, w), like=values, integer=True)
    check_kind("table", table, PointTable)
    check_image("table.offsets", table.offsets, ("P", 2), like=values)
    check_image("table.weights", table.weights, (len(table.offsets),), like=values)
    check_image("table.counts", table.counts, ("K+1",), like=values, integer=True)
    if len(table.counts) == 0:
        raise ValueError("table.counts: expected at least the leading 0, got no entries")
    if rotation is not None:
        check_image("rotation", rotation, (b, 2, 2, h, w), like=values)
    if position is not None:
        check_image("position", position, (b, 2, h, w), like=values)
    if not isinstance(pad, int) or isinstance(pad, bool):
        raise TypeError(f"pad: expected an int, got {type(pad).__name__}")
    if pad < 0:
        raise ValueError(f"pad: expected 0 or more, got {pad}")
    if not torch.compiler.is_compiling():  # which may leave sizes open
        height, width = (h, w) if size is None else check_size(size)
        check_pixels("pad", height + 2 * pad, width + 2 * pad)
    if size is not None and position is None:
        raise ValueError("position: expected one beside size, got None")
    refuse_transforms("splat_points", values, table.offsets, table.weights, rotation, position)
    work = working_dtype(values.device)
    out = _splat_points_op(
        values.to(compute_dtype(values)),
        index.long(),
        [table.offsets, table.weights, table.counts.long()],
        None if rotation is None else rotation.to(work),
        None if position is None else position.to(work),
        pad,
        (h, w) if size is None else size,
    )
    return out.to(values.dtype)


def _check_contents(index: Tensor, points: Tensor, counts: Tensor) -> None:
    """What only the numbers tell. Runs inside the operator, so that compiled code is checked as well."""
    if not bool((counts[0] == 0) & (counts[-1] == len(points)) & (counts.diff() >= 0).all()):
        raise ValueError(f"table.counts: expected ascending numbers from 0 to {len(points)}, got {counts.tolist()}")
    if index.numel() == 0:
        return
    low, high = torch.stack(index.aminmax()).tolist()
    psfs = len(counts) - 1
    if low < 0 or high >= psfs:
        raise ValueError(f"index: expected 0 to {psfs - 1}, a PSF of the table, got {low} to {high}")


def flatten(t: Tensor) -> Tensor:
    """``(B, ..., H, W) -> (..., B*H*W)``."""
    return t.movedim(0, -3).reshape(*t.shape[1:-2], -1)


def unflatten(t: Tensor, like: Tensor) -> Tensor:
    """Undo `flatten`, in the shape and dtype of ``like``."""
    b, *inner, h, w = like.shape
    return t.reshape(*inner, b, h, w).movedim(-3, 0).to(like.dtype).contiguous()


def _flattened(placement: Placement) -> Placement:
    """The placement of flat pixels."""
    rotation, position = (None if t is None else flatten(t) for t in placement[:2])
    return Placement(rotation, position, placement.pad)


def _expand(index: Tensor, counts: Tensor, alive: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
    """For all points of the ``alive`` pixels ``(B*H*W,)``: the pixel and the number of the point in the table.

    They come in pieces of at most `CHUNK` points, or of a single pixel.
    """
    psf = index.reshape(-1)
    size = counts.diff()[psf]
    where = (alive & (size > 0)).nonzero()[:, 0]
    ends = size[where].cumsum(0)
    start, done = 0, 0
    while start < len(where):
        stop = max(int(torch.searchsorted(ends, done + CHUNK, right=True)), start + 1)
        piece = where[start:stop]
        n = size[piece]
        pixels = piece.repeat_interleave(n)
        first = counts[psf[piece]] - (n.cumsum(0) - n)
        yield pixels, first.repeat_interleave(n) + torch.arange(len(pixels), device=index.device)
        start, done = stop, int(ends[stop - 1])


def _targets(
    pixels: Tensor, offsets: Tensor, placement: Placement, source: torch.Size, size: Sequence[int]
) -> tuple[Tensor, Tensor, Tensor]:
    """For points at ``offsets`` from their ``pixels``: the upper left of four cells, and the shares right and down.

    ``pixels`` are flat indices into ``(B, H, W)`` with ``(H, W)`` the shape of the ``source``; the ``placement`` is
    flat as well, ``(2, 2, B*H*W)`` and ``(2, B*H*W)``. Cells are flat indices into the padded buffer with its margin.
    """
    rotation, position, pad = placement
    (rows, columns), (h, w) = source, size
    target = offsets.T
    if rotation is not None:
        target = (rotation.index_select(2, pixels) * target).sum(1)
    if position is not None:
        target = target + position.index_select(1, pixels)
    else:
        target = target + torch.stack([pixels % columns, pixels // columns % rows])
    x, y = target + pad
    column = x.floor().clamp(-_MARGIN, w + 2 * pad)
    row = y.floor().clamp(-_MARGIN, h + 2 * pad)
    padded, stride = h + 2 * (pad + _MARGIN), w + 2 * (pad + _MARGIN)
    cell = (pixels // (rows * columns) * padded + row.long() + _MARGIN) * stride + column.long() + _MARGIN
    return cell, x - column, y - row


def _splat_points_torch(
    values: Tensor, index: Tensor, points: Tensor, counts: Tensor, placement: Placement, size: Sequence[int]
) -> Tensor:
    b, c = values.shape[:2]
    rows, columns = (n + 2 * (placement.pad + _MARGIN) for n in size)
    work = working_dtype(values.device)
    flat, flat_placement = flatten(values).to(work), _flattened(placement)
    out = torch.zeros(c, b * rows * columns, dtype=work, device=values.device)
    for pixels, numbers in _expand(index, counts, (flat != 0).any(0)):
        here = points.index_select(0, numbers)
        cell, right, down = _targets(pixels, here[:, :2], flat_placement, values.shape[2:], size)
        source = flat.index_select(1, pixels) * here[:, 2]
        for step, share in (
            (0, (1 - down) * (1 - right)),
            (1, (1 - down) * right),
            (columns, down * (1 - right)),
            (columns + 1, down * right),
        ):
            if share.any():  # three of the four corners of whole targets get nothing
                out.index_add_(1, cell + step, source * share)
    inner = slice(_MARGIN, -_MARGIN)
    return out.reshape(c, b, rows, columns)[..., inner, inner].movedim(0, 1).to(values.dtype).contiguous()


def _gather_points_torch(
    grad: Tensor, values: Tensor, index: Tensor, points: Tensor, counts: Tensor, placement: Placement, geometry: bool
) -> list[Tensor]:
    """Gradients of ``values`` and, if ``geometry``, of ``points``, ``rotation`` and ``position`` as far as given.

    The splat is linear in the buffer, so this is the gradient of ``sum(value * weight * g(target))`` with ``g`` the
    incoming gradient, interpolated bilinearly.
    """
    size = [n - 2 * placement.pad for n in grad.shape[-2:]]
    stride = grad.shape[-1] + 2 * _MARGIN
    work = working_dtype(values.device)
    g = flatten(torch.nn.functional.pad(grad.to(work), (_MARGIN,) * 4))
    flat, flat_placement = flatten(values).to(work), _flattened(placement)
    turn, place, _ = flat_placement
    by_values, by_points = torch.zeros_like(flat), torch.zeros_like(points)
    by_turn, by_place = (None if t is None else torch.zeros_like(t) for t in (turn, place))
    for pixels, numbers in _expand(index, counts, torch.ones_like(index, dtype=torch.bool).reshape(-1)):
        here = points.index_select(0, numbers)
        offsets, weights = here[:, :2], here[:, 2]
        cell, right, down = _targets(pixels, offsets, flat_placement, values.shape[2:], size)
        a, b, c, d = (g.index_select(1, cell + step) for step in (0, 1, stride, stride + 1))
        upper, lower = a + right * (b - a), c + right * (d - c)
        mass = upper + down * (lower - upper)
        by_values.index_add_(1, pixels, weights * mass)
        if not geometry:
            continue
        value = flat.index_select(1, pixels)
        across = (value * (b - a + down * (d - c - b + a))).sum(0)
        along = (value * (lower - upper)).sum(0)
        move = weights * torch.stack([across, along])
        if by_place is not None:
            by_place.index_add_(1, pixels, move)
        if turn is not None and by_turn is not None:
            by_turn.index_add_(2, pixels, move[:, None] * offsets.T)
            move = (turn.index_select(2, pixels) * move[:, None]).sum(0)
        by_points.index_add_(0, numbers, torch.stack([*move, (value * mass).sum(0)], 1))
    grads = [unflatten(by_values, values)]
    if geometry:
        grads.append(by_points)
        frame = ((by_turn, placement.rotation), (by_place, placement.position))
        grads += [unflatten(t, like) for t, like in frame if t is not None and like is not None]
    return grads


def _packed(offsets: Tensor, weights: Tensor) -> Tensor:
    """Points ``(P, 3)``: dx, dy, weight. Made anew in each pass: what waits for the backward one is the table."""
    work = working_dtype(offsets.device)
    return torch.cat([offsets.to(work), weights.to(work)[:, None]], 1)


@torch.library.custom_op("torchbokeh::splat_points", mutates_args=())
def _splat_points_op(
    values: Tensor,
    index: Tensor,
    table: Sequence[Tensor],
    rotation: Tensor | None,
    position: Tensor | None,
    pad: int,
    size: Sequence[int],
) -> Tensor:
    offsets, weights, counts = table
    _check_contents(index, offsets, counts)
    points, placement = _packed(offsets, weights), Placement(rotation, position, pad)
    if has_kernel(values):
        from torchbokeh.ops.kernels import points as kernels

        return kernels.splat_points(values, index, points, counts, placement, size)
    return _splat_points_torch(values, index, points, counts, placement, size)


@_splat_points_op.register_fake
def _(values: Tensor, index: Tensor, *settings: Any) -> Tensor:
    *_, pad, size = settings
    return values.new_empty(*values.shape[:2], *(n + 2 * pad for n in size))


@torch.library.custom_op("torchbokeh::gather_points", mutates_args=())
def _gather_points_op(
    grad: Tensor,
    values: Tensor,
    index: Tensor,
    table: Sequence[Tensor],
    rotation: Tensor | None,
    position: Tensor | None,
    pad: int,
    geometry: bool,
) -> list[Tensor]:
    offsets, weights, counts = table
    points, placement = _packed(offsets, weights), Placement(rotation, position, pad)
    if has_kernel(values) and not geometry:
        from torchbokeh.ops.kernels import points as kernels

        return [kernels.gather_points(grad, index, points, counts, placement)]
    return _gather_points_torch(grad, values, index, points, counts, placement, geometry)


@_gather_points_op.register_fake
def _(grad: Tensor, values: Tensor, index: Tensor, table: Sequence[Tensor], *settings: Any) -> list[Tensor]:
    (offsets, weights, _), (rotation, position, _, geometry) = table, settings
    wanted = (values, _packed(offsets, weights), rotation, position) if geometry else (values,)
    return [torch.empty_like(t, memory_format=torch.contiguous_format) for t in wanted if t is not None]


def _points_setup(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    values, index, table, rotation, position, ctx.pad, _ = inputs
    ctx.save_for_backward(values, index, *table, rotation, position)


def _points_backward(ctx: Any, grad: Tensor) -> tuple[Any, ...]:
    values, index, *table, rotation, position = ctx.saved_tensors
    needs = ctx.needs_input_grad
    geometry = any(needs[2]) or needs[3] or needs[4]
    by_values, *found = _gather_points_op(grad, values, index, table, rotation, position, ctx.pad, geometry)
    return by_values, None, *_by_geometry(found, table, rotation, position), None, None


def _by_geometry(
    found: list[Tensor], table: Sequence[Tensor], rotation: Tensor | None, position: Tensor | None
) -> tuple[Any, ...]:
    """Gradients of ``table, rotation, position``, as far as `_gather_points_op` found any beside that of values."""
    if not found:
        return [None] * 3, None, None
    by_points, *rest = found
    by_rotation, by_position = (None if t is None else rest.pop(0) for t in (rotation, position))
    by_table = [by_points[:, :2].to(table[0].dtype), by_points[:, 2].to(table[1].dtype), None]
    return by_table, by_rotation, by_position


_splat_points_op.register_autograd(_points_backward, setup_context=_points_setup)


def _gather_setup(ctx: Any, inputs: tuple[Any, ...], output: list[Tensor]) -> None:
    grad, _, index, table, rotation, position, ctx.pad, _ = inputs
    ctx.save_for_backward(index, *table, rotation, position, grad)
    ctx.set_materialize_grads(False)


def _gather_backward(ctx: Any, grads: list[Tensor | None]) -> tuple[Any, ...]:
    """Of ``<grad, splat(by_values)>``, which is linear in both: the adjoint of the adjoint is the splat itself."""
    by_values, *others = grads
    refuse_second("splat_points", *others)
    if by_values is None:
        return *[None] * 3, [None] * 3, *[None] * 4
    index, *table, rotation, position, grad = ctx.saved_tensors
    size = [n - 2 * ctx.pad for n in grad.shape[-2:]]
    by_grad = _splat_points_op(by_values, index, table, rotation, position, ctx.pad, size)
    needs = ctx.needs_input_grad
    geometry = any(needs[3]) or needs[4] or needs[5]
    _, *found = _gather_points_op(grad, by_values, index, table, rotation, position, ctx.pad, geometry)
    return by_grad, None, None, *_by_geometry(found, table, rotation, position), None, None


_gather_points_op.register_autograd(_gather_backward, setup_context=_gather_setup)
