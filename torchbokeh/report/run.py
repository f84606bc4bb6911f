"""All experiments, one after the other, and everything that a reader of their numbers wants to know."""

import time
from collections.abc import Collection
from typing import Any

from torchbokeh.report.experiment import find_rows
from torchbokeh.report.experiments import EXPERIMENTS
from torchbokeh.report.machine import machine
from torchbokeh.report.measure import flip_is_there
from torchbokeh.report.rows import Say
from torchbokeh.report.settings import Settings
from torchbokeh.report.speed.baselines import absent
from torchbokeh.report.speed.exported import can_export
from torchbokeh.report.speed.memory import is_known
from torchbokeh.report.speed.registry import every_method

FORMAT = 1
"""Of ``report.json``; it goes up when the meaning of a field changes."""


def run_experiments(settings: Settings, say: Say, only: Collection[str] | None = None) -> dict[str, Any]:
    """Run everything, or some of it.

    Args:
        settings: sizes and repetitions.
        say: is told in a line what comes next.
        only: names of the experiments to run; the others have no rows. All if None.

    Returns:
        What goes into ``report.json``: ``format``, ``machine``, ``settings``, ``methods`` with their descriptions,
        ``absent`` with what could not be measured here and why, ``experiments`` with the rows of each, and
        ``seconds``, how long it all took.
    """
    start = time.perf_counter()
    rows = find_rows(EXPERIMENTS, settings, say, only)
    methods = every_method().values()
    return {
        "format": FORMAT,
        "machine": machine(),
        "settings": settings.row(),
        "methods": [{"name": m.name, "family": m.family, "description": m.description} for m in methods],
        "absent": _absent(),
        "experiments": rows,
        "seconds": time.perf_counter() - start,
    }


def _absent() -> list[str]:
    lines = absent()
    if not flip_is_there():
        lines.append("FLIP: flip-evaluator is not installed (`pip install torchbokeh[report]`)")
    if not can_export():
        lines.append("exported files: onnx or onnxruntime is not installed (`pip install torchbokeh[export]`)")
    if not is_known():
        lines.append("peak memory: only Linux tells it")
    return lines
