"""``report.md``: all experiments one after the other, and everything that a reader of their numbers wants to know."""

import time
from collections.abc import Collection, Sequence
from typing import Any

from torchbokeh.report.experiment import Figures, draw_figures, find_rows, sections
from torchbokeh.report.experiments import EXPERIMENTS
from torchbokeh.report.machine import machine
from torchbokeh.report.markdown import row_table, section
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


def markdown(found: dict[str, Any], plots: Sequence[str]) -> str:
    """The whole report.

    Args:
        found: what `run_experiments` returns.
        plots: names of the pictures beside the report; each is shown in the section whose name it begins with.

    Returns:
        Markdown.
    """
    parts = sections(EXPERIMENTS, found["experiments"], found["settings"], plots)
    return "\n\n".join([_head(found), *parts, _methods(found)]) + "\n"


def _head(found: dict[str, Any]) -> str:
    made, settings = found["machine"], found["settings"]
    versions = ", ".join(f"{k} {v}" for k, v in made.items() if k not in ("processor", "processors", "threads"))
    return (
        "# Error and run time\n\n"
        f"{made['processor']}, processors: {made['processors']}, threads: {made['threads']}; {versions}. "
        f"The whole report took {found['seconds'] / 60:.1f} minutes.\n\n"
        f"Run times are medians of up to {settings['repeat']} runs after one to warm up, all methods of a table by "
        f"turns. Where these would take more than {settings['budget']:g} s ({settings['recipe_budget']:g} s for "
        f"recipes as one layer, {settings['sweep_budget']:g} s from then on) there are fewer (column *runs*). The "
        "spread is from the first to the third quartile. Compiling, and tables that depend on the largest radius "
        "only, are not counted. SSIM, PSNR and FLIP are of `clip(x, 0, 1) ** (1/2.2)`, L1 is the sum of absolute "
        "differences of linear values over the sum of the reference. All numbers, with fastest and slowest run, "
        "are in `report.json`."
    )


def _methods(found: dict[str, Any]) -> str:
    missing = "Not measured here:\n\n" + "\n".join(f"- {line}" for line in found["absent"]) if found["absent"] else ""
    methods = row_table(found["methods"], "method | what it does", "{name} | {description}")
    return section("What the methods are", methods, missing)


def draw(found: dict[str, Any]) -> Figures:
    """All plots of a report, by the names of their files. Experiments without rows have none."""
    return draw_figures(EXPERIMENTS, found["experiments"])
