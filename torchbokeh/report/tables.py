"""``report.md``: what a reader has to know about a report, and the tables of its experiments."""

from collections.abc import Sequence
from typing import Any

from torchbokeh.report.experiment import sections
from torchbokeh.report.experiments import EXPERIMENTS
from torchbokeh.report.markdown import row_table, section


def markdown(found: dict[str, Any], plots: Sequence[str]) -> str:
    """The whole report.

    Args:
        found: what `torchbokeh.report.run.run_experiments` returns.
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
