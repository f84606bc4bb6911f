"""Compositions in double, by plain sums: what stiff cases of `LensBlur` and its kin are compared with.

A plan says what is done: bins, sub-apertures, what fills hidden parts. How it is done is written anew on top of
`torchbokeh.ops.dense.dense_spans` and `torchbokeh.report.stability.splats.dense_bank`: no merging, no list of pixels,
no fused pass, no special case for what is sharp or even. Only `pull_push` is shared.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from torchbokeh import LensBlur, Plan, PsfBank
from torchbokeh.ops.composite import TINY, pull_push
from torchbokeh.ops.dense import dense_spans
from torchbokeh.ops.spans import Profile, area, subdivide
from torchbokeh.ops.surface import BLEND
from torchbokeh.psfs.aperture import Disc
from torchbokeh.psfs.combined import turned_capsule
from torchbokeh.psfs.model import Labels
from torchbokeh.report import internals
from torchbokeh.report.stability.splats import dense_bank


class Part(NamedTuple):
    """What a sheet does in a part of the exposure.

    Attributes:
        motion: ``(B, 2, H, W)`` in px.
        offset: where its middle is seen from the pixel, likewise; None for at the pixel.
        coc: ``(B, 1, H, W)`` signed radius meanwhile; None for that of the sheet.
    """

    motion: Tensor
    offset: Tensor | None = None
    coc: Tensor | None = None

    def mapped(self, change: Callable[[Tensor], Tensor]) -> "Part":
        """All maps changed."""
        return Part(*(None if t is None else change(t) for t in self))  # type: ignore[arg-type]


Parts = tuple[Part, ...]
Spread = Callable[[Tensor, Tensor, Parts, Profile], Tensor]
"""Blurs ``(values, coc, parts)`` through a piece of the lens; the last channel is the coverage."""


@dataclass(frozen=True)
class Sheet:
    """A surface.

    Attributes:
        colour: ``(B, C, H, W)``, premultiplied.
        alpha: ``(B, 1, H, W)``.
        coc: ``(B, 1, H, W)`` signed radius in px, everywhere.
        parts: its motion, everywhere; empty for none.
        bins: centres of its bins in px of CoC.
        opaque: it covers everything.
    """

    colour: Tensor
    alpha: Tensor
    coc: Tensor
    parts: Parts
    bins: tuple[float, ...]
    opaque: bool = False


def composed(
    blur: LensBlur,
    image: Tensor,
    coc: Tensor,
    motion: internals.Displacements = None,
    shutter_depth: Tensor | None = None,
    background: tuple[Tensor, Tensor] | None = None,
) -> Tensor:
    """What a `LensBlur` without a lens is by definition, without merging: float64.

    Args:
        blur: whose settings count.
        image: ``(B, C, H, W)``, or layers ``(B, L, 4, H, W)``; the rest as in `LensBlur.forward`.
        coc: signed radius in px.
        motion: displacement in px, or several in turn.
        shutter_depth: CoC when the shutter opens and when it closes.
        background: what the foreground hides, and its CoC.
    """
    limit = math.inf if blur.max_coc is None else blur.max_coc
    image, coc = image.double(), coc.double().clamp(-limit, limit)
    ways = [] if motion is None else [motion] if isinstance(motion, Tensor) else motion
    steps = [way.double() for way in ways]
    ends = None if shutter_depth is None else shutter_depth.double().clamp(-limit, limit)
    behind = None if background is None else (background[0].double(), background[1].double().clamp(-limit, limit))
    if not image.numel():
        return image if image.dim() == 4 else image.sum(1)
    if len(image) > 1:  # every picture has its own plan
        each = [slice(n, n + 1) for n in range(len(image))]
        return torch.cat(
            [
                composed(
                    blur,
                    image[one],
                    coc[one],
                    [step[one] for step in steps] or None,
                    None if ends is None else ends[one],
                    None if behind is None else (behind[0][one], behind[1][one]),
                )
                for one in each
            ]
        )
    plan = blur.plan(image, coc=coc, motion=steps or None, shutter_depth=ends, background=behind)
    out: Tensor | float = 0.0
    for other, share in ((plan, 1 - sum(share for _, share in plan.fading)), *plan.fading):
        parts = _parts(steps, ends if other.approaches else None, other.parts, blur.shutter) if other.moves else ()
        out = out + share * _by_plan(other, blur, image, coc, parts, behind)
    assert isinstance(out, Tensor)
    height, width = out.shape[2:]
    return out[..., blur.margin : height - blur.margin, blur.margin : width - blur.margin]


def _by_plan(
    plan: Plan, blur: LensBlur, image: Tensor, coc: Tensor, parts: Parts, behind: tuple[Tensor, Tensor] | None
) -> Tensor:
    if image.dim() == 4 and parts and plan.uniform is not None:
        return _panned(image, plan, internals.ADVANCE[blur.shutter])
    sheets = _given(image, coc, parts, plan) if image.dim() == 5 else _split(image, coc, parts, plan, behind)
    if not sheets:
        return torch.zeros_like(image[:, 0])
    blend = 1.0 if plan.quality.merging is None or parts else BLEND
    colour, covered = over(sheets, subdivide(blur.aperture.profile(), plan.subapertures), _spread, blend)
    return torch.cat([colour, covered], 1) if image.dim() == 5 else colour


def _parts(steps: Sequence[Tensor], ends: Tensor | None, pieces: int, shutter: str) -> Parts:
    """A motion in equal parts of the exposure, each of ``pieces`` pieces, seen from where the picture shows it."""
    if not steps:
        assert ends is not None
        steps = [torch.zeros_like(ends)]
    cut = [step / pieces for step in steps for _ in range(pieces)]
    count = len(cut)
    # At the time t, in parts, a point has gone on by all parts before it and what has passed of its own.
    moment = 0.0 if shutter == "start" else count / 2
    gone = [sum((min(max(t - k, 0.0), 1.0) * step for k, step in enumerate(cut)), 0 * cut[0]) for t in _halves(count)]
    shown = sum((min(max(moment - k, 0.0), 1.0) * step for k, step in enumerate(cut)), 0 * cut[0])
    radii: list[Tensor | None] = [None] * count
    if ends is not None:
        start, change = ends[..., :1, :, :], ends.diff(dim=-3) / count
        # Of a radius that changes evenly within a part, the mean of its square counts.
        radii = [((start + t * change).square() + change.square() / 12).sqrt() for t in _halves(count)]
    return tuple(Part(step, middle - shown, r) for step, middle, r in zip(cut, gone, radii, strict=True))


def _halves(count: int) -> list[float]:
    """The middles of parts."""
    return [k + 0.5 for k in range(count)]


def _spread(values: Tensor, coc: Tensor, parts: Parts, profile: Profile) -> Tensor:
    if not parts:
        return dense_spans(values, coc, profile)
    labels = [Labels(coc if p.coc is None else p.coc, motion=p.motion, offset=p.offset) for p in parts]
    return dense_bank(values, labels, internals.bank_of_motion(values.device))


def over(
    sheets: Sequence[Sheet], pieces: Sequence[Profile], spread: Spread, blend: float = 1.0
) -> tuple[Tensor, Tensor]:
    """Sheets over one another, front to back, through every piece of the lens, and the mean of all pieces.

    A piece has a say in a pixel as far as it knows what is there: where splats of a sheet without holes reach it.

    Returns:
        Colour ``(B, C, H, W)``, premultiplied, and coverage ``(B, 1, H, W)``.
    """
    sums: list[Tensor] = [torch.zeros_like(t) for t in (sheets[0].colour, sheets[0].coc, sheets[0].coc)]
    for piece in pieces:
        blurs = [blurred(sheet, piece, spread, blend) for sheet in sheets]
        left = torch.full_like(sheets[0].coc, float(area(piece)))
        votes: list[tuple[Tensor, Tensor, Tensor]] = []
        known = left
        for sheet, (mean, stopped, density) in zip(sheets, blurs, strict=True):
            known = (internals.CERTAIN * density).clamp(max=1)
            votes.append((left * stopped * known, mean, density))
            nothing = torch.zeros_like(left) if sheet.opaque else (sheet.alpha == 0).double()
            left = left * (known * (1 - stopped) + (1 - known) * nothing)
        total = torch.stack([vote for vote, _, _ in votes]).sum(0)
        crowd = torch.stack([vote * density for vote, _, density in votes]).sum(0)
        # Evenly lit whatever the blur does around: weighted by how dense the splats are that are seen.
        dense = torch.where(total > TINY, crowd / total.clamp_min(TINY), blurs[-1][2])
        seen = torch.stack([vote * mean for vote, mean, _ in votes]).sum(0)
        for out, more in zip(sums, (dense * seen, dense * total, dense * (total + left * known)), strict=True):
            out += more
    whole = sums[2].clamp_min(TINY**2)
    return sums[0] / whole, sums[1] / whole


def blurred(sheet: Sheet, piece: Profile, spread: Spread, blend: float = 1.0) -> tuple[Tensor, Tensor, Tensor]:
    """A sheet through a piece of the lens: its mean colour, the share of light it stops, and how dense splats are."""
    source = torch.cat([sheet.colour, sheet.alpha], 1)
    hats = shares(sheet.coc, sheet.bins, blend)
    if not sheet.parts:  # one sum for all of them
        bins = spread(torch.cat([source * hat for hat in hats], 1), sheet.coc, (), piece).chunk(len(hats), 1)
    else:
        bins = tuple(spread(source * hat, sheet.coc, sheet.parts, piece) for hat in hats)
    mean, coverage = filled(bins)
    if sheet.opaque:
        return mean, torch.ones_like(coverage), coverage
    density = spread(torch.ones_like(sheet.alpha), sheet.coc, sheet.parts, piece).clamp_min(0)
    return mean, (coverage / density.clamp_min(TINY)).clamp(max=1), density


def filled(bins: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """Bins, whose last channel is coverage, front to back until a pixel is full: mean colour, sum of coverages."""
    taken, total = torch.zeros_like(bins[0][:, -1:]), torch.zeros_like(bins[0][:, -1:])
    colour = torch.zeros_like(bins[0][:, :-1])
    for found in bins:
        coverage = found[:, -1:].clamp_min(0)
        counts = torch.minimum(coverage, (1 - taken).clamp_min(0))
        colour = colour + found[:, :-1] * counts / coverage.clamp_min(TINY)
        taken, total = taken + counts, total + coverage
    return colour / taken.clamp_min(TINY), total


def shares(coc: Tensor, centres: Sequence[float], blend: float) -> list[Tensor]:
    """Share of each pixel in each bin: all in the nearer one but within ``blend`` of the way between two."""
    if len(centres) == 1:
        return [torch.ones_like(coc)]
    place = ((coc - centres[0]) / (centres[1] - centres[0])).clamp(0, len(centres) - 1)
    below = place.floor().clamp(max=len(centres) - 2)
    passed = ((place - below - 0.5) / blend + 0.5).clamp(0, 1)
    return [(below == k) * (1 - passed) + (below + 1 == k) * passed for k in range(len(centres))]


def splatted(bank: PsfBank, image: Tensor, coc: Tensor) -> Tensor:
    """What `KernelSplatting` with a bank that asks for no more than the CoC is by definition: float64."""
    count = bank.values.shape[1]
    source = torch.cat([image.double(), torch.ones_like(coc).double().expand(-1, count, -1, -1)], 1)
    out = dense_bank(source, [Labels(coc.double())], bank)
    return out[:, :-count] / out[:, -count:].clamp_min(TINY).repeat(1, image.shape[1] // count, 1, 1)


def gathered(image: Tensor, coc: Tensor, motion: Tensor | None, layers: int = 4) -> Tensor:
    """What `reconstruct` makes of samples in the middle of their pixels, of the lens and of the exposure: float64."""
    assert motion is not None
    image, coc, motion = image.double(), coc.double(), motion.double()
    source = torch.cat([image, torch.ones_like(coc)], 1)
    centres = internals.bin_centres(float(coc.min()), float(coc.max()), layers)
    labels, bank = Labels(coc, motion=motion, offset=torch.zeros_like(motion)), internals.bank_of_motion(image.device)
    colour, coverage = filled([dense_bank(source * hat, [labels], bank) for hat in shares(coc, centres, 1.0)])
    return pull_push(colour, (coverage / internals.KNOWN).clamp(0, 1))


def viewed(layers: Tensor, coc: Tensor, views: int, motion: Tensor | None = None) -> Tensor:
    """What `AccumulationBuffer` makes of layers: the mean of views, each looked up point by point.

    Args:
        layers: ``(B, L, 4, H, W)`` premultiplied RGBA, front to back.
        coc: ``(B, L, 1, H, W)`` signed radius in px.
        views: how many, through the points of a disc and at the times that `Views` lists.
        motion: ``(B, L, 2, H, W)`` in px over the open shutter.
    """
    layers, coc = layers.double(), coc.double()
    fields = torch.cat([coc, torch.zeros_like(coc).expand(-1, -1, 2, -1, -1) if motion is None else motion.double()], 2)
    height, width = layers.shape[3:]
    held = [k for k in range(layers.shape[1]) if bool((layers[:, k, 3:] > 0).any())]
    parallax = [gone_on(fields[:, k], layers[:, k, 3:]) for k in held]
    y, x = torch.arange(height, dtype=torch.float64)[:, None], torch.arange(width, dtype=torch.float64)
    total = torch.zeros_like(layers[:, 0])
    seen_from = internals.Views.spread(views, Disc().profile())
    for (u, v), time in zip(seen_from.lens.double().tolist(), seen_from.time.double().tolist(), strict=True):
        left = torch.ones_like(total[:, 3:])
        for k, field in zip(held, parallax, strict=True):
            # A view moves a point by its CoC times the point of the lens: which one comes to lie on each pixel?
            found = field
            for _ in range(internals.STEPS_OF_VIEWS):
                column = x - found[:, 0] * u - found[:, 1] * time
                row = y - found[:, 0] * v - found[:, 2] * time
                found = _looked_up(field, row, column)
            seen = _looked_up(layers[:, k], row, column)
            total = total + left * seen
            left = left * (1 - seen[:, 3:])
    return total / views


def _looked_up(t: Tensor, row: Tensor, column: Tensor) -> Tensor:
    """Bilinear between the pixels of ``(B, C, H, W)`` at ``(B, H, W)`` places; beyond the border, its values."""
    row, column = row.clamp(0, t.shape[2] - 1), column.clamp(0, t.shape[3] - 1)
    out = torch.zeros_like(t)
    batch = torch.arange(len(t))[:, None, None]
    for below in (0, 1):
        for right_of in (0, 1):
            i, j = row.floor().long() + below, column.floor().long() + right_of
            weight = (1 - (row - i).abs()) * (1 - (column - j).abs())
            value = t[batch, :, i.clamp(max=t.shape[2] - 1), j.clamp(max=t.shape[3] - 1)]
            out = out + weight[:, None] * value.movedim(-1, 1)
    return out


def _given(layers: Tensor, coc: Tensor, parts: Parts, plan: Plan) -> list[Sheet]:
    """Those of the caller that hold anything."""
    sheets = []
    for k, bins in zip(plan.layers, plan.bins, strict=True):
        colour, alpha = layers[:, k, :-1], layers[:, k, -1:]
        own = (part.mapped(partial(torch.select, dim=1, index=k)) for part in parts)
        moved = tuple(part.mapped(partial(gone_on, alpha=alpha)) for part in own)
        sheets.append(Sheet(colour, alpha, gone_on(coc[:, k], alpha), moved, bins, k in plan.opaque))
    return sheets


def _split(image: Tensor, coc: Tensor, parts: Parts, plan: Plan, behind: tuple[Tensor, Tensor] | None) -> list[Sheet]:
    """The picture, or what stands in front of its focus plane and the rest, with what is hidden filled in."""
    if len(plan.bins) == 1:
        return [Sheet(image, torch.ones_like(coc), coc, parts, plan.bins[0], opaque=True)]
    start, stop = internals.FOREGROUND
    front = ((stop - coc) / (stop - start)).clamp(0, 1)
    around = F.pad(front, (1, 1, 1, 1))
    height, width = coc.shape[2:]
    near = torch.stack([around[..., y : y + height, x : x + width] for y in range(3) for x in range(3)])
    known = 1 - near.amax(0)
    weight = torch.maximum(known, 1e-9 * (1 - front))
    fill, fill_coc = (
        _hidden(image, coc, weight, internals.COARSE if plan.quality.coarse else 1) if behind is None else behind
    )

    def rest(t: Tensor, hidden: Tensor) -> Tensor:
        return known * t + (1 - known) * hidden

    ahead = tuple(part.mapped(lambda t: gone_on(t, front)) for part in parts)
    after = tuple(part.mapped(lambda t: rest(t, pull_push(t, weight))) for part in parts)
    return [
        Sheet(image * front, front, gone_on(coc, front), ahead, plan.bins[0]),
        Sheet(rest(image, fill), torch.ones_like(coc), rest(coc, fill_coc), after, plan.bins[1], opaque=True),
    ]


def _hidden(image: Tensor, coc: Tensor, weight: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Colour and CoC from the surroundings, in blocks of ``size**2`` pixels; highlights do not spread."""
    height, width = coc.shape[2:]
    if size > 1:
        edge = (0, -width % size, 0, -height % size)
        total, light, radius = (
            F.pad(t, edge).unfold(2, size, size).unfold(3, size, size).mean((4, 5))
            for t in (weight, weight * image, weight * coc)
        )
        weight, image, coc = total, light / total.clamp_min(TINY), radius / total.clamp_min(TINY)
    usual = (image.abs() * weight).sum((2, 3), True) / weight.sum((2, 3), True).clamp_min(TINY)
    excess = image.abs() / (4 * usual).clamp_min(TINY)
    ordinary = torch.maximum(weight / (1 + excess.clamp(max=1e4) ** 4), 1e-9 * weight)
    colours = [pull_push(image[:, c : c + 1], ordinary[:, c : c + 1]) for c in range(image.shape[1])]
    found = torch.cat(colours, 1), pull_push(coc, weight)
    if size == 1:
        return found
    colour, behind = (_between(_between(t, size, 2), size, 3)[..., :height, :width] for t in found)
    return colour, behind


def _between(t: Tensor, size: int, dim: int) -> Tensor:
    """Means of blocks, interpolated linearly along one axis; beyond the middle of the last block, its mean."""
    count = t.shape[dim]
    place = ((torch.arange(count * size, dtype=torch.float64) + 0.5) / size - 0.5).clamp(0, count - 1)
    tent = (1 - (place[:, None] - torch.arange(count)).abs()).clamp_min(0)
    return torch.tensordot(t, tent, dims=([dim], [1])).movedim(-1, dim)


def gone_on(t: Tensor, alpha: Tensor) -> Tensor:
    """A map of a sheet, gone on from its surroundings to where the sheet is not."""
    there = alpha > 0
    return torch.where(there, t, pull_push(torch.where(there, t, 0.0), there.double()))


def _panned(image: Tensor, plan: Plan, advance: float) -> Tensor:
    """Every pixel spread along the same way, divided by the coverage: one PSF, shifted to each pixel."""
    height, width = image.shape[2:]
    radius = plan.uniform
    assert radius is not None
    assert plan.pan is not None
    psf = torch.from_numpy(turned_capsule(abs(radius), plan.pan, advance, (width - 1, height - 1)))
    reach_y, reach_x = (n // 2 for n in psf.shape)
    psf = F.pad(psf, (width - 1 - reach_x,) * 2 + (height - 1 - reach_y,) * 2)
    source = torch.cat([image, torch.ones_like(image[:, :1])], 1)
    out = torch.zeros_like(source)
    for y in range(height):
        for x in range(width):
            at = psf[height - 1 - y : 2 * height - 1 - y, width - 1 - x : 2 * width - 1 - x]
            out += source[:, :, y, x, None, None] * at
    return out[:, :-1] / out[:, -1:].clamp_min(TINY)
