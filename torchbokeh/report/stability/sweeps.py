"""Radii and depths that change by a little: the picture changes by a little, across levels and changes of the plan."""

from collections.abc import Callable, Iterator
from itertools import pairwise

import torch
from torch import Tensor

from torchbokeh import Dispersion, KernelSplatting, LensBlur, ThinLens
from torchbokeh.ops.merge import FADE, STEPS
from torchbokeh.report.internals import FEWEST, QUALITIES, SEEN, Spectrum
from torchbokeh.report.rows import Row
from torchbokeh.report.stability.bounds import coverage, lipschitz
from torchbokeh.report.stability.cases import slope, texture
from torchbokeh.report.stability.pictures import off, row

STEP = 1 / STEPS
"""Change of all radii in px: that of merged ones in cells, so that each step shows."""

STEEPEST = 128.0
"""How steeply a picture may change with what decides on its plan, as a share of its contrast per px.

The splats of 1/2 px change by 16 per px, and where they thin out to a quarter of their density, by 64 (`lipschitz`);
parts of a plan come in over half a pixel or more, the foreground over 1 px: 4 per px in all, on each of those.
"""

WIDTH = 1e-5
"""Px to either side of a change of plan."""

PARTS = 0.005
"""Relative L1 that a picture may jump by where an approach is cut into one more part: stated, not derived."""


def sweep_rows(side: int) -> Iterator[Row]:
    """Even radii around 1/2 px, the FFT's first radius, and the borders of levels: no jump beyond the Lipschitz bound.

    Merged radii are rounded to 1/64 of a cell, so that the picture moves in steps: the change of the radius counts as
    one step more. Between two levels, whose pictures differ by no more than the contrast, a pixel passes within `FADE`.
    """
    image = texture(side, side)
    contrast = float(image.max() - image.min())
    for quality in QUALITIES:
        blur, merging = KernelSplatting(quality=quality.name), quality.merging
        radii = [0.5, 3.0, 8.0]
        if merging is not None:
            radii += [2 * merging.cells, 2 * merging.cells * (1 + FADE), 4 * merging.cells]
        for radius in dict.fromkeys(radii):
            coc = slope(side, side, radius, radius)
            near = [blur(image, coc + k * STEP) for k in (-2, -1, 0, 1, 2)]
            change = max(off(b, a) for a, b in pairwise(near))
            step, fade = STEP, 0.0
            if merging is not None:
                level = max(radius / merging.cells, 1.0)
                step += level / STEPS
                fade = STEP / (FADE * merging.cells * level) * contrast
            limit = lipschitz(contrast, radius, float(coverage(coc).min())) * step + fade
            case = f"sweep: {radius:.4g} px, in steps of 1/{STEPS} px"
            yield row(f"KernelSplatting, {quality.name}", case, "float64", "largest change", change, limit)


def plan_rows(side: int) -> Iterator[Row]:
    """By how much a picture changes where its plan does, over twice `WIDTH`, at the worst pixel.

    Where a plan takes up one more part, the pictures with and without it are mixed, so that nothing jumps. What is left
    is the number of parts that an exposure is cut into, as relative L1.

    Args:
        side: of the pictures in px.
    """
    image, ramp = texture(side, side), slope(side, side, 0.0, 1.0)
    steepest = 2 * WIDTH * STEEPEST * float(image.max() - image.min())
    borders: tuple[tuple[Spectrum, float], ...] = ("rgb", SEEN), ("continuous", SEEN), ("continuous", FEWEST + 1.0)
    for quality in QUALITIES:
        blur, name = LensBlur(quality=quality.name), f"LensBlur image, {quality.name}"
        for change, picture in _changes(image, ramp).items():
            moved = off(picture(blur, -WIDTH), picture(blur, WIDTH))
            yield row(name, f"change of plan: {change}", "float64", "largest change", moved, steepest)
        for spectrum, border in borders:
            moved = _colour_change(blur, image, 3.3 + 3 * ramp, spectrum, border)
            case = f"change of plan: {spectrum} colours from {border:g} px"
            yield row(name, case, "float64", "largest change", moved, steepest * border)
        coc = 8 + 4 * ramp
        before, after = (blur(image, coc=coc, shutter_depth=_ends(coc, 4 + s)) for s in (-WIDTH, WIDTH))
        jump = float((before - after).abs().sum() / before.abs().sum())
        case = "change of plan: two parts of an approach, or three"
        yield row(name, case, "float64", "relative L1 jump", jump, PARTS, stated=True)


def _changes(image: Tensor, ramp: Tensor) -> dict[str, Callable[[LensBlur, float], Tensor]]:
    """Pictures that are a little below or above the border of a plan, by what changes there.

    Args:
        image: ``(1, 3, H, W)``.
        ramp: from 0 to 1 across it.
    """
    side = image.shape[3]
    edge = (torch.arange(side) > side // 2).double().expand_as(ramp)
    way = torch.tensor([0.6, 0.8], dtype=torch.float64).view(1, 2, 1, 1).expand(1, 2, side, side)
    behind = texture(side, side, seed=3)
    layers = torch.stack([torch.cat([image * edge, edge], 1), torch.cat([behind, torch.ones_like(edge)], 1)], 1)
    deep = -6 + 10 * ramp
    maps: dict[str, Callable[[float], Tensor]] = {
        "sharp, or not": lambda s: 0.5 + s - 0.7 * edge,
        "one radius, or several": lambda s: 10 + max(s, 0.0) * ramp,
        "foreground appears at -1 px": lambda s: -1 + s + 5 * ramp,
        "foreground appears at a range of 1 px": lambda s: -1.5 + (1 + s) * ramp,
        "rest appears at -2 px": lambda s: -7 + (5 + s) * edge,
        "one bin, or two": lambda s: 4 + (1 + s) * ramp,
        "two bins, or three": lambda s: 4 + (6 + s) * ramp,
        "sub-apertures from 3 px": lambda s: -2 + (5 + s) * ramp,
        "sub-apertures from 3 px, at an edge": lambda s: -2 + (5 + s) * edge,
    }
    return {name: lambda blur, s, coc=coc: blur(image, coc=coc(s)) for name, coc in maps.items()} | {
        "foreground over a known background": lambda blur, s: blur(image, coc=-1 + s + 5 * ramp, background=behind),
        "sub-apertures of layers": lambda blur, s: blur(layers, coc=torch.stack([-3 + s - edge * 0, 2 * edge], 1)),
        "motion from 0.5 px": lambda blur, s: blur(image, coc=deep, motion=(0.5 + s) * way),
        "approach from 0.5 px": lambda blur, s: blur(image, coc=deep, shutter_depth=_ends(deep, 0.5 + s)),
    }


def _ends(coc: Tensor, change: float) -> Tensor:
    """CoC when the shutter opens and when it closes."""
    return torch.cat([coc - change / 2, coc + change / 2], 1)


def _colour_change(blur: LensBlur, image: Tensor, depth: Tensor, spectrum: Spectrum, border: float) -> float:
    """How much a picture changes where its colours spread by that many px."""

    def with_axial(strength: float) -> LensBlur:
        lens = ThinLens(0.05, 0.1, 2.0, 0.036, dispersion=Dispersion("BK7", axial=strength, spectrum=spectrum))
        return LensBlur(lens, quality=blur.quality)

    low, high = 0.0, 1.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        below = with_axial(middle).plan(image, depth).spread < border
        low, high = (middle, high) if below else (low, middle)
    before, after = (with_axial(high * (1 + s))(image, depth) for s in (-WIDTH, WIDTH))
    return off(before, after)
