"""Parsers of the values of flags: each says in one line what was expected and what came."""

import math
import re
from argparse import ArgumentTypeError
from collections.abc import Callable

_METRES = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "": 1.0}


def whole(low: int, high: int = 10**9) -> Callable[[str], int]:
    """A parser of whole numbers from ``low`` to ``high``."""

    def parse(text: str) -> int:
        found = _integers("([0-9]{1,10})", text)
        _require(bool(found) and low <= found[0] <= high, f"a whole number from {low} to {high}", text)
        return found[0]

    return parse


count = whole(1, 1024)
"""A parser of numbers of layers, levels, threads and the like."""


def number(text: str) -> float:
    """A number, or an infinity; not NaN."""
    value = _parsed(text)
    _require(not math.isnan(value), "a number", text)
    return value


def finite(text: str) -> float:
    """A finite number."""
    value = number(text)
    _require(math.isfinite(value), "a finite number", text)
    return value


def positive(text: str) -> float:
    """A finite number above 0."""
    value = finite(text)
    _require(value > 0, "a number above 0", text)
    return value


def share(text: str) -> float:
    """A number above 0 and below 1."""
    value = _parsed(text)
    _require(0 < value < 1, "a number between 0 and 1", text)
    return value


def stops(text: str) -> float:
    """An exposure in stops, from -30 to 30."""
    value = finite(text)
    _require(abs(value) <= 30, "between -30 and 30 stops", text)
    return value


def length(text: str) -> float:
    """A length above 0 in metres, from ``50mm``, ``3.6cm``, ``2m`` or plain metres."""
    digits, unit = re.fullmatch(r"(.*?)\s*(mm|cm|m|)", text.strip(), re.DOTALL).groups()  # type: ignore[union-attr]
    value = number(digits) * _METRES[unit]
    _require(value > 0, "a length above 0, such as 50mm or 2.5", text)
    return value


def interval(text: str) -> tuple[float, float]:
    """Two finite numbers, from ``LO,HI``."""
    ends = [_parsed(end) for end in text.split(",")]
    _require(len(ends) == 2 and all(map(math.isfinite, ends)), "two numbers LO,HI such as 2,20", text)
    return ends[0], ends[1]


def pixel(text: str) -> tuple[int, int]:
    """Column and row of a pixel, from ``X,Y``."""
    found = _integers("([0-9]{1,9}),([0-9]{1,9})", text)
    _require(bool(found), "a pixel X,Y such as 320,240", text)
    return found[0], found[1]


def size(text: str) -> tuple[int, int]:
    """Height and width of a picture in px, from ``WxH``."""
    found = _integers("([0-9]{1,5})x([0-9]{1,5})", text)
    _require(bool(found) and min(found) > 0, "a size WxH such as 320x240", text)
    return found[1], found[0]


def shard(text: str) -> tuple[int, int]:
    """Which machine of how many, from ``K/M``."""
    found = _integers("([0-9]{1,6})/([0-9]{1,6})", text)
    _require(bool(found) and 1 <= found[0] <= found[1], "K/M with K from 1 to M, such as 2/4", text)
    return found[0], found[1]


def names(text: str) -> tuple[str, ...]:
    """Names with commas between them, in the order given."""
    found = tuple(name.strip() for name in text.split(","))
    _require(all(found), "names with commas between them", text)
    return found


def _require(fits: bool, expected: str, text: str) -> None:
    if not fits:
        raise ArgumentTypeError(f"expected {expected}, got {text!r}")


def _parsed(text: str) -> float:
    """NaN where the text is no number."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def _integers(pattern: str, text: str) -> list[int]:
    """The groups of a pattern of digits, or none where the text is something else."""
    match = re.fullmatch(pattern, text)
    return [int(digits) for digits in match.groups()] if match else []
