"""The parts that a report is written with."""

from collections.abc import Iterable, Mapping, Sequence
from string import Formatter
from typing import Any

from torchbokeh.report.rows import Row, distinct


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


class _Cells(Formatter):
    def get_value(self, key: int | str, args: Sequence[Any], row: Mapping[str, Any]) -> Any:
        return row.get(str(key))

    def format_field(self, value: Any, form: str) -> str:
        if value is None:
            return "-"
        return seconds(value) if form == "t" else f"{value / 1e6:.0f}" if form == "M" else format(value, form)


def cell(row: Row, form: str) -> str:
    """What a cell of a table shows of a row.

    Args:
        row: whose values are shown.
        form: a format that names keys. ``t`` formats a time as `seconds` does, ``M`` gives whole millions; a value that
            is missing or None is a dash.

    Example:
        >>> cell({"seconds": 0.5, "psnr": None}, "{seconds:t} s, {psnr:.1f} dB")
        '0.500 s, - dB'
    """
    return _Cells().vformat(form, (), row)


def row_table(rows: Iterable[Row], header: str, cells: str) -> str:
    """A table with a line for each row, from its header and what its cells show (`cell`), with bars between columns.

    Example:
        >>> print(row_table([{"size": 64, "l1": 0.5}], "size | L1", "{size} | {l1:.2f}"))
        | size | L1 |
        | --- | --- |
        | 64 | 0.50 |
    """
    forms = cells.split(" | ")
    return table(header.split(" | "), ([cell(row, form) for form in forms] for row in rows))


def cross_table(rows: Sequence[Row], line: str, column: str, form: str, heading: str = ".3g") -> str:
    """A table with a line for each value of one key and a column for each value of another.

    Args:
        rows: one for each cell; a cell is a dash where there is none, or where it was skipped.
        line: the key of the lines, whose heading is its name.
        column: the key of the columns.
        form: what a cell shows, see `cell`.
        heading: the format of the head of a column.
    """
    cells = {(row[line], row[column]): "-" if "skipped" in row else cell(row, form) for row in rows}
    columns = distinct(rows, column)
    lines = ([name, *(cells.get((name, value), "-") for value in columns)] for name in distinct(rows, line))
    return table([line, *(format(value, heading) for value in columns)], lines)


def skipped(rows: Sequence[Row], where: str = "") -> str:
    """Methods that were not run, those of one reason together; ``where`` is a format that says at which values."""
    reasons: dict[str, list[str]] = {}
    for row in rows:
        if "skipped" in row:
            reasons.setdefault(row["skipped"], []).append(row["method"] + cell(row, where))
    if not reasons:
        return ""
    return "Left out: " + "; ".join(f"{', '.join(names)}: {reason}" for reason, names in reasons.items()) + "."


def pictures(plots: Sequence[str], start: str) -> list[str]:
    """Those whose names begin alike."""
    return [f"![{name.removesuffix('.png').replace('_', ' ')}]({name})" for name in plots if name.startswith(start)]


def section(title: str, *parts: str) -> str:
    """A heading and what there is below it."""
    return "\n\n".join([f"## {title}", *(part for part in parts if part)])
