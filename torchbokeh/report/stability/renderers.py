"""The renderers that stiff cases are run through, each with an oracle in double.

Where a renderer does what its definition says but for rounding, the oracle is that definition, by plain sums
(`torchbokeh.report.stability.oracles`). Where it approximates it, by merging or by the border of a buffer, there are
two: itself in double, for rounding, and the definition, for the approximation.
"""

import math
from collections.abc import Iterator
from functools import lru_cache, partial
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

import torchbokeh
from torchbokeh import AccumulationBuffer, ChromaticAccumulation, KernelSplatting, LensBlur
from torchbokeh.ops.composite import TINY
from torchbokeh.ops.dense import dense_spans
from torchbokeh.ops.dispatch import compute_dtype
from torchbokeh.psfs.aperture import Disc
from torchbokeh.report.internals import QUALITIES, pixel_positions
from torchbokeh.report.stability.oracles import gathered, splatted, viewed
from torchbokeh.report.stability.renderer import (
    VIEWS,
    Renderer,
    bank_of,
    blur_renderer,
    call_with,
    layered,
    layers_of,
    moving,
    moving_layers,
    picture,
    splatting_renderer,
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


def renderers() -> Iterator[Renderer]:
    """All of them."""
    for quality in QUALITIES:
        kind = "splat" if quality.merging is None else "merged"
        name = f"KernelSplatting, {quality.name}"
        yield splatting_renderer(name, kind, KernelSplatting(quality=quality.name), dense)
    for quality in QUALITIES:
        blur = LensBlur(quality=quality.name)
        yield blur_renderer(f"LensBlur image, {quality.name}", "composed", blur, picture)
        yield blur_renderer(f"LensBlur layers, {quality.name}", "layers", blur, layered)
        yield blur_renderer(f"LensBlur motion, {quality.name}", "bank", blur, moving, moves=True, bank="combined")
    for name in ("stylized", "physical-lens"):
        bank = bank_of(name)
        splatting, slow = KernelSplatting(quality="exact", bank=bank), lambda i, c, _, bank=bank: splatted(bank, i, c)
        yield splatting_renderer(f"KernelSplatting, bank {name}", "bank", splatting, slow, bank=name)
    run = partial(call_with, AccumulationBuffer(views=VIEWS), layered)
    yield Renderer("AccumulationBuffer layers", "views", run, lambda i, c, _: viewed(*layers_of(i, c), VIEWS))
    yield from options()
    yield Renderer("reconstruct", "samples", _samples, _samples, moves=True, bank="combined", sums=gathered)


def options() -> Iterator[Renderer]:
    """Renderers with the options that a user may set, one of each."""
    for quality in ("exact", "balanced"):
        for spectrum in ("rgb", "continuous"):
            run, plan = partial(_coloured, spectrum, quality), partial(_coloured_plan, spectrum, quality)
            name = f"LensBlur dispersion {spectrum}, {quality}"
            yield Renderer(name, "colours", run, run, plan, widths=dispersed, quality=quality)
        bank: dict[str, Any] = {"moves": True, "bank": "combined"}
        blur = LensBlur(quality=quality)
        yield blur_renderer(f"LensBlur approaching, {quality}", "bank", blur, _approaching, widths=_doubled, **bank)
        blur = LensBlur(quality=quality, shutter="start")
        yield blur_renderer(f"LensBlur curved motion, {quality}", "bank", blur, _curved, ahead=1.25, **bank)
    yield blur_renderer("LensBlur 6-gon, exact", "composed", LensBlur(aperture="6-gon"), picture)
    yield blur_renderer("LensBlur background, exact", "composed", LensBlur(), _background)
    blur = LensBlur(margin=MARGIN, max_coc=CUT_TO, quality="balanced")
    yield blur_renderer("LensBlur margin and max_coc, balanced", "composed", blur, _margin, widths=_cut)
    run = partial(call_with, AccumulationBuffer(views=VIEWS, level_of_detail=1.0, reuse=1), layered)
    yield Renderer("AccumulationBuffer layers, coarser and shared", "views", run, run, texels=TEXELS)
    run = partial(call_with, AccumulationBuffer(views=VIEWS, subsamples=4), layered)
    yield Renderer("AccumulationBuffer layers, sub-samples", "rays", run, run)
    run = partial(call_with, AccumulationBuffer(views=VIEWS), moving_layers)
    yield Renderer("AccumulationBuffer layers, in motion", "views", run, _moving_viewed, moves=True)
    for spectrum in ("rgb", "continuous"):
        run = partial(_chromatic_views, spectrum)
        yield Renderer(f"ChromaticAccumulation layers, {spectrum}", "views", run, run, widths=dispersed)


def dense(image: Tensor, coc: Tensor, motion: Tensor | None = None) -> Tensor:
    """Every pixel's disc, row by row, divided by the coverage: float64."""
    out = dense_spans(torch.cat([image, torch.ones_like(coc)], 1), coc, Disc().profile())
    return out[:, :-1] / out[:, -1:].clamp_min(TINY)


def coverage(coc: Tensor) -> Tensor:
    """What all discs together cover of each pixel, ``(B, 1, H, W)`` float64."""
    return dense_spans(torch.ones_like(coc), coc, Disc().profile())


def _samples(image: Tensor, coc: Tensor, motion: Tensor | None) -> Tensor:
    """Samples in the middle of their pixels, of the lens and of the exposure: a plain picture."""
    assert motion is not None
    # Half precision cannot tell the columns of a wide picture apart.
    position = pixel_positions(image.to(compute_dtype(image))).expand(len(image), 2, *image.shape[2:])
    zero = torch.zeros_like(position)
    present = torch.ones_like(coc, dtype=torch.bool)
    return torchbokeh.reconstruct(
        torchbokeh.Samples(*(t[:, None] for t in (image, position, zero, zero[:, :1], coc, motion, present)))
    )


@lru_cache
def dispersing(width: int, spectrum: str) -> torchbokeh.ThinLens:
    """A lens that moves light by a px or two, whatever the width of the picture."""
    dispersion = torchbokeh.Dispersion("BK7", axial=8.0, lateral=0.02, spectrum=spectrum)  # type: ignore[arg-type]
    return torchbokeh.ThinLens(0.05, 1.0, 2.0, sensor_width=0.003 * width, dispersion=dispersion)


def dispersed(coc: Tensor) -> tuple[Tensor, Tensor]:
    """Radii that differ from those of a CoC by `SPREAD`."""
    sign = torch.where(coc < 0, -1.0, 1.0).to(coc.dtype)
    return sign * (coc.abs() - SPREAD).clamp_min(0), sign * (coc.abs() + SPREAD)


def _coloured(spectrum: str, quality: str, image: Tensor, coc: Tensor, motion: Tensor | None) -> Tensor:
    out: Tensor = LensBlur(dispersing(image.shape[3], spectrum), quality=quality)(image, coc=coc)
    return out


def _coloured_plan(spectrum: str, quality: str, image: Tensor, coc: Tensor, motion: Tensor | None) -> object:
    return LensBlur(dispersing(image.shape[3], spectrum), quality=quality).plan(image, coc=coc)


def _approaching(image: Tensor, coc: Tensor, motion: Tensor | None) -> tuple[Tensor, dict[str, Any]]:
    return image, {"coc": coc, "motion": motion, "shutter_depth": torch.cat([coc / 2, 2 * coc], 1)}


def _doubled(coc: Tensor) -> tuple[Tensor, Tensor]:
    return coc / 2, 2 * coc


def _curved(image: Tensor, coc: Tensor, motion: Tensor | None) -> tuple[Tensor, dict[str, Any]]:
    """Half of the motion, as much to its right, and a quarter of it back."""
    assert motion is not None
    right = torch.stack([-motion[:, 1], motion[:, 0]], 1)
    return image, {"coc": coc, "motion": (motion / 2, right / 2, -motion / 4)}


def _background(image: Tensor, coc: Tensor, motion: Tensor | None) -> tuple[Tensor, dict[str, Any]]:
    return image, {"coc": coc, "background": (image.flip(-1), coc.abs())}


def _margin(image: Tensor, coc: Tensor, motion: Tensor | None) -> tuple[Tensor, dict[str, Any]]:
    """The picture goes on beyond the sensor, with its last pixels."""
    if image.numel():
        image, coc = (F.pad(t, (MARGIN,) * 4, mode="replicate") for t in (image, coc))
    return image, {"coc": coc}


def _cut(coc: Tensor) -> tuple[Tensor, Tensor]:
    cut = coc.clamp(-CUT_TO, CUT_TO)
    return cut, cut


def _moving_viewed(image: Tensor, coc: Tensor, motion: Tensor | None) -> Tensor:
    assert motion is not None
    return viewed(*layers_of(image, coc), VIEWS, torch.stack([motion, -motion], 1))


def _chromatic_views(spectrum: str, image: Tensor, coc: Tensor, motion: Tensor | None) -> Tensor:
    buffer = ChromaticAccumulation(dispersing(image.shape[3], spectrum), views=VIEWS)
    out: Tensor = call_with(buffer, layered, image, coc, motion)
    return out
