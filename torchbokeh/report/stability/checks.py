"""Stiff cases of single parts: lenses, sweeps of radii, layers, scenes, iteration, gradients and large pictures."""

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

import torchbokeh
from torchbokeh import AccumulationBuffer, ChromaticAccumulation, Dispersion, KernelSplatting, LensBlur
from torchbokeh.ops.merge import FADE
from torchbokeh.report.internals import QUALITIES
from torchbokeh.report.rows import Row
from torchbokeh.report.scenes import with_dispersion
from torchbokeh.report.stability.bounds import STEP, coverage, lipschitz
from torchbokeh.report.stability.cases import even, slope, texture
from torchbokeh.report.stability.pictures import CONSTANT, OUTSIDE, STRANGE, off, outside, row, strange
from torchbokeh.report.stability.renderers import VIEWS
from torchbokeh.scenes import RECIPES, Scene

U32 = torch.finfo(torch.float32).eps / 2
BLURRED = ("exact", "balanced")
"""Qualities of the renderers here."""

LENSES = {
    "focus at the near limit": {"focus_distance": 0.05 * (1 + 4e-6)},
    "focus at infinity": {"focus_distance": math.inf},
    "f/0.5": {"f_number": 0.5},
    "f/1000": {"f_number": 1000.0},
    "50 mm, f/1.8 at 2 m": {},
}

CHOSEN = ("coins", "whirl", "sky")
"""Recipes: highlights at many depths, fast rotation, and a backdrop at infinity."""


CHANGE = 1 / 64
"""Of all radii in px, in a sweep."""


def lens_rows(side: int) -> Iterator[Row]:
    """Pictures through lenses at the ends of their ranges, of depths from 1 mm to beyond any scene and the sky."""
    near = torch.logspace(-3, 12, side * side).reshape(1, 1, side, side)
    near[..., 0, 0], near[..., 0, 1] = math.inf, 2.0
    image = texture(side, side).float()
    usual = {"focal_length": 0.05, "f_number": 1.8, "focus_distance": 2.0, "sensor_width": 0.036}
    for name, change in LENSES.items():
        lens = torchbokeh.ThinLens(*(usual | change).values())
        for quality in BLURRED:
            out = LensBlur(lens, quality=quality)(image, near)
            yield from _sound(f"LensBlur image, {quality}", f"lens: {name}, depth 1e-3 to 1e12 m", out, image)
    for axial, lateral in ((59.0, 0.0), (-100.0, 0.0), (0.3, 50.0), (0.3, -50.0)):
        lens = torchbokeh.ThinLens(*usual.values(), dispersion=Dispersion("BK7", axial=axial, lateral=lateral))
        out = LensBlur(lens)(image, near.clamp(0.5, 1e4))
        yield from _sound(
            "LensBlur image, exact", f"lens: dispersion, axial {axial:g}, lateral {lateral:g}", out, image
        )


def _sound(renderer: str, case: str, out: Tensor, image: Tensor) -> Iterator[Row]:
    """All finite and, as a mean of what was given, within its range."""
    here = (renderer, case, "float32")
    yield row(*here, STRANGE, strange(out, out.dtype), 0)
    yield row(*here, OUTSIDE, _outside(out, image), 64 * U32 * float(image.abs().max()))


def _outside(out: Tensor, image: Tensor) -> float:
    """How far a picture is outside of the range of another, at most."""
    return float(outside(out, image.min(), image.max()).max())


def sweep_rows(side: int) -> Iterator[Row]:
    """Even radii around 1/2 px, the FFT's first radius, and the borders of levels: no jump beyond the Lipschitz bound.

    Merged radii are rounded, so that the picture moves in steps: the change of the radius counts as one step more.
    Between two levels, whose pictures differ by no more than the contrast, a pixel passes within `FADE`.
    """
    image = texture(side, side).float()
    contrast = float(image.max() - image.min())
    for quality in QUALITIES:
        blur, merging = KernelSplatting(quality=quality.name), quality.merging
        radii = [0.5, 3.0, 8.0]
        if merging is not None:
            radii += [2 * merging.cells, 2 * merging.cells * (1 + FADE), 4 * merging.cells]
        for radius in dict.fromkeys(radii):
            coc = even(side, side, radius).float()
            near = [blur(image, coc + k * CHANGE) for k in (-2, -1, 0, 1, 2)]
            change = max(off(b, a) for a, b in pairwise(near))
            step, fade = CHANGE, 0.0
            if merging is not None:
                level = max(radius / merging.cells, 1.0)
                step += radius * STEP
                fade = CHANGE / (FADE * merging.cells * level) * contrast
            limit = lipschitz(contrast, radius, float(coverage(coc).min())) * step + fade
            case = f"sweep: {radius:.4g} px, in steps of 1/64 px"
            yield row(f"KernelSplatting, {quality.name}", case, "float32", "largest change", change, limit)


def layer_rows(side: int) -> Iterator[Row]:
    """1, 2 and 64 layers, empty ones, and alpha 0 everywhere: a constant stays constant, nothing stays nothing."""
    for count in (1, 2, 64):
        alpha = torch.rand(1, count, 1, side, side, generator=torch.Generator().manual_seed(count))
        alpha[:, -1] = 1.0
        alpha[:, : count // 2] = 0.0
        layers = torch.cat([0.7 * alpha.expand(-1, -1, 3, -1, -1), alpha], 2)
        coc = torch.linspace(-6, 6, count).view(1, count, 1, 1, 1).expand(1, count, 1, side, side).contiguous()
        for quality in BLURRED:
            blur, name = LensBlur(quality=quality), f"LensBlur layers, {quality}"
            found = off(blur(layers, coc=coc), torch.tensor([0.7, 0.7, 0.7, 1.0]).view(1, 4, 1, 1))
            case = f"layers: {count}, the first half of them empty"
            yield row(name, case, "float32", CONSTANT, found, (64 + 8 * count) * U32)
            nothing = off(blur(torch.zeros_like(layers), coc=coc), 0.0)
            yield row(name, f"layers: {count}, alpha 0", "float32", "light from nothing", nothing, 0)


def scene_rows(side: int) -> Iterator[Row]:
    """Recipes through `AccumulationBuffer` with each of its techniques, and `ChromaticAccumulation`, in float32.

    Homographies are double, textures and what is looked up in them float32. Of a picture of K planes a view is a sum
    with weights that sum to 1; each plane is a mean of four texels (8 roundings) and hides the next ones (3 roundings).
    A place in a texture, or in a frame that dispersion moves, is held to ``u`` times its size in texels (px), and lies
    between two of them each way. So the error is ``(3 K + 8 + 4 extent) u`` of the brightest texel.
    """
    for recipe in CHOSEN:
        scene, camera = RECIPES[recipe](0, (side, side * 3 // 2))
        assert scene.backdrop is not None
        double = Scene(
            tuple(replace(s, texture=s.texture.double()) for s in scene.sprites),
            replace(scene.backdrop, texture=scene.backdrop.texture.double()),
        )
        renderers: dict[str, tuple[Any, str | None]] = {
            "AccumulationBuffer scene": (AccumulationBuffer(views=VIEWS), None),
            "AccumulationBuffer scene, coarser and shared": (
                AccumulationBuffer(views=VIEWS, level_of_detail=1.0, reuse=1),
                None,
            ),
            "AccumulationBuffer scene, sub-samples": (AccumulationBuffer(views=VIEWS, subsamples=4), None),
            "ChromaticAccumulation scene, rgb": (ChromaticAccumulation(views=VIEWS), "rgb"),
            "ChromaticAccumulation scene, continuous": (ChromaticAccumulation(views=VIEWS), "continuous"),
        }
        textures = [*(s.texture[:3] * s.emission for s in scene.sprites), scene.backdrop.texture]
        top = max(float(t.max()) for t in textures)
        extent = max(*camera.size, *(n for t in textures for n in t.shape[1:]))
        limit = (3 * len(scene) + 8 + 4 * extent) * U32 * top
        for name, (renderer, spectrum) in renderers.items():
            seen = camera
            if spectrum is not None:
                seen = with_dispersion(camera, Dispersion("BK7", lateral=0.02, spectrum=spectrum))  # type: ignore[arg-type]
            out, want = renderer(scene, seen), renderer(double, seen)
            here = (name, f"scene: {recipe}", "float32")
            yield row(*here, STRANGE, strange(out, torch.float32), 0)
            yield row(*here, "error", off(out, want), limit)
            yield row(*here, "outside of [0, max]", float(outside(out, 0.0, torch.tensor(top)).max()), limit)


def iteration_rows(side: int, times: int = 100) -> Iterator[Row]:
    """A blur, applied again and again: within the range of the picture, and a constant stays constant.

    Each time adds one rounding of the result, ``4 u`` of its value: ``4 n u`` after n times.
    """
    image, coc = texture(side, side).float(), slope(side, side, -3.0, 6.0).float()
    for quality in BLURRED:
        for name, blur in _blurs(quality).items():
            got, flat = image, torch.full_like(image, 0.7)
            for _ in range(times):
                got, flat = blur(got, coc=coc), blur(flat, coc=coc)
            here, rounded = (name, f"iteration: {times} times", "float32"), 16 * times * U32
            yield row(*here, OUTSIDE, _outside(got, image), rounded * float(image.max()))
            yield row(*here, CONSTANT, off(flat, 0.7), rounded)


def _blurs(quality: str) -> dict[str, torch.nn.Module]:
    return {
        f"KernelSplatting, {quality}": KernelSplatting(quality=quality),
        f"LensBlur image, {quality}": LensBlur(quality=quality),
    }


def gradient_rows(side: int) -> Iterator[Row]:
    """Gradients where a blur is not smooth: at CoC 0, at half a pixel, where pixels tie; and of huge values."""
    image = texture(side, side).float()
    values = {"CoC 0": 0.0, "half a pixel": 0.5, "ties of -2 and 2 px": 2.0, "1e4 px": 1e4}
    for quality in BLURRED:
        for case, radius in values.items():
            coc = even(side, side, radius).float()
            if "ties" in case:
                coc[..., ::2] *= -1
            for bright in (1.0, 1e6):
                leaves = (image * bright).requires_grad_(), coc.clone().requires_grad_()
                out = LensBlur(quality=quality)(leaves[0], coc=leaves[1])
                found = torch.autograd.grad(out.square().mean(), leaves)
                here = (f"LensBlur image, {quality}", f"gradient: {case}, values of {bright:g}", "float32")
                yield row(*here, "not finite", sum(strange(g, g.dtype) for g in found), 0)
                if radius <= 0.5:
                    yield row(*here, "slope to the CoC", off(found[1], 0.0), 0)


def large_rows(height: int, width: int) -> Iterator[Row]:
    """Large pictures: all finite, and a constant stays constant."""
    coc = slope(height, width, -4.0, 12.0).float()
    image = torch.full((1, 3, height, width), 0.7)
    for name, blur in {"KernelSplatting, exact": KernelSplatting(), **_blurs("balanced")}.items():
        out = blur(image, coc=coc)
        found = off(out, 0.7) if bool(out.isfinite().all()) else math.inf
        yield row(name, f"size: {height} x {width}", "float32", CONSTANT, found, 64 * U32)
