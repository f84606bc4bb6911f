"""Renderers with the options that a user may set, one of each: for the stability report."""

import math
from collections.abc import Callable, Iterator
from functools import lru_cache, partial
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

from torchbokeh.lens import ThinLens
from torchbokeh.lens.dispersion import Dispersion
from torchbokeh.renderers.accumulation import AccumulationBuffer
from torchbokeh.renderers.chromatic import ChromaticAccumulation
from torchbokeh.renderers.lens_blur import LensBlur
from torchbokeh.report.stability.oracles import composed, viewed
from torchbokeh.report.stability.renderer import VIEWS, Renderer, layers_of

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
        bank: dict[str, Any] = {"moves": True, "quality": quality, "bank": "combined"}
        blur = LensBlur(quality=quality)
        run, plan, sums = (partial(_approaching, call) for call in (blur, blur.plan, partial(composed, blur)))
        yield Renderer(f"LensBlur approaching, {quality}", "bank", run, run, plan, widths=_doubled, sums=sums, **bank)
        blur = LensBlur(quality=quality, shutter="start")
        run, plan, sums = (partial(_curved, call) for call in (blur, blur.plan, partial(composed, blur)))
        yield Renderer(f"LensBlur curved motion, {quality}", "bank", run, run, plan, ahead=1.25, sums=sums, **bank)
    blur = LensBlur(aperture="6-gon")
    run, plan, sums = (partial(_image, call) for call in (blur, blur.plan, partial(composed, blur)))
    yield Renderer("LensBlur 6-gon, exact", "composed", run, sums, plan)
    blur = LensBlur()
    run, plan, sums = (partial(_background, call) for call in (blur, blur.plan, partial(composed, blur)))
    yield Renderer("LensBlur background, exact", "composed", run, sums, plan)
    blur = LensBlur(margin=MARGIN, max_coc=CUT_TO, quality="balanced")
    run, plan, sums = (partial(_margin, call) for call in (blur, blur.plan, partial(composed, blur)))
    name = "LensBlur margin and max_coc, balanced"
    yield Renderer(name, "composed", run, run, plan, widths=_cut, quality="balanced", sums=sums)
    run = partial(_views, AccumulationBuffer(views=VIEWS, level_of_detail=1.0, reuse=1))
    yield Renderer("AccumulationBuffer layers, coarser and shared", "views", run, run, texels=TEXELS)
    run = partial(_views, AccumulationBuffer(views=VIEWS, subsamples=4))
    yield Renderer("AccumulationBuffer layers, sub-samples", "rays", run, run)
    run = partial(_moving_views, AccumulationBuffer(views=VIEWS))
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


def _image(call: Callable[..., Any], image: Tensor, coc: Tensor, motion: Tensor | None) -> Any:
    return call(image, coc=coc)


def _coloured(spectrum: str, quality: str, image: Tensor, coc: Tensor, motion: Tensor | None) -> Tensor:
    out: Tensor = LensBlur(dispersing(image.shape[3], spectrum), quality=quality)(image, coc=coc)
    return out


def _coloured_plan(spectrum: str, quality: str, image: Tensor, coc: Tensor, motion: Tensor | None) -> object:
    return LensBlur(dispersing(image.shape[3], spectrum), quality=quality).plan(image, coc=coc)


def _approaching(call: Callable[..., Any], image: Tensor, coc: Tensor, motion: Tensor | None) -> Any:
    return call(image, coc=coc, motion=motion, shutter_depth=torch.cat([coc / 2, 2 * coc], 1))


def _doubled(coc: Tensor) -> tuple[Tensor, Tensor]:
    return coc / 2, 2 * coc


def _curved(call: Callable[..., Any], image: Tensor, coc: Tensor, motion: Tensor | None) -> Any:
    """Half of the motion, as much to its right, and a quarter of it back."""
    assert motion is not None
    right = torch.stack([-motion[:, 1], motion[:, 0]], 1)
    return call(image, coc=coc, motion=(motion / 2, right / 2, -motion / 4))


def _background(call: Callable[..., Any], image: Tensor, coc: Tensor, motion: Tensor | None) -> Any:
    return call(image, coc=coc, background=(image.flip(-1), coc.abs()))


def _margin(call: Callable[..., Any], image: Tensor, coc: Tensor, motion: Tensor | None) -> Any:
    """The picture goes on beyond the sensor, with its last pixels."""
    if image.numel():
        image, coc = (F.pad(t, (MARGIN,) * 4, mode="replicate") for t in (image, coc))
    return call(image, coc=coc)


def _cut(coc: Tensor) -> tuple[Tensor, Tensor]:
    cut = coc.clamp(-CUT_TO, CUT_TO)
    return cut, cut


def _views(buffer: AccumulationBuffer, image: Tensor, coc: Tensor, motion: Tensor | None) -> Tensor:
    rgba, radius = layers_of(image, coc)
    out: Tensor = buffer(rgba, coc=radius)
    return out


def _moving_views(buffer: AccumulationBuffer, image: Tensor, coc: Tensor, motion: Tensor | None) -> Tensor:
    assert motion is not None
    rgba, radius = layers_of(image, coc)
    out: Tensor = buffer(rgba, coc=radius, motion=torch.stack([motion, -motion], 1))
    return out


def _moving_viewed(image: Tensor, coc: Tensor, motion: Tensor | None) -> Tensor:
    assert motion is not None
    return viewed(*layers_of(image, coc), VIEWS, torch.stack([motion, -motion], 1))


def _chromatic_views(spectrum: str, image: Tensor, coc: Tensor, motion: Tensor | None) -> Tensor:
    return _views(ChromaticAccumulation(dispersing(image.shape[3], spectrum), views=VIEWS), image, coc, motion)
