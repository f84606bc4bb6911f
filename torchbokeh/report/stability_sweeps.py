"""Radii and depths that change by a little: the picture changes by a little, across levels and changes of the plan."""

from collections.abc import Callable, Iterator
from itertools import pairwise

import torch
from torch import Tensor

from torchbokeh.kernel_splatting import KernelSplatting
from torchbokeh.lens_blur import LensBlur
from torchbokeh.ops.merge import FADE, STEPS
from torchbokeh.quality import QUALITIES
from torchbokeh.report.stability_bounds import lipschitz
from torchbokeh.report.stability_cases import slope, texture
from torchbokeh.report.stability_renderers import coverage
from torchbokeh.report.stability_rows import Row, row

STEP = 1 / STEPS
"""Change of all radii in px: that of merged ones in cells, so that each step shows."""

JUMP = 0.02
"""Relative L1 that a picture may jump by where a plan changes: stated, not derived. A plan chooses between two
approximations of one composition, and both are off by some hundredths at silhouettes."""


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
            change = max(float((b - a).abs().max()) for a, b in pairwise(near))
            step = STEP
            fade = 0.0
            if merging is not None:
                level = max(radius / merging.cells, 1.0)
                step += level / STEPS
                fade = STEP / (FADE * merging.cells * level) * contrast
            limit = lipschitz(contrast, radius, float(coverage(coc).min())) * step + fade
            case = f"sweep: {radius:.4g} px, in steps of 1/{STEPS} px"
            yield row(f"KernelSplatting, {quality.name}", case, "float64", "largest change", change, limit)


def plan_rows(side: int, width: float = 1e-5) -> Iterator[Row]:
    """By how much a picture jumps where its plan changes, as relative L1 and at worst; below `JUMP`."""
    image, ramp = texture(side, side), slope(side, side, 0.0, 1.0)
    edge = (torch.arange(side) > side // 2).double().expand(1, 1, side, side)
    changes: dict[str, Callable[[float], Tensor]] = {
        "sharp, or not": lambda s: 0.5 + s - 0.7 * edge,
        "one radius, or several": lambda s: 10 + max(s, 0.0) * ramp,
        "foreground appears at -1 px": lambda s: -1 + s + 5 * ramp,
        "foreground appears at a range of 1 px": lambda s: -1.5 + (1 + s) * ramp,
        "one bin, or two": lambda s: 4 + (1 + s) * ramp,
        "two bins, or three": lambda s: 4 + (6 + s) * ramp,
        "sub-apertures from 3 px": lambda s: -2 + (5 + s) * ramp,
        "sub-apertures from 3 px, at an edge": lambda s: -2 + (5 + s) * edge,
    }
    for quality in QUALITIES:
        blur = LensBlur(quality=quality.name)
        for name, coc in changes.items():
            before, after = (blur(image, coc=coc(s)) for s in (-width, width))
            jump = (before - after).abs()
            relative = float(jump.sum() / before.abs().sum())
            yield row(
                f"LensBlur image, {quality.name}",
                f"change of plan: {name}",
                "float64",
                "relative L1 jump",
                relative,
                JUMP,
                largest=float(jump.max()),
            )
    still = LensBlur()
    way = torch.ones(1, 2, side, side, dtype=torch.float64) / 2**0.5
    before, after = (still(image, coc=3 + edge, motion=(0.5 + s) * way) for s in (-width, width))
    jump = float((before - after).abs().sum() / before.abs().sum())
    yield row("LensBlur motion, exact", "change of plan: motion from 0.5 px", "float64", "relative L1 jump", jump, JUMP)
