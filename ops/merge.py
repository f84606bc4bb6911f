"""Merging by radius: cost that falls with the blur.

A wide PSF needs neither every source pixel nor every target pixel by itself. Pixels whose radius is at least
``2**l * cells`` are summed over blocks of ``2**l x 2**l`` pixels, the *cells* of level ``l``; the cells are splatted
into a picture of the size of the level, with their mean radius, and that picture is interpolated up to the next finer
level and added. So a pixel of radius r costs about ``4 r / 4**l`` points with ``2**l`` in proportion to r: the wider,
the cheaper, and without an upper bound of the radius.

Where the error comes from, and what is done about it:

* *Interpolation.* Bilinear interpolation blurs once more. Cells are splatted with a radius that is smaller by just as
  much (`SPREAD`). Higher orders would be more exact, but their negative lobes are larger than what covers a picture
  thinly beside a dense part: a halo after the division by coverage.
* *Level borders.* Between the radii of two levels a pixel shares itself between both: no seam, no popping.
* *Highlights.* What is so bright that the edge of its PSF can be seen stays on the lowest level, whatever its radius.
* *Mixed radii.* A cell only holds pixels of one level, so their radii differ by little more than a factor of two, and
  of one surface, since surfaces are splatted one by one. Finer classes of radius change little, and sub-pixel centres
  of partly filled cells change less: neither is worth its time.

Everything is linear in the values. Merging knows nothing of the PSF: it calls a function that splats a picture with
given radii, once for each level, in whatever domain that function works.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from torchbokeh.ops.checks import check_flag, check_image, check_kind, check_whole
from torchbokeh.ops.composite import TINY
from torchbokeh.ops.dispatch import compute_dtype, has_kernel, refuse_transforms
from torchbokeh.ops.highlights import LEAST_CONTRAST, ordinary_brightness
from torchbokeh.ops.spans import MIN_RADIUS, Profile, check_profile, working_dtype
from torchbokeh.ops.splat import splat_spans

FADE = 0.125
"""Radii from one to ``1 + FADE`` times the least radius of a level belong partly to the level below."""

LIT = 0.75
"""A pixel that has this much of the brightness of a highlight begins to be one: nothing jumps as a light grows."""

STEPS = 9216
"""Radii in cells are rounded, so that few PSFs are drawn: small ones to steps of ``1 / radius``, this many to 1, since
the weights of small PSFs change fast: by up to 2e-4 from one step to the next."""

EVEN = 4.6
"""From this radius on steps grow with its square root: half a step moves 1e-3 of the light at most."""

ROUNDED_TO = 32.0
"""Larger radii are not rounded: their PSFs are too large to be kept."""

MARGIN = 2
"""Cells around the picture of a level: interpolation at the border looks beyond it."""

SPREAD = 2 / 3
"""What interpolation adds to the square of a radius in cells: 4 times its variance, 1/8 + 1/32 + ... = 1/6."""

FEWEST = 16
"""Cells across the longer side of the coarsest level. From there on, the height of the picture bounds the cost."""

MOST_LEVELS = 32


class Merging(NamedTuple):
    """How far to merge.

    Attributes:
        cells: a PSF spans at least this radius in cells of its level; more is more exact, and slower.
        highlight: a pixel is a highlight, no part of which is merged, where it is brighter, by its channel's mean, than
            ``highlight`` times its squared radius (and `LEAST_CONTRAST`): spread over its disc, it then stands out by
            ``highlight / pi``.
    """

    cells: float
    highlight: float


def highest_level(largest: float, size: tuple[int, int], merging: Merging) -> int:
    """The coarsest level that radii up to ``largest`` px need in a picture of ``(H, W)``; 0 merges nothing."""
    room = max(math.floor(math.log2(max(*size, FEWEST) / FEWEST)), 0)
    if largest < 2 * merging.cells:
        return 0
    return min(math.floor(math.log2(largest / merging.cells)), room)


def level_shares(
    values: Tensor, coc: Tensor, merging: Merging, highest: int, weight: Tensor | None = None
) -> list[Tensor]:
    """Share ``(B, 1, H, W)`` of every pixel in the levels ``0 .. highest``; the shares of a pixel sum to 1.

    They are a choice, not a part of the picture: no gradient runs through them.
    """
    values, radius = values.detach(), coc.detach().to(working_dtype(coc.device)).abs()
    counted = torch.ones_like(values[:, :1]) if weight is None else weight.detach().to(values.dtype)
    mean = ordinary_brightness(values, counted)
    bound = (merging.highlight * radius.square()).clamp_min(LEAST_CONTRAST)
    ratio = (values.abs() / (mean * bound).clamp_min(torch.finfo(values.dtype).tiny)).amax(1, keepdim=True)
    lit = ((ratio - LIT) / (1 - LIT)).clamp(max=1)
    ordinary = 1 - torch.where(lit > 0, lit, 0.0)  # beside what is infinite, all others are no numbers
    above = [torch.ones_like(radius)]
    for level in range(1, highest + 1):
        excess = radius / (merging.cells * 2**level) - 1
        above.append((excess / FADE).clamp(0, 1) * ordinary)
    above.append(torch.zeros_like(radius))
    return [(above[k] - above[k + 1]).to(values.dtype) for k in range(highest + 1)]


def rounded(radius: Tensor) -> Tensor:
    """Radii in cells, rounded to steps (see `STEPS` and `EVEN`); those of the identity are kept, and large ones."""
    last, root = 1 / MIN_RADIUS - 1 / EVEN, EVEN**0.5
    above = (radius.clamp_min(EVEN).sqrt() - root) * 2 / root**3
    number = ((1 / MIN_RADIUS - 1 / radius.clamp(MIN_RADIUS, EVEN) + above) * STEPS).round() / STEPS
    small = 1 / (1 / MIN_RADIUS - number.clamp_max(last))
    graded = torch.where(number < last, small, (root + (number - last) * root**3 / 2).square())
    return torch.where((radius > MIN_RADIUS) & (radius < ROUNDED_TO), graded, radius)


def merge_cells(
    values: Tensor,
    coc: Tensor,
    shares: list[Tensor],
    weight: Tensor | None = None,
    labels: Tensor | None = None,
) -> list[tuple[Tensor, ...]]:
    """The pictures that are splatted: values and signed CoC in cells, for every level.

    Args:
        values: ``(B, C, H, W)``.
        coc: ``(B, 1, H, W)`` signed radius in px.
        shares: those of `level_shares`.
        weight: ``(B, 1, H, W)`` >= 0, factor of the values; a pixel counts by it in the mean radius. ``None``: 1.
        labels: ``(B, E, H, W)``, more of what a PSF depends on.

    Returns:
        For level ``l`` the sums ``(B, C, h, w)`` over blocks of ``2**l x 2**l`` pixels, h and w rounded up; the mean
        radius ``(B, 1, h, w)`` in cells, with the sign that prevails; and the means ``(B, E, h, w)`` of the labels.
    """
    levels: list[tuple[Tensor, ...]] = []
    for level, share in enumerate(shares):
        size = 2**level
        border = (0, -values.shape[3] % size, 0, -values.shape[2] % size)

        def total(t: Tensor, size: int = size, border: tuple[int, ...] = border) -> Tensor:
            if size == 1:
                return t
            # torch pools no picture without channels.
            t = F.pad(t, border)
            return F.avg_pool2d(t, size) * size**2 if t.shape[1] else t[..., ::size, ::size]

        counted = share if weight is None else share * weight.detach()
        amount = total(counted).clamp_min(TINY)
        radius = total(counted * coc.abs()) / amount / size
        if level:
            radius = (radius.square() - SPREAD).clamp_min(MIN_RADIUS**2).sqrt()
        exact = radius.detach().to(working_dtype(coc.device))
        step = rounded(exact)
        radius = radius + (step.to(radius.dtype) - radius.detach())
        factor = share if weight is None else share * torch.where(weight > 0, weight, 0.0)
        # What is infinite stays on its own levels.
        level_maps = (
            total(torch.where(factor > 0, values * factor, 0.0)),
            torch.where(total(counted * coc.detach()) < 0, -radius, radius),
        )
        levels.append(level_maps if labels is None else (*level_maps, total(counted * labels) / amount))
    return levels


def upsample(coarse: Tensor) -> Tensor:
    """Twice as many cells each way, ``(B, C, h, w) -> (B, C, 2h, 2w)``: bilinear, so never negative."""
    for dim in (2, 3):
        n = coarse.shape[dim]
        before = torch.cat([coarse.narrow(dim, 0, 1), coarse.narrow(dim, 0, n - 1)], dim)
        after = torch.cat([coarse.narrow(dim, 1, n - 1), coarse.narrow(dim, n - 1, 1)], dim)
        coarse = torch.stack([torch.lerp(coarse, t, 0.25) for t in (before, after)], dim + 1).flatten(dim, dim + 1)
    return coarse


def merged(
    values: Tensor,
    coc: Tensor,
    splat: Callable[..., Tensor],
    merging: Merging,
    highest: int,
    weight: Tensor | None = None,
    labels: Tensor | None = None,
) -> Tensor:
    """Splat with merging, for any PSF.

    Args:
        values: ``(B, C, H, W)``, what each pixel spreads.
        coc: ``(B, 1, H, W)`` signed radius in px.
        splat: takes values ``(B, C, h, w)`` and radii ``(B, 1, h, w)`` in cells and returns the blurred picture
            ``(B, C, h, w)``. With ``labels`` it takes their means and the size of a cell in px as well.
        merging: how far to merge.
        highest: the coarsest level, see `highest_level`.
        weight: ``(B, 1, H, W)`` >= 0, factor of the values. Pixels without weight do not take part.
        labels: ``(B, E, H, W)``, more of what a PSF depends on; cells take their means.

    Returns:
        ``(B, C, H, W)``, close to ``splat(weight * values, coc)``.
    """
    counted = weight
    if labels is not None and weight is None:  # pixels of a part of a picture, of which many are not there
        counted = (values.detach() != 0).any(1, keepdim=True).to(values.dtype)
    levels = merge_cells(values, coc, level_shares(values, coc, merging, highest, counted), weight, labels)
    pictures = []
    for level, cells in enumerate(levels):
        maps = [F.pad(t, (MARGIN if level else 0,) * 4) for t in cells]
        pictures.append(splat(*maps) if labels is None else splat(*maps, 2**level))
    out = pictures[highest]
    for level in range(highest - 1, -1, -1):
        start, (h, w) = MARGIN if level else 2 * MARGIN, pictures[level].shape[2:]
        out = pictures[level] + upsample(out)[..., start : start + h, start : start + w] / 4
    return out


def splat_merged(
    values: Tensor,
    coc: Tensor,
    profile: Profile,
    merging: Merging,
    *,
    highest: int | None = None,
    weight: Tensor | None = None,
    ones: bool = False,
    normalise: bool = False,
) -> Tensor:
    """Blur with flat convex PSFs, merged by radius: close to `splat_spans(..., integrate=True)` and much faster.

    Args:
        values: ``(B, C, H, W)``, what each pixel spreads.
        coc: ``(B, 1, H, W)`` signed radius in px. Must be finite.
        profile: the unit shape of the PSF, see `torchbokeh.psfs.aperture`.
        merging: how far to merge.
        highest: the coarsest level; ``None`` looks at ``coc`` once.
        weight: ``(B, 1, H, W)`` >= 0, factor of the values. Pixels without weight do not take part: they get no
            gradient.
        ones: splat a channel of ones as well, times the weight: the coverage. It is put last.
        normalise: divide the values by the last channel, the coverage.

    Returns:
        ``(B, C, H, W)``, or ``(B, C + 1, H, W)`` with ``ones``, in the dtype of ``values`` (of ``values`` and ``coc``
        where both are at least float32). Differentiable to ``values``, ``coc`` and ``profile``.

    Raises:
        TypeError: an argument is not a floating-point tensor.
        ValueError: shapes, devices or settings do not fit.

    Example:
        >>> import torch
        >>> from torchbokeh.psfs import Disc
        >>> image, coc = torch.full((1, 3, 64, 64), 0.5), torch.full((1, 1, 64, 64), 20.0)
        >>> out = splat_merged(image, coc, Disc().profile(), Merging(4, 0.03), ones=True, normalise=True)
        >>> out.shape, round(out[:, :3].min().item(), 5), round(out[:, :3].max().item(), 5)
        (torch.Size([1, 4, 64, 64]), 0.5, 0.5)
    """
    b, _, h, w = check_image("values", values, ("B", "C", "H", "W")).shape
    check_image("coc", coc, (b, 1, h, w), like=values)
    check_profile(profile, values)
    check_kind("merging", merging, Merging)
    for name, flag in (("ones", ones), ("normalise", normalise)):
        check_flag(name, flag)
    if weight is not None:
        check_image("weight", weight, (b, 1, h, w), like=values)
    if not 0 < merging.cells < math.inf or not merging.highlight >= 0:
        raise ValueError(f"merging: expected cells above 0 and a highlight of at least 0, got {merging}")
    if highest is not None:
        check_whole("highest", highest, 0, MOST_LEVELS)
    if highest is None:
        largest = float(coc.detach().abs().max()) if coc.numel() else 0.0
        if not math.isfinite(largest):
            raise ValueError(f"coc: expected finite radii, got one of {largest}")
        highest = highest_level(largest, (h, w), merging)
    refuse_transforms("splat_merged", values, coc, weight, *profile)
    dtype = compute_dtype(values, coc)
    source, radius = values.to(dtype), coc.to(dtype)
    weight = None if weight is None else weight.to(dtype)
    fixed = not (profile.knots.requires_grad or profile.bulge.requires_grad)
    if values.shape[1] + ones == 0 or coc.numel() == 0:
        out = torch.cat([source * radius, radius], 1) if ones else source * radius
    elif has_kernel(source) and fixed:
        knots, bulge = profile.knots.double(), profile.bulge.double()
        out = _splat_merged_op(source, radius, weight, [knots, bulge], merging, highest, ones, normalise)
    else:
        out = _splat_merged_torch(source, radius, weight, profile, merging, highest, ones, normalise)
    return out.to(values.dtype) if dtype != values.dtype and values.dtype.itemsize < 4 else out


def _splat_merged_torch(
    values: Tensor,
    coc: Tensor,
    weight: Tensor | None,
    profile: Profile,
    merging: Merging,
    highest: int,
    ones: bool,
    normalise: bool,
) -> Tensor:
    if ones:
        values = torch.cat([values, torch.ones_like(coc)], 1)
    out = merged(values, coc, lambda v, r: splat_spans(v, r, profile, integrate=True), merging, highest, weight)
    return torch.cat([out[:, :-1] / out[:, -1:].clamp_min(TINY), out[:, -1:]], 1) if normalise else out


@torch.library.custom_op("torchbokeh::splat_merged", mutates_args=())
def _splat_merged_op(
    values: Tensor,
    coc: Tensor,
    weight: Tensor | None,
    profile: Sequence[Tensor],
    merging: Sequence[float],
    highest: int,
    ones: bool,
    normalise: bool,
) -> Tensor:
    from torchbokeh.ops.kernels import merge as kernels

    shape, extent = Profile(*profile), Merging(*merging)
    return kernels.splat_merged(values, coc, weight, shape, extent, highest, ones, normalise)


@_splat_merged_op.register_fake
def _(values: Tensor, *settings: Any) -> Tensor:
    b, c, h, w = values.shape
    *_, ones, _ = settings
    return values.new_empty(b, c + ones, h, w)


@torch.library.custom_op("torchbokeh::gather_merged", mutates_args=())
def _gather_merged_op(
    grad: Tensor,
    out: Tensor | None,
    values: Tensor,
    coc: Tensor,
    weight: Tensor | None,
    profile: Sequence[Tensor],
    merging: Sequence[float],
    highest: int,
) -> tuple[Tensor, Tensor, Tensor]:
    from torchbokeh.ops.kernels import merge_gather as kernels

    shape, extent = Profile(*profile), Merging(*merging)
    return kernels.gather_merged(grad, out, values, coc, weight, shape, extent, highest)


@_gather_merged_op.register_fake
def _(
    grad: Tensor, out: Tensor | None, values: Tensor, coc: Tensor, weight: Tensor | None, *settings: Any
) -> tuple[Tensor, Tensor, Tensor]:
    b, _, h, w = values.shape
    by_weight = values.new_empty((b, 1, 0, 0) if weight is None else (b, 1, h, w))
    return torch.empty_like(values, memory_format=torch.contiguous_format), values.new_empty(b, 1, h, w), by_weight


def _setup(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    values, coc, weight, profile, *ctx.settings, ctx.ones, normalise = inputs
    ctx.save_for_backward(output if normalise else None, values, coc, weight, *profile)


def _backward(ctx: Any, grad: Tensor) -> tuple[Any, ...]:
    *tensors, knots, bulge = ctx.saved_tensors
    if torch.is_grad_enabled() and not torch.compiler.is_compiling():  # for second derivatives: those of the definition
        out, *sources = tensors
        merging, highest = ctx.settings
        values, coc, weight = sources
        settings = Merging(*merging), highest, ctx.ones, out is not None
        again = _splat_merged_torch(values, coc, weight, Profile(knots, bulge), *settings)
        wanted = [t for t, asked in zip(sources, ctx.needs_input_grad[:3], strict=True) if asked]
        found = iter(torch.autograd.grad(again, wanted, grad, create_graph=True))
        by = [next(found) if asked else None for asked in ctx.needs_input_grad[:3]]
        return *by, [None, None], *[None] * 4
    by_values, by_coc, by_weight = _gather_merged_op(grad, *tensors, [knots, bulge], *ctx.settings)
    return by_values, by_coc, None if tensors[3] is None else by_weight, [None, None], *[None] * 4


_splat_merged_op.register_autograd(_backward, setup_context=_setup)
