"""Stiff pictures through every renderer, each held to a bound: against itself in double, and against its exact quality.

In double there are no kernels: a renderer does what its torch definitions say. So what a kernel does otherwise shows as
rounding beyond its bound, and what a quality approximates beyond what it promises as an error against the exact one.
"""

import math
from collections.abc import Callable, Collection, Iterable, Iterator
from typing import Any

import torch
from torch import Tensor

from torchbokeh.report.rows import Row
from torchbokeh.report.stability.bounds import DENORMAL, PRECISIONS, Precision, approximation, far_leak, rounding
from torchbokeh.report.stability.cases import Case, beyond, cases, highlights
from torchbokeh.report.stability.renderers import Renderer, renderers

STRANGE = "not finite, or of another dtype"
OUTSIDE = "outside of [min, max]"
LEAK = "far-field leak"
CONSTANT = "off the constant"
"""What is measured in many places."""

Memo = dict[Any, Tensor]


def row(renderer: str, case: Case | str, precision: str, what: str, measured: float, limit: float, **more: Any) -> Row:
    """One line of a table; it is kept where the measured number is at most the limit, and so not where it is NaN.

    Args:
        renderer: its name.
        case: a case, or ``"group: name"``.
        precision: its name.
        what: was measured.
        measured: the number.
        limit: its bound.
        more: anything else to keep; ``stated=True`` where the bound is not derived.
    """
    group, name = (case.group, case.name) if isinstance(case, Case) else case.split(": ", 1)
    numbers = {"measured": float(measured), "bound": float(limit), "kept": bool(measured <= limit)}
    return {"renderer": renderer, "group": group, "case": name, "precision": precision, "what": what, **numbers, **more}


def autocast(precision: Precision) -> torch.autocast:
    """As a user of mixed precision has it around the call."""
    return torch.autocast("cpu", dtype=precision.autocast, enabled=precision.autocast is not None)


def strange(out: Tensor, dtype: torch.dtype) -> int:
    """How many numbers are not finite, and one more if they are of another dtype."""
    return int((~out.isfinite()).sum()) + (out.dtype != dtype)


def outside(out: Tensor, low: Tensor | float, high: Tensor) -> Tensor:
    """How far each number lies outside of a range."""
    return torch.maximum(low - out, out - high).clamp_min(0)


def worst(error: Tensor, limit: Tensor) -> tuple[float, float]:
    """The error that is nearest to its limit, or farthest beyond it, and that limit."""
    k = int((error / limit).nan_to_num(torch.inf).argmax())
    return float(error.flatten()[k]), float(limit.flatten()[k])


def off(out: Tensor, constant: Tensor | float) -> float:
    """How far numbers are from a constant at most."""
    return float((out - constant).abs().max())


def render_rows(side: int, precisions: Iterable[Precision] = PRECISIONS, names: Collection[str] = ()) -> Iterator[Row]:
    """All cases through all renderers.

    Args:
        side: of the pictures in px.
        precisions: in which.
        names: of the renderers; all where there are none.
    """
    chosen = [r for r in renderers() if not names or r.name in names]
    for case in cases(side):
        memo: Memo = {}
        for renderer in chosen:
            if renderer.takes(case):
                for precision in precisions:
                    yield from rows_of(renderer, case, precision, memo)


def rows_of(renderer: Renderer, case: Case, precision: Precision, memo: Memo) -> Iterator[Row]:
    """One case through one renderer: error, leak, range and numbers that are not finite.

    Args:
        renderer: which.
        case: which.
        precision: of its inputs.
        memo: keeps what renderers find in double; precisions and qualities share it.
    """
    if renderer.gain() * case.peak > torch.finfo(precision.dtype).max:
        return
    motion = renderer.motion(case)
    image, coc = (t.to(precision.dtype) for t in (case.image, case.coc))
    motion = None if motion is None else motion.to(precision.dtype)
    with autocast(precision):
        out = renderer.run(image, coc, motion)
    here = (renderer.name, case, precision.name)
    yield row(*here, STRANGE, strange(out, precision.dtype), 0)
    if not image.numel():
        return
    doubled = image.double(), coc.double(), None if motion is None else motion.double()

    def in_double(quality: str) -> Tensor:
        return renderer.run(*doubled, quality)

    what = renderer.name.replace(f", {renderer.quality}", "")
    got, want = out.double(), _kept(memo, (what, renderer.quality, precision.dtype), in_double, renderer.quality)
    limit = rounding(renderer, case, want, *doubled[:2], precision)
    if renderer.kind in ("splat", "merged"):
        low, high = doubled[0].amin((2, 3), keepdim=True), doubled[0].amax((2, 3), keepdim=True)
        yield row(*here, OUTSIDE, *worst(outside(got, low, high), limit))
    if case.bright is not None:
        leak, pixels = _leak(renderer, case, out, coc, motion)
        if pixels:
            yield row(*here, LEAK, leak, far_leak(case) + 2 * precision.store * case.even, stated=True)
    if precision.dtype != torch.float64:
        yield row(*here, "error", *worst((got - want).abs(), limit), stated=renderer.merges or renderer.kind == "rays")
    if not renderer.merges or precision.store or not case.promised:
        return  # half precision adds its rounding, which is held to its bound above
    want = _kept(memo, (what, "exact", precision.dtype), in_double, "exact")
    total = float(want.abs().sum().clamp_min(1e-300))
    promise = approximation(renderer, doubled[1]) + DENORMAL * precision.least * want.numel() / total
    yield row(*here, "relative L1 error", float((got - want).abs().sum()) / total, promise, stated=True)


def _kept(memo: Memo, key: object, find: Callable[[str], Tensor], quality: str) -> Tensor:
    if key not in memo:
        memo[key] = find(quality)
    return memo[key]


def highlight_rows(side: int, edge: int = 100, names: Collection[str] = ()) -> Iterator[Row]:
    """What highlights add in float32 to every pixel that their PSFs do not reach: a promise.

    Args:
        side: of the pictures with one highlight in px.
        edge: of the square of them in px.
        names: of the renderers; all where there are none.
    """
    for case in highlights(side, edge):
        for renderer in renderers():
            if not names or renderer.name in names:
                motion = renderer.motion(case)
                given = case.coc.float(), None if motion is None else motion.float()
                out = renderer.run(case.image.float(), *given)
                leak, pixels = _leak(renderer, case, out, *given)
                yield row(renderer.name, case, "float32", LEAK, leak, 1e-3, pixels=pixels, stated=True)


def _leak(renderer: Renderer, case: Case, out: Tensor, coc: Tensor, motion: Tensor | None) -> tuple[float, int]:
    """What the highlights of a case add where their PSFs do not reach, and to how many pixels: NaN for none."""
    far = beyond(case, renderer.reach(case), mirrored=renderer.layered)
    plain = renderer.run(torch.full_like(case.image, case.even).to(out.dtype), coc, motion)
    added = (out.double() - plain.double())[:, :3, far].abs()
    return float(added.max()) if added.numel() else math.nan, int(far.sum())
