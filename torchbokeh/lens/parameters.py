"""Modules with physical parameters: numbers are buffers, what is to be learned stays as it is."""

from copy import copy
from numbers import Real
from typing import Self

import torch
from torch import Tensor, nn


class ParametricModule(nn.Module):
    """Base of modules with physical parameters: scalars, or ``(B,)`` with one value for each item of the batch."""

    _names: tuple[str, ...]

    def extra_repr(self) -> str:
        """Name and value of every parameter."""
        return ", ".join(f"{name}={_show(value)}" for name, value in self.values().items())

    def values(self) -> dict[str, Tensor]:
        """Name and tensor of every parameter, in the order in which :meth:`keep` got them."""
        return {name: getattr(self, name) for name in self._names}

    def item(self, number: int) -> Self:
        """The same module for one item of the batch: of values of shape ``(B,)``, that of the item."""
        if not any(value.dim() for value in self.values().values()):
            return self
        other = copy(self)
        other._parameters, other._buffers = dict(self._parameters), dict(self._buffers)
        for name, value in self.values().items():
            other._parameters.pop(name, None)
            other._buffers[name] = value[number % len(value)] if value.dim() else value
        return other

    def keep(self, **values: float | Tensor) -> None:
        """Keep parameters: numbers and tensors as buffers, an ``nn.Parameter`` as the one it is.

        Raises:
            TypeError: not a number or floating-point tensor.
            ValueError: shapes or devices that do not go together.
        """
        # Numbers join the tensors' device: a focus distance predicted on a GPU needs no further .to().
        device = next((v.device for v in values.values() if isinstance(v, Tensor)), None)
        batched: tuple[str, int] | None = None
        self._names = tuple(values)
        for name, value in values.items():
            if isinstance(value, Real) and not isinstance(value, bool):
                value = torch.tensor(float(value), dtype=torch.float32, device=device)
            elif not isinstance(value, Tensor):
                raise TypeError(f"{name}: expected a number or a tensor, got {type(value).__name__}")
            if not value.is_floating_point():
                raise TypeError(f"{name}: expected a floating-point tensor, got {value.dtype}")
            if value.device != device and device is not None:
                raise ValueError(f"{name}: expected device {device}, got {value.device}")
            if value.dim() > 1:
                raise ValueError(f"{name}: expected a scalar or shape (B,), got {tuple(value.shape)}")
            if value.dim() == 1:
                batched = batched or (name, len(value))
                if len(value) != batched[1]:
                    raise ValueError(
                        f"{name}: expected a scalar or shape ({batched[1]},) like {batched[0]}, got ({len(value)},)"
                    )
            if isinstance(value, nn.Parameter):
                self.register_parameter(name, value)
            else:
                self.register_buffer(name, value)


def check_parameter(name: str, value: Tensor, good: Tensor, want: str) -> None:
    """Raise unless a parameter is good everywhere."""
    if not good.all():
        raise ValueError(f"{name}: expected {want}, got {value[~good][0].item():g}")


def _show(value: Tensor) -> str:
    if value.dim() == 0:
        return f"{value.item():.6g}"
    shown = [f"{v:.6g}" for v in value.detach()[:4].tolist()]
    return f"({', '.join(shown)}{', ...' if len(value) > 4 else ''})"
