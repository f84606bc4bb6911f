"""Lines of the tables of the stability report."""

import contextlib
from collections.abc import Iterator
from typing import Any

import torch

from torchbokeh.report.stability.bounds import Precision
from torchbokeh.report.stability.cases import Case

Row = dict[str, Any]


def row(renderer: str, case: Case | str, precision: str, what: str, measured: float, limit: float, **more: Any) -> Row:
    """One line of a table; it is kept where the measured number is at most the limit, and so not where it is NaN.

    Args:
        renderer: its name.
        case: a case, or ``"group: name"``.
        precision: its name.
        what: was measured.
        measured: the number.
        limit: its bound.
        more: anything else to keep; ``stated=True`` where the bound is not derived.
    """
    group, name = (case.group, case.name) if isinstance(case, Case) else case.split(": ", 1)
    return {
        "renderer": renderer,
        "group": group,
        "case": name,
        "precision": precision,
        "what": what,
        "measured": float(measured),
        "bound": float(limit),
        "kept": bool(measured <= limit),
        **more,
    }


@contextlib.contextmanager
def autocast(precision: Precision) -> Iterator[None]:
    """As a user of mixed precision has it around the call."""
    if precision.autocast is None:
        yield
        return
    with torch.autocast("cpu", dtype=precision.autocast):
        yield
