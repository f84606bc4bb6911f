"""``stability.md``: its tables and plots."""

from collections.abc import Sequence
from typing import Any

from matplotlib.figure import Figure

from torchbokeh.report.experiment import Figures
from torchbokeh.report.figures import one_panel
from torchbokeh.report.markdown import pictures, row_table, section, table
from torchbokeh.report.rows import Row, distinct, of

SCALED = "share of the bound"
"""What plots show: 1 is the bound."""


COLOURS = {"float64": "#7f7f7f", "float32": "#d62728", "bfloat16": "#1f77b4", "float16": "#2ca02c"}


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
    plans = {(row["case"], row["renderer"]): " ".join(row["plan"].split("\n")[1:]) for row in rows if row.get("plan")}
    head_of_mechanisms, mechanisms = "mechanism | case | error without | with", found["mechanisms"]
    parts = [
        head,
        section("Broken bounds", _table(broken)) if broken else "",
        section("Worst case of each renderer", _table([worst[key] for key in sorted(worst)])),
        section(
            "What keeps the bounds",
            row_table(mechanisms, head_of_mechanisms, "{mechanism} | {case} | {without:.2g} | {with:.2g}"),
        ),
        section("What the plans did", table(["case", "renderer", "plan"], [[*k, v] for k, v in plans.items()])),
        section("Every case in float32 and float64", _table(single)),
        "\n\n".join(pictures(plots, "")),
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


def _share(r: Row) -> float:
    """How much of its bound a number takes."""
    if not r["kept"]:
        return float("inf")
    return r["measured"] / r["bound"] if r["bound"] > 0 else 0.0


def draw(found: dict[str, Any]) -> Figures:
    """Both plots."""
    return {
        "stability_bounds.png": _bounds(found["rows"]),
        "stability_mechanisms.png": _mechanisms(found["mechanisms"]),
    }


def _bounds(rows: list[Row]) -> Figure:
    """All errors in float32 and less over their bounds, a line of dots for each renderer."""
    shown = [r for r in rows if r["what"] == "error" and r["bound"] > 0]
    names = sorted(distinct(shown, "renderer"), reverse=True)
    figure, axes = one_panel(9, 0.32 * len(names) + 1.5)
    for number, (precision, colour) in enumerate(COLOURS.items()):
        here = of(shown, precision=precision)
        x = [max(_share(r) if r["kept"] else r["measured"] / r["bound"], 1e-6) for r in here]
        y = [names.index(r["renderer"]) + 0.15 * (number - 1.5) for r in here]
        axes.plot(x, y, ".", color=colour, label=precision, markersize=4)
    axes.axvline(1.0, color="black", linewidth=0.8)
    axes.set_xscale("log")
    axes.set_yticks(range(len(names)), names)
    axes.set_xlabel(SCALED)
    axes.legend(loc="upper left", fontsize=8)
    return figure


def _mechanisms(rows: list[Row]) -> Figure:
    """Error without and with each mechanism."""
    figure, axes = one_panel(9, 0.32 * len(rows) + 1.2)
    for y, r in enumerate(reversed(rows)):
        ends = [max(r[key], 1e-12) for key in ("without", "with")]
        axes.plot(ends, [y, y], color="#c0c0c0", zorder=1)
        axes.plot(ends[:1], [y], "o", color="#d62728", label="without" if y == 0 else None)
        axes.plot(ends[1:], [y], "o", color="#2ca02c", label="with" if y == 0 else None)
    axes.set_xscale("log")
    axes.set_yticks(range(len(rows)), [f"{r['mechanism']}: {r['case']}" for r in reversed(rows)], fontsize=7)
    axes.set_xlabel("error")
    axes.legend(fontsize=8)
    return figure
