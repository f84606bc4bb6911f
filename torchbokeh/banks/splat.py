"""Splatting from a bank of sparse PSFs: what each pixel needs of it, merged by radius, highlights apart (LKS 6)."""

import math
from collections.abc import Sequence
from functools import lru_cache

import torch
from torch import Tensor

from torchbokeh.banks.highlights import dense_highlights, light_of, needed, support, tiers, usual
from torchbokeh.banks.samples import located, splat_samples, spreading
from torchbokeh.ops.checks import check_image
from torchbokeh.ops.composite import TINY
from torchbokeh.ops.merge import SPREAD, Merging, highest_level, merged
from torchbokeh.ops.spans import MIN_RADIUS
from torchbokeh.ops.splat import splat_spans
from torchbokeh.psfs.aperture import Disc
from torchbokeh.psfs.bank import PsfBank
from torchbokeh.psfs.combined import Combined
from torchbokeh.psfs.model import Labels


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
    if labels.field is not None:
        maps.append(labels.field)
    return torch.cat(maps, 1) if maps else needed(labels)[:, :0]


def unpacked(coc: Tensor, maps: Tensor, like: Labels) -> Labels:
    """Labels from averages of `packed`: of the same kinds as ``like``."""
    depth = motion = offset = field = None
    if like.depth is not None:
        depth, maps = maps[:, :1].clamp_min(1e-12).reciprocal(), maps[:, 1:]
    if like.motion is not None:
        motion, maps = _along(*maps[:, :3].split(1, 1)), maps[:, 3:]
    if like.offset is not None:
        offset, maps = maps[:, :2], maps[:, 2:]
    if like.field is not None:
        field = maps
    return Labels(coc, depth, motion, offset, field)


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
    parts = [located(p, bank, values) for p in ([labels] if isinstance(labels, Labels) else labels)]
    extreme = isinstance(bank.model, Combined) and _far_beyond(values, parts)
    values = values if len(parts) == 1 else values / len(parts)
    if not values.numel():
        return torch.zeros_like(values)
    lit = [_confined(values, part, 1) if extreme else (values, part) for part in parts]
    ordinary = usual(torch.stack([one for one, _ in lit]).mean(0) if extreme else values)
    dense, values = dense_highlights(values, lit, ordinary, bank, interpolate)

    count = bank.values.shape[1]
    lowest, *brighter = tiers(values, count)
    if not brighter:
        return dense + _splat(values, parts, bank, merging, highest, interpolate, extreme)
    lower = torch.cat([values[:, :-count] * lowest, values[:, -count:]], 1)
    out = dense + _splat(lower, parts, bank, merging, highest, interpolate, extreme)
    for bright in brighter:
        # As where discs are merged, what is bright is not; beyond its support it is dark, and nowhere less than that.
        source = light_of(values, count) * bright
        apart = _splat(source, parts, bank, None, 0, interpolate, extreme)
        apart = apart if bool((source < 0).any()) else apart.clamp_min(0)
        out = out + apart * support(bright, [part for _, part in lit], bank)
    return out


def _splat(
    values: Tensor,
    parts: Sequence[Labels],
    bank: PsfBank,
    merging: Merging | None,
    highest: int,
    interpolate: bool,
    extreme: bool,
) -> Tensor:
    """`splat_bank` of values that are all spread alike; ``extreme`` says that `_confined` has something to do."""

    def splat(cells: Tensor, now: Sequence[Labels], size: int) -> Tensor:
        out = torch.zeros_like(cells)
        moving: list[tuple[Tensor, Labels]] = []
        discs: list[tuple[Tensor, Tensor]] = []
        for part in now:
            lit, part = _confined(cells, part, size) if extreme else (cells, part)
            still = None if part.coc is None else bank.model.still(part)
            if still is None or part.coc is None:
                moving.append((lit, part))
                continue
            alive = spreading(lit)[:, None]
            if bool((alive & (still < 1)).any()):
                moving.append((lit * (1 - still), part))
            if not bool((alive & (still > 0)).any()):
                continue
            if discs and discs[-1][0] is part.coc:
                discs[-1] = part.coc, discs[-1][1] + lit * still
            else:
                discs.append((part.coc, lit * still))
        for coc, lit in discs:
            out = out + splat_spans(lit, coc / size, Disc().profile(), integrate=True)
        return out + splat_samples(moving, bank, size, interpolate) if moving else out

    if merging is None or highest == 0:
        return splat(values, parts, 1)
    varies = any(part.coc is not parts[0].coc for part in parts)
    coc = torch.stack([needed(p).abs() for p in parts]).amin(0) if varies else needed(parts[0])
    # Bins and layers are parts of a picture, and need not have its largest radii.
    largest = float(torch.where(spreading(values)[:, None], coc.detach().abs(), 0.0).max())
    highest = min(highest, highest_level(largest, (values.shape[2], values.shape[3]), merging))
    if highest == 0:
        return splat(values, parts, 1)
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

    return merged(values, coc, splat_cells, merging, highest, labels=torch.cat(maps, 1))


def _far_beyond(values: Tensor, parts: Sequence[Labels]) -> bool:
    """Whether a way or a disc is far larger than the picture, so that its buffer would be as large as it."""
    sizes = [t.detach().square().sum(1) for p in parts for t in (p.motion, p.offset) if t is not None]
    sizes += [p.coc.detach()[:, 0].square() for p in parts if p.coc is not None]
    if not values.numel() or not sizes:
        return False
    return bool(torch.stack([t.max() for t in sizes]).amax().sqrt() > math.hypot(*values.shape[2:]))


def _confined(values: Tensor, part: Labels, size: int) -> tuple[Tensor, Labels]:
    """The same picture with ways and discs that are no larger than it asks for, for `Combined`.

    A disc that moves evenly is a mean of discs over time. Those that do not reach the picture add nothing: what is left
    is a shorter way, with as much less light. A disc that covers all of the picture all the time has the same density
    everywhere, the reciprocal of its area: a smaller one that stands still stands for it, with as much less light.

    Args:
        values: ``(B, C, h, w)``, of blocks of ``size`` px.
        part: its labels, in px.
        size: see ``values``.
    """
    coc, height, width = needed(part), values.shape[2] * size, values.shape[3] * size
    motion = torch.zeros_like(coc).expand(-1, 2, -1, -1) if part.motion is None else part.motion
    offset = torch.zeros_like(motion) if part.offset is None else part.offset
    rows, columns = ((torch.arange(n, device=coc.device) + 0.5) * size - 0.5 for n in values.shape[2:])
    radius, length = coc.abs(), motion.detach().square().sum(1, keepdim=True).sqrt()
    diagonal = math.hypot(height, width) + size
    wide = radius > diagonal + length / 2 + offset.detach().square().sum(1, keepdim=True).sqrt()
    # Samples of the bank fade towards their ends, so these are to lie well beyond the picture.
    room = radius + max(height, width) / 4 + 2 * size
    first, last = torch.full_like(radius, -0.5), torch.full_like(radius, 0.5)
    for axis, (place, extent) in enumerate(((columns, width), (rows[:, None], height))):
        start, speed = place + offset[:, axis : axis + 1], motion[:, axis : axis + 1]
        speed = torch.where(speed.abs() < TINY, TINY, speed)
        ends = (-0.5 - room - start) / speed, (extent - 0.5 + room - start) / speed
        first, last = first.maximum(torch.minimum(*ends)), last.minimum(torch.maximum(*ends))
    share, middle = (last - first).clamp_min(0), (first + last) / 2
    uncut = (length <= diagonal + 2 * room) & (share > 0)
    share, middle = torch.where(uncut, 1.0, share), torch.where(uncut, 0.0, middle)
    there = (share > 0) & ~wide
    light = torch.where(wide, (diagonal / radius.clamp_min(1.0)).square(), share)
    motion, offset = (torch.where(there, t, 0.0) for t in (share * motion, offset + middle * motion))
    coc = torch.where(there, coc, torch.where(wide, diagonal, 0.0))
    return values * light, part._replace(coc=coc, motion=motion, offset=offset)
