"""Which path an operator takes: the numba kernel or the torch definition, and in which dtype."""

import importlib.util
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache

import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensor
from torch.autograd import forward_ad

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


def has_numbers(t: Tensor) -> bool:
    """Whether the numbers of a tensor may be looked at: not while compiling, under vmap, on meta or if it is fake."""
    hidden = torch.compiler.is_compiling() or t.is_meta or isinstance(t, FakeTensor)
    return not (hidden or torch._C._functorch.is_batchedtensor(t))


def refuse_transforms(name: str, *tensors: Tensor | None) -> None:
    """Raise an error where torch would lose derivatives of an operator in silence, or fail within it.

    Raises:
        RuntimeError: a tensor carries a forward-mode tangent, or is inside ``torch.func.grad`` and the like.
    """
    if torch.compiler.is_compiling():
        return
    for t in tensors:
        if t is None:
            continue
        tangent = forward_ad.unpack_dual(t).tangent is not None
        if tangent or torch._C._functorch.is_gradtrackingtensor(t):
            raise RuntimeError(
                f"{name}: has no derivative in forward mode (jvp, jacfwd, hessian) nor under torch.func (grad, "
                "jacrev); use torch.autograd.grad or torch.autograd.functional.jacobian instead"
            )


def refuse_second(name: str, *grads: Tensor | None) -> None:
    """Raise an error for second derivatives other than those through the values.

    Raises:
        RuntimeError: one of these gradients of a gradient is asked for.
    """
    if any(grad is not None for grad in grads):
        raise RuntimeError(
            f"{name}: has second derivatives through the gradient of its values alone; "
            "take that of radii, shapes and places without create_graph=True"
        )


def compute_dtype(*tensors: Tensor) -> torch.dtype:
    """The common dtype of the tensors, at least float32."""
    dtype = torch.float32
    for t in tensors:
        dtype = torch.promote_types(dtype, t.dtype)
    return dtype
