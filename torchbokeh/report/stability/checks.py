"""Stiff cases of single parts: lenses, integrators, layers, banks of odd PSFs, iteration and gradients."""

import math
from collections.abc import Callable, Collection, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

import torchbokeh
from torchbokeh import KernelSplatting, LensBlur, PyramidIntegrator
from torchbokeh.psfs.combined import Combined, capsule
from torchbokeh.psfs.refit import Sparse
from torchbokeh.psfs.represent import Represented, laplacian, nonzero
from torchbokeh.report.rows import Row
from torchbokeh.report.stability.bounds import DENORMAL, PRECISIONS, U64
from torchbokeh.report.stability.cases import Case, beyond, dynamic_range, even, slope, texture
from torchbokeh.report.stability.renderer import Renderer
from torchbokeh.report.stability.renderers import renderers
from torchbokeh.report.stability.rows import (
    CONSTANT,
    LEAK,
    OUTSIDE,
    STRANGE,
    autocast,
    off,
    outside,
    row,
    strange,
    worst,
)

U32 = torch.finfo(torch.float32).eps / 2
PLAIN = tuple(p for p in PRECISIONS if p.autocast is None)

PYRAMID = 0.05
"""Of the height of a disc, from 2 px outside of its rim on, what `PyramidIntegrator` leaves there. Stated, not derived:
twice what `torchbokeh.ops.integrate.poisson_pyramid` was measured to leave; its kernels are a fit."""

LENSES = {
    "focus at the near limit": {"focus_distance": 0.05 * (1 + 4e-6)},
    "focus at infinity": {"focus_distance": math.inf},
    "f/0.5": {"f_number": 0.5},
    "f/1000": {"f_number": 1000.0},
    "50 mm, f/1.8 at 2 m": {},
}


def lens_rows(side: int) -> Iterator[Row]:
    """CoC of lenses at the ends of their ranges against the defocus equation in double, and the pictures of these.

    ``coc = gain (1/df - 1/d)`` with ``gain = E F / (1 - F/df)``. Three roundings in each reciprocal's product bound the
    error by ``4 u gain (1/df + 1/d)``; that of ``1 - F/df`` is ``u / (1 - F/df)`` of the result.
    """
    near = torch.logspace(-3, 12, side * side, dtype=torch.float64).reshape(1, 1, side, side)
    near[..., 0, 0], near[..., 0, 1] = math.inf, 2.0
    image = texture(side, side)
    for name, change in LENSES.items():
        values = {"focal_length": 0.05, "f_number": 1.8, "focus_distance": 2.0, "sensor_width": 0.036} | change
        lens = torchbokeh.ThinLens(*values.values())
        for precision in PLAIN:
            depth = near.to(precision.dtype)
            depth = torch.where(depth.isinf() & ~near.isinf(), torch.finfo(precision.dtype).max, depth)
            coc = lens.coc(depth, side).double()
            f, n, df, sensor = (t.double() for t in lens.values().values())
            d = depth.double()
            gain = f * f / (2 * n) / (1 - f / df) * side / sensor
            want = gain * (1 / df - 1 / d)
            bound = 4 * precision.work * (gain * (1 / df + 1 / d) + want.abs() / (1 - f / df))
            here = ("ThinLens.coc", f"lens: {name}", precision.name)
            yield row(*here, "error in px", *worst((coc - want).abs(), bound))
            if name == "50 mm, f/1.8 at 2 m":
                focused = float(coc[0, 0, 0, 1])
                yield row("ThinLens.coc", "lens: depth in focus", precision.name, "CoC in px", focused, 0)
        for quality in ("exact", "balanced"):
            out = LensBlur(lens, quality=quality)(image.float(), near.float())
            yield from _sound(f"LensBlur image, {quality}", f"lens: {name}, depth 1e-3 to 1e12 m", out, image)
    for axial, lateral in ((59.0, 0.0), (-100.0, 0.0), (0.3, 50.0), (0.3, -50.0)):
        dispersion = torchbokeh.Dispersion("BK7", axial=axial, lateral=lateral)
        lens = torchbokeh.ThinLens(0.05, 1.8, 2.0, 0.036, dispersion=dispersion)
        out = LensBlur(lens)(image.float(), near.float().clamp(0.5, 1e4))
        case = f"lens: dispersion, axial {axial:g}, lateral {lateral:g}"
        yield from _sound("LensBlur image, exact", case, out, image)


def _sound(renderer: str, case: str, out: Tensor, image: Tensor) -> Iterator[Row]:
    """All finite and, as a mean of what was given, within its range."""
    here = (renderer, case, "float32")
    yield row(*here, STRANGE, strange(out, out.dtype), 0)
    yield row(*here, OUTSIDE, _outside(out, image), 64 * U32 * float(image.abs().max()))


def _outside(out: Tensor, image: Tensor) -> float:
    """How far a picture is outside of the range of another, at most."""
    return float(outside(out, image.min(), image.max()).max())


def integrator_rows(side: int) -> Iterator[Row]:
    """What each integrator makes of a buffer in each precision, against itself in double.

    *Scanline*: sums are taken in double and stored, ``u |out| + W u64 |b|``. *FFT*: in double as well, ``log2(n)``
    times ``u64 |b|_2 |g|_2``. *Pyramid*: in float32, 25 products on each of ``log2(n) + 2`` levels, both ways, of what
    the transposed sums of magnitudes are. All are held to the magnitudes of the buffer times the largest response.
    """
    x = torch.arange(side, dtype=torch.float64) - side / 2
    y = x[:, None]
    disc = (torch.hypot(y, x) < side / 4).double()[None, None]
    point = torch.zeros(1, 1, side, side, dtype=torch.float64)
    point[..., side // 3, side // 3] = 1e6
    levels = math.ceil(math.log2(side)) + 2
    integrators: dict[str, tuple[Any, float, float]] = {
        "ScanlineIntegrator": (torchbokeh.ScanlineIntegrator(), 1.0, side * U64),
        "FFTIntegrator": (torchbokeh.FFTIntegrator(), 1.3, 16 * levels * U64),
        "FFTIntegrator, compact": (torchbokeh.FFTIntegrator(compact=True), 1.3, 16 * levels * U64),
        "PyramidIntegrator": (PyramidIntegrator(), 1.3, 0.0),
    }
    for name, (integrator, response, double) in integrators.items():
        buffers = {
            "a disc": integrator.differentiate(disc),
            "a point of 1e6 and its surroundings": integrator.differentiate(disc + point),
            "non-zero sum": point * 1e-6 + integrator.differentiate(disc),
        }
        for case, buffer in buffers.items():
            for precision in PRECISIONS:
                given = buffer.to(precision.dtype)
                if not bool(given.isfinite().all()):
                    continue
                with torch.no_grad(), autocast(precision):
                    out = integrator(given)
                with torch.no_grad():
                    want = integrator(given.double())
                work = max(precision.work * 50 * levels if name == "PyramidIntegrator" else 0.0, double)
                bound = (precision.work + precision.store) * want.abs() + work * response * given.double().abs().sum()
                bound = bound + DENORMAL * precision.least
                here = (name, f"integrator: {case}", precision.name)
                yield row(*here, STRANGE, strange(out, precision.dtype), 0)
                yield row(*here, "error", *worst((out.double() - want).abs(), bound))
        far = torch.hypot(y + side // 8, x + side // 8) > side / 4 + 2
        u = (disc * 1e6 / 3).roll((-(side // 8),) * 2, (2, 3)).float()
        with torch.no_grad():
            leak = float(integrator(integrator.differentiate(u))[..., far].abs().max())
        # Rounding of the buffer, times the largest response.
        limit = response * U32 * float(integrator.differentiate(u).abs().sum())
        approximates = name == "PyramidIntegrator"
        limit += PYRAMID * 1e6 / 3 if approximates else 0.0
        here = (name, "integrator: a disc of 3e5 by itself", "float32")
        yield row(*here, LEAK, leak, limit, stated=approximates)


def highlight_rows(side: int) -> Iterator[Row]:
    """A pixel of 1e6 over an even ground of 1, in float32: what it adds to every pixel that its PSF does not reach."""
    (case,) = [c for c in dynamic_range(side) if c.name == "1e+06 beside grey"]
    for radius in (side / 64, side / 24):
        coc = slope(side, side, 0.95 * radius, radius)
        here = replace(case, coc=coc, group="highlight", name=f"1e6 over 1, radius {radius:.1f} px")
        for renderer in renderers():
            yield _leak_row(renderer, here, beyond(here, renderer.reach(here), mirrored=renderer.layered))


def _leak_row(renderer: Renderer, case: Case, far: Tensor) -> Row:
    """What the highlights of a case add to pixels, in float32: a promise."""
    motion = renderer.motion(case)
    way = None if motion is None else motion.float()
    image, coc = case.image.float(), case.coc.float()
    lit, plain = (renderer.run(t, coc, way) for t in (image, torch.ones_like(image)))
    leak = float((lit - plain)[:, :3, far].abs().max()) if bool(far.any()) else math.nan
    return row(renderer.name, case, "float32", LEAK, leak, 1e-3, pixels=int(far.sum()), stated=True)


def field_rows(names: Collection[str] = (), edge: int = 100) -> Iterator[Row]:
    """A square of 1e4 highlights of 1e6 over a ground of 1, in float32: what it adds beyond the reach of its PSFs.

    Args:
        names: of the renderers; all where there are none.
        edge: of the square in px.
    """
    side = edge + 140
    image = torch.ones(1, 3, side, side, dtype=torch.float64)
    image[..., :edge, :edge] = 1e6
    here = Case("highlight", f"{edge} x {edge} of 1e6 over 1", image, slope(side, side, 4.5, 5.0))
    x, y = torch.arange(side), torch.arange(side)[:, None]
    for renderer in renderers():
        if not names or renderer.name in names:
            reach = edge - 1 + renderer.reach(here)
            yield _leak_row(renderer, here, y > reach + 0 * x if renderer.layered else (x > reach) | (y > reach))


def layer_rows(side: int) -> Iterator[Row]:
    """1, 2 and 64 layers, empty ones, and alpha 0 everywhere: a constant stays constant, nothing stays nothing."""
    for count in (1, 2, 64):
        alpha = torch.rand(1, count, 1, side, side, generator=torch.Generator().manual_seed(count))
        alpha[:, -1] = 1.0
        alpha[:, : count // 2] = 0.0
        layers = torch.cat([0.7 * alpha.expand(-1, -1, 3, -1, -1), alpha], 2)
        coc = torch.linspace(-6, 6, count).view(1, count, 1, 1, 1).expand(1, count, 1, side, side).contiguous()
        for quality in ("exact", "balanced"):
            blur, name = LensBlur(quality=quality), f"LensBlur layers, {quality}"
            found = off(blur(layers, coc=coc), torch.tensor([0.7, 0.7, 0.7, 1.0]).view(1, 4, 1, 1))
            case = f"layers: {count}, the first half of them empty"
            yield row(name, case, "float32", CONSTANT, found, (64 + 8 * count) * U32)
            nothing = off(blur(torch.zeros_like(layers), coc=coc), 0.0)
            yield row(name, f"layers: {count}, alpha 0", "float32", "light from nothing", nothing, 0)


def bank_rows(side: int) -> Iterator[Row]:
    """PSFs of one point, of few, whose Laplacian does not sum to 0, and with light beyond the picture."""
    psf = capsule(3.0, 6.0)
    sparse = nonzero(laplacian(psf))
    one = Sparse(np.zeros((1, 2), np.int64), np.ones((1, 1)))
    lopsided = sparse._replace(values=sparse.values + 1e-4 * np.abs(sparse.values).max())
    away = Sparse(np.array([[4 * side, 0], [0, 0]]), np.array([[0.5], [0.5]]))
    ways = {
        "one point": Represented("direct", one),
        "all points of a Laplacian": Represented("laplacian", sparse),
        "a Laplacian of non-zero sum": Represented("laplacian", lopsided),
        "half of the light beyond the picture": Represented("direct", away),
    }
    image = torch.full((1, 3, side, side), 0.7)
    motion = torch.tensor([6.0, 0.0]).view(1, 2, 1, 1).expand(1, 2, side, side)
    for name, sample in ways.items():
        model = Combined(radius=8.0, length=16.0)
        bank = torchbokeh.PsfBank(model, [sample] * len(model.grid))
        out = KernelSplatting(quality="exact", bank=bank)(image, even(side, side, 3.0).float(), motion=motion)
        # As many roundings as a buffer has points, each of a constant relative to its coverage.
        yield row("KernelSplatting, bank", f"psf: {name}", "float32", CONSTANT, off(out, 0.7), 1e-4)


def iteration_rows(side: int, times: int = 100) -> Iterator[Row]:
    """A blur, applied again and again: within the range of the picture, and a constant stays constant.

    Each time adds one rounding of the result, ``4 u`` of its value: ``4 n u`` after n times.
    """
    image, coc = texture(side, side).float(), slope(side, side, -3.0, 6.0).float()
    for quality in ("exact", "balanced"):
        calls: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
            f"KernelSplatting, {quality}": KernelSplatting(quality=quality),
            f"LensBlur image, {quality}": _by_coc(LensBlur(quality=quality)),
        }
        for name, call in calls.items():
            got, flat = image, torch.full_like(image, 0.7)
            for _ in range(times):
                got, flat = call(got, coc), call(flat, coc)
            here, rounded = (name, f"iteration: {times} times", "float32"), 16 * times * U32
            yield row(*here, OUTSIDE, _outside(got, image), rounded * float(image.max()))
            yield row(*here, CONSTANT, off(flat, 0.7), rounded)


def _by_coc(blur: LensBlur) -> Callable[[Tensor, Tensor], Tensor]:
    return lambda image, coc: blur(image, coc=coc)


def gradient_rows(side: int) -> Iterator[Row]:
    """Gradients where a blur is not smooth: at CoC 0, at half a pixel, where pixels tie; and of huge values."""
    image = texture(side, side).float()
    values = {"CoC 0": 0.0, "half a pixel": 0.5, "ties of -2 and 2 px": 2.0, "1e4 px": 1e4}
    for quality in ("exact", "balanced"):
        for case, radius in values.items():
            coc = even(side, side, radius).float()
            if "ties" in case:
                coc[..., ::2] *= -1
            for bright in (1.0, 1e6):
                leaves = (image * bright).requires_grad_(), coc.clone().requires_grad_()
                out = LensBlur(quality=quality)(leaves[0], coc=leaves[1])
                found = torch.autograd.grad(out.square().mean(), leaves)
                strange = sum(int((~g.isfinite()).sum()) for g in found)
                largest = float(found[1].abs().max())
                here = (f"LensBlur image, {quality}", f"gradient: {case}, values of {bright:g}", "float32")
                yield row(*here, "not finite", strange, 0, largest=largest)
                if radius <= 0.5:
                    yield row(*here, "slope to the CoC", largest, 0)


def descent_rows(side: int, steps: int = 1000) -> Iterator[Row]:
    """Gradient descent to a blurred picture's CoC and colours: stays finite, and does not end above where it began."""
    want_image, want_coc = texture(side, side).float(), slope(side, side, -4.0, 6.0).float()
    for quality in ("exact", "balanced"):
        blur = LensBlur(quality=quality)
        aim = blur(want_image, coc=want_coc).detach()
        leaves = [torch.ones_like(want_image).requires_grad_(), torch.full_like(want_coc, 1.0).requires_grad_()]
        adam = torch.optim.Adam(leaves, lr=0.02)
        losses = []
        for _ in range(steps):
            loss = (blur(leaves[0], coc=leaves[1]) - aim).square().mean()
            adam.zero_grad()
            loss.backward()
            adam.step()
            losses.append(loss.item())
        strange = sum(int((~t.isfinite()).sum()) for t in leaves) + sum(not math.isfinite(v) for v in losses)
        here = (f"LensBlur image, {quality}", f"gradient: {steps} steps of Adam", "float32")
        yield row(*here, "not finite", strange, 0)
        yield row(*here, "loss at the end", losses[-1], losses[0])


def large_rows(height: int, width: int) -> Iterator[Row]:
    """Large pictures: all finite, and a constant stays constant."""
    coc = slope(height, width, -4.0, 12.0).float()
    image = torch.full((1, 3, height, width), 0.7)
    blurs: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
        "KernelSplatting, exact": KernelSplatting(quality="exact"),
        "KernelSplatting, balanced": KernelSplatting(quality="balanced"),
        "LensBlur image, balanced": _by_coc(LensBlur(quality="balanced")),
    }
    for name, blur in blurs.items():
        out = blur(image, coc)
        found = off(out, 0.7) if bool(out.isfinite().all()) else math.inf
        yield row(name, f"size: {height} x {width}", "float32", CONSTANT, found, 64 * U32)
