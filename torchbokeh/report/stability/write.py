"""Write the stability chapter: ``stability.md``, ``stability.json`` and plots, all of them or none."""

from pathlib import Path
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from torchbokeh.report.markdown import section, table
from torchbokeh.report.stability.rows import Row
from torchbokeh.report.write import write_together

SCALED = "share of the bound"
"""What plots show: 1 is the bound."""


def write_stability(found: dict[str, Any], folder: Path) -> list[Path]:
    """Write the files of the chapter.

    Args:
        found: what `torchbokeh.report.stability.run_stability` returns.
        folder: an existing folder; files of an earlier report are replaced.

    Returns:
        The files written.
    """
    rows, mechanisms = found["rows"], found["mechanisms"]
    figures = {"stability_bounds.png": _bounds(rows), "stability_mechanisms.png": _mechanisms(mechanisms)}
    return write_together(folder, "stability", stability_markdown(found, list(figures)), _plain(found), figures)


def stability_markdown(found: dict[str, Any], plots: list[str]) -> str:
    """The chapter as Markdown: broken bounds first, then the worst case of each renderer, then all of float32."""
    rows: list[Row] = found["rows"]
    broken = [r for r in rows if not r["kept"]]
    head = f"# Numerical stability\n\n{len(rows)} numbers, each held to a bound; {len(broken)} of them broken. "
    head += f"Bounds follow from the arithmetic, but for {sum(map(_stated, rows))} that are stated: a number that "
    head += "was chosen by what was seen, or is a promise. A renderer's worst case is the one nearest to its bound."
    parts = [head]
    if broken:
        parts.append(section("Broken bounds", _table(broken)))
    worst: dict[tuple[str, str, str], Row] = {}
    for r in rows:
        key = r["renderer"], r["precision"], r["what"]
        if key not in worst or _share(r) > _share(worst[key]):
            worst[key] = r
    parts.append(section("Worst case of each renderer", _table(sorted(worst.values(), key=_order))))
    lines = [[m["mechanism"], m["case"], f"{m['without']:.2g}", f"{m['with']:.2g}"] for m in found["mechanisms"]]
    parts.append(section("What keeps the bounds", table(["mechanism", "case", "error without", "with"], lines)))
    plans = {(r["case"], r["renderer"]): " ".join(str(r["plan"]).split("\n")[1:]) for r in rows if r.get("plan")}
    decided = table(["case", "renderer", "plan"], [[*k, v] for k, v in plans.items()])
    parts.append(section("What the plans did", decided))
    single = [r for r in rows if r["precision"] in ("float32", "float64") and r["bound"] > 0]
    parts.append(section("Every case in float32 and float64", _table(single)))
    parts.append("\n\n".join(f"![{name.removesuffix('.png').replace('_', ' ')}]({name})" for name in plots))
    return "\n\n".join(parts) + "\n"


def _table(rows: list[Row]) -> str:
    header = ["renderer", "group", "case", "precision", "what", "measured", "bound", "verdict"]
    names = header[:5]
    numbers = [[f"{r['measured']:.2g}", f"{r['bound']:.2g}" + " (stated)" * _stated(r)] for r in rows]
    verdicts = ["kept" if r["kept"] else "**broken**" for r in rows]
    lines = [[*(r[n] for n in names), *n, v] for r, n, v in zip(rows, numbers, verdicts, strict=True)]
    return table(header, lines)


def _stated(r: Row) -> bool:
    """Whether a bound is no more than a statement."""
    return bool(r.get("stated", False))


def _order(r: Row) -> tuple[str, str, str]:
    return r["renderer"], r["what"], r["precision"]


def _share(r: Row) -> float:
    """How much of its bound a number takes."""
    if not r["kept"]:
        return float("inf")
    return r["measured"] / r["bound"] if r["bound"] > 0 else 0.0


def _plain(value: Any) -> Any:
    """The same without numbers that JSON cannot hold: as text."""
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    return str(value) if isinstance(value, float) and not abs(value) < float("inf") else value


def _bounds(rows: list[Row]) -> Figure:
    """All errors in float32 and less over their bounds, a line of dots for each renderer."""
    shown = [r for r in rows if r["what"] == "error" and r["bound"] > 0]
    names = sorted({r["renderer"] for r in shown}, reverse=True)
    colours = {"float64": "#7f7f7f", "float32": "#d62728", "bfloat16": "#1f77b4", "float16": "#2ca02c"}
    figure = Figure(figsize=(9, 0.32 * len(names) + 1.5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for number, (precision, colour) in enumerate(colours.items()):
        here = [r for r in shown if r["precision"] == precision]
        x = [max(_share(r) if r["kept"] else r["measured"] / r["bound"], 1e-6) for r in here]
        y = [names.index(r["renderer"]) + 0.15 * (number - 1.5) for r in here]
        axes.plot(x, y, ".", color=colour, label=precision, markersize=4)
    axes.axvline(1.0, color="black", linewidth=0.8)
    axes.set_xscale("log")
    axes.set_yticks(range(len(names)), names)
    axes.set_xlabel(SCALED)
    axes.legend(loc="upper left", fontsize=8)
    return figure


def _mechanisms(rows: list[dict[str, Any]]) -> Figure:
    """Error without and with each mechanism."""
    figure = Figure(figsize=(9, 0.32 * len(rows) + 1.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
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
