"""The pictures of a report."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, NullFormatter
from matplotlib.transforms import Bbox

from torchbokeh.report.speed.methods import OWN

Row = dict[str, Any]

EXACT = 1e-6
"""Where plots put errors below this."""

COLOURS = {
    OWN: "#d62728",
    "dense scatter": "#1f77b4",
    "gather": "#2ca02c",
    "layered FFT": "#9467bd",
    "layered direct": "#b08a3e",
    "fixed kernel": "#7f7f7f",
}
JOINS = {"sum, normalised": "s", "over, normalised": "o", "over": "X"}
SHADES = ("#7a0c0c", "#c4302b", "#ee6a50", "#f6a58c")


@dataclass(frozen=True)
class _Label:
    x: float
    y: float
    text: str
    colour: str
    side: tuple[int, int] = (1, 0)


def draw(found: dict[str, Any]) -> dict[str, Figure]:
    """All plots of a report.

    Args:
        found: what `torchbokeh.report.run.run_experiments` returns.

    Returns:
        Figures by the names of their files. Experiments without rows have none.
    """
    rows = found["experiments"]
    figures: dict[str, Figure] = {}
    photo = [row for row in rows["one_layer"] if row["scene"] == "photo"]
    for radius in dict.fromkeys(row["radius"] for row in photo):
        figures[f"one_layer_{radius:g}.png"] = _one_layer([row for row in photo if row["radius"] == radius])
    recipes = [row for row in rows["one_layer"] if row["scene"] != "photo"]
    if recipes:
        figures["one_layer_recipes.png"] = _recipes(recipes)
    if rows["truth"]:
        figures["truth.png"] = _truth(rows["truth"])
    if rows["radius"]:
        figures["radius.png"] = _radius(rows["radius"])
    if rows["pixels"]:
        figures["pixels.png"] = _pixels(rows["pixels"])
    if rows["layers"]:
        figures["layers.png"] = _layers(rows["layers"])
    if rows["threads"]:
        figures["threads.png"] = _threads(rows["threads"])
    if rows["chromatic_truth"]:
        figures["chromatic.png"] = _chromatic(rows["chromatic_truth"])
    return figures


def _one_layer(rows: list[Row]) -> Figure:
    figure = Figure(figsize=(9, 5.4), layout="constrained")
    axes = figure.subplots()
    size = f"{rows[0]['size']} x {rows[0]['size']}"
    axes.set_title(f"One layer, {rows[0]['scene']}, {size}, radius up to {rows[0]['radius']:g} px")
    run = _error_time(axes, rows)
    figure.legend(handles=_keys(run), loc="outside right upper", frameon=False, fontsize=9)
    _write_labels(figure, axes, [_label(row) for row in run])
    return figure


def _recipes(rows: list[Row]) -> Figure:
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    columns = min(4, len(scenes))
    lines = -(-len(scenes) // columns)
    figure = Figure(figsize=(3.1 * columns + 2.2, 2.9 * lines + 0.3), layout="constrained")
    grid = figure.subplots(lines, columns, squeeze=False, sharex=True, sharey=True)
    shown: list[Row] = []
    for axes, scene in zip(grid.flat, scenes, strict=False):
        axes.set_title(scene, fontsize=10)
        shown += _error_time(axes, [row for row in rows if row["scene"] == scene])
    for axes in grid.flat[len(scenes) :]:
        axes.remove()
    for axes in grid.flat:
        axes.label_outer()
    size = f"{rows[0]['size']} x {rows[0]['size']}"
    figure.suptitle(f"One layer, {size}, radius up to {rows[0]['radius']:g} px", fontsize=11)
    figure.legend(handles=_keys(shown), loc="outside right upper", frameon=False, fontsize=9)
    return figure


def _error_time(axes: Axes, rows: list[Row]) -> list[Row]:
    """Points of all methods that were run, and the line of those that nobody beats; returns the rows drawn."""
    run = [row for row in rows if "skipped" not in row]
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
    _plain_seconds(axes)
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


def _label(row: Row) -> _Label:
    name = row["method"]
    if row["family"] == OWN:
        name = name.removeprefix(f"{OWN} ")
    elif row["family"].startswith("layered"):
        name = name.split(",")[0].split()[-1]
    # The line of the best goes on to the right, and comes from above.
    return _Label(row["seconds"], _error(row["ssim"]), name, COLOURS[row["family"]], (-1 if row["pareto"] else 1, 0))


def _keys(rows: Iterable[Row]) -> list[Line2D]:
    """The legend: a colour for each family, a shape for each way to join layers, and the line."""
    rows = list(rows)
    families = [family for family in COLOURS if any(row["family"] == family for row in rows)]
    joins = [j for j, mark in JOINS.items() if any(_marker(row) == mark for row in rows)]
    keys = [
        Line2D(
            [], [], color=COLOURS[f], marker="*" if f == OWN else "D", markersize=10 if f == OWN else 6, ls="", label=f
        )
        for f in families
    ]
    if joins:
        keys.append(Line2D([], [], ls="", label="\nlayers joined by"))
    keys += [Line2D([], [], color="0.3", marker=JOINS[j], markersize=6, ls="", label=j) for j in joins]
    return [*keys, Line2D([], [], color="0.6", label="none is faster\nand nearer")]


def _write_labels(figure: Figure, axes: Axes, labels: Sequence[_Label]) -> None:
    """Put each label beside its point, where it covers no other label and no point; drop those without a place.

    This is the last thing done to a figure: it fixes the layout.
    """
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    figure.set_layout_engine("none")
    renderer = canvas.get_renderer()
    points = axes.transData.transform([(label.x, label.y) for label in labels])
    taken = [Bbox.from_bounds(x - 5, y - 5, 10, 10) for x, y in points]
    frame = axes.get_window_extent(renderer)
    for label in labels:
        for distance, (across, up) in _places(label):
            text = axes.annotate(
                label.text,
                (label.x, label.y),
                (across * distance, up * distance),
                textcoords="offset points",
                ha=("right", "center", "left")[across + 1],
                va=("top", "center", "bottom")[up + 1],
                color=label.colour,
                fontsize=9,
            )
            box = text.get_window_extent(renderer)
            outside = box.x0 < frame.x0 or box.x1 > frame.x1 or box.y0 < frame.y0 or box.y1 > frame.y1
            if not outside and not any(box.overlaps(other) for other in taken):
                taken.append(box)
                break
            text.remove()


def _places(label: _Label) -> list[tuple[int, tuple[int, int]]]:
    """Distances in points and sides that a label may have, the best first."""
    sides = sorted(_SIDES, key=lambda side: math.dist(side, label.side))
    return [(distance, side) for distance in (7, 13, 20) for side in sides]


_SIDES = ((1, 0), (0, 1), (0, -1), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1))


def _truth(rows: list[Row]) -> Figure:
    """Error against the truth by time, the mean over the scenes of each input and quality."""
    colours = {"one layer": "#1f77b4", "image": "#d62728", "image and background": "#2ca02c", "layers": "#9467bd"}
    noise = [1 - row["ssim_truth"] for row in rows if row["input"] == "truth"]
    found = [(r["input"], r["quality"], r["seconds"], 1 - r["ssim_truth"]) for r in rows if r["input"] in colours]
    return _against_truth(found, colours, noise, "LensBlur by input and quality, mean over the recipes")


def _against_truth(
    found: list[tuple[str, str, float, float]], colours: dict[str, str], noise: list[float], title: str
) -> Figure:
    """A line for each name, a point for each of its settings: the mean of all with that name and setting.

    Args:
        found: name, setting, seconds and error.
        colours: of the lines.
        noise: errors between two halves of the truth.
        title: of the plot.
    """
    figure = Figure(figsize=(8, 4.6), layout="constrained")
    axes = figure.subplots()
    labels = []
    for name, colour in colours.items():
        points = []
        for setting in dict.fromkeys(f[1] for f in found if f[0] == name):
            of = [f for f in found if f[:2] == (name, setting)]
            points.append((_mean([f[2] for f in of]), _mean([f[3] for f in of])))
            labels.append(_Label(*points[-1], setting, colour, (0, 1)))
        axes.plot(*zip(*points, strict=True), "o-", color=colour, label=name, markersize=6)
    axes.axhline(_mean(noise), color="0.6", linestyle="--", label="between two halves\nof the truth")
    axes.set(xscale="log", yscale="log", xlabel="seconds", ylabel="1 - SSIM against the truth")
    axes.set_title(title)
    axes.margins(0.15)
    _plain_seconds(axes)
    _plain_errors(axes)
    axes.grid(alpha=0.25, which="both")
    figure.legend(loc="outside right upper", frameon=False, fontsize=9)
    _write_labels(figure, axes, labels)
    return figure


def _mean(values: Sequence[float]) -> float:
    """The geometric mean, as a logarithmic axis shows it."""
    return float(np.exp(np.mean(np.log(np.maximum(values, EXACT)))))


def _curves(axes: Axes, rows: list[Row], x: str, y: str) -> None:
    """A line for each method."""
    own = 0
    run = [row for row in rows if "skipped" not in row and row.get(y) is not None]
    for name in dict.fromkeys(row["method"] for row in run):
        chosen = [row for row in run if row["method"] == name]
        colour = COLOURS[chosen[0].get("family", OWN)]
        style = "o--"
        if chosen[0].get("family", OWN) == OWN:
            colour, style, own = SHADES[own % len(SHADES)], "o-", own + 1
        axes.plot([r[x] for r in chosen], [r[y] for r in chosen], style, color=colour, label=name, markersize=4)
        if y == "seconds":
            low, high = ([r[key] for r in chosen] for key in ("quartile_low", "quartile_high"))
            axes.fill_between([r[x] for r in chosen], low, high, color=colour, alpha=0.15, linewidth=0)
    axes.set(xscale="log", yscale="log")
    axes.grid(alpha=0.25, which="major")


def _radius(rows: list[Row]) -> Figure:
    figure = Figure(figsize=(9, 4.8), layout="constrained")
    axes = figure.subplots()
    _curves(axes, rows, "radius", "seconds")
    _distinct([line for line in axes.lines if line.get_linestyle() == "--"])
    axes.set(xlabel="largest radius in px", ylabel="seconds", title=f"photo, {rows[0]['size']} x {rows[0]['size']}")
    _plain(axes, {row["radius"] for row in rows})
    _plain_seconds(axes, axes.yaxis)
    figure.legend(loc="outside right upper", frameon=False, fontsize=9)
    return figure


def _pixels(rows: list[Row]) -> Figure:
    known = any(row.get("peak_bytes") for row in rows)
    figure = Figure(figsize=(12 if known else 7.5, 4.4), layout="constrained")
    grid = figure.subplots(1, 2 if known else 1, squeeze=False)[0]
    _curves(grid[0], rows, "megapixels", "seconds")
    grid[0].set(ylabel="seconds", title=f"photo, radius up to {rows[0]['radius']:g} px")
    _plain_seconds(grid[0], grid[0].yaxis)
    if known:
        memory = [{**row, "megabytes": row["bytes_per_megapixel"] / 1e6} for row in rows if row.get("peak_bytes")]
        _curves(grid[1], memory, "megapixels", "megabytes")
        grid[1].set(ylabel="peak memory, MB per megapixel", title="one call, beyond its inputs", yscale="linear")
        grid[1].set_ylim(bottom=0)
    for axes, shown in zip(grid, (rows, [row for row in rows if row.get("peak_bytes")]), strict=False):
        axes.set_xlabel("megapixels")
        _plain(axes, {row["megapixels"] for row in shown})
    figure.legend(*grid[0].get_legend_handles_labels(), loc="outside right upper", frameon=False, fontsize=9)
    return figure


def _layers(rows: list[Row]) -> Figure:
    figure = Figure(figsize=(7.5, 4), layout="constrained")
    axes = figure.subplots()
    for kind, colour in zip(dict.fromkeys(row["kind"] for row in rows), ("#d62728", "#9467bd"), strict=True):
        chosen = [row for row in rows if row["kind"] == kind]
        axes.plot([r["layers"] for r in chosen], [r["seconds"] for r in chosen], "o-", color=colour, label=kind)
    axes.set(
        xlabel="layers", ylabel="seconds", title=f"LensBlur, {rows[0]['size']} x {rows[0]['size']}", ylim=(0, None)
    )
    axes.set_xticks(sorted({row["layers"] for row in rows}))
    axes.grid(alpha=0.25)
    axes.legend(frameon=False)
    return figure


def _threads(rows: list[Row]) -> Figure:
    figure = Figure(figsize=(7.5, 4), layout="constrained")
    axes = figure.subplots()
    _curves(axes, rows, "threads", "seconds")
    most = max(row["threads"] for row in rows)
    axes.set(xlabel="threads", ylabel="seconds", title="run time against threads")
    _plain(axes, {row["threads"] for row in rows})
    _plain_seconds(axes, axes.yaxis)
    slowest = max(row["seconds"] for row in rows if row["threads"] == 1)
    axes.plot([1, most], [slowest, slowest / most], color="0.6", linestyle=":", label="in proportion")
    figure.legend(loc="outside right upper", frameon=False, fontsize=9)
    return figure


def _chromatic(rows: list[Row]) -> Figure:
    """Error against the truth by time with dispersion, the mean over all cases of each method and setting."""
    noise = [1 - row["ssim"] for row in rows if row["method"] == "truth"]
    found = [(r["method"], r["setting"], r["seconds"], 1 - r["ssim"]) for r in rows if r["method"] != "truth"]
    colours = dict(zip(dict.fromkeys(f[0] for f in found), ("#9467bd", "#d62728", "#1f77b4"), strict=True))
    return _against_truth(found, colours, noise, "With dispersion, mean over scenes, spectra and strengths")


def _distinct(lines: Sequence[Any]) -> None:
    """Markers that tell lines of one colour apart."""
    for line, marker in zip(lines, "sD^vP*X<>", strict=False):
        line.set_marker(marker)


def _plain(axes: Axes, ticks: Iterable[float]) -> None:
    """Ticks of the horizontal axis where there are points, without powers of ten."""
    axes.set_xticks(sorted(ticks), [f"{tick:.3g}" for tick in sorted(ticks)])
    axes.xaxis.set_minor_formatter(NullFormatter())


def _plain_seconds(axes: Axes, which: Any = None) -> None:
    """Seconds without powers of ten, with ticks within a decade where there are few of them."""
    axis = axes.xaxis if which is None else which
    low, high = axis.get_view_interval()
    few: Callable[[float], bool] = lambda value: f"{value:e}"[0] in ("25" if high / low < 300 else "")  # noqa: E731
    axis.set_tick_params(which="minor", pad=5.1)  # in line with the major ones, whose ticks are longer
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(FuncFormatter(lambda value, _: f"{value:g}" if few(value) else ""))


def _plain_errors(axes: Axes) -> None:
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(FuncFormatter(lambda value, _: f"{value:g}" if f"{value:e}"[0] in "25" else ""))
