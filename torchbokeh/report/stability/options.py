"""Renderers with the options that a user may set, one of each: for the stability report."""

import math
from collections.abc import Iterator
from functools import lru_cache, partial
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

from torchbokeh import AccumulationBuffer, ChromaticAccumulation, Dispersion, LensBlur, ThinLens
from torchbokeh.report.stability.oracles import viewed
from torchbokeh.report.stability.renderer import (
    VIEWS,
    Renderer,
    ask,
    layered,
    layered_moving,
    layers_of,
    of_blur,
    picture,
)

CUT_TO = 6.0
"""``max_coc`` of the renderer that has one, in px."""

MARGIN = 3
"""Of the renderer that has one, in px."""

TEXELS = 1.5 * math.sqrt(2) * 2 * math.sqrt(math.pi)
"""How far a level of detail of 1 spreads light, as a share of the radius: a texel covers up to the area of the blur, or
four times that of the level above, and is shared with its neighbours each way."""

SPREAD = 3.0
"""How far in px `dispersing` moves light, in radius and in place, at most."""


def options() -> Iterator[Renderer]:
    """All of them."""
    for quality in ("exact", "balanced"):
        for spectrum in ("rgb", "continuous"):
            run, plan = partial(_coloured, spectrum, quality), partial(_coloured_plan, spectrum, quality)
            name = f"LensBlur dispersion {spectrum}, {quality}"
            yield Renderer(name, "colours", run, run, plan, widths=dispersed, quality=quality)
        bank: dict[str, Any] = {"moves": True, "bank": "combined"}
        blur = LensBlur(quality=quality)
        yield of_blur(f"LensBlur approaching, {quality}", "bank", blur, _approaching, widths=_doubled, **bank)
        blur = LensBlur(quality=quality, shutter="start")
        yield of_blur(f"LensBlur curved motion, {quality}", "bank", blur, _curved, ahead=1.25, **bank)
    yield of_blur("LensBlur 6-gon, exact", "composed", LensBlur(aperture="6-gon"), picture)
    yield of_blur("LensBlur background, exact", "composed", LensBlur(), _background)
    blur = LensBlur(margin=MARGIN, max_coc=CUT_TO, quality="balanced")
    yield of_blur("LensBlur margin and max_coc, balanced", "composed", blur, _margin, widths=_cut)
    run = partial(ask, AccumulationBuffer(views=VIEWS, level_of_detail=1.0, reuse=1), layered)
    yield Renderer("AccumulationBuffer layers, coarser and shared", "views", run, run, texels=TEXELS)
    run = partial(ask, AccumulationBuffer(views=VIEWS, subsamples=4), layered)
    yield Renderer("AccumulationBuffer layers, sub-samples", "rays", run, run)
    run = partial(ask, AccumulationBuffer(views=VIEWS), layered_moving)
    yield Renderer("AccumulationBuffer layers, in motion", "views", run, _moving_viewed, moves=True)
    for spectrum in ("rgb", "continuous"):
        run = partial(_chromatic_views, spectrum)
        yield Renderer(f"ChromaticAccumulation layers, {spectrum}", "views", run, run, widths=dispersed)


@lru_cache
def dispersing(width: int, spectrum: str) -> ThinLens:
    """A lens that moves light by a px or two, whatever the width of the picture."""
    dispersion = Dispersion("BK7", axial=8.0, lateral=0.02, spectrum=spectrum)  # type: ignore[arg-type]
    return ThinLens(0.05, 1.0, 2.0, sensor_width=0.003 * width, dispersion=dispersion)


def dispersed(coc: Tensor) -> tuple[Tensor, Tensor]:
    """Radii that differ from those of a CoC by `SPREAD`."""
    sign = torch.where(coc < 0, -1.0, 1.0).to(coc.dtype)
    return sign * (coc.abs() - SPREAD).clamp_min(0), sign * (coc.abs() + SPREAD)


def _coloured(spectrum: str, quality: str, image: Tensor, coc: Tensor, motion: Tensor | None) -> Tensor:
    out: Tensor = LensBlur(dispersing(image.shape[3], spectrum), quality=quality)(image, coc=coc)
    return out


def _coloured_plan(spectrum: str, quality: str, image: Tensor, coc: Tensor, motion: Tensor | None) -> object:
    return LensBlur(dispersing(image.shape[3], spectrum), quality=quality).plan(image, coc=coc)


def _approaching(image: Tensor, coc: Tensor, motion: Tensor | None) -> dict[str, Any]:
    return {"": image, "coc": coc, "motion": motion, "shutter_depth": torch.cat([coc / 2, 2 * coc], 1)}


def _doubled(coc: Tensor) -> tuple[Tensor, Tensor]:
    return coc / 2, 2 * coc


def _curved(image: Tensor, coc: Tensor, motion: Tensor | None) -> dict[str, Any]:
    """Half of the motion, as much to its right, and a quarter of it back."""
    assert motion is not None
    right = torch.stack([-motion[:, 1], motion[:, 0]], 1)
    return {"": image, "coc": coc, "motion": (motion / 2, right / 2, -motion / 4)}


def _background(image: Tensor, coc: Tensor, motion: Tensor | None) -> dict[str, Any]:
    return {"": image, "coc": coc, "background": (image.flip(-1), coc.abs())}


def _margin(image: Tensor, coc: Tensor, motion: Tensor | None) -> dict[str, Any]:
    """The picture goes on beyond the sensor, with its last pixels."""
    if image.numel():
        image, coc = (F.pad(t, (MARGIN,) * 4, mode="replicate") for t in (image, coc))
    return {"": image, "coc": coc}


def _cut(coc: Tensor) -> tuple[Tensor, Tensor]:
    cut = coc.clamp(-CUT_TO, CUT_TO)
    return cut, cut


def _moving_viewed(image: Tensor, coc: Tensor, motion: Tensor | None) -> Tensor:
    assert motion is not None
    return viewed(*layers_of(image, coc), VIEWS, torch.stack([motion, -motion], 1))


def _chromatic_views(spectrum: str, image: Tensor, coc: Tensor, motion: Tensor | None) -> Tensor:
    buffer = ChromaticAccumulation(dispersing(image.shape[3], spectrum), views=VIEWS)
    out: Tensor = ask(buffer, layered, image, coc, motion)
    return out
