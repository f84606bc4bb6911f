"""One good call of something public, and everything that can be wrong with one argument of it."""

import inspect
import math
import re
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

KINDS: dict[type, dict[str, Any]] = {
    bool: {"none": None, "text": "yes", "number": 2, "list": []},
    int: {"none": None, "text": "3", "real": 1.5, "list": [1], "bool": True, "-1": -1, "0": 0, "huge": 10**12},
    float: {
        "none": None,
        "text": "x",
        "list": [1.0],
        "complex": 1j,
        "bool": True,
        "array": np.ones(2),
        "nan": float("nan"),
        "inf": float("inf"),
        "-inf": -float("inf"),
        "-1": -1.0,
        "0": 0.0,
        "1e30": 1e30,
    },
    str: {"none": None, "number": 3, "list": [], "unknown": "no such thing", "empty": ""},
    tuple: {
        "none": None,
        "number": 3,
        "text": "ab",
        "one": (3,),
        "three": (3, 4, 5),
        "words": ("a", "b"),
        "reals": (2.5, 3.5),
        "nan": (float("nan"), 1.0),
        "0": (0, 3),
        "-1": (3, -1),
        "huge": (10**6, 10**6),
    },
}


Call = tuple[Callable[..., object], dict[str, Any], tuple[str, ...]]
"""A function, good values of its arguments, and as "argument: what" the mutations that make another good call. ``*``
stands for any argument, or for anything. What is marked by "?" is not tried on tensors at all."""


def tensors(good: Tensor) -> Iterator[tuple[str, Any]]:
    """What can be wrong with a tensor: its type, rank, dtype, device and each of its sizes."""
    yield from {"none": None, "text": "x", "list": [1.0], "number": 3, "array": np.ones(3)}.items()
    yield "rank + 1", good[None]
    yield "rank - 1", good[0] if good.dim() and len(good) else good.new_zeros(1)
    number = good.is_floating_point()
    yield "dtype", good.to(torch.int32) if number else good.float()
    yield "bool", good != 0
    yield "complex", good.to(torch.complex64)
    yield "meta", good.to("meta")
    for axis in range(good.dim()):
        yield f"size {axis}", torch.cat([good, good.narrow(axis, 0, 1)], axis)
    if number:
        for name, value in (("nan", torch.nan), ("inf", torch.inf), ("-1", -1.0)):
            bad = good.detach().clone(memory_format=torch.contiguous_format)
            bad.view(-1)[-1] = value
            yield name, bad


def mutations(name: str, good: Any) -> Iterator[tuple[str, Any]]:
    """Wrong values for an argument, by what is wrong."""
    if isinstance(good, Tensor):
        yield from tensors(good)
    else:
        other = {"none": None, "text": "x", "number": 3, "list": [], "module": math}
        yield from KINDS.get(type(good), other).items()
    yield "object", object()


@pytest.fixture
def one_by_one() -> Callable[[Call], list[str]]:
    """Spoil one argument after the other; the calls that were not refused as they should be."""

    def tried(call: Call) -> list[str]:
        function, arguments, marked = call
        function(**arguments)
        allowed = "|".join([*inspect.signature(function).parameters, *arguments])
        wrong = []
        for name, good in arguments.items():
            for what, bad in mutations(name, good):
                if what == "meta" and sum(isinstance(value, Tensor) for value in arguments.values()) == 1:
                    continue  # there is nothing to be on another device than
                if f"?: {what}" in marked and isinstance(good, Tensor):
                    continue
                label = f"{name}: {what}"
                fine = bool({label, f"{name}: *", f"*: {what}"} & {*marked})
                try:
                    function(**{**arguments, name: bad})
                except (TypeError, ValueError, FileNotFoundError) as error:
                    # Of two that do not fit each other, either one may be named; of what is missing, who misses it.
                    both = re.match("size|rank|meta|1e30", what) or (what == "list" and isinstance(good, list))
                    named = f"{allowed}|depth|combined" if what == "none" else allowed if both else name
                    if fine:
                        wrong.append(f"{label} is marked as fine, but raises {error}")
                    elif not re.match(rf"({named})([.\[]\S*)?: expected ", str(error)):
                        wrong.append(f"{label}: {type(error).__name__}: {error}"[:200])
                except Exception as error:
                    wrong.append(f"{label}: {type(error).__name__}: {error}"[:200])
                else:
                    if not fine:
                        wrong.append(f"{label}: taken without a word")
        return wrong

    return tried
