"""Numerical stability: stiff and extreme cases, each held to a bound that follows from the arithmetic."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor

from torchbokeh.report.machine import machine
from torchbokeh.report.stability.bounds import (
    DENORMAL,
    PRECISIONS,
    Precision,
    approximation,
    bound,
    far_leak,
    ties,
)
from torchbokeh.report.stability.cases import Case, beyond, cases
from torchbokeh.report.stability.checks import (
    bank_rows,
    descent_rows,
    field_rows,
    gradient_rows,
    highlight_rows,
    integrator_rows,
    iteration_rows,
    large_rows,
    layer_rows,
    lens_rows,
)
from torchbokeh.report.stability.mechanisms import mechanism_rows
from torchbokeh.report.stability.renderer import Renderer
from torchbokeh.report.stability.renderers import renderers
from torchbokeh.report.stability.rows import Row, autocast, row
from torchbokeh.report.stability.scenes import scene_rows
from torchbokeh.report.stability.sweeps import plan_rows, sweep_rows

FORMAT = 1
"""Of ``stability.json``; it goes up when the meaning of a field changes."""

Memo = dict[Any, Tensor]


@dataclass(frozen=True)
class StabilitySettings:
    """How large it all is.

    Attributes:
        side: of pictures with a dense oracle, in px.
        wide: of those without, and of the mechanisms.
        times: how often a blur is applied to its result.
        steps: of gradient descent.
        large: height and width of large pictures.
        renderers: names of those that pictures go through; all where there are none.
    """

    side: int = 16
    wide: int = 96
    times: int = 100
    steps: int = 1000
    large: tuple[tuple[int, int], ...] = ((64, 8192), (4096, 4096))
    renderers: tuple[str, ...] = ()


QUICK = StabilitySettings(8, 96, 4, 5, ((16, 256),), ("KernelSplatting, exact", "LensBlur image, balanced"))
"""Small enough for a test."""


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
    strange = int((~out.isfinite()).sum()) + (out.dtype != precision.dtype)
    yield row(*here, "not finite, or of another dtype", strange, 0, plan=plan)
    if not image.numel():
        return
    got = out.double()
    want = _kept(memo, (renderer.oracle, precision.dtype), lambda: renderer.oracle(*doubled))  # type: ignore[arg-type]
    limit = _kept(
        memo, (renderer.name, precision), lambda: bound(renderer, case, want, image, coc, precision).expand_as(want)
    )
    if renderer.kind in ("splat", "merged"):
        low, high = image.amin((2, 3), keepdim=True), image.amax((2, 3), keepdim=True)
        outside = torch.maximum(low - got, got - high).clamp_min(0)
        yield row(*here, "outside of [min, max]", *_worst(outside, limit))
    if case.bright:
        far = beyond(case, renderer.reach(case), mirrored=renderer.layered)
        if bool(far.any()):
            flat = torch.full_like(image, case.even).to(precision.dtype)
            plain = renderer.run(flat, *given[1:]).double()  # type: ignore[arg-type]
            leak = float((got - plain)[:, :3, far].abs().max())
            yield row(*here, "far-field leak", leak, far_leak(case) + 2 * precision.store * case.even, stated=True)
    error = (got - want).abs()
    merges = renderer.quality != "exact"
    stated = merges or renderer.kind == "rays"
    yield row(*here, "error", *_worst(error, limit + ties(renderer, image)), stated=stated)
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


def _worst(error: Tensor, limit: Tensor) -> tuple[float, float]:
    """The error that is nearest to its limit, or farthest beyond it, and that limit."""
    k = int((error / limit).nan_to_num(torch.inf).argmax())
    return float(error.flatten()[k]), float(limit.flatten()[k])


def run_stability(settings: StabilitySettings, say: Callable[[str], None]) -> dict[str, Any]:
    """All cases and mechanisms.

    Args:
        settings: sizes.
        say: is told in a line what comes next.

    Returns:
        What goes into ``stability.json``: ``format``, ``machine``, ``settings``, ``rows`` and ``mechanisms``.
    """
    rows: list[Row] = []
    parts: dict[str, Callable[[], Iterable[Row]]] = {
        "pictures through renderers": lambda: render_rows(settings.side, names=settings.renderers),
        "highlights": lambda: highlight_rows(settings.wide),
        "fields of highlights": lambda: field_rows(settings.renderers),
        "sweeps of radii": lambda: sweep_rows(settings.side),
        "changes of plans": lambda: plan_rows(settings.wide // 2),
        "lenses": lambda: lens_rows(settings.side),
        "integrators": lambda: integrator_rows(settings.wide),
        "layers": lambda: layer_rows(settings.side),
        "scenes": lambda: scene_rows(settings.side),
        "odd PSFs": lambda: bank_rows(settings.side),
        "iteration": lambda: iteration_rows(settings.side, settings.times),
        "gradients": lambda: gradient_rows(settings.side),
        "gradient descent": lambda: descent_rows(settings.side, settings.steps),
        "large pictures": lambda: (r for size in settings.large for r in large_rows(*size)),
    }
    for name, part in parts.items():
        say(f"stability: {name}")
        rows += part()
    say("stability: mechanisms")
    mechanisms = list(mechanism_rows(settings.wide))
    return {
        "format": FORMAT,
        "machine": machine(),
        "settings": asdict(settings),
        "rows": rows,
        "mechanisms": mechanisms,
    }
