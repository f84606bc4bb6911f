"""Splatting from a bank of sparse PSFs: every pixel takes its sample, in the domain in which that is sparse (LKS 6)."""

import math
from collections.abc import Callable, Sequence
from functools import lru_cache

import torch
from torch import Tensor

from torchbokeh.ops._checks import check_image
from torchbokeh.ops.capsules import splat_capsules
from torchbokeh.ops.composite import TINY
from torchbokeh.ops.integrate import poisson_fft, running_sum_x
from torchbokeh.ops.merge import LEAST_CONTRAST, Merging, merged
from torchbokeh.ops.points import splat_points
from torchbokeh.ops.spans import MIN_RADIUS
from torchbokeh.ops.splat import splat_spans
from torchbokeh.psfs.aperture import Disc
from torchbokeh.psfs.bank import PsfBank
from torchbokeh.psfs.combined import Combined
from torchbokeh.psfs.model import Labels, Place, scaled
from torchbokeh.psfs.represent import DOMAINS, Domain

_INTEGRALS: dict[Domain, Callable[[Tensor], Tensor]] = {
    "direct": lambda buffer: buffer,
    "scanline": running_sum_x,
    "laplacian": lambda buffer: poisson_fft(buffer, compact=True),
}

BRIGHT = 0.5
"""A pixel is a highlight where its light, spread over its PSF, is this many times the mean of the picture."""

MOST = 4096
"""Highlights that are drawn densely, at most: the brightest."""

ROOM = 2
"""Pixels around the farthest points: what is shared with a neighbour, and the ring on which the picture vanishes."""


@lru_cache(maxsize=4)
def bank_of_motion(device: torch.device) -> PsfBank:
    """The bank of `torchbokeh.psfs.Combined` that comes with the package."""
    with torch.inference_mode(False):  # it is kept, and may be asked for gradients later
        return PsfBank.load("combined").to(device)


def bank_labels(
    bank: PsfBank, image: Tensor, coc: Tensor | None, depth: Tensor | None, motion: Tensor | None
) -> Labels:
    """Check a picture and its maps, and put the maps together.

    Raises:
        TypeError: one of them is not a floating-point tensor.
        ValueError: a shape, device or value does not fit, or a map that the model needs is missing.
    """
    check_image("image", image, ("B", "C", "H", "W"))
    b, channels, h, w = image.shape
    for name, given, count in (("coc", coc, 1), ("depth", depth, 1), ("motion", motion, 2)):
        if given is None:
            continue
        check_image(name, given, (b, count, h, w), like=image)
        if torch.compiler.is_compiling() or given.numel() == 0:
            continue
        low, high = given.detach().aminmax()
        if name == "depth" and not bool(low > 0):
            raise ValueError(f"depth: expected values above 0 (inf is sky), got one of {low.item():g}")
        if name != "depth" and not bool((high - low).isfinite()):
            raise ValueError(f"{name}: expected finite values, got {int((~given.isfinite()).sum())} that are not")
    colours = bank.values.shape[1]
    if channels % colours:
        raise ValueError(f"image: expected a multiple of {colours} channels for coloured PSFs, got {channels}")
    labels = Labels(coc, depth, motion)
    if image.numel():
        corner = [None if t is None else t[:1, :, :1, :1].detach() for t in labels]
        bank.model.place(Labels(*corner))  # says which map is missing
    return labels


def blur_with_bank(
    image: Tensor, labels: Labels, bank: PsfBank, merging: Merging | None, highest: int, *, interpolate: bool
) -> Tensor:
    """`splat_bank` of a picture ``(B, C, H, W)`` and its coverage, the one divided by the other."""
    count = bank.values.shape[1]
    covered = torch.cat([image, torch.ones_like(image[:, :1]).expand(-1, count, -1, -1)], 1)
    out = splat_bank(covered, labels, bank, merging, highest=highest, interpolate=interpolate)
    return out[:, :-count] / out[:, -count:].clamp_min(TINY).repeat(1, image.shape[1] // count, 1, 1)


def packed(labels: Labels) -> Tensor:
    """The maps of labels but for the CoC, ``(B, E, H, W)``, as channels that may be averaged.

    Motion becomes ``(dx dx, dx dy, dy dy)``: a PSF spreads along a line, so that opposite directions are the same.
    """
    maps = [] if labels.depth is None else [labels.depth.reciprocal()]
    if labels.motion is not None:
        x, y = labels.motion.split(1, 1)
        maps += [x * x, x * y, y * y]
    if labels.offset is not None:
        maps.append(labels.offset)
    return torch.cat(maps, 1) if maps else needed(labels)[:, :0]


def unpacked(coc: Tensor, maps: Tensor, like: Labels) -> Labels:
    """Labels from averages of `packed`: of the same kinds as ``like``."""
    depth = motion = offset = None
    if like.depth is not None:
        depth, maps = maps[:, :1].clamp_min(1e-12).reciprocal(), maps[:, 1:]
    if like.motion is not None:
        motion, maps = _along(*maps[:, :3].split(1, 1)), maps[:, 3:]
    if like.offset is not None:
        offset = maps
    return Labels(coc, depth, motion, offset)


def _along(xx: Tensor, xy: Tensor, yy: Tensor) -> Tensor:
    """The displacement whose square has the given entries, as far as one has: the direction of the largest spread."""
    length = (xx + yy).clamp_min(1e-12).sqrt()
    angle = 0.5 * torch.atan2(2 * xy, torch.where((xy == 0) & (xx == yy), 1.0, xx - yy))
    return torch.cat([length * angle.cos(), length * angle.sin()], 1)


def splat_bank(
    values: Tensor,
    labels: Labels,
    bank: PsfBank,
    merging: Merging | None = None,
    *,
    highest: int = 0,
    interpolate: bool = False,
) -> Tensor:
    """Blur with the PSFs of a bank.

    Args:
        values: ``(B, C, H, W)``, what each pixel spreads, and last the coverage: ones, in as many channels as the PSFs
            have. For a coloured bank C is a multiple of 3.
        labels: what the bank's model asks for.
        bank: the PSFs.
        merging: how far to merge by the radius of ``labels.coc``; ``None``: not at all.
        highest: the coarsest level, see `torchbokeh.ops.merge.highest_level`.
        interpolate: splat the neighbouring samples of the grid as well, by their share, instead of the nearest one
            alone. Without it, gradients to the coordinates of the PSFs run through their size and direction only.

    Returns:
        ``(B, C, H, W)``, not divided by the coverage.

    Raises:
        ValueError: the model needs another label.
    """

    def places(now: Labels, size: int) -> list[Place]:
        found = bank.model.places(now, size)
        if now.offset is None:
            return found
        shift = now.offset / size
        return [p._replace(offset=shift if p.offset is None else p.offset + shift) for p in found]

    dense, values = _highlights(values, labels, bank)

    def splat(cells: Tensor, radius: Tensor | None, now: Labels, size: int) -> Tensor:
        still = bank.model.still(now)
        if still is None or radius is None:
            return splat_places(cells, places(now, size), bank, interpolate)
        discs = splat_spans(cells * still, radius, Disc().profile(), integrate=True)
        moving = cells * (1 - still)
        if not bool((still < 1).any()):
            return discs
        return discs + splat_places(moving, places(now, size), bank, interpolate)

    if merging is None or highest == 0:
        return dense + splat(values, labels.coc, labels, 1)
    coc, maps = needed(labels), packed(labels)

    def splat_cells(cells: Tensor, radius: Tensor, means: Tensor, size: int) -> Tensor:
        return splat(cells, radius, unpacked(radius * size, means, labels), size)

    return dense + merged(values, coc, splat_cells, merging, highest, labels=maps)


def _highlights(values: Tensor, labels: Labels, bank: PsfBank) -> tuple[Tensor | float, Tensor]:
    """What pixels spread that are so bright that the ripples of a sparse PSF would be seen, and all other values."""
    if labels.coc is None or labels.motion is None or not values.numel() or not isinstance(bank.model, Combined):
        return 0.0, values
    with torch.no_grad():
        brightness, radius = values.abs(), labels.coc.abs().clamp_min(MIN_RADIUS)
        length = labels.motion.square().sum(1, keepdim=True).sqrt()
        alive = (values != 0).any(1, keepdim=True).sum((2, 3), keepdim=True).clamp_min(1)
        area = radius * (math.pi * radius + 2 * length)
        bound = brightness.sum((2, 3), keepdim=True) / alive * (BRIGHT * area).clamp_min(LEAST_CONTRAST)
        excess = (brightness / bound.clamp_min(TINY)).amax(1).flatten()
        pixels = (excess > 1).nonzero()[:, 0]
        if len(pixels) > MOST:
            pixels = excess.topk(MOST).indices.sort().values
    if not len(pixels):
        return 0.0, values

    def of(t: Tensor) -> Tensor:
        return t.movedim(1, -1).flatten(0, 2)[pixels]

    radius, motion = of(labels.coc)[:, 0].abs(), of(labels.motion)
    centre = torch.zeros_like(motion) if labels.offset is None else of(labels.offset)
    rest = values.movedim(1, 0).reshape(values.shape[1], -1).index_fill(1, pixels, 0.0)
    shape = (values.shape[1], values.shape[0], *values.shape[2:])
    return splat_capsules(values, pixels, radius, motion, centre), rest.reshape(shape).movedim(0, 1)


def needed(labels: Labels) -> Tensor:
    """The CoC of labels that must have one."""
    if labels.coc is None:
        raise ValueError("labels.coc: expected one, since pixels are merged by it, got none")
    return labels.coc


def splat_places(values: Tensor, places: Sequence[Place], bank: PsfBank, interpolate: bool = False) -> Tensor:
    """Splat ``(B, C, H, W)`` with the PSFs at places, each pixel with all of them. See `splat_bank`."""
    out = torch.zeros_like(values)
    for place in places:
        source = values if place.share is None else values * place.share
        grid, coordinates = bank.model.grid, place.coordinates.movedim(1, -1)
        extent = bank.model.extent(coordinates)
        chosen = grid.neighbours(coordinates) if interpolate else [(grid.index(coordinates), None)]
        for number, share in chosen:
            weighed = source if share is None else source * share[:, None].to(source.dtype)
            drawn = place
            if extent is not None:
                ratio = extent / bank.extents.to(extent)[number]
                drawn = scaled(place, ratio[:, None].to(source.dtype))._replace(offset=place.offset)
            out = out + _splat_samples(weighed, number[:, None], drawn, bank)
    return out


def _splat_samples(values: Tensor, index: Tensor, place: Place, bank: PsfBank) -> Tensor:
    """Every pixel spreads one sample ``index (B, 1, H, W)``."""
    if bank.model.tints:
        # The last channels are the coverage: how much of the PSF arrives, whatever its colour.
        count = bank.values.shape[1]
        gains = bank.gains()[index[:, 0]].movedim(-1, 1).clamp_min(TINY)
        values = torch.cat([values[:, :-count], values[:, -count:] / gains], 1)
    out = torch.zeros_like(values)
    if not bool(values.detach().any()):
        return out
    used = index.flatten().bincount(minlength=len(bank)) > 0
    # Turned by 45 degrees, a point on a corner lies farther away along an axis.
    stretch = 1.0 if place.frame is None else math.sqrt(2)
    if place.scale is not None:
        stretch = stretch * float(place.scale.detach().max())
    shift = 0.0 if place.offset is None else float(place.offset.detach().abs().max())
    reach, domains = bank.reach(), bank.domains
    for number, domain in enumerate(DOMAINS):
        here = used & (domains == number)
        if not bool(here.any()):
            continue
        pad = math.ceil(float(reach[here].max()) * stretch + shift) + ROOM
        source = values
        if domain == "laplacian" and place.scale is not None:
            source = values / place.scale.square()
        whole = _INTEGRALS[domain](_splat_channels(source, index, bank, domain, pad, place))
        out = out + whole[..., pad : pad + values.shape[2], pad : pad + values.shape[3]]
    return out


def _splat_channels(values: Tensor, index: Tensor, bank: PsfBank, domain: Domain, pad: int, place: Place) -> Tensor:
    position = None
    if place.offset is not None:
        rows, columns = values.shape[2:]
        y, x = torch.meshgrid(
            torch.arange(rows, device=values.device), torch.arange(columns, device=values.device), indexing="ij"
        )
        position = place.offset + torch.stack([x, y])
    colours = bank.values.shape[1]
    # Channel k of a coloured PSF spreads the channels k, k + 3, ... of the picture.
    parts = [
        splat_points(
            values[:, k::colours], index, bank.table(domain, k), pad=pad, rotation=place.frame, position=position
        )
        for k in range(colours)
    ]
    return parts[0] if colours == 1 else torch.stack(parts, 2).flatten(1, 2)
