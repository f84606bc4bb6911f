"""Splatting: every source pixel adds its point-spread function to a buffer.

Two kinds of PSFs. `splat_spans` draws flat convex shapes by the two ends of each row, exact and in closed form;
`splat_points` draws tables of points, the *spreadlets* of Leimkühler et al., "Laplacian Kernel Splatting for
Efficient Depth-of-field and Motion Blur Synthesis or Reconstruction" (2018), section 6.

The torch functions here are the definition, on any device and in any floating-point dtype. On CPU in float32 the
numba kernels of the same functions take over when numba is installed (``pip install torchbokeh[cpu]``). Both
stand behind one custom operator each, whose backward pass is the adjoint gather: no graph over the points is
ever built.
"""

from typing import Any

import torch
from torch import Tensor

from torchbokeh.ops.checks import check_flag, check_image
from torchbokeh.ops.dispatch import compute_dtype, has_kernel, refuse_second, refuse_transforms
from torchbokeh.ops.points import PointTable, flatten, splat_points, unflatten
from torchbokeh.ops.span_gradient import row_span_gradient
from torchbokeh.ops.spans import MIN_RADIUS, Profile, check_profile, clamp_radius, row_span, working_dtype

__all__ = ["PointTable", "splat_points", "splat_spans"]


def splat_spans(values: Tensor, coc: Tensor, profile: Profile, *, integrate: bool = False) -> Tensor:
    """Splat flat convex PSFs as row intervals: two differences per row, for any radius.

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


def _row_ends(coc: Tensor, row: int, profile: Profile, size: tuple[int, int]) -> Any:
    """The interval ends of one PSF row for the pixels of flat ``(B, H, W)`` images where it can be seen.

    Returns the flat indices of these pixels, then for the left and the right end the flat index of its column in a
    ``(B, H, W+2)`` buffer, the share of the next column and whether it lies within the image, and the row's weight.
    """
    h, w = size
    where = torch.arange(len(coc), device=coc.device)
    y = where // w % h
    pixels = where[(y + row >= 0) & (y + row < h) & (coc.abs() + 1 > abs(row))]
    left, right, weight = row_span(coc[pixels], row, profile)
    base = (pixels // w + row) * (w + 2)
    ends = []
    for end in (left, right):
        u = end + (pixels % w + 0.5)
        column = u.clamp(0, w).floor()
        ends.append((base + column.long(), u.clamp(0, w) - column, (u > 0) & (u < w)))
    return pixels, *ends, weight


def _splat_spans_torch(values: Tensor, coc: Tensor, profile: Profile, integrate: bool) -> Tensor:
    b, c, h, w = values.shape
    work = working_dtype(values.device)
    flat = flatten(values).to(work)
    radius = clamp_radius(coc.reshape(-1).to(work))
    out = torch.zeros(c, b * h * (w + 2), dtype=work, device=values.device)
    for row in _rows(radius, h):
        pixels, left, right, weight = _row_ends(radius, row, profile, (h, w))
        share = flat.index_select(1, pixels) * weight
        for (column, part, _), signed in ((left, share), (right, -share)):
            out.index_add_(1, column, signed * (1 - part))
            out.index_add_(1, column + 1, signed * part)
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

    The splat is linear in the buffer, so its backward pass is the gradient of
    ``sum(value * weight * (g(left) - g(right)))`` with ``g`` the incoming gradient, interpolated linearly.
    """
    h, w = values.shape[2:]
    work = working_dtype(values.device)
    g = flatten(torch.nn.functional.pad(grad.to(work), (0, 2)))
    flat = flatten(values).to(work)
    radius = clamp_radius(coc.reshape(-1).to(work))
    by_values, by_coc = torch.zeros_like(flat), torch.zeros_like(radius)
    by_knots, by_bulge = torch.zeros_like(profile.knots), torch.zeros_like(profile.bulge)
    for row in _rows(radius, h):
        pixels, left, right, weight = _row_ends(radius, row, profile, (h, w))
        value = flat.index_select(1, pixels)
        mass, by_end = torch.zeros_like(value), {}
        for (column, part, moves), sign in ((left, 1), (right, -1)):
            here, slope = g.index_select(1, column), g.index_select(1, column + 1) - g.index_select(1, column)
            mass += sign * (here + part * slope)
            by_end[sign] = sign * moves * weight * (value * slope).sum(0)
        by_values.index_add_(1, pixels, weight * mass)
        by_row = row_span_gradient(radius[pixels], row, profile, by_end[1], by_end[-1], (value * mass).sum(0))
        by_coc.index_add_(0, pixels, by_row[0])
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
