"""The checks of arguments: each error names the argument, what was expected and what came."""

import doctest
import math
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
import torch

import torchbokeh.ops.checks
from torchbokeh.ops.checks import (
    check_count,
    check_finite,
    check_flag,
    check_kind,
    check_number,
    check_size,
    check_whole,
    not_finite,
)


def test_sizes() -> None:
    assert check_size((3, 5)) == (3, 5)
    assert check_size([np.int64(3), 5]) == (3, 5)
    for bad in ((3,), (1, 2, 3), (1.0, 2), 5, "35", (True, 2), None):
        with pytest.raises(TypeError, match=r"size: expected two integers \(H, W\), got"):
            check_size(bad)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"size: expected \(H, W\) of at least 1, got \(0, 5\)"):
        check_size((0, 5))


def test_numbers_come_back_as_those_of_python() -> None:
    assert type(check_whole("n", np.int64(3), 1)) is type(check_count("n", np.uint8(3), 1, 4)) is int
    assert type(check_number("x", Fraction(1, 2))) is type(check_finite("x", np.float32(0.5), 0)) is float
    assert check_flag("flag", False) is False
    assert check_number("x", math.inf, 0) == math.inf


def test_what_is_not_finite_is_counted_and_named() -> None:
    values = torch.tensor([1.0, math.nan, -math.inf])
    assert not_finite(values) == "2 that are not, first nan"
    assert not_finite(values[2:]) == "1 that are not, first -inf"
    assert not_finite(torch.tensor([6e4, 7e4]).half()) == "1 that are not, first inf: float16 ends at 65504"


def test_kinds() -> None:
    check_kind("name", "a", str)
    check_kind("name", None, str, optional=True)
    with pytest.raises(TypeError, match="name: expected a str, got NoneType"):
        check_kind("name", None, str)
    with pytest.raises(TypeError, match="count: expected an int or None, got str"):
        check_kind("count", "3", int, optional=True)


@pytest.mark.parametrize(
    ("check", "arguments", "message"),
    [
        (check_whole, (1.5, 1), "n: expected an int, got 1.5"),
        (check_whole, (True, 1), "n: expected an int, got True"),
        (check_whole, (0, 1), "n: expected at least 1, got 0"),
        (check_whole, (9, 1, 8), "n: expected at most 8, got 9"),
        (check_count, (2.0, 3, 64), "n: expected an int, got float"),
        (check_count, (2, 3, 64), "n: expected 3 to 64, got 2"),
        (check_number, ("1",), "n: expected a number, got '1'"),
        (check_number, (math.nan, 0, 1), "n: expected a number from 0 to 1, got nan"),
        (check_finite, (True, 0), "n: expected a number, got True"),
        (check_finite, (math.inf, 0), "n: expected a finite number of at least 0, got inf"),
        (check_finite, (math.nan, 0), "n: expected a finite number of at least 0, got nan"),
        (check_finite, (-0.5, 0), "n: expected a finite number of at least 0, got -0.5"),
        (check_flag, (1,), "n: expected a bool, got 1"),
    ],
)
def test_errors(check: Any, arguments: tuple[Any, ...], message: str) -> None:
    with pytest.raises((TypeError, ValueError)) as caught:
        check("n", *arguments)
    assert str(caught.value) == message


def test_above_leaves_the_bound_out() -> None:
    assert check_finite("x", 1, 1) == 1.0
    with pytest.raises(ValueError, match=r"x: expected a finite number above 1, got 1\.0"):
        check_finite("x", 1, 1, above=True)


def test_examples() -> None:
    assert doctest.testmod(torchbokeh.ops.checks).failed == 0
