"""The parts that a report is written with."""

from collections.abc import Iterable, Sequence
from typing import Any

Row = dict[str, Any]


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)


def seconds(value: float) -> str:
    """Three digits that count, without an exponent.

    Example:
        >>> seconds(0.0123456), seconds(12.3456)
        ('0.0123', '12.3')
    """
    return f"{value:.1f}" if value >= 10 else f"{value:.2f}" if value >= 1 else f"{value:#.3g}"


def number(value: float | None, form: str) -> str:
    """A number in a format, or a dash for none."""
    return "-" if value is None else format(value, form)


def spread(row: Row) -> str:
    """The quartiles of its run time."""
    return f"{seconds(row['quartile_low'])} - {seconds(row['quartile_high'])}"


def skipped(rows: Sequence[Row]) -> str:
    """Methods that were not run, the reasons of equal ones together."""
    reasons: dict[str, list[str]] = {}
    for row in rows:
        if "skipped" in row:
            where = f" at {row['where']}" if "where" in row else ""
            reasons.setdefault(row["skipped"], []).append(row["method"] + where)
    if not reasons:
        return ""
    return "Left out: " + "; ".join(f"{', '.join(names)}: {reason}" for reason, names in reasons.items()) + "."


def pictures(plots: Sequence[str], start: str) -> list[str]:
    """Those whose names begin alike."""
    return [f"![{name.removesuffix('.png').replace('_', ' ')}]({name})" for name in plots if name.startswith(start)]


def section(title: str, *parts: str) -> str:
    """A heading and what there is below it."""
    return "\n\n".join([f"## {title}", *(part for part in parts if part)])
