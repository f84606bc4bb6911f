"""The rows that every experiment finds: what tables, plots and JSON are made of."""

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

Row = dict[str, Any]
"""Numbers and names by key, as JSON can hold them. A method that was not run has ``skipped``, the reason."""

Say = Callable[[str], None]
"""Is told in a line what comes next."""

OWN = "torchbokeh"
"""The family of this package's own methods."""


def of(rows: Iterable[Row], **wanted: Any) -> list[Row]:
    """The rows that have all these values."""
    return [row for row in rows if all(row.get(key) == value for key, value in wanted.items())]


def distinct(rows: Iterable[Row], key: str) -> list[Any]:
    """The values of a column, each once, in the order of the rows."""
    return list(dict.fromkeys(row[key] for row in rows))


def not_skipped(rows: Iterable[Row]) -> list[Row]:
    """The rows of what was run."""
    return [row for row in rows if "skipped" not in row]


def mean(rows: Iterable[Row], key: str) -> float:
    """The mean of a column.

    Example:
        >>> mean([{"l1": 1.0}, {"l1": 2.0}], "l1")
        1.5
    """
    return float(np.mean([row[key] for row in rows]))
