"""Numerical stability: stiff and extreme cases, each held to a bound. A new kind of case is a line here."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from torchbokeh.report.machine import machine
from torchbokeh.report.rows import Row, Say
from torchbokeh.report.settings import Sizes, sized
from torchbokeh.report.stability import checks
from torchbokeh.report.stability.mechanisms import mechanism_rows
from torchbokeh.report.stability.pictures import render_rows
from torchbokeh.report.stability.scenes import scene_rows
from torchbokeh.report.stability.sweeps import plan_rows, sweep_rows

FORMAT = 1
"""Of ``stability.json``; it goes up when the meaning of a field changes."""


@dataclass(frozen=True)
class StabilitySettings(Sizes):
    """How large it all is.

    Attributes:
        side: of pictures with a dense oracle, in px.
        wide: of those without, and of the mechanisms.
        times: how often a blur is applied to its result.
        steps: of gradient descent.
        large: height and width of large pictures.
        renderers: names of those that pictures go through; all where there are none.
    """

    side: int = sized(16, 8)
    wide: int = 96
    times: int = sized(100, 4)
    steps: int = sized(1000, 5)
    large: tuple[tuple[int, int], ...] = sized(((64, 8192), (4096, 4096)), ((16, 256),))
    renderers: tuple[str, ...] = sized((), ("KernelSplatting, exact", "LensBlur image, balanced"))


PARTS: dict[str, Callable[[StabilitySettings], Iterable[Row]]] = {
    "pictures through renderers": lambda settings: render_rows(settings.side, names=settings.renderers),
    "highlights": lambda settings: checks.highlight_rows(settings.wide),
    "fields of highlights": lambda settings: checks.field_rows(settings.renderers),
    "sweeps of radii": lambda settings: sweep_rows(settings.side),
    "changes of plans": lambda settings: plan_rows(settings.wide // 2),
    "lenses": lambda settings: checks.lens_rows(settings.side),
    "integrators": lambda settings: checks.integrator_rows(settings.wide),
    "layers": lambda settings: checks.layer_rows(settings.side),
    "scenes": lambda settings: scene_rows(settings.side),
    "odd PSFs": lambda settings: checks.bank_rows(settings.side),
    "iteration": lambda settings: checks.iteration_rows(settings.side, settings.times),
    "gradients": lambda settings: checks.gradient_rows(settings.side),
    "gradient descent": lambda settings: checks.descent_rows(settings.side, settings.steps),
    "large pictures": lambda settings: (row for size in settings.large for row in checks.large_rows(*size)),
}
"""All kinds of cases, in the order in which they are run."""


def run_stability(settings: StabilitySettings, say: Say) -> dict[str, Any]:
    """All cases and mechanisms.

    Args:
        settings: sizes.
        say: is told in a line what comes next.

    Returns:
        What goes into ``stability.json``: ``format``, ``machine``, ``settings``, ``rows`` and ``mechanisms``.
    """
    rows: list[Row] = []
    for name, part in PARTS.items():
        say(f"stability: {name}")
        rows += part(settings)
    say("stability: mechanisms")
    mechanisms = list(mechanism_rows(settings.wide))
    head = {"format": FORMAT, "machine": machine(), "settings": settings.row()}
    return {**head, "rows": rows, "mechanisms": mechanisms}
