"""The analysis of sparse PSFs: its experiments, run, written and drawn. A new one is a file, and a line here."""

import time
from collections.abc import Sequence
from typing import Any

from torchbokeh.report.experiment import Experiment, Figures, draw_figures, find_rows, sections
from torchbokeh.report.machine import machine
from torchbokeh.report.psfs import plots as drawn
from torchbokeh.report.psfs import tables
from torchbokeh.report.psfs.analysis import (
    Array,
    PsfSettings,
    equal_sparsity,
    large,
    needed,
    random_psfs,
    sample_count,
    sizes,
    steps,
)
from torchbokeh.report.rows import Say


def _psfs(settings: PsfSettings) -> Sequence[Array]:
    return random_psfs(settings.psfs, settings.support)


EXPERIMENTS = [
    Experiment("equal", lambda s, say: equal_sparsity(_psfs(s), say), tables.equal, drawn.equal),
    Experiment("needed", lambda s, say: needed(_psfs(s), say), tables.needed, drawn.needed),
    Experiment("sizes", sizes, tables.sizes, drawn.sizes),
    Experiment("samples", lambda s, say: sample_count(s.coordinates, s.cells, say), tables.samples, drawn.samples),
    Experiment("ablation", lambda s, say: steps(_psfs(s)[: s.ablated], say), tables.ablation),
    Experiment("large", large, tables.large),
]


def analyse(settings: PsfSettings, say: Say) -> dict[str, Any]:
    """Run all experiments.

    Args:
        settings: how much of each.
        say: is told in a line what comes next.

    Returns:
        What goes into ``psfs.json``: ``machine``, ``settings``, ``experiments`` with the rows of each, and ``seconds``,
        how long it all took.
    """
    start = time.perf_counter()
    rows = find_rows(EXPERIMENTS, settings, say)
    seconds = time.perf_counter() - start
    return {"machine": machine(), "settings": settings.row(), "experiments": rows, "seconds": seconds}


def markdown(found: dict[str, Any], plots: Sequence[str]) -> str:
    """The whole analysis, in Markdown."""
    parts = sections(EXPERIMENTS, found["experiments"], found["settings"], plots)
    return "\n\n".join([tables.head(found), *parts]) + "\n"


def draw(found: dict[str, Any]) -> Figures:
    """All plots of an analysis, by the names of their files."""
    return draw_figures(EXPERIMENTS, found["experiments"])
