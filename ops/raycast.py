"""Sub-sample blur: more lens samples from one frame, by casting rays at its height field.

Section 3.4 and algorithm 3.3 of the defocus and bokeh dissertation. A frame rendered for one point of the lens is
looked at from other points close by; what they would see is found in the frame itself.

The torch functions here are the definition, on any device and in any floating-point dtype. On CPU in float32 a numba
kernel of the same function takes over when numba is installed and no gradient is asked for.
"""

import math

import torch
from torch import Tensor

from torchbokeh.ops.checks import check_image, check_number, check_whole
from torchbokeh.ops.dispatch import compute_dtype, has_kernel
from torchbokeh.ops.nbuffers import NBuffers
from torchbokeh.ops.spans import working_dtype


def subsample_blur(
    colour: Tensor,
    coc: Tensor,
    offsets: Tensor,
    *,
    far: float = math.inf,
    background: Tensor | None = None,
    iterations: int = 3,
    tolerance: float = 1.0,
) -> Tensor:
    """Mean of a frame and of what is seen from lens points around its own (section 3.4).

    A surface point of circle of confusion r that the frame shows at x₀ is seen at ``x₀ + r u`` from the lens point u.
    So the ray of output pixel x passes, at the depth of r, over the pixel ``x - r u``, and hits the first surface with
    ``coc(x - r u) = r``. The ray is walked from near to far in steps of one pixel, between bounds of r that
    `NBuffers` give. Beyond the image its border pixels go on.

    Neighbouring samples on the ray are one surface where, seen from u, less than ``1 + tolerance`` pixels lie between
    them; it is interpolated linearly. Anywhere else each sample ends half a pixel from its middle, and a ray that gets
    behind it goes on. The colour is that of the bilinear interpolation at the hit, without the pixels that belong to
    another surface.

    A ray that hits nothing the frame shows has got behind something. Where all that its bounds enclose is nearer
    than ``far`` it is taken to be blocked and keeps the frame's colour at x; where they reach ``far`` it sees the
    background at x.

    Args:
        colour: ``(B, C, H, W)``, the frame of one lens sample.
        coc: ``(B, 1, H, W)`` signed circle of confusion in px of the surface in each pixel, growing with depth. May
            be infinite, not NaN.
        offsets: ``(S, 2)``, lens points (x, y) relative to that of the frame, in units of the aperture radius. They
            should be small: the frame does not show what is hidden from its own lens point.
        far: circle of confusion in px from which on a surface counts as infinitely far.
        background: ``(B, C, H, W)``, what is behind everything; the frame itself if not given.
        iterations: how many times the bounds of each ray are tightened.
        tolerance: greatest gap in px between neighbouring pixels of one surface, 1 to 1.5 in the text.

    Returns:
        ``(B, C, H, W)`` in the dtype of ``colour``. Differentiable to ``colour`` and ``background``, not to the
        geometry.

    Raises:
        TypeError: a tensor is not a floating-point one.
        ValueError: shapes or devices do not fit, ``coc`` holds NaN, ``offsets`` are not finite, or a number is out
            of its range.

    Example:
        >>> import torch
        >>> frame = torch.tensor([[[[0.0, 0.0, 1.0, 0.0, 0.0]]]])
        >>> subsample_blur(frame, torch.full_like(frame, 4.0), torch.tensor([[0.25, 0.0]]))
        tensor([[[[0.0000, 0.0000, 0.5000, 0.5000, 0.0000]]]])
    """
    b, c, h, w = check_image("colour", colour, ("B", "C", "H", "W")).shape
    check_image("coc", coc, (b, 1, h, w), like=colour)
    check_image("offsets", offsets, ("S", 2), like=colour)
    if background is not None:
        check_image("background", background, (b, c, h, w), like=colour)
    if not offsets.isfinite().all():
        raise ValueError("offsets: expected finite numbers, got others")
    check_whole("iterations", iterations, 0, 100)
    if math.isnan(check_number("far", far)):
        raise ValueError("far: expected a number, got nan")
    if not check_number("tolerance", tolerance) >= 0:
        raise ValueError(f"tolerance: expected at least 0 px, got {tolerance}")
    if colour.numel() == 0:
        return colour.clone()
    coc = coc.detach()
    if coc.isnan().any():
        raise ValueError("coc: expected numbers, got NaN")
    views: list[list[float]] = offsets.detach().to("cpu", torch.float64).tolist()
    reach = max((abs(x) for view in views for x in view), default=0.0)
    if reach == 0:
        return colour.clone()
    missed = colour if background is None else background
    grads = torch.is_grad_enabled() and (colour.requires_grad or missed.requires_grad)
    if has_kernel(colour) and coc.dtype == missed.dtype == torch.float32 and not grads:
        from torchbokeh.ops.kernels import raycast as kernels

        return kernels.subsample_blur(colour, coc, views, far, background, iterations, tolerance)
    dtype = compute_dtype(colour)
    out = _subsample_blur_torch(
        colour.to(dtype), coc.to(working_dtype(coc.device)), views, reach, far, missed.to(dtype), iterations, tolerance
    )
    return out.to(colour.dtype)


def coc_bounds(coc: Tensor, reach: float, iterations: int) -> tuple[Tensor, Tensor]:
    """Least and greatest circle of confusion that the rays of each pixel can meet (section 3.4).

    Starts with the bounds of the whole image; each iteration looks up what lies within the window that the rays
    reach at the present bounds.

    Args:
        coc: ``(B, 1, H, W)`` signed circle of confusion in px.
        reach: largest offset of a ray along x or y, in units of the aperture radius; above 0.
        iterations: how often to look up.

    Returns:
        Lower and upper bound, ``(B, 1, H, W)`` each.
    """
    low, high = (t.expand_as(coc) for t in (coc.amin((1, 2, 3), keepdim=True), coc.amax((1, 2, 3), keepdim=True)))
    if iterations == 0:
        return low, high
    buffers = NBuffers.build(coc, largest=2 * window(float(coc.abs().max()), reach, coc.shape) + 1)
    for _ in range(iterations):
        half = torch.maximum(low.abs(), high.abs()).mul(reach).clamp(max=max(coc.shape[-2:])).ceil().long()
        low, high = buffers.square(half)
    return low, high


def window(radius: float, reach: float, shape: torch.Size) -> int:
    """Half the width in px of the window around a pixel that its rays stay in."""
    return math.ceil(min(radius * reach, max(shape[-2:])))


def _subsample_blur_torch(
    colour: Tensor,
    coc: Tensor,
    views: list[list[float]],
    reach: float,
    far: float,
    missed: Tensor,
    iterations: int,
    tolerance: float,
) -> Tensor:
    low, high = coc_bounds(coc, reach, iterations)
    beyond = torch.where(high >= far, missed, colour)
    total = torch.zeros_like(colour)
    for ux, uy in views:
        # Differences to the frame are added up, so that a constant picture stays constant to the bit.
        if abs(ux) >= abs(uy):
            total = total + _differences(colour, beyond, coc, low, high, (ux, uy), tolerance)
        else:  # the same with x and y exchanged
            turned = _differences(colour.mT, beyond.mT, coc.mT, low.mT, high.mT, (uy, ux), tolerance)
            total = total + turned.mT
    return colour + total / (len(views) + 1)


def _differences(
    colour: Tensor, beyond: Tensor, coc: Tensor, low: Tensor, high: Tensor, view: tuple[float, float], tolerance: float
) -> Tensor:
    """What one view sees, less the frame; for views that are shifted along x at least as much as along y."""
    scale = abs(view[0])
    if scale == 0:
        return torch.zeros_like(colour)
    # Shifts by more than the image are all the same: everything is beyond the border.
    limit = coc.shape[-1] / scale
    coc, low, high = (t.clamp(-limit, limit) for t in (coc, low, high))
    r, found = _cast(coc, low, high, view, tolerance / scale)
    seen = _look_up(colour, coc, r, view, tolerance / scale)
    return torch.where(found, seen, beyond) - colour


def _cast(coc: Tensor, low: Tensor, high: Tensor, view: tuple[float, float], step: float) -> tuple[Tensor, Tensor]:
    """Circle of confusion at which each ray hits the height field, and whether it does.

    Sample j of a ray lies at ``r = j / |ux|``, j pixels along x from the output pixel. As the bounds enclose
    all that the ray passes over, it starts in front of the surface and ends behind it.
    """
    scale, px = abs(view[0]), 1 / abs(view[0])
    first, last = (low * scale).floor(), (high * scale).ceil()
    found = low == high
    r = low
    begin, end = int(first.min()), int(last.max())
    after = _sample(coc, begin, view, step)
    for j in range(begin, end):
        before, after = after, _sample(coc, j + 1, view, step)
        # How far the ray is in front of the surface, in coc px.
        here, there = before - j * px, after - (j + 1) * px
        whole = (after - before).abs() <= step
        crosses = whole & torch.where(here >= 0, there <= 0, there >= 0)
        near = ~whole & (here >= 0) & (here * scale <= 0.5)
        ends = ~whole & (there <= 0) & (there * scale >= -0.5)
        open_ = ~found & (j >= first) & (j < last)
        share = here / torch.where(here != there, here - there, 1)
        at = torch.where(crosses, (j + share) * px, torch.where(near, before, after))
        hits = open_ & (crosses | near | ends)
        r = torch.where(hits, at, r)
        found = found | hits
    return r, found


def _sample(coc: Tensor, j: int, view: tuple[float, float], step: float) -> Tensor:
    """The height field under every ray after j steps: on a pixel along x, between two along y."""
    h, w = coc.shape[-2:]
    aside = -j * (view[1] / abs(view[0]))
    whole = math.floor(aside)
    share = aside - whole
    x = (torch.arange(w, device=coc.device) - j * (1 if view[0] > 0 else -1)).clamp(0, w - 1)
    y = torch.arange(h, device=coc.device) + whole
    column = coc[..., x]
    a, b = column[..., y.clamp(0, h - 1), :], column[..., (y + 1).clamp(0, h - 1), :]
    nearest = a if share < 0.5 else b
    return torch.where((a - b).abs() <= step, a + (b - a) * share, nearest)


def _look_up(colour: Tensor, coc: Tensor, r: Tensor, view: tuple[float, float], step: float) -> Tensor:
    """Colour of the surface at ``x - r u``: bilinear among those of its four pixels whose coc is near r."""
    b, c, h, w = colour.shape
    x = (torch.arange(w, device=r.device) - r * view[0]).clamp(0, w - 1)
    y = (torch.arange(h, device=r.device)[:, None] - r * view[1]).clamp(0, h - 1)
    left, top = x.floor(), y.floor()
    x, y = x - left, y - top
    corners, weights = [], []
    for row, part in ((top, 1 - y), ((top + 1).clamp(max=h - 1), y)):
        for column, share in ((left, 1 - x), ((left + 1).clamp(max=w - 1), x)):
            where = (row.long() * w + column.long()).flatten(2)
            near = (coc.flatten(2).gather(2, where).reshape(r.shape) - r).abs() <= step
            corners.append(where)
            weights.append(part * share * near)
    best = torch.stack(weights).argmax(0, keepdim=True)
    flat = colour.flatten(2)
    base = flat.gather(2, torch.stack(corners).gather(0, best.flatten(3))[0].expand(b, c, h * w))
    total = torch.stack(weights).sum(0)
    mixed = torch.zeros_like(flat)
    for where, weight in zip(corners, weights, strict=True):
        share = (weight / torch.where(total > 0, total, 1)).to(colour.dtype).flatten(2)
        mixed = mixed + share * (flat.gather(2, where.expand(b, c, h * w)) - base)
    return (base + mixed).reshape(colour.shape)
