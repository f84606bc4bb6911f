"""Stiff pictures through every renderer, each held to a bound that follows from the arithmetic."""

from collections.abc import Callable, Iterable, Iterator
from typing import Any

import torch
from torch import Tensor

from torchbokeh.report.rows import Row
from torchbokeh.report.stability.bounds import DENORMAL, PRECISIONS, Precision, approximation, bound, far_leak, ties
from torchbokeh.report.stability.cases import Case, beyond, cases
from torchbokeh.report.stability.renderer import Renderer
from torchbokeh.report.stability.renderers import renderers
from torchbokeh.report.stability.rows import LEAK, OUTSIDE, STRANGE, autocast, outside, row, strange, worst

Memo = dict[Any, Tensor]


def render_rows(side: int, precisions: Iterable[Precision] = PRECISIONS, names: Iterable[str] = ()) -> Iterator[Row]:
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
        memo: keeps what oracles found; renderers and precisions share it.
    """
    gain = renderer.gain()
    if gain * case.peak > torch.finfo(precision.dtype).max:
        return
    motion = renderer.motion(case)
    given = [None if t is None else t.to(precision.dtype) for t in (case.image, case.coc, motion)]
    doubled = [None if t is None else t.double() for t in given]
    with autocast(precision):
        out = renderer.run(*given)  # type: ignore[arg-type]
    name, image, coc = renderer.name, doubled[0], doubled[1]
    assert image is not None
    assert coc is not None
    plan = "" if renderer.plan is None or not image.numel() else str(renderer.plan(*given))  # type: ignore[arg-type]
    here = (name, case, precision.name)
    yield row(*here, STRANGE, strange(out, precision.dtype), 0, plan=plan)
    if not image.numel():
        return
    got = out.double()
    want = _kept(memo, (renderer.oracle, precision.dtype), lambda: renderer.oracle(*doubled))  # type: ignore[arg-type]
    limit = _kept(
        memo, (renderer.name, precision), lambda: bound(renderer, case, want, image, coc, precision).expand_as(want)
    )
    if renderer.kind in ("splat", "merged"):
        low, high = image.amin((2, 3), keepdim=True), image.amax((2, 3), keepdim=True)
        yield row(*here, OUTSIDE, *worst(outside(got, low, high), limit))
    if case.bright:
        far = beyond(case, renderer.reach(case), mirrored=renderer.layered)
        if bool(far.any()):
            flat = torch.full_like(image, case.even).to(precision.dtype)
            plain = renderer.run(flat, *given[1:]).double()  # type: ignore[arg-type]
            leak = float((got - plain)[:, :3, far].abs().max())
            yield row(*here, LEAK, leak, far_leak(case) + 2 * precision.store * case.even, stated=True)
    error = (got - want).abs()
    merges = renderer.quality != "exact"
    stated = merges or renderer.kind == "rays"
    yield row(*here, "error", *worst(error, limit + ties(renderer, image)), stated=stated)
    if renderer.sums is None or precision.store or (merges and not case.promised):
        return  # half precision adds its rounding, which is held to its bound above
    slow = renderer.sums
    want = _kept(memo, (slow, precision.dtype), lambda: slow(*doubled))  # type: ignore[arg-type]
    total = float(want.abs().sum().clamp_min(1e-300))
    promise = approximation(renderer, image, coc) + DENORMAL * precision.least * want.numel() / total
    yield row(*here, "relative L1 error", float((got - want).abs().sum()) / total, promise, stated=True)


def _kept(memo: Memo, key: object, find: Callable[[], Tensor]) -> Tensor:
    if key not in memo:
        memo[key] = find()
    return memo[key]
