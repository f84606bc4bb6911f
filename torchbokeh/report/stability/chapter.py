"""Numerical stability: stiff and extreme cases, each held to a bound. A new kind of case is a line here."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from torchbokeh.report.experiment import Figures
from torchbokeh.report.machine import machine
from torchbokeh.report.markdown import pictures, row_table, section
from torchbokeh.report.rows import Row, Say, distinct, of
from torchbokeh.report.settings import Sizes, sized
from torchbokeh.report.stability import checks
from torchbokeh.report.stability.pictures import highlight_rows, render_rows

FORMAT = 2
"""Of ``stability.json``; it goes up when the meaning of a field changes."""

COLOURS = {"float64": "#7f7f7f", "float32": "#d62728", "bfloat16": "#1f77b4", "float16": "#2ca02c"}


@dataclass(frozen=True)
class StabilitySettings(Sizes):
    """How large it all is.

    Attributes:
        side: of pictures in px that go through all renderers.
        wide: of those of single parts.
        field: side of a square of highlights in px.
        times: how often a blur is applied to its result.
        large: height and width of large pictures.
        renderers: names of those that pictures go through; all where there are none.
    """

    side: int = sized(16, 8)
    wide: int = 96
    field: int = 100
    times: int = sized(100, 4)
    large: tuple[tuple[int, int], ...] = sized(((64, 8192), (4096, 4096)), ((16, 256),))
    renderers: tuple[str, ...] = sized((), ("KernelSplatting, exact", "LensBlur image, balanced"))


PARTS: dict[str, Callable[[StabilitySettings], Iterable[Row]]] = {
    "pictures through renderers": lambda s: render_rows(s.side, names=s.renderers),
    "highlights": lambda s: highlight_rows(s.wide, s.field, s.renderers),
    "sweeps of radii": lambda s: checks.sweep_rows(s.side),
    "lenses": lambda s: checks.lens_rows(s.side),
    "layers": lambda s: checks.layer_rows(s.side),
    "scenes": lambda s: checks.scene_rows(s.side),
    "iteration": lambda s: checks.iteration_rows(s.side, s.times),
    "gradients": lambda s: checks.gradient_rows(s.side),
    "large pictures": lambda s: (row for size in s.large for row in checks.large_rows(*size)),
}
"""All kinds of cases, in the order in which they are run."""


def run_stability(settings: StabilitySettings, say: Say) -> dict[str, Any]:
    """All cases.

    Args:
        settings: sizes.
        say: is told in a line what comes next.

    Returns:
        What goes into ``stability.json``: ``format``, ``machine``, ``settings`` and ``rows``.
    """
    rows: list[Row] = []
    for name, part in PARTS.items():
        say(f"stability: {name}")
        rows += part(settings)
    return {"format": FORMAT, "machine": machine(), "settings": settings.row(), "rows": rows}


def markdown(found: dict[str, Any], plots: Sequence[str]) -> str:
    """The chapter as Markdown: broken bounds first, then the worst case of each renderer, then all of float32."""
    rows: list[Row] = found["rows"]
    broken, stated = of(rows, kept=False), of(rows, stated=True)
    head = f"# Numerical stability\n\n{len(rows)} numbers, each held to a bound; {len(broken)} of them broken. "
    head += f"Bounds follow from the arithmetic, but for {len(stated)} that are stated: a number that "
    head += "was chosen by what was seen, or is a promise. A renderer's worst case is the one nearest to its bound."
    worst: dict[tuple[str, str, str], Row] = {}
    for row in rows:
        key = row["renderer"], row["what"], row["precision"]
        if key not in worst or _share(row) > _share(worst[key]):
            worst[key] = row
    single = [row for row in rows if row["precision"] in ("float32", "float64") and row["bound"] > 0]
    parts = [
        head,
        section("Broken bounds", _table(broken)) if broken else "",
        section("Worst case of each renderer", _table([worst[key] for key in sorted(worst)])),
        section("Every case in float32 and float64", _table(single)),
        *pictures(plots, ""),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def _table(rows: list[Row]) -> str:
    told = [
        {**row, "mark": " (stated)" * row.get("stated", False), "verdict": "kept" if row["kept"] else "**broken**"}
        for row in rows
    ]
    return row_table(
        told,
        "renderer | group | case | precision | what | measured | bound | verdict",
        "{renderer} | {group} | {case} | {precision} | {what} | {measured:.2g} | {bound:.2g}{mark} | {verdict}",
    )


def _share(row: Row) -> float:
    """How much of its bound a number takes."""
    if not row["kept"]:
        return float("inf")
    return row["measured"] / row["bound"] if row["bound"] > 0 else 0.0


def draw(found: dict[str, Any]) -> Figures:
    """All errors in float32 and less over their bounds, a line of dots for each renderer; 1 is the bound."""
    from torchbokeh.report.figures import one_panel

    shown = [row for row in found["rows"] if row["what"] == "error" and row["bound"] > 0]
    names = sorted(distinct(shown, "renderer"), reverse=True)
    figure, axes = one_panel(9, 0.32 * len(names) + 1.5)
    for number, (precision, colour) in enumerate(COLOURS.items()):
        here = of(shown, precision=precision)
        x = [max(row["measured"] / row["bound"], 1e-6) for row in here]
        y = [names.index(row["renderer"]) + 0.15 * (number - 1.5) for row in here]
        axes.plot(x, y, ".", color=colour, label=precision, markersize=4)
    axes.axvline(1.0, color="black", linewidth=0.8)
    axes.set_xscale("log")
    axes.set_yticks(range(len(names)), names)
    axes.set_xlabel("share of the bound")
    axes.legend(loc="upper left", fontsize=8)
    return {"stability_bounds.png": figure}
