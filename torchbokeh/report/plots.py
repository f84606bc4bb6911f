"""The pictures of a report."""

from typing import Any

from torchbokeh.report.experiment import Figures, draw_figures
from torchbokeh.report.experiments import EXPERIMENTS


def draw(found: dict[str, Any]) -> Figures:
    """All plots of a report.

    Args:
        found: what `torchbokeh.report.run.run_experiments` returns.

    Returns:
        Figures by the names of their files. Experiments without rows have none.
    """
    return draw_figures(EXPERIMENTS, found["experiments"])
