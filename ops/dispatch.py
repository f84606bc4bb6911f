"""Which path an operator takes: the numba kernel or the torch definition, and in which dtype."""

import importlib.util
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache

import torch
from torch import Tensor

_FOUND = importlib.util.find_spec("numba") is not None
_definitions_only = ContextVar("_definitions_only", default=False)


@contextmanager
def definitions_only() -> Iterator[None]:
    """Take the torch definitions, even where there are kernels: their operators are what other runtimes know."""
    token = _definitions_only.set(True)
    try:
        yield
    finally:
        _definitions_only.reset(token)


def only_definitions() -> bool:
    """Whether `definitions_only` holds."""
    return not torch.compiler.is_dynamo_compiling() and _definitions_only.get()  # a variable that it does not follow


@cache
def numba_is_there() -> bool:
    """Whether numba can be imported; warns the first time that it cannot."""
    found = importlib.util.find_spec("numba") is not None
    if not found:
        warnings.warn(
            "numba is not installed: splatting on the CPU takes the slower torch path. "
            "`pip install torchbokeh[cpu]` brings the fast kernels.",
            stacklevel=2,
        )
    return found


def has_kernel(values: Tensor) -> bool:
    """Whether the numba kernels take these values: float32 on the CPU, and numba is installed."""
    if values.device.type != "cpu" or values.dtype != torch.float32:
        return False
    if only_definitions():
        return False
    return _FOUND if torch.compiler.is_compiling() else numba_is_there()  # the compiler does not follow a cache


def compute_dtype(*tensors: Tensor) -> torch.dtype:
    """The common dtype of the tensors, at least float32."""
    dtype = torch.float32
    for t in tensors:
        dtype = torch.promote_types(dtype, t.dtype)
    return dtype
