"""What the plots of several experiments share: colours, panels, labels, lines and ticks."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import cycle
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter, NullLocator
from matplotlib.transforms import Bbox

from torchbokeh.report.rows import OWN, Row, distinct, not_skipped, of

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
SHADES = ("#7a0c0c", "#c4302b", "#ee6a50", "#f6a58c")


@dataclass(frozen=True)
class Label:
    """A text beside a point of a plot; ``side`` is where it had best be, across and up."""

    x: float
    y: float
    text: str
    colour: str
    side: tuple[int, int] = (1, 0)


def one_panel(width: float, height: float) -> tuple[Figure, Axes]:
    """A figure with one plot, its size in inches."""
    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, figure.subplots()


def legend(figure: Figure, *entries: Any, **options: Any) -> None:
    """The legend of a whole figure, at its right; of what its axes name if no entries are given."""
    figure.legend(*entries, **options, loc="outside right upper", frameon=False, fontsize=9)


def write_labels(figure: Figure, axes: Axes, labels: Sequence[Label]) -> None:
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


def _places(label: Label) -> list[tuple[int, tuple[int, int]]]:
    """Distances in points and sides that a label may have, the best first."""
    sides = sorted(_SIDES, key=lambda side: math.dist(side, label.side))
    return [(distance, side) for distance in (7, 13, 20) for side in sides]


_SIDES = ((1, 0), (0, 1), (0, -1), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1))


def against_truth(rows: list[Row], name: str, setting: str, error: str, colours: dict[str, str], title: str) -> Figure:
    """A line for each name, a point for each of its settings: the mean of all with that name and setting.

    Args:
        rows: with ``seconds``; those named ``truth`` compare two halves of the truth.
        name: key of the names.
        setting: key of the settings.
        error: key of the SSIM against the truth.
        colours: of the lines, by name.
        title: of the plot.
    """
    figure, axes = one_panel(8, 4.6)
    labels = []
    for line, colour in colours.items():
        points = []
        for label in distinct(of(rows, **{name: line}), setting):
            chosen = of(rows, **{name: line, setting: label})
            points.append((_mean([row["seconds"] for row in chosen]), _mean([1 - row[error] for row in chosen])))
            labels.append(Label(*points[-1], label, colour, (0, 1)))
        axes.plot(*zip(*points, strict=True), "o-", color=colour, label=line, markersize=6)
    noise = _mean([1 - row[error] for row in of(rows, **{name: "truth"})])
    axes.axhline(noise, color="0.6", linestyle="--", label="between two halves\nof the truth")
    axes.set(xscale="log", yscale="log", xlabel="seconds", ylabel="1 - SSIM against the truth", title=title)
    axes.margins(0.15)
    plain_seconds(axes.xaxis)
    plain_errors(axes.yaxis)
    axes.grid(alpha=0.25, which="both")
    legend(figure)
    write_labels(figure, axes, labels)
    return figure


def _mean(values: Sequence[float]) -> float:
    """The geometric mean, as a logarithmic axis shows it."""
    return float(np.exp(np.mean(np.log(np.maximum(values, EXACT)))))


def curves(axes: Axes, rows: list[Row], x: str, y: str) -> None:
    """A line for each method, with its quartiles where it is one of seconds."""
    run = [row for row in not_skipped(rows) if row.get(y) is not None]
    shades = cycle(SHADES)
    for name in distinct(run, "method"):
        chosen = of(run, method=name)
        own = chosen[0].get("family", OWN) == OWN
        colour = next(shades) if own else COLOURS[chosen[0]["family"]]
        places = [row[x] for row in chosen]
        axes.plot(places, [row[y] for row in chosen], "o-" if own else "o--", color=colour, label=name, markersize=4)
        if y == "seconds":
            low, high = ([row[key] for row in chosen] for key in ("quartile_low", "quartile_high"))
            axes.fill_between(places, low, high, color=colour, alpha=0.15, linewidth=0)
    axes.set(xscale="log", yscale="log")
    axes.grid(alpha=0.25, which="major")


def plain(axes: Axes, rows: list[Row], x: str) -> None:
    """Ticks of the horizontal axis at the values of a column, without powers of ten."""
    ticks = sorted({row[x] for row in rows})
    axes.set_xticks(ticks, [f"{tick:.3g}" for tick in ticks])
    axes.xaxis.set_minor_formatter(NullFormatter())


def plain_seconds(axis: Axis) -> None:
    """Seconds without powers of ten, with ticks within a decade where there are few of them."""
    low, high = axis.get_view_interval()
    axis.set_tick_params(which="minor", pad=5.1)  # in line with the major ones, whose ticks are longer
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(FuncFormatter(_few if high / low < 300 else lambda value, _: ""))


def plain_errors(axis: Axis) -> None:
    """Numbers without powers of ten; within a decade, at 2 and 5."""
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(FuncFormatter(_few))


def per_cent(axes: Axes, ticks: Sequence[float]) -> None:
    """Ticks of the horizontal axis in per cent."""
    axes.set_xticks(ticks, [f"{100 * tick:.3g} %" for tick in ticks])
    axes.xaxis.set_minor_locator(NullLocator())


def _few(value: float, _: int | None) -> str:
    return f"{value:g}" if f"{value:e}"[0] in "25" else ""
