"""Splatting: every source pixel adds its point-spread function to a buffer.

Two kinds of PSFs. `splat_spans` draws flat convex shapes by their outline, exact and in closed form;
`splat_points` draws tables of points, the *spreadlets* of Leimkühler et al., "Laplacian Kernel Splatting for
Efficient Depth-of-field and Motion Blur Synthesis or Reconstruction" (2018), section 6.

The torch functions here are the definition, on any device and in any floating-point dtype. On CPU in float32 the
numba kernels of the same functions take over when numba is installed (``pip install torchbokeh[cpu]``). Both
stand behind one custom operator each, whose backward pass is the adjoint gather: no graph over the points is
ever built.
"""

from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchbokeh.ops.checks import check_flag, check_image
from torchbokeh.ops.dispatch import compute_dtype, has_kernel, refuse_second, refuse_transforms
from torchbokeh.ops.outline import Arcs, Pieces, arcs_of, mean_edge, row_pieces
from torchbokeh.ops.outline_gradient import mean_edge_gradient
from torchbokeh.ops.points import PointTable, flatten, splat_points, unflatten
from torchbokeh.ops.spans import MIN_RADIUS, Profile, check_profile, clamp_radius, working_dtype

__all__ = ["PointTable", "splat_points", "splat_spans"]


def splat_spans(values: Tensor, coc: Tensor, profile: Profile, *, integrate: bool = False) -> Tensor:
    """Splat flat convex PSFs by their outlines: differences where a row begins and ends, for any radius.

    Every pixel gets the share of the shape that covers it, so that a disc is the same along rows and along columns.

    The result is the derivative along x of the blurred image; the running sum along x
    (`torchbokeh.ops.integrate.running_sum_x`) is its inverse. Intervals are cut at the image border, where the
    sum starts, so no padding is needed and nothing that matters is lost: the cost of a pixel is bounded by the
    number of image rows, and there is no cap on the radius.

    Args:
        values: ``(B, C, H, W)``, what each pixel spreads.
        coc: ``(B, 1, H, W)`` signed radius in px; radii below 0.5 give the identity. Must be finite.
        profile: the unit shape of the PSF, see `torchbokeh.psfs.aperture`.
        integrate: return the blurred image itself. The sum is then taken in double before it is rounded, so
            that a pixel of 1e6 leaves no trace on its row.

    Returns:
        ``(B, C, H, W)`` in the common dtype of ``values`` and ``coc`` (half precision is computed in float32
        and returned in the dtype of ``values``). Differentiable to ``values``, ``coc`` and ``profile``.

    Raises:
        TypeError: an argument is not a floating-point tensor.
        ValueError: shapes or devices do not fit.

    Example:
        >>> import torch
        >>> from torchbokeh.ops.splat import splat_spans
        >>> from torchbokeh.psfs import Disc
        >>> dot = torch.zeros(1, 1, 65, 65); dot[..., 32, 32] = 1
        >>> disc = splat_spans(dot, torch.full_like(dot, 20.0), Disc().profile(), integrate=True)
        >>> round(disc.sum().item(), 4)
        1.0
    """
    b, _, h, w = check_image("values", values, ("B", "C", "H", "W")).shape
    check_image("coc", coc, (b, 1, h, w), like=values)
    check_profile(profile, values)
    check_flag("integrate", integrate)
    refuse_transforms("splat_spans", values, coc, *profile)
    dtype = compute_dtype(values, coc)
    work = working_dtype(values.device)
    source, radius = values.to(dtype), coc.to(dtype)
    if values.numel():
        out = _splat_spans_op(source, radius, profile.knots.to(work), profile.bulge.to(work), integrate)
    else:
        out = source * radius
    return out.to(values.dtype) if dtype != values.dtype and values.dtype.itemsize < 4 else out


class _Ends(NamedTuple):
    """What the PSFs of flat ``(B, H, W)`` images leave in one row, as differences along x.

    Attributes:
        pieces: of their outlines, whose owners are pixels.
        column: flat index ``(M,)`` of the column of each piece in a ``(B, H, W+2)`` buffer.
        part: share ``(M,)`` of the next column.
        moves: whether ``(M,)`` the piece lies within the image.
        weight: ``(M,)``, positive for the left end of a row.
    """

    pieces: Pieces
    column: Tensor
    part: Tensor
    moves: Tensor
    weight: Tensor


def _row_ends(coc: Tensor, row: int, profile: Profile, arcs: Arcs, size: tuple[int, int]) -> _Ends:
    """The differences of one row of the PSFs of all pixels of flat ``(B, H, W)`` images where it can be seen."""
    h, w = size
    where = torch.arange(len(coc), device=coc.device)
    y = where // w % h
    pixels = where[(y + row >= 0) & (y + row < h) & (coc.abs() + 1 > abs(row))]
    pieces = row_pieces(coc[pixels], pixels % w + 0.5, row, profile, arcs, w)
    pieces = pieces._replace(owner=pixels[pieces.owner])
    radius, x = coc[pieces.owner], pieces.owner % w + 0.5
    mean, weight = mean_edge(radius, pieces, profile)
    column = pieces.column.clamp_min(0)
    moves = (pieces.column >= 0) & (pieces.column < w)
    part = torch.where(moves, (x + mean - column).clamp(0, 1), 0.0)
    left = (pieces.arc < 2) == (radius > 0)
    column = (pieces.owner // w + row) * (w + 2) + column.long()
    return _Ends(pieces, column, part, moves, torch.where(left, weight, -weight))


def _splat_spans_torch(values: Tensor, coc: Tensor, profile: Profile, integrate: bool) -> Tensor:
    b, c, h, w = values.shape
    work = working_dtype(values.device)
    flat = flatten(values).to(work)
    radius, arcs = clamp_radius(coc.reshape(-1).to(work)), arcs_of(profile)
    out = torch.zeros(c, b * h * (w + 2), dtype=work, device=values.device)
    for row in _rows(radius, h):
        ends = _row_ends(radius, row, profile, arcs, (h, w))
        share = flat.index_select(1, ends.pieces.owner) * ends.weight
        out.index_add_(1, ends.column, share * (1 - ends.part))
        out.index_add_(1, ends.column + 1, share * ends.part)
    out = out.reshape(c, b, h, w + 2)[..., :w].movedim(0, 1)
    return (out.cumsum(-1) if integrate else out).to(values.dtype).contiguous()


def _rows(radius: Tensor, height: int) -> range:
    """Row offsets that any PSF of these radii reaches within an image of this height."""
    if radius.numel() == 0:
        return range(0)
    n = int(min(radius.abs().max().item() + 1, height - 1))
    return range(-n, n + 1)


def _gather_spans_torch(grad: Tensor, values: Tensor, coc: Tensor, profile: Profile) -> list[Tensor]:
    """Gradients of ``values, coc, knots, bulge``; ``grad`` is that of the differences.

    The splat is linear in the buffer, so its backward pass is the gradient of ``sum(value * weight * g(end))`` over the
    pieces of all outlines, with ``g`` the incoming gradient, interpolated linearly.
    """
    h, w = values.shape[2:]
    work = working_dtype(values.device)
    g = flatten(torch.nn.functional.pad(grad.to(work), (0, 2)))
    flat = flatten(values).to(work)
    radius, arcs = clamp_radius(coc.reshape(-1).to(work)), arcs_of(profile)
    by_values, by_coc = torch.zeros_like(flat), torch.zeros_like(radius)
    by_knots, by_bulge = torch.zeros_like(profile.knots), torch.zeros_like(profile.bulge)
    for row in _rows(radius, h):
        ends = _row_ends(radius, row, profile, arcs, (h, w))
        owner = ends.pieces.owner
        value = flat.index_select(1, owner)
        here = g.index_select(1, ends.column)
        slope = g.index_select(1, ends.column + 1) - here
        here = here + ends.part * slope
        by_values.index_add_(1, owner, ends.weight * here)
        by_mean = ends.moves * ends.weight * (value * slope).sum(0)
        by_weight = ends.weight.sign() * (value * here).sum(0)
        by_row = mean_edge_gradient(radius[owner], ends.pieces, profile, by_mean, by_weight)
        by_coc.index_add_(0, owner, by_row[0])
        by_knots += by_row[1]
        by_bulge += by_row[2]
    by_coc = by_coc.reshape(coc.shape) * (coc.abs() > MIN_RADIUS)
    return [unflatten(by_values, values), by_coc.to(coc.dtype), by_knots, by_bulge]


@torch.library.custom_op("torchbokeh::splat_spans", mutates_args=())
def _splat_spans_op(values: Tensor, coc: Tensor, knots: Tensor, bulge: Tensor, integrate: bool) -> Tensor:
    profile = Profile(knots, bulge)
    if has_kernel(values):
        from torchbokeh.ops.kernels import splat as kernels

        return kernels.splat_spans(values, coc, profile, integrate)
    return _splat_spans_torch(values, coc, profile, integrate)


@_splat_spans_op.register_fake
def _(values: Tensor, coc: Tensor, knots: Tensor, bulge: Tensor, integrate: bool) -> Tensor:
    return torch.empty_like(values, memory_format=torch.contiguous_format)


@torch.library.custom_op("torchbokeh::gather_spans", mutates_args=())
def _gather_spans_op(
    grad: Tensor, values: Tensor, coc: Tensor, knots: Tensor, bulge: Tensor, shape: bool
) -> list[Tensor]:
    profile = Profile(knots, bulge)
    if has_kernel(values) and not shape:
        from torchbokeh.ops.kernels import splat as kernels

        grads = kernels.gather_spans(grad, values, coc, profile)
        return [*grads, torch.zeros_like(knots), torch.zeros_like(bulge)]
    return _gather_spans_torch(grad, values, coc, profile)


@_gather_spans_op.register_fake
def _(grad: Tensor, values: Tensor, coc: Tensor, knots: Tensor, bulge: Tensor, shape: bool) -> list[Tensor]:
    like = torch.contiguous_format
    return [torch.empty_like(t, memory_format=like) for t in (values, coc, knots, bulge)]


def _spans_setup(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    *tensors, ctx.integrate = inputs
    ctx.save_for_backward(*tensors)


def _spans_backward(ctx: Any, grad: Tensor) -> tuple[Any, ...]:
    if ctx.integrate:  # the adjoint of a running sum runs from the other end
        grad = grad.to(working_dtype(grad.device)).flip(-1).cumsum(-1).flip(-1)
    shape = any(ctx.needs_input_grad[2:4])
    return (*_gather_spans_op(grad, *ctx.saved_tensors, shape), None)


_splat_spans_op.register_autograd(_spans_backward, setup_context=_spans_setup)


def _gather_setup(ctx: Any, inputs: tuple[Any, ...], output: list[Tensor]) -> None:
    ctx.save_for_backward(inputs[0], *inputs[2:5])
    ctx.set_materialize_grads(False)


def _gather_backward(ctx: Any, grads: list[Tensor | None]) -> tuple[Any, ...]:
    """Of ``<grad, splat(by_values)>``, which is linear in both: the adjoint of the adjoint is the splat itself."""
    by_values, *others = grads
    refuse_second("splat_spans", *others)
    if by_values is None:
        return (None,) * 6
    grad, *shape = ctx.saved_tensors
    _, *by_shape = _gather_spans_op(grad, by_values, *shape, any(ctx.needs_input_grad[3:5]))
    return _splat_spans_op(by_values, *shape, False), None, *by_shape, None


_gather_spans_op.register_autograd(_gather_backward, setup_context=_gather_setup)
