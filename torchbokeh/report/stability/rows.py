"""Lines of the tables of the stability report."""

from typing import Any

import torch
from torch import Tensor

from torchbokeh.report.rows import Row
from torchbokeh.report.stability.bounds import Precision
from torchbokeh.report.stability.cases import Case

STRANGE = "not finite, or of another dtype"
OUTSIDE = "outside of [min, max]"
LEAK = "far-field leak"
CONSTANT = "off the constant"
"""What is measured in many places."""


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


def autocast(precision: Precision) -> torch.autocast:
    """As a user of mixed precision has it around the call."""
    return torch.autocast("cpu", dtype=precision.autocast, enabled=precision.autocast is not None)


def strange(out: Tensor, dtype: torch.dtype) -> int:
    """How many numbers are not finite, and one more if they are of another dtype."""
    return int((~out.isfinite()).sum()) + (out.dtype != dtype)


def outside(out: Tensor, low: Tensor | float, high: Tensor) -> Tensor:
    """How far each number lies outside of a range."""
    return torch.maximum(low - out, out - high).clamp_min(0)


def worst(error: Tensor, limit: Tensor) -> tuple[float, float]:
    """The error that is nearest to its limit, or farthest beyond it, and that limit."""
    k = int((error / limit).nan_to_num(torch.inf).argmax())
    return float(error.flatten()[k]), float(limit.flatten()[k])


def off(out: Tensor, constant: Tensor | float) -> float:
    """How far numbers are from a constant at most."""
    return float((out - constant).abs().max())
