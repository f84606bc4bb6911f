"""What an experiment is, and how tables of them are run, written and drawn."""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from torchbokeh.report.rows import Row, Say

Figures = dict[str, Any]
"""Figures of matplotlib, which is not always installed, by the names of their files."""


def _no_figures(rows: list[Row]) -> Figures:
    return {}


@dataclass(frozen=True)
class Experiment:
    """One experiment. A table of them, such as `torchbokeh.report.experiments.EXPERIMENTS`, is all that names it.

    Attributes:
        name: the key of its rows in JSON, by which a user asks for it.
        run: finds the rows; it is given the settings, and what is told in a line what comes next.
        section: writes the rows as Markdown; it is given the rows, the settings as a row, and the names of all plots.
            Without rows it is not asked.
        draw: draws the rows: figures by the names of their files. Without rows it is not asked.
    """

    name: str
    run: Callable[[Any, Say], Iterable[Row]]
    section: Callable[[list[Row], Row, Sequence[str]], str]
    draw: Callable[[list[Row]], Figures] = _no_figures


def find_rows(
    experiments: Iterable[Experiment], settings: Any, say: Say, only: Collection[str] | None = None
) -> dict[str, list[Row]]:
    """The rows of every experiment, by its name; those that ``only`` does not name have none."""
    chosen = only.__contains__ if only is not None else lambda name: True
    return {e.name: list(e.run(settings, say)) if chosen(e.name) else [] for e in experiments}


def sections(
    experiments: Iterable[Experiment], rows: Mapping[str, list[Row]], settings: Row, plots: Sequence[str]
) -> list[str]:
    """The Markdown of every experiment that has rows."""
    return [e.section(rows[e.name], settings, plots) for e in experiments if rows[e.name]]


def draw_figures(experiments: Iterable[Experiment], rows: Mapping[str, list[Row]]) -> Figures:
    """The figures of every experiment that has rows, by the names of their files."""
    return {name: figure for e in experiments if rows[e.name] for name, figure in e.draw(rows[e.name]).items()}
