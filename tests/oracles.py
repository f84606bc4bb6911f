"""Oracles in double: compositions and splats from banks written a second time, by plain sums.

A plan says what is done: bins, sub-apertures, what fills hidden parts; a bank and its renderer say which sample a pixel
takes, where it lies and which pixels are highlights. How it is done is written anew on top of
`torchbokeh.ops.dense.dense_spans`: no list of pixels, no running sum, no Fourier transform, no fused pass, no special
case for what is sharp or even. Only `pull_push` is shared.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from torchbokeh import LensBlur, Plan, PsfBank
from torchbokeh.banks.highlights import BRIGHT, ordinary_light, share_of_others
from torchbokeh.compose.composition import CERTAIN
from torchbokeh.ops.composite import TINY, pull_push
from torchbokeh.ops.dense import dense_spans
from torchbokeh.ops.highlights import LEAST_CONTRAST
from torchbokeh.ops.integrate import lattice_green
from torchbokeh.ops.spans import MIN_RADIUS, Profile, area, subdivide
from torchbokeh.plan.bins import FOREGROUND
from torchbokeh.psfs.aperture import Disc
from torchbokeh.psfs.combined import Combined
from torchbokeh.psfs.model import Labels, Place
from torchbokeh.psfs.represent import DOMAINS

FINE = 2
"""Samples along each side of a pixel that the capsule of a highlight is drawn by (`torchbokeh.ops.capsules`)."""

POINTS = 1 << 21
"""Points that are expanded at a time."""


@dataclass(frozen=True)
class Sheet:
    """A surface.

    Attributes:
        colour: ``(B, C, H, W)``, premultiplied.
        alpha: ``(B, 1, H, W)``.
        coc: ``(B, 1, H, W)`` signed radius in px, everywhere.
        bins: centres of its bins in px of CoC.
        opaque: it covers everything.
    """

    colour: Tensor
    alpha: Tensor
    coc: Tensor
    bins: tuple[float, ...]
    opaque: bool = False


def composed(blur: LensBlur, image: Tensor, coc: Tensor, background: tuple[Tensor, Tensor] | None = None) -> Tensor:
    """What an exact `LensBlur` without a lens makes of one still picture, by definition.

    Args:
        blur: whose settings count.
        image: ``(1, C, H, W)``, or layers ``(1, L, 4, H, W)``, float64.
        coc: signed radius in px.
        background: what the foreground hides, and its CoC.
    """
    plan = blur.plan(image, coc=coc, background=background)
    mixed = [(plan, 1 - sum(share for _, share in plan.fading)), *plan.fading]
    return torch.stack([share * _by_plan(other, blur, image, coc, background) for other, share in mixed]).sum(0)


def _by_plan(plan: Plan, blur: LensBlur, image: Tensor, coc: Tensor, behind: tuple[Tensor, Tensor] | None) -> Tensor:
    sheets = _given(image, coc, plan) if image.dim() == 5 else _split(image, coc, plan, behind)
    if not sheets:
        return torch.zeros_like(image[:, 0])
    colour, covered = over(sheets, subdivide(blur.aperture.profile(), plan.subapertures))
    return torch.cat([colour, covered], 1) if image.dim() == 5 else colour


def over(sheets: Sequence[Sheet], pieces: Sequence[Profile]) -> tuple[Tensor, Tensor]:
    """Sheets over one another, front to back, through every piece of the lens, and the mean of all pieces.

    A piece has a say in a pixel as far as it knows what is there: where splats of a sheet without holes reach it. Of
    a sheet that lets light through it has to know what is behind, or what stops light there would count for more.

    Returns:
        Colour ``(B, C, H, W)``, premultiplied, and coverage ``(B, 1, H, W)``.
    """
    sums: list[Tensor] = [torch.zeros_like(t) for t in (sheets[0].colour, sheets[0].coc, sheets[0].coc)]
    for piece in pieces:
        blurs = [blurred(sheet, piece) for sheet in sheets]
        left = torch.full_like(sheets[0].coc, float(area(piece)))
        votes: list[tuple[Tensor, Tensor, Tensor]] = []
        parts = [
            (
                stopped,
                (CERTAIN * density).clamp(max=1),
                torch.zeros_like(left) if sheet.opaque else (sheet.alpha == 0) * 1.0,
            )
            for sheet, (_, stopped, density) in zip(sheets, blurs, strict=True)
        ]
        # How much is known of all from each sheet on backwards: of what stops light, all that is there.
        told = [torch.ones_like(left)]
        for stopped, known, nothing in reversed(parts):
            ahead = known * (stopped + (1 - stopped) * told[0])
            told.insert(0, nothing * told[0] + (1 - nothing) * ahead)
        for number, ((stopped, known, nothing), (mean, _, density)) in enumerate(zip(parts, blurs, strict=True)):
            votes.append((left * stopped * known * (stopped + (1 - stopped) * told[number + 1]), mean, density))
            goes_on = (1 - known) * nothing if number < len(sheets) - 1 else 0.0
            left = left * (known * (1 - stopped) + goes_on)
        total = torch.stack([vote for vote, _, _ in votes]).sum(0)
        crowd = torch.stack([vote * density for vote, _, density in votes]).sum(0)
        # Evenly lit whatever the blur does around: weighted by how dense the splats are that are seen.
        dense = torch.where(total > TINY, crowd / total.clamp_min(TINY), blurs[-1][2])
        seen = torch.stack([vote * mean for vote, mean, _ in votes]).sum(0)
        for out, more in zip(sums, (dense * seen, dense * total, dense * (total + left)), strict=True):
            out += more
    whole = sums[2].clamp_min(TINY**2)
    return sums[0] / whole, sums[1] / whole


def blurred(sheet: Sheet, piece: Profile) -> tuple[Tensor, Tensor, Tensor]:
    """A sheet through a piece of the lens: its mean colour, the share of light it stops, and how dense splats are."""
    source = torch.cat([sheet.colour, sheet.alpha], 1)
    hats = shares(sheet.coc, sheet.bins)
    bins = dense_spans(torch.cat([source * hat for hat in hats], 1), sheet.coc, piece).chunk(len(hats), 1)
    mean, coverage = filled(bins)
    if sheet.opaque:
        return mean, torch.ones_like(coverage), coverage
    density = dense_spans(torch.ones_like(sheet.alpha), sheet.coc, piece).clamp_min(0)
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


def shares(coc: Tensor, centres: Sequence[float]) -> list[Tensor]:
    """Share of each pixel in each bin: hats that sum to 1."""
    if len(centres) == 1:
        return [torch.ones_like(coc)]
    place = ((coc - centres[0]) / (centres[1] - centres[0])).clamp(0, len(centres) - 1)
    return [(1 - (place - k).abs()).clamp_min(0) for k in range(len(centres))]


def _given(layers: Tensor, coc: Tensor, plan: Plan) -> list[Sheet]:
    """Those of the caller that hold anything."""
    sheets = []
    for k, bins in zip(plan.layers, plan.bins, strict=True):
        colour, alpha = layers[:, k, :-1], layers[:, k, -1:]
        sheets.append(Sheet(colour, alpha, gone_on(coc[:, k], alpha), bins, k in plan.opaque))
    return sheets


def _split(image: Tensor, coc: Tensor, plan: Plan, behind: tuple[Tensor, Tensor] | None) -> list[Sheet]:
    """The picture, or what stands in front of its focus plane and the rest, with what is hidden filled in."""
    if len(plan.bins) == 1:
        return [Sheet(image, torch.ones_like(coc), coc, plan.bins[0], opaque=True)]
    start, stop = FOREGROUND
    front = ((stop - coc) / (stop - start)).clamp(0, 1)
    around = F.pad(front, (1, 1, 1, 1))
    height, width = coc.shape[2:]
    near = torch.stack([around[..., y : y + height, x : x + width] for y in range(3) for x in range(3)])
    known = 1 - near.amax(0)
    weight = torch.maximum(known, 1e-9 * (1 - front))
    fill, fill_coc = _hidden(image, coc, weight) if behind is None else behind

    def rest(t: Tensor, hidden: Tensor) -> Tensor:
        return known * t + (1 - known) * hidden

    return [
        Sheet(image * front, front, gone_on(coc, front), plan.bins[0]),
        Sheet(rest(image, fill), torch.ones_like(coc), rest(coc, fill_coc), plan.bins[1], opaque=True),
    ]


def _hidden(image: Tensor, coc: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Colour and CoC from the surroundings; highlights do not spread."""
    usual = (image.abs() * weight).sum((2, 3), True) / weight.sum((2, 3), True).clamp_min(TINY)
    excess = image.abs() / (4 * usual).clamp_min(TINY)
    ordinary = torch.maximum(weight / (1 + excess.clamp(max=1e4) ** 4), 1e-9 * weight)
    colours = [pull_push(image[:, c : c + 1], ordinary[:, c : c + 1]) for c in range(image.shape[1])]
    return torch.cat(colours, 1), pull_push(coc, weight)


def gone_on(t: Tensor, alpha: Tensor) -> Tensor:
    """A map of a sheet, gone on from its surroundings to where the sheet is not."""
    there = alpha > 0
    return torch.where(there, t, pull_push(torch.where(there, t, 0.0), there.double()))


def splatted(bank: PsfBank, image: Tensor, coc: Tensor) -> Tensor:
    """What `KernelSplatting` with a bank that asks for no more than the CoC is by definition: float64."""
    count = bank.values.shape[1]
    source = torch.cat([image.double(), torch.ones_like(coc).double().expand(-1, count, -1, -1)], 1)
    out = dense_bank(source, [Labels(coc.double())], bank)
    return out[:, :-count] / out[:, -count:].clamp_min(TINY).repeat(1, image.shape[1] // count, 1, 1)


def dense_bank(values: Tensor, parts: Sequence[Labels], bank: PsfBank) -> Tensor:
    """What `torchbokeh.banks.splat.splat_bank` defines, without merging.

    Args:
        values: ``(B, C, H, W)`` float64, what each pixel spreads, and last the coverage.
        parts: labels, of which each spreads an equal part.
        bank: the PSFs.

    Returns:
        ``(B, C, H, W)``, float64.
    """
    extreme = bank.model.needs_clipping(parts, (values.shape[2], values.shape[3]))
    if not bool((values != 0).any()):
        return values
    values = values / len(parts)
    seen = [bank.model.clipped(values, part, 1) if extreme else (values, part) for part in parts]
    light = torch.stack([t for t, _ in seen]).mean(0)
    ordinary = ordinary_light(light)
    bound = ordinary * (BRIGHT * bank.model.area([part for _, part in seen], bank.reach())).clamp_min(LEAST_CONTRAST)
    bright = (light.abs() > bound.clamp_min(TINY)).any(1, keepdim=True)
    kept = share_of_others(light, ordinary, bright, bank.values.shape[1])
    out = torch.zeros_like(values)
    for own, part in seen:
        rest = own * kept
        lit = own - rest
        still = None if part.coc is None else bank.model.still(part)
        if still is not None and part.coc is not None:
            resting, rest = rest * still, rest * (1 - still)
            if bool((resting != 0).any()):
                out = out + dense_spans(resting, part.coc, Disc().profile())
        out = out + dense_samples(rest, part, bank)
        if bool(bright.any()):
            out = out + (capsules(lit, part) if isinstance(bank.model, Combined) else _pictured(lit, part, bank))
    return out


def dense_samples(values: Tensor, labels: Labels, bank: PsfBank) -> Tensor:
    """Every pixel's nearest sample, point by point; each domain is undone by the sum that defines it."""
    out = torch.zeros_like(values)
    for place, number in _places(labels, bank):
        for name in DOMAINS:
            out = out + _undone(values, place, number, bank, name)
    return out


def _places(labels: Labels, bank: PsfBank) -> list[tuple[Place, Tensor]]:
    """Where the PSFs of each pixel lie, with all that scales them in ``frame`` and ``scale``, and their samples."""
    found = []
    for place in bank.model.places(labels):
        coordinates = place.coordinates.movedim(1, -1)
        number = bank.model.grid.index(coordinates)
        factor = torch.ones_like(place.coordinates[:, :1])
        extent = bank.model.extent(coordinates)
        if extent is not None:
            factor = (extent / bank.extents[number])[:, None]
        frame = place.frame
        if frame is None:
            frame = torch.eye(2, dtype=torch.float64)[None, :, :, None, None].expand(-1, -1, -1, *number.shape[1:])
        shift = torch.zeros_like(factor) if place.offset is None else place.offset
        if labels.offset is not None:
            shift = shift + labels.offset
        scale = factor if place.scale is None else place.scale * factor
        found.append((place._replace(frame=frame * factor[:, None], scale=scale, offset=shift), number))
    return found


def _undone(values: Tensor, place: Place, number: Tensor, bank: PsfBank, domain: str) -> Tensor:
    """The samples of one domain: their points in a buffer, and the sum that undoes the domain's operator."""
    height, width = values.shape[2:]
    used = (bank.domains == DOMAINS.index(domain))[number][:, None] & (values != 0).any(1, keepdim=True)
    if not bool(used.any()):
        return torch.zeros_like(values)
    assert place.scale is not None
    spread = torch.where(used, values if place.share is None else values * place.share, 0.0)
    colours = bank.values.shape[1]
    if bank.model.tints:
        gains = bank.gains().double()[number].movedim(-1, 1).clamp_min(TINY)
        spread = torch.cat([spread[:, :-colours], spread[:, -colours:] / gains], 1)
    if domain == "laplacian":
        spread = spread / place.scale.square()
    buffer, left, top = _pointed(spread, place, number, bank, used)
    rows, columns = (
        n + torch.arange(m, dtype=torch.float64) for n, m in zip((top, left), buffer.shape[2:], strict=True)
    )
    y, x = torch.arange(height)[:, None], torch.arange(width)[:, None]
    if domain == "direct":
        return _product((y == rows).double(), buffer, (x == columns).double())
    if domain == "scanline":
        return _product((y == rows).double(), buffer, (x >= columns).double())
    away_y, away_x = (y - rows).abs().long(), (x - columns).abs().long()
    green = lattice_green(int(away_y.max()) + 1, int(away_x.max()) + 1)
    # All pairs of a row of the picture and one of the buffer that are as far apart, one distance after the other.
    lines = (_product((away_y == n).double(), buffer, green[n, away_x]) for n in range(len(green)))
    return torch.stack(list(lines)).sum(0)


def _product(over_rows: Tensor, buffer: Tensor, over_columns: Tensor) -> Tensor:
    return torch.einsum("vy,bcyx,ux->bcvu", over_rows, buffer, over_columns)


def _pointed(spread: Tensor, place: Place, number: Tensor, bank: PsfBank, used: Tensor) -> tuple[Tensor, int, int]:
    """All points, each shared bilinearly by four pixels, and where the buffer that holds them begins (x, y)."""
    assert place.frame is not None
    assert place.offset is not None
    batch, channels = spread.shape[:2]
    n, _, y, x = used.nonzero().unbind(1)
    sample = number[n, y, x]
    sizes = (bank.counts[sample + 1] - bank.counts[sample]).long()
    owner = torch.arange(len(n)).repeat_interleave(sizes)
    point = torch.arange(len(owner)) - (sizes.cumsum(0) - sizes)[owner] + bank.counts[sample].long()[owner]
    frame, offset = place.frame.expand(batch, -1, -1, -1, -1), place.offset.expand(batch, 2, -1, -1)
    matrix, centre = frame[n, :, :, y, x], torch.stack([x, y], 1) + offset[n, :, y, x]
    target = centre[owner] + (matrix[owner] @ bank.offsets[point].double()[..., None])[..., 0]
    low = target.floor()
    left, top = (int(v) for v in low.amin(0))
    right, bottom = (int(v) + 2 for v in low.amax(0))
    width = right - left
    buffer = torch.zeros(channels, batch * (bottom - top) * width, dtype=torch.float64)
    values = spread[n, :, y, x].T
    colour = torch.arange(channels) % bank.values.shape[1]
    for part in torch.arange(len(owner)).split(POINTS):
        who, share = owner[part], target[part] - low[part]
        light = values[:, who] * bank.values[point[part]].double().T[colour]
        column, row = (low[part] - torch.tensor([left, top])).long().unbind(1)
        first = (n[who] * (bottom - top) + row) * width + column
        for right_of, below in ((0, 0), (1, 0), (0, 1), (1, 1)):
            weight = (share[:, 0] if right_of else 1 - share[:, 0]) * (share[:, 1] if below else 1 - share[:, 1])
            buffer.index_add_(1, first + below * width + right_of, light * weight)
    return buffer.reshape(channels, batch, bottom - top, width).movedim(0, 1), left, top


def _pictured(values: Tensor, labels: Labels, bank: PsfBank) -> Tensor:
    """Highlights: samples as pictures, of which each pixel is drawn as several points where it is turned or scaled."""
    out = torch.zeros_like(values)
    alive = (values != 0).any(1)
    for place, number in _places(labels, bank):
        assert place.scale is not None
        turned = bank.model.turns or float((place.scale - 1).abs().max()) > 0
        fine = max(1, math.ceil(2 * float(place.scale.max()))) if turned else 1
        used = number[alive].bincount(minlength=len(bank)) > 0
        out = out + _undone(values, place, number, bank.dense(used, fine), "direct")
    return out


def capsules(values: Tensor, labels: Labels) -> Tensor:
    """Highlights: discs along a segment, each pixel of the picture by `FINE` samples each way, and a sum of 1."""
    out = torch.zeros_like(values)
    height, width = values.shape[2:]
    assert labels.coc is not None
    motion = torch.zeros_like(values[:, :2]) if labels.motion is None else labels.motion
    offset = torch.zeros_like(motion) if labels.offset is None else labels.offset
    steps = (torch.arange(FINE, dtype=torch.float64) + 0.5) / FINE - 0.5
    for n, y, x in (values != 0).any(1).nonzero().tolist():
        radius = max(abs(float(labels.coc[n, 0, y, x])), MIN_RADIUS)
        way, at = motion[n, :, y, x], offset[n, :, y, x]
        length = float(way.norm())
        ahead = way / length if length >= 2e-3 else torch.tensor([1.0, 0.0], dtype=torch.float64)
        reach = math.ceil(radius + float((way.abs() / 2 + at.abs()).max())) + 1
        side = torch.arange(-reach, reach + 1, dtype=torch.float64)
        v = (side[:, None] + steps).flatten()[:, None] - at[1]
        u = (side[:, None] + steps).flatten() - at[0]
        along, across = u * ahead[0] + v * ahead[1], v * ahead[0] - u * ahead[1]
        chord = (radius**2 - across.square()).clamp_min(0).sqrt()
        if length < 2e-3:
            light = (along.abs() <= chord).double() * (chord > 2e-6)
        else:
            stop, start = torch.minimum(along + length / 2, chord), torch.maximum(along - length / 2, -chord)
            light = (stop - start).clamp_min(0)
        pixels = light.reshape(len(side), FINE, len(side), FINE).sum((1, 3))
        pixels = pixels / pixels.sum()
        top, left = max(y - reach, 0), max(x - reach, 0)
        bottom, right = min(y + reach + 1, height), min(x + reach + 1, width)
        piece = pixels[top - y + reach : bottom - y + reach, left - x + reach : right - x + reach]
        out[n, :, top:bottom, left:right] += values[n, :, y, x, None, None] * piece
    return out
