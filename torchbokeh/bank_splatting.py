"""Splatting from a bank of sparse PSFs: what each pixel needs of it, merged by radius, highlights apart (LKS 6)."""

import math
from collections.abc import Sequence
from functools import lru_cache

import torch
from torch import Tensor

from torchbokeh.bank_samples import splat_samples, spreading
from torchbokeh.ops._checks import check_image
from torchbokeh.ops.capsules import splat_capsules
from torchbokeh.ops.composite import TINY
from torchbokeh.ops.merge import LEAST_CONTRAST, SPREAD, Merging, highest_level, merged
from torchbokeh.ops.spans import MIN_RADIUS
from torchbokeh.ops.splat import splat_spans
from torchbokeh.psfs.aperture import Disc
from torchbokeh.psfs.bank import PsfBank
from torchbokeh.psfs.combined import Combined
from torchbokeh.psfs.model import Labels

BRIGHT = 0.5
"""A pixel is a highlight where its light, spread over its PSF, is this many times the mean of the picture."""

MOST = 4096
"""Highlights that are drawn densely, at most: the brightest."""


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
    labels: Labels | Sequence[Labels],
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
        labels: what the bank's model asks for. Several labels of the same kinds are PSFs of which each spreads an equal
            part, as those of a way that bends.
        bank: the PSFs.
        merging: how far to merge by the radius of ``labels.coc``, the smallest of them; ``None``: not at all.
        highest: the coarsest level, see `torchbokeh.ops.merge.highest_level`.
        interpolate: splat the neighbouring samples of the grid as well, by their share, instead of the nearest one
            alone. Without it, gradients to the coordinates of the PSFs run through their size and direction only.

    Returns:
        ``(B, C, H, W)``, not divided by the coverage.

    Raises:
        ValueError: the model needs another label.
    """
    parts = [labels] if isinstance(labels, Labels) else list(labels)
    dense, values = _highlights(values if len(parts) == 1 else values / len(parts), parts, bank)

    def splat(cells: Tensor, now: Sequence[Labels], size: int) -> Tensor:
        out = torch.zeros_like(cells)
        alive = spreading(cells)[:, None]
        moving: list[tuple[Tensor, Labels]] = []
        discs: list[tuple[Tensor, Tensor]] = []
        for part in now:
            still = None if part.coc is None else bank.model.still(part)
            if still is None or part.coc is None:
                moving.append((cells, part))
                continue
            if bool((alive & (still < 1)).any()):
                moving.append((cells * (1 - still), part))
            if discs and discs[-1][0] is part.coc:
                discs[-1] = part.coc, discs[-1][1] + still
            else:
                discs.append((part.coc, still))
        for coc, still in discs:
            if bool((alive & (still > 0)).any()):
                out = out + splat_spans(cells * still, coc / size, Disc().profile(), integrate=True)
        return out + splat_samples(moving, bank, size, interpolate) if moving else out

    if merging is None or highest == 0:
        return dense + splat(values, parts, 1)
    varies = any(part.coc is not parts[0].coc for part in parts)
    coc = torch.stack([needed(p).abs() for p in parts]).amin(0) if varies else needed(parts[0])
    # Bins and layers are parts of a picture, and need not have its largest radii.
    largest = float(torch.where(spreading(values)[:, None], coc.detach().abs(), 0.0).max())
    highest = min(highest, highest_level(largest, (values.shape[2], values.shape[3]), merging))
    if highest == 0:
        return dense + splat(values, parts, 1)
    maps = [torch.cat([packed(p), needed(p).abs()], 1) if varies else packed(p) for p in parts]

    def splat_cells(cells: Tensor, radius: Tensor, means: Tensor, size: int) -> Tensor:
        now, shared = [], radius * size
        for part, mean in zip(parts, means.split([m.shape[1] for m in maps], 1), strict=True):
            if not varies:
                now.append(unpacked(shared, mean, part))
                continue
            own = mean[:, -1:]
            if size > 1:
                own = (own.square() - SPREAD * size**2).clamp_min((MIN_RADIUS * size) ** 2).sqrt()
            now.append(unpacked(own, mean[:, :-1], part))
        return splat(cells, now, size)

    return dense + merged(values, coc, splat_cells, merging, highest, labels=torch.cat(maps, 1))


def _highlights(values: Tensor, parts: Sequence[Labels], bank: PsfBank) -> tuple[Tensor | float, Tensor]:
    """What pixels spread that are so bright that the ripples of a sparse PSF would be seen, and all other values."""
    maps = [(p.coc, p.motion, p.offset) for p in parts if p.coc is not None and p.motion is not None]
    if not maps or not values.numel() or not isinstance(bank.model, Combined):
        return 0.0, values
    with torch.no_grad():
        brightness = values.abs()
        radius = torch.stack([coc.abs().clamp_min(MIN_RADIUS) for coc, _, _ in maps]).mean(0)
        length = torch.stack([motion.square().sum(1, keepdim=True).sqrt() for _, motion, _ in maps]).sum(0)
        alive = (values != 0).any(1, keepdim=True).sum((2, 3), keepdim=True).clamp_min(1)
        area = radius * (math.pi * radius + 2 * length) / len(maps)
        bound = brightness.sum((2, 3), keepdim=True) / alive * (BRIGHT * area).clamp_min(LEAST_CONTRAST)
        excess = (brightness / bound.clamp_min(TINY)).amax(1).flatten()
        pixels = (excess > 1).nonzero()[:, 0]
        if len(pixels) > MOST:
            pixels = excess.topk(MOST).indices.sort().values
    if not len(pixels):
        return 0.0, values

    def of(t: Tensor) -> Tensor:
        return t.movedim(1, -1).flatten(0, 2)[pixels]

    dense = torch.zeros_like(values)
    for coc, motion, offset in maps:
        way = of(motion)
        centre = torch.zeros_like(way) if offset is None else of(offset)
        dense = dense + splat_capsules(values, pixels, of(coc)[:, 0].abs(), way, centre)
    rest = values.movedim(1, 0).reshape(values.shape[1], -1).index_fill(1, pixels, 0.0)
    shape = (values.shape[1], values.shape[0], *values.shape[2:])
    return dense, rest.reshape(shape).movedim(0, 1)


def needed(labels: Labels) -> Tensor:
    """The CoC of labels that must have one."""
    if labels.coc is None:
        raise ValueError("labels.coc: expected one, since pixels are merged by it, got none")
    return labels.coc
