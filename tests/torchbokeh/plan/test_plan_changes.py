"""A picture changes by a little where its plan does: parts fade in, and nothing pops.

``python -P tests/torchbokeh/plan/test_plan_changes.py`` prints by how much.
"""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from torchbokeh import Dispersion, LensBlur, ThinLens
from torchbokeh.lens.dispersion import FEWEST, SEEN, Spectrum
from torchbokeh.plan.quality import QUALITIES
from torchbokeh.report.stability.cases import slope, texture

STEEPEST = 128.0
"""How steeply a picture may change with what decides on its plan, as a share of its contrast per px.

The splats of 1/2 px change by 16 per px, and where they thin out to a quarter of their density, by 64
(`torchbokeh.report.stability.bounds.lipschitz`); parts of a plan come in over half a pixel or more, the foreground over
1 px: 4 per px in all, on each of those.
"""

WIDTH = 1e-5
"""Px to either side of a change of plan."""

SIDE = 24
IMAGE, RAMP = texture(SIDE, SIDE), slope(SIDE, SIDE, 0.0, 1.0)
CONTRAST = float(IMAGE.max() - IMAGE.min())
NAMES = [quality.name for quality in QUALITIES]
BORDERS: tuple[tuple[Spectrum, float], ...] = ("rgb", SEEN), ("continuous", SEEN), ("continuous", FEWEST + 1.0)


def ends(coc: Tensor, change: float) -> Tensor:
    """CoC when the shutter opens and when it closes."""
    return torch.cat([coc - change / 2, coc + change / 2], 1)


def pictures() -> dict[str, Callable[[LensBlur, float], Tensor]]:
    """Pictures that are a little below or above the border of a plan, by what changes there."""
    image, ramp, side = IMAGE, RAMP, SIDE
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
        "approach from 0.5 px": lambda blur, s: blur(image, coc=deep, shutter_depth=ends(deep, 0.5 + s)),
        "three parts of an approach": lambda blur, s: blur(image, coc=deep, shutter_depth=ends(deep, 3.5 + s)),
        "three parts alone": lambda blur, s: blur(image, coc=deep, shutter_depth=ends(deep, 4 + s)),
    }


PICTURES = pictures()


def change(quality: str, name: str) -> float:
    """Of the worst pixel, over twice `WIDTH`."""
    blur = LensBlur(quality=quality)
    return float((PICTURES[name](blur, -WIDTH) - PICTURES[name](blur, WIDTH)).abs().max())


def colour_change(quality: str, spectrum: Spectrum, border: float) -> float:
    """The same where colours spread by that many px."""
    depth = 3.3 + 3 * RAMP

    def with_axial(strength: float) -> LensBlur:
        lens = ThinLens(0.05, 0.1, 2.0, 0.036, dispersion=Dispersion("BK7", axial=strength, spectrum=spectrum))
        return LensBlur(lens, quality=quality)

    low, high = 0.0, 1.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        below = with_axial(middle).plan(IMAGE, depth).spread < border
        low, high = (middle, high) if below else (low, middle)
    before, after = (with_axial(high * (1 + s))(IMAGE, depth) for s in (-WIDTH, WIDTH))
    return float((before - after).abs().max())


@pytest.mark.parametrize("name", PICTURES)
def test_a_part_of_a_plan_fades_in(name: str) -> None:
    for quality in NAMES:
        assert change(quality, name) <= min(2 * WIDTH * STEEPEST * CONTRAST, 1e-3)


@pytest.mark.parametrize(("spectrum", "border"), BORDERS)
def test_another_band_of_colours_fades_in(spectrum: Spectrum, border: float) -> None:
    for quality in NAMES:
        assert colour_change(quality, spectrum, border) <= min(2 * WIDTH * border * STEEPEST * CONTRAST, 1e-3)


if __name__ == "__main__":
    for quality in NAMES:
        for name in PICTURES:
            print(f"{quality}, {name}: {change(quality, name):.2g}")
        for spectrum, border in BORDERS:
            print(f"{quality}, {spectrum} colours from {border:g} px: {colour_change(quality, spectrum, border):.2g}")
