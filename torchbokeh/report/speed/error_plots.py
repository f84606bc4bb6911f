"""The plots of errors against run time as one layer."""

from collections.abc import Iterable

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter

from torchbokeh.report.figures import COLOURS, EXACT, Label, legend, one_panel, plain_seconds, write_labels
from torchbokeh.report.rows import OWN, Row, distinct, not_skipped, of

JOINS = {"sum, normalised": "s", "over, normalised": "o", "over": "X"}


def photo_figure(rows: list[Row]) -> Figure:
    """All methods on the photograph at one radius, each with its name."""
    figure, axes = one_panel(9, 5.4)
    axes.set_title(f"One layer, {rows[0]['scene']}, {_about(rows)}")
    run = _error_time(axes, rows)
    legend(figure, handles=_keys(run))
    write_labels(figure, axes, [_label(row) for row in run])
    return figure


def recipe_figure(rows: list[Row]) -> Figure:
    """All methods on every recipe, a panel for each recipe."""
    scenes = distinct(rows, "scene")
    columns = min(4, len(scenes))
    lines = -(-len(scenes) // columns)
    figure = Figure(figsize=(3.1 * columns + 2.2, 2.9 * lines + 0.3), layout="constrained")
    grid = figure.subplots(lines, columns, squeeze=False, sharex=True, sharey=True)
    shown: list[Row] = []
    for axes, scene in zip(grid.flat, scenes, strict=False):
        axes.set_title(scene, fontsize=10)
        shown += _error_time(axes, of(rows, scene=scene))
    for axes in grid.flat[len(scenes) :]:
        axes.remove()
    for axes in grid.flat:
        axes.label_outer()
    figure.suptitle(f"One layer, {_about(rows)}", fontsize=11)
    legend(figure, handles=_keys(shown))
    return figure


def _about(rows: list[Row]) -> str:
    return f"{rows[0]['size']} x {rows[0]['size']}, radius up to {rows[0]['radius']:g} px"


def _error_time(axes: Axes, rows: list[Row]) -> list[Row]:
    """Points of all methods that were run, and the line of those that nobody beats; returns the rows drawn."""
    run = not_skipped(rows)
    for row in run:
        spread, error = (row["quartile_low"], row["quartile_high"]), _error(row["ssim"])
        axes.plot(spread, (error, error), color=COLOURS[row["family"]], alpha=0.4, linewidth=1.5, zorder=2)
        axes.plot(
            row["seconds"],
            error,
            marker=_marker(row),
            color=COLOURS[row["family"]],
            markersize=9 if row["family"] == OWN else 6,
            markeredgecolor="white",
            markeredgewidth=0.6,
            linestyle="",
            zorder=4 if row["family"] == OWN else 3,
        )
    front = sorted((row["seconds"], _error(row["ssim"])) for row in run if row["pareto"])
    axes.plot(*zip(*front, strict=True), color="0.6", linewidth=1.2, zorder=2, drawstyle="steps-post")
    axes.set(xscale="log", yscale="log", xlabel="seconds", ylabel="1 - SSIM")
    axes.margins(0.12)
    plain_seconds(axes.xaxis)
    if any(_error(row["ssim"]) == EXACT for row in run):
        axes.yaxis.set_major_formatter(FuncFormatter(_error_tick))
    axes.grid(alpha=0.25, which="major")
    return run


def _error(ssim: float) -> float:
    return max(1 - ssim, EXACT)


def _error_tick(value: float, _: int) -> str:
    power = f"$10^{{{round(np.log10(value))}}}$"
    return f"< {power}" if np.isclose(value, EXACT) else power


def _marker(row: Row) -> str:
    if row["family"] == OWN:
        return "*"
    joined = [mark for join, mark in JOINS.items() if row["method"].endswith(f", {join}")]
    return joined[0] if joined else "D"


def _label(row: Row) -> Label:
    name = row["method"]
    if row["family"] == OWN:
        name = name.removeprefix(f"{OWN} ")
    elif row["family"].startswith("layered"):
        name = name.split(",")[0].split()[-1]
    # The line of the best goes on to the right, and comes from above.
    return Label(row["seconds"], _error(row["ssim"]), name, COLOURS[row["family"]], (-1 if row["pareto"] else 1, 0))


def _keys(rows: Iterable[Row]) -> list[Line2D]:
    """The legend: a colour for each family, a shape for each way to join layers, and the line."""
    rows = list(rows)
    families = [family for family in COLOURS if any(row["family"] == family for row in rows)]
    joins = [j for j, mark in JOINS.items() if any(_marker(row) == mark for row in rows)]
    shapes = {f: ("*", 10) if f == OWN else ("D", 6) for f in families}
    keys = [Line2D([], [], color=COLOURS[f], marker=m, markersize=s, ls="", label=f) for f, (m, s) in shapes.items()]
    if joins:
        keys.append(Line2D([], [], ls="", label="\nlayers joined by"))
    keys += [Line2D([], [], color="0.3", marker=JOINS[j], markersize=6, ls="", label=j) for j in joins]
    return [*keys, Line2D([], [], color="0.6", label="none is faster\nand nearer")]
