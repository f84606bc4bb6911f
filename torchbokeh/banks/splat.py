"""Splatting from a bank of sparse PSFs: what each pixel needs of it, merged by radius, highlights apart (LKS 6)."""

from collections.abc import Sequence
from functools import lru_cache, partial

import torch
from torch import Tensor

from torchbokeh.banks.highlights import brightness_classes, dense_highlights, ordinary_light, support
from torchbokeh.banks.samples import BankSettings, Source, splat_samples, spreading
from torchbokeh.ops.checks import check_image, not_finite
from torchbokeh.ops.composite import TINY
from torchbokeh.ops.dispatch import has_numbers
from torchbokeh.ops.merge import SPREAD, Merging, highest_level, merged
from torchbokeh.ops.spans import MIN_RADIUS
from torchbokeh.ops.splat import splat_spans
from torchbokeh.psfs.aperture import Disc
from torchbokeh.psfs.bank import PsfBank
from torchbokeh.psfs.model import Labels, field_of


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
        if not has_numbers(given) or given.numel() == 0:
            continue
        low, high = given.detach().aminmax()
        if name == "depth" and not bool(low > 0):
            raise ValueError(f"depth: expected values above 0 (inf is sky), got one of {low.item():g}")
        if name != "depth" and not bool(low.isfinite() & high.isfinite()):
            raise ValueError(f"{name}: expected finite values, got {not_finite(given)}")
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
    return torch.cat(maps, 1) if maps else labels.required_coc()[:, :0]


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
    if not values.numel():
        return torch.zeros_like(values)
    parts = [labels] if isinstance(labels, Labels) else list(labels)
    if bank.model.fields:  # before any pixel is left out
        parts = [p if p.field is not None else p._replace(field=field_of(values)) for p in parts]
    settings = BankSettings(bank, interpolate, bank.model.needs_clipping(parts, (values.shape[2], values.shape[3])))
    values = values if len(parts) == 1 else values / len(parts)
    sources = [bank.model.clipped(values, part, 1) if settings.clip else (values, part) for part in parts]
    mean = torch.stack([source for source, _ in sources]).mean(0) if settings.clip else values
    out, values = dense_highlights(values, sources, ordinary_light(mean), settings)

    count, spread, level = bank.values.shape[1], partial(splat_parts, parts=parts, settings=settings), 0
    darkest, *brighter = brightness_classes(values, count)
    rest = torch.cat([values[:, :-count] * darkest, values[:, -count:]], 1) if brighter else values
    if merging and highest:
        coc, maps = _merging_maps(parts)
        # Bins and layers are parts of a picture, and need not have its largest radii.
        largest = float(torch.where(spreading(rest)[:, None], coc.detach().abs(), 0.0).max())
        level = min(highest, highest_level(largest, (values.shape[2], values.shape[3]), merging))
    out = out + (merged(rest, coc, spread, merging, level, labels=maps) if merging and level else spread(rest))
    for bright in brighter:
        # As where discs are merged, what is bright is not; beyond its support it is dark, and nowhere less than that.
        source = torch.cat([values[:, :-count] * bright, torch.zeros_like(values[:, -count:])], 1)
        apart = spread(source)
        apart = apart if bool((source < 0).any()) else apart.clamp_min(0)
        out = out + apart * support(bright, [part for _, part in sources], bank)
    return out


def splat_parts(
    values: Tensor,
    radius: Tensor | None = None,
    means: Tensor | None = None,
    size: int = 1,
    *,
    parts: Sequence[Labels],
    settings: BankSettings,
) -> Tensor:
    """Splat a picture in each part of an exposure: what stands still as discs, all else by samples of the bank.

    Args:
        values: ``(B, C, h, w)``, what each block of ``size`` px spreads in a part.
        radius: ``(B, 1, h, w)``, mean of the CoC that blocks were merged by, in blocks; None: none were.
        means: ``(B, E, h, w)``, of the other maps of `_merging_maps`; likewise.
        size: see ``values``.
        parts: labels in px.
        settings: the bank, whether to interpolate between its samples, and whether to clip them.

    Returns:
        ``(B, C, h, w)``.
    """
    model = settings.bank.model
    if radius is not None and means is not None:
        parts = _of_blocks(radius, means, size, parts)
    moving: list[Source] = []
    discs: list[tuple[Tensor, Tensor]] = []
    for part in parts:
        light, part = model.clipped(values, part, size) if settings.clip else (values, part)
        still = model.still(part)
        if still is None:
            moving.append((light, part))
            continue
        alive, coc = spreading(light)[:, None], part.required_coc()
        if bool((alive & (still < 1)).any()):
            moving.append((light * (1 - still), part))
        if not bool((alive & (still > 0)).any()):
            continue
        if discs and discs[-1][0] is coc:
            discs[-1] = coc, discs[-1][1] + light * still
        else:
            discs.append((coc, light * still))
    out = torch.zeros_like(values)
    for coc, light in discs:
        out = out + splat_spans(light, coc / size, Disc().profile(), integrate=True)
    return out + splat_samples(moving, settings, size) if moving else out


def _merging_maps(parts: Sequence[Labels]) -> tuple[Tensor, Tensor]:
    """The CoC that pixels are merged by, the smallest where it varies, and what is averaged, ``(B, E, H, W)``."""
    coc, maps = parts[0].required_coc(), [packed(part) for part in parts]
    if _coc_varies(parts):
        radii = [part.required_coc().abs() for part in parts]
        coc, maps = torch.stack(radii).amin(0), [torch.cat(pair, 1) for pair in zip(maps, radii, strict=True)]
    return coc, torch.cat(maps, 1)


def _of_blocks(radius: Tensor, means: Tensor, size: int, like: Sequence[Labels]) -> list[Labels]:
    """The labels of blocks of ``size`` px, from averages of `_merging_maps`: of the same kinds as ``like``."""
    found, varies, shared = [], _coc_varies(like), radius * size
    for mean, part in zip(means.chunk(len(like), 1), like, strict=True):
        coc = shared
        if varies:
            coc, mean = mean[:, -1:], mean[:, :-1]
            if size > 1:
                coc = (coc.square() - SPREAD * size**2).clamp_min((MIN_RADIUS * size) ** 2).sqrt()
        found.append(unpacked(coc, mean, part))
    return found


def _coc_varies(parts: Sequence[Labels]) -> bool:
    return any(part.coc is not parts[0].coc for part in parts)
