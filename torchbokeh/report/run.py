"""All experiments, one after the other, and everything that a reader of their numbers wants to know."""

import time
from collections.abc import Sequence
from typing import Any

from torchbokeh.report.chromatic.experiments import chromatic_bands, chromatic_samples, chromatic_truth, importance
from torchbokeh.report.machine import machine
from torchbokeh.report.measure import flip_is_there
from torchbokeh.report.motion.experiments import like_lks, with_motion
from torchbokeh.report.settings import Settings
from torchbokeh.report.speed.baselines import absent
from torchbokeh.report.speed.blur import against_layers, against_truth, left_out
from torchbokeh.report.speed.experiments import (
    Say,
    against_pixels,
    against_radius,
    against_threads,
    methods,
    one_layer,
)
from torchbokeh.report.speed.exported import can_export, exported
from torchbokeh.report.speed.gradients import gradient_methods, gradients
from torchbokeh.report.speed.memory import is_known
from torchbokeh.report.speed.stages import stages

FORMAT = 1
"""Of ``report.json``; it goes up when the meaning of a field changes."""

EXPERIMENTS = {
    "one_layer": one_layer,
    "truth": against_truth,
    "radius": against_radius,
    "pixels": against_pixels,
    "layers": against_layers,
    "threads": against_threads,
    "gradients": gradients,
    "export": exported,
    "motion": with_motion,
    "like_lks": like_lks,
    "chromatic_truth": chromatic_truth,
    "chromatic_samples": chromatic_samples,
    "chromatic_bands": chromatic_bands,
    "importance": importance,
    "left_out": left_out,
    "stages": stages,
}


def run_experiments(settings: Settings, say: Say, only: Sequence[str] = tuple(EXPERIMENTS)) -> dict[str, Any]:
    """Run everything, or some of it.

    Args:
        settings: sizes and repetitions.
        say: is told in a line what comes next.
        only: names of the experiments to run; the others have no rows.

    Returns:
        What goes into ``report.json``: ``format``, ``machine``, ``settings``, ``methods`` with their descriptions,
        ``absent`` with what could not be measured here and why, ``experiments`` with the rows of each, and
        ``seconds``, how long it all took.
    """
    start = time.perf_counter()
    rows = {name: experiment(settings, say) if name in only else [] for name, experiment in EXPERIMENTS.items()}
    compared = {**methods(), **gradient_methods()}.values()
    return {
        "format": FORMAT,
        "machine": machine(),
        "settings": settings.row(),
        "methods": [{"name": m.name, "family": m.family, "description": m.description} for m in compared],
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
