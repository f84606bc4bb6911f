"""What every lens is: depth, or disparity, to the signed circle of confusion (CoC) and back."""

from abc import ABC, abstractmethod
from copy import copy
from typing import Self

import torch
from torch import Tensor

from torchbokeh.lens.dispersion import Dispersion
from torchbokeh.lens.field_map import Field
from torchbokeh.lens.parameters import ParametricModule
from torchbokeh.ops.dispatch import has_numbers


class Lens(ParametricModule, ABC):
    """What every lens can do: turn depth into a signed CoC radius in pixels, and back.

    A lens of one's own is a subclass with :meth:`coc`, and with :meth:`depth` where anyone asks for the inverse; every
    renderer takes it. ``examples/own_lens.py`` has one whose CoC depends on the place in the picture.

    A lens parameter is a scalar, or ``(B,)`` with one value for each item of the batch, the first dimension
    of the maps. Numbers and tensors are kept as buffers (float32 for numbers), so they follow ``.to()`` and
    are saved; an ``nn.Parameter`` stays the very same parameter and receives a gradient. Parameters are
    checked when the lens is built, not at each call: whoever optimises one keeps it in its range.

    Maps have shape ``(B, 1, H, W)``, or any ``(..., H, W)``; parameters of shape ``(B,)`` with B > 1 need the
    batch dimension. Results have the shape of the map and its dtype, but float32 for half precision.
    """

    dispersion: Dispersion | None

    def __init__(self) -> None:
        super().__init__()
        self.dispersion = None

    @abstractmethod
    def coc(self, depth: Tensor, width: int, *, field: Field | None = None) -> Tensor:
        """Signed CoC radius in pixels, positive behind the focus plane.

        Args:
            depth: ``(..., H, W)``, whatever the lens takes for depth.
            width: of the sensor in pixels.
            field: where the pixels are, from the middle of the sensor; renderers always pass it. A lens that needs it
                says what it does without.
        """

    def depth(self, coc: Tensor, width: int) -> Tensor:
        """Inverse of :meth:`coc`: the depth at which the signed CoC radius is ``coc`` pixels."""
        raise NotImplementedError(f"{type(self).__name__} does not say which depth has a given circle of confusion")

    def coc_shift(self, wavelength: float, width: int, field: Field | None = None) -> Tensor:
        """How much larger the signed CoC radius of a wavelength is in px: 0 for a lens without dispersion."""
        return torch.zeros(())

    def item(self, number: int) -> Self:
        """The lens for one item of the batch, with the dispersion for that."""
        other = super().item(number)
        dispersion = None if self.dispersion is None else self.dispersion.item(number)
        if dispersion is not self.dispersion:
            other = copy(other)
            other._modules = {**self._modules, "dispersion": dispersion}
        return other

    def forward(self, depth: Tensor, width: int) -> Tensor:
        """Same as :meth:`coc`."""
        return self.coc(depth, width)

    def aligned(self, name: str, x: Tensor, width: int) -> list[Tensor]:
        """Check a map and the width; return the map and the lens's parameters, all ready to broadcast.

        Args:
            name: of the map, for messages.
            x: the map ``(..., H, W)``.
            width: of the sensor in pixels.

        Raises:
            TypeError: ``x`` is no floating-point tensor, or ``width`` no integer.
            ValueError: a shape or device does not fit, or ``width`` < 1.
        """
        if not isinstance(x, Tensor):
            raise TypeError(f"{name}: expected a tensor of shape (..., H, W), got {type(x).__name__}")
        if not x.is_floating_point():
            raise TypeError(f"{name}: expected a floating-point tensor, got {x.dtype}")
        if x.dim() < 2:
            raise ValueError(f"{name}: expected shape (..., H, W), got {tuple(x.shape)}")
        check_width(width)
        # A map of less than float32 would lose the difference of two nearly equal reciprocals.
        dtype = torch.float64 if x.dtype == torch.float64 else torch.float32
        out = [x.to(dtype)]
        for value in self.values().values():
            if value.device != x.device:
                raise ValueError(f"{name}: expected the lens's device {value.device}, got {x.device}")
            value = value.to(dtype)
            if value.dim() == 1:
                if value.shape[0] > 1 and (x.dim() < 3 or x.shape[0] != value.shape[0]):
                    raise ValueError(
                        f"{name}: expected a batch of {len(value)} like the lens, got shape {tuple(x.shape)}"
                    )
                value = value.view(-1, *[1] * (x.dim() - 1))
            out.append(value)
        return out


def check_width(width: object) -> None:
    """Raise unless ``width`` is a number of pixels."""
    if not isinstance(width, int | torch.SymInt) or isinstance(width, bool):
        raise TypeError(f"width: expected an integer, got {type(width).__name__}")
    if width < 1:
        raise ValueError(f"width: expected at least 1, got {width}")


def check_map(name: str, x: Tensor, good: Tensor, want: str) -> None:
    """Raise unless all values of a map are good; one bool crosses to the host. Compiled code is not checked."""
    if has_numbers(good) and not good.all():
        bad = x[~good].sort().values  # NaN sorts last, so the smallest is a number where there is one
        raise ValueError(f"{name}: expected {want}, got {len(bad)} bad of {x.numel()}, the smallest {bad[0].item():g}")
