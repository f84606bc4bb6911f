"""From an image with depth to surfaces that are blurred and put over one another.

A *surface* is something with one depth per pixel: the picture itself, what stands in front of the focus plane, what
lies behind that, or a layer of the caller's. Each is blurred in soft bins of constant parallax (uniform in the signed
circle of confusion), and all are composed front to back, once for every sub-aperture of the lens.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from torchbokeh.banks.splat import splat_bank
from torchbokeh.ops.composite import TINY, bin_weights, fill_until_full, pull_push
from torchbokeh.ops.merge import MARGIN, Merging, splat_merged, upsample
from torchbokeh.ops.spans import Profile, area
from torchbokeh.ops.splat import splat_spans
from torchbokeh.ops.surface import blur_surface
from torchbokeh.psfs.bank import PsfBank
from torchbokeh.psfs.model import Labels

FOREGROUND = (-2.0, -1.0)
"""Signed CoC (px) between which a pixel passes from foreground to rest. What is sharper hides nothing."""

SPACING = 6.0
"""Distance of bins in px of CoC, where there are three or more. What counts is what hides what."""

COARSE = 4
"""Where pixels are merged, what is hidden is filled in blocks of this many pixels each way."""

BEYOND = 2 * MARGIN
"""Blocks of 2 x 2 pixels around a picture where `half_density` goes on."""

CERTAIN = 4.0
"""Views of a surface that splats cover to one over this count fully: splats of varying blur thin out, holes do not."""


class Way(NamedTuple):
    """A part of a motion, along a line.

    Attributes:
        motion: displacement ``(B, 2, H, W)``, (dx, dy) in px.
        offset: where its middle is seen from the pixel, likewise; ``None`` for at the pixel itself.
        coc: ``(B, 1, H, W)`` radius in px meanwhile; ``None`` for that of the surface.
    """

    motion: Tensor
    offset: Tensor | None = None
    coc: Tensor | None = None


class Moving(NamedTuple):
    """How a surface moves while the shutter is open.

    Attributes:
        parts: what it does in equal parts of the exposure.
        bank: the PSFs of defocus with motion, see `torchbokeh.psfs.Combined`.
    """

    parts: tuple[Way, ...]
    bank: PsfBank

    @classmethod
    def along(cls, ways: Sequence[Tensor], bank: PsfBank, *, from_start: bool) -> "Moving":
        """The motion along displacements, of a picture that shows the start of the exposure, or its middle."""
        starts = [torch.zeros_like(ways[0])]
        for way in ways:
            starts.append(starts[-1] + way)
        if len(ways) == 1 and not from_start:
            return cls((Way(ways[0]),), bank)
        half = len(ways) // 2
        origin = starts[0] if from_start else starts[half] if len(ways) % 2 == 0 else starts[half] + ways[half] / 2
        middles = [start + way / 2 - origin for way, start in zip(ways, starts[:-1], strict=True)]
        return cls(tuple(Way(way, middle) for way, middle in zip(ways, middles, strict=True)), bank)

    def approaching(self, ends: Tensor) -> "Moving":
        """The same while the radius changes, evenly in time, from one end ``(B, 2, H, W)`` to the other, signed."""
        start, stop = ends.split(1, 1)
        count = len(self.parts)
        step = (stop - start) / count
        # Within a part the mean square of the radius is more than the square of its mean.
        middles = [start + (k + 0.5) * step for k in range(count)]
        radii = [(r.square() + step.square() / 12).clamp_min(1e-12).sqrt() for r in middles]
        return self._replace(parts=tuple(w._replace(coc=r) for w, r in zip(self.parts, radii, strict=True)))

    def mapped(self, change: Callable[[Tensor], Tensor]) -> "Moving":
        """The same with all maps changed."""

        def of(t: Tensor | None) -> Tensor | None:
            return None if t is None else change(t)

        return self._replace(parts=tuple(Way(change(w.motion), of(w.offset), of(w.coc)) for w in self.parts))

    def labels(self, coc: Tensor) -> list[Labels]:
        """What the bank wants to know of a surface of that CoC."""
        return [Labels(coc if w.coc is None else w.coc, motion=w.motion, offset=w.offset) for w in self.parts]


@dataclass(frozen=True)
class Surface:
    """Something with one depth per pixel.

    Attributes:
        colour: ``(B, C, H, W)``, premultiplied by ``alpha`` where there is one.
        alpha: coverage ``(B, 1, H, W)`` in [0, 1]; ``None`` means opaque everywhere.
        coc: ``(B, 1, H, W)`` signed radius in px, continued to where ``alpha`` is 0.
        centres: centres of its bins in px of CoC, front to back.
        moving: how it moves; ``None`` means that it stands still.
    """

    colour: Tensor
    alpha: Tensor | None
    coc: Tensor
    centres: tuple[float, ...]
    moving: Moving | None = None

    def continued(self) -> "Surface":
        """The surface with its CoC and motion continued to where it is not."""
        if self.alpha is None:
            return self
        alpha = self.alpha
        moving = None if self.moving is None else self.moving.mapped(lambda t: continued(t, alpha))
        return replace(self, coc=continued(self.coc, alpha), moving=moving)


def bin_centres(low: float, high: float, most: int) -> tuple[float, ...]:
    """Evenly spaced bins for CoCs from ``low`` to ``high`` px, `SPACING` apart if ``most`` allows.

    They move and appear without a jump as the CoCs change: a new bin begins with a share of 0. The last one may lie
    beyond ``high``. Between 1 and 2 px, one bin becomes two.
    """
    extent = high - low
    if extent <= 1 or most == 1:
        return (0.5 * (low + high),)
    if extent <= 2:
        shift = (2 - extent) * extent
        return low + shift, high + shift
    spacing = max(min(extent, SPACING), extent / (most - 1))
    return tuple(low + spacing * k for k in range(1 + math.ceil(extent / spacing - 1e-9)))


def split_foreground(
    image: Tensor,
    coc: Tensor,
    behind: tuple[Tensor, Tensor | None] | None,
    centres: Sequence[tuple[float, ...]],
    scale: int = 1,
    moving: Moving | None = None,
) -> list[Surface]:
    """What stands in front of the focus plane, and the rest with the hidden part filled in.

    The rest is taken from ``behind`` where the foreground hides it, or from its surroundings by pull-push, in colour
    and in CoC. Pixels beside the foreground are replaced as well, since they hold some of its colour. Highlights are
    not spread: one beside an edge would make all that is hidden glow.

    Args:
        image: ``(B, C, H, W)``.
        coc: ``(B, 1, H, W)`` signed radius in px.
        behind: what the foreground hides, as colour and CoC; ``None`` for what is not known.
        centres: bins of the foreground and of the rest.
        scale: fill in blocks of ``scale**2`` pixels: what is hidden is smooth, and blurred in the end. Above 1, the
            CoC of the foreground is not continued beyond it.
        moving: how the picture moves; what is hidden moves as its surroundings do.
    """
    front, known = front_and_known(coc)
    colour, behind_coc = (None, None) if behind is None else behind
    if colour is None or behind_coc is None:
        filled, filled_coc = _surroundings(image, coc, front, known, scale)
        colour = filled if colour is None else colour
        behind_coc = filled_coc if behind_coc is None else behind_coc
    rest = known * image + (1 - known) * colour
    rest_coc = known * coc + (1 - known) * behind_coc
    ahead = behind_it = None
    if moving is not None:
        weight = torch.maximum(known, 1e-9 * (1 - front))
        ahead = moving.mapped(lambda t: continued(t, front))
        behind_it = moving.mapped(lambda t: known * t + (1 - known) * pull_push(t, weight))
    front_coc = coc if scale > 1 and moving is None else continued(coc, front)
    return [
        Surface(image * front, front, front_coc, centres[0], ahead),
        Surface(rest, None, rest_coc, centres[1], behind_it),
    ]


def front_and_known(coc: Tensor) -> tuple[Tensor, Tensor]:
    """Share ``(B, 1, H, W)`` of every pixel in the foreground, and of the rest in what is seen of it.

    What is beside the foreground holds some of its colour, so it counts as hidden.
    """
    start, stop = FOREGROUND
    front = ((stop - coc) / (stop - start)).clamp(0, 1)
    return front, 1 - F.max_pool2d(front, 3, 1, 1)


def _surroundings(image: Tensor, coc: Tensor, front: Tensor, known: Tensor, scale: int) -> tuple[Tensor, Tensor]:
    """Colour and CoC of what is hidden, filled in from its surroundings, in blocks of ``scale**2`` pixels."""
    # Where the foreground is beside everything, those pixels are all there is; elsewhere the second weight is nothing.
    weight = torch.maximum(known, 1e-9 * (1 - front))
    if scale == 1:
        return fill_hidden(image, coc, weight)
    share, total, total_coc = (block_means(t, scale) for t in (weight, weight * image, weight * coc))
    filled = fill_hidden(total / share.clamp_min(TINY), total_coc / share.clamp_min(TINY), share)
    colour, behind = (enlarged(t, scale, coc.shape[2:]) for t in filled)
    return colour, behind


def fill_hidden(image: Tensor, coc: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Fill colour and CoC by pull-push from where ``weight (B, 1, H, W)`` is; highlights do not spread."""
    ordinary = torch.maximum(weight * _ordinary(image, weight), 1e-9 * weight)
    planes = (t.flatten(0, 1)[:, None] for t in (image, ordinary))
    return pull_push(*planes).reshape(image.shape), pull_push(coc, weight)


def block_means(t: Tensor, size: int) -> Tensor:
    """Means over blocks of ``size**2`` pixels; what a block lacks at the border is 0."""
    return F.avg_pool2d(F.pad(t, (0, -t.shape[3] % size, 0, -t.shape[2] % size)), size)


def enlarged(t: Tensor, scale: int, size: tuple[int, ...]) -> Tensor:
    """A picture of block means, interpolated bilinearly to ``size`` pixels."""
    large = F.interpolate(t, scale_factor=scale, mode="bilinear", align_corners=False)
    return large[..., : size[0], : size[1]]


def _ordinary(image: Tensor, known: Tensor) -> Tensor:
    """Weight ``(B, C, H, W)``: 1 for ordinary values, 0 for highlights, far above four times the channel's mean."""
    brightness = image.abs()
    usual = 4 * (brightness * known).sum((2, 3), keepdim=True) / known.sum((2, 3), keepdim=True).clamp_min(TINY)
    ratio = (brightness / usual.clamp_min(TINY)).clamp(max=1e4)  # keeps the power and its slope finite
    return 1 / (1 + ratio**4)


def continued(coc: Tensor, alpha: Tensor) -> Tensor:
    """A map of a surface, its CoC or motion, continued from its surroundings to where the surface is not."""
    here = (alpha > 0).to(coc.dtype)
    return torch.where(here > 0, coc, pull_push(torch.where(here > 0, coc, 0.0), here))


def blurred(
    surface: Surface, profile: Profile, merging: Merging | None = None, highest: int = 0, *, coarse: bool = False
) -> tuple[Tensor, Tensor, Tensor]:
    """One surface through one sub-aperture, exact or merged by radius, for `compose`.

    Returns:
        The mean colour ``(B, C, H, W)``, the share ``(B, 1, H, W)`` of the light that the surface stops, and the
        density of its splats: 1 where blur is even, more or less where it varies, 0 where the picture does not know
        the surface, beyond the border or behind something else.
    """
    alpha = surface.alpha
    if merging is not None and surface.moving is None:
        plain = surface.colour if alpha is None else surface.colour / alpha.clamp_min(TINY)
        colour, coverage = blur_surface(plain, alpha, surface.coc, surface.centres, profile, merging, highest)
        if alpha is None:
            return colour, torch.ones_like(coverage), coverage
        if coarse:
            half = half_density(*block_sums(surface.coc, alpha), profile, merging, highest)
            whole = _enlarged_density(half, surface.coc)
        else:
            whole = splat_merged(torch.ones_like(alpha), surface.coc, profile, merging, highest=highest).clamp_min(0)
        return colour, (coverage / whole.clamp_min(TINY)).clamp(max=1), whole

    moving = surface.moving

    def spread(values: Tensor) -> Tensor:
        if moving is None:
            return splat_spans(values, surface.coc, profile, integrate=True)
        return splat_bank(values, moving.labels(surface.coc), moving.bank, merging, highest=highest)

    source = torch.cat([surface.colour, torch.ones_like(surface.coc) if alpha is None else alpha], 1)
    splats = [spread(source * weight) for weight in bin_weights(surface.coc, surface.centres)]
    colour, coverage = fill_until_full([(splat[:, :-1], splat[:, -1:]) for splat in splats])
    if alpha is None:
        return colour, torch.ones_like(coverage), coverage
    # The same splats of a surface without holes say which part of the coverage is due to their density.
    if moving is None or merging is None or not coarse:
        whole = spread(torch.ones_like(alpha)).clamp_min(0)
    else:
        whole = _enlarged_density(_moving_density(surface.coc, moving, merging, highest), surface.coc)
    return colour, (coverage / whole.clamp_min(TINY)).clamp(max=1), whole


def _enlarged_density(half: Tensor, like: Tensor) -> Tensor:
    """The density that `half_density` returns, for all pixels."""
    h, w = like.shape[2:]
    return upsample(half)[..., 2 * BEYOND : 2 * BEYOND + h, 2 * BEYOND : 2 * BEYOND + w].clamp_min(0)


def _moving_density(coc: Tensor, moving: Moving, merging: Merging, highest: int) -> Tensor:
    """`half_density` of a surface that moves; its maps are continued to where the surface is not."""
    full = block_means(torch.ones_like(coc), COARSE)

    def blocks(t: Tensor) -> Tensor:
        return F.pad(block_means(t, COARSE) / (full * COARSE), (MARGIN,) * 4, mode="replicate")

    inside = F.pad(torch.ones_like(full), (MARGIN,) * 4)
    labels = moving.mapped(blocks).labels(blocks(coc))
    return upsample(splat_bank(inside, labels, moving.bank, merging, highest=max(highest - 2, 0)))


def block_sums(coc: Tensor, alpha: Tensor) -> tuple[Tensor, Tensor]:
    """For blocks of ``COARSE**2`` pixels: the share with any ``alpha``, and that times CoC."""
    here = (alpha > 0).to(coc.dtype)
    return block_means(here, COARSE), block_means(here * coc, COARSE)


def half_density(share: Tensor, total: Tensor, profile: Profile, merging: Merging, highest: int) -> Tensor:
    """Density of the splats of a surface without holes, for blocks of 2 x 2 pixels and `BEYOND` of them around.

    It is smooth, so it is splatted in blocks of 4 x 4. The CoC is continued to where the surface is not.

    Args:
        share: ``(B, 1, h, w)`` from `block_sums`, as is ``total``.
        total: see ``share``.
        profile: the unit shape of the PSF.
        merging: how far to merge.
        highest: the coarsest level of the whole picture.
    """
    coc = F.pad(continued(total / share.clamp_min(TINY), share) / COARSE, (MARGIN,) * 4, mode="replicate")
    inside = F.pad(torch.ones_like(share), (MARGIN,) * 4)
    return upsample(splat_merged(inside, coc, profile, merging, highest=max(highest - 2, 0)))


def foreground_over_rest(
    image: Tensor,
    coc: Tensor,
    centres: Sequence[tuple[float, ...]],
    profile: Profile,
    merging: Merging,
    highest: int,
) -> Tensor:
    """`compose` of `split_foreground` in blocks for the whole lens, in few passes; CPU float32, without gradients."""
    return _foreground_over_rest_op(image, coc, *centres, profile, merging, highest)


@torch.library.custom_op("torchbokeh::foreground_over_rest", mutates_args=())
def _foreground_over_rest_op(
    image: Tensor,
    coc: Tensor,
    ahead: Sequence[float],
    behind: Sequence[float],
    profile: Sequence[Tensor],
    merging: Sequence[float],
    highest: int,
) -> Tensor:
    from torchbokeh.ops.kernels import foreground as kernels

    shape, extent = Profile(*profile), Merging(*merging)
    out = torch.empty_like(image)
    for n in range(len(image)):
        scene = image[n].numpy(), coc[n, 0].numpy()
        front, known, means = kernels.split(*scene, *FOREGROUND)
        parts = torch.from_numpy(means)[None].split([1, 1, 1, 1, image.shape[1]], 1)
        share, total_coc, here, total_here, totals = parts
        known_share = share.clamp_min(TINY)
        hidden, hidden_coc = fill_hidden(totals / known_share, total_coc / known_share, share)
        rest, rest_coc = kernels.rest(*scene, known, hidden[0].numpy(), hidden_coc[0, 0].numpy())
        picture, radius = torch.from_numpy(rest)[None], torch.from_numpy(rest_coc)[None, None]
        rest_picture, density = blur_surface(picture, None, radius, behind, shape, extent, highest)
        alpha = torch.from_numpy(front)[None, None]
        colour, coverage = blur_surface(image[n : n + 1], alpha, coc[n : n + 1], ahead, shape, extent, highest)
        half = half_density(here, total_here, shape, extent, highest)
        planes = (t.contiguous().numpy() for t in (half[0, 0], rest_picture[0], density[0, 0]))
        kernels.over(colour[0].numpy(), coverage[0, 0].numpy(), front, next(planes), BEYOND, CERTAIN, *planes)
        out[n] = rest_picture[0]
    return out


@_foreground_over_rest_op.register_fake
def _(image: Tensor, *settings: object) -> Tensor:
    return torch.empty_like(image, memory_format=torch.contiguous_format)


def compose(
    surfaces: Sequence[Surface],
    pieces: Sequence[Profile],
    merging: Merging | None = None,
    highest: int = 0,
    *,
    coarse: bool = False,
) -> tuple[Tensor, Tensor]:
    """Blur all surfaces and put them over one another, front to back, for every sub-aperture.

    Through one small piece of the lens, what is in front covers what is behind almost as in a pinhole picture; the
    mean over the pieces keeps the relation of coverage to lens position that one "over" of fully blurred surfaces
    loses. A part of the view that nothing is known of, beyond the border or behind an edge, gets no vote. Pieces are
    weighted by the density of their splats: a highlight is lit evenly, whatever the blur does around it.

    Args:
        surfaces: front to back.
        pieces: the sub-apertures, see `torchbokeh.ops.spans.subdivide`.
        merging: how far to merge by radius; ``None``: not at all.
        highest: the coarsest level to merge on.
        coarse: where pixels are merged, find in blocks how dense the splats of a surface are; its CoC need then not be
            continued to where it is not.

    Returns:
        Colour ``(B, C, H, W)``, premultiplied, and coverage ``(B, 1, H, W)``, 1 where something opaque is behind.
    """
    zero = torch.zeros_like(surfaces[0].coc)
    colour = torch.zeros_like(surfaces[0].colour)
    covered = total = zero
    for profile in pieces:
        seen = torch.zeros_like(colour)
        votes = crowd = zero
        left = zero + area(profile).to(zero.dtype)
        for surface in surfaces:
            mean, stopped, density = blurred(surface, profile, merging, highest, coarse=coarse)
            known = (CERTAIN * density).clamp(max=1)
            vote = left * stopped * known
            seen = seen + vote * mean
            votes = votes + vote
            crowd = crowd + vote * density
            # Where a surface is and no splat says how much it stops, the piece has no vote on what is behind either.
            absent = torch.zeros_like(known) if surface.alpha is None else (surface.alpha == 0).to(known.dtype)
            left = left * torch.lerp(absent, 1 - stopped, known)
        density = torch.where(votes > TINY, crowd / votes.clamp_min(TINY), density)
        colour = colour + density * seen
        covered = covered + density * votes
        total = total + density * (votes + left * known)
    total = total.clamp_min(TINY**2)  # the density counts twice
    return colour / total, covered / total
