"""What a renderer is to the stability report, and the parts that several of them share."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import torch
from torch import Tensor

from torchbokeh import KernelSplatting, LensBlur, PsfBank
from torchbokeh.psfs.model import Labels
from torchbokeh.report.stability.cases import Case, reach_of
from torchbokeh.report.stability.oracles import composed

Run = Callable[[Tensor, Tensor, Tensor | None], Tensor]

Inputs = Callable[[Tensor, Tensor, Tensor | None], tuple[Tensor, dict[str, Any]]]
"""What a part of this package is given for ``(image, coc, motion)``: the image, and all else by name."""

WAY = (5.0, -3.0)
"""Motion in px where a renderer needs one and a case has none."""

VIEWS = 16
"""Of the accumulation buffer."""

WIDEST = 100.0
"""Radius in px up to which banks other than that of motion are asked: what they scale their PSFs to needs a buffer as
large, and that of 1e4 px is refused."""


@dataclass(frozen=True, eq=False)
class Renderer:
    """One way to render a case.

    Attributes:
        name: for tables.
        kind: which bound holds for it, see `torchbokeh.report.stability.bounds`.
        run: renders ``(image, coc, motion)`` in their dtype.
        oracle: the same in double but for rounding: by plain sums, or by the renderer itself where there are ``sums``.
        sums: what it approximates, in double and by plain sums.
        plan: decides on such a picture, where it does that before.
        moves: whether it looks at motion.
        ahead: how far it goes along a motion, as a share of the length of that: half of it about the middle.
        texels: how much farther than its radius a PSF reaches by coarse texels, as a share of it.
        widths: least and largest radius, signed, of what has a CoC.
        quality: name of the operating point.
        bank: of the PSFs, where they are not flat discs.
    """

    name: str
    kind: str
    run: Run
    oracle: Run
    plan: Callable[[Tensor, Tensor, Tensor | None], object] | None = None
    moves: bool = False
    quality: str = "exact"
    bank: str | None = None
    sums: Run | None = None
    ahead: float = 0.5
    texels: float = 0.0
    widths: Callable[[Tensor], tuple[Tensor, Tensor]] = lambda coc: (coc, coc)

    @property
    def layered(self) -> bool:
        """Whether it takes the two layers of `layers_of`."""
        return self.kind in ("layers", "views", "rays")

    def takes(self, case: Case) -> bool:
        """Whether a case says anything about this renderer, and is among what it is for."""
        empty, channels = case.image.numel() == 0, case.image.shape[1]
        if (case.group == "motion" and not self.moves) or (empty and self.kind in ("samples", "views", "rays")):
            return False
        coloured = self.layered or self.kind in ("samples", "colours") or self.bank not in (None, "combined")
        if channels != 3 and coloured:
            return False
        return empty or self.bank in (None, "combined") or float(case.coc.abs().max()) <= WIDEST

    def gain(self) -> float:
        """The largest factor of the values: 1 of a mean, more where PSFs are tinted."""
        return 1.0 if self.bank is None else max(1.0, float(bank_of(self.bank).gains().max()) - 0.01)

    def reach(self, case: Case) -> float:
        """How far in px the PSFs of a case reach."""
        if self.bank in (None, "combined"):
            return reach_of((1 + self.texels) * self.widths(case.coc)[1], self.motion(case), self.ahead)
        bank = bank_of(self.bank)
        place = bank.model.place(Labels(case.coc))
        scale = 1.0 if place.scale is None else float(place.scale.max())
        number = bank.model.grid.index(place.coordinates.movedim(1, -1))
        return math.sqrt(2) * scale * float(bank.reach()[number].max()) + 3

    def motion(self, case: Case) -> Tensor | None:
        """The motion of a case, or one in its place, where the renderer needs one."""
        if not self.moves or case.motion is not None:
            return case.motion if self.moves else None
        way = torch.tensor(WAY, dtype=torch.float64).view(1, 2, 1, 1)
        return way.expand(len(case.image), 2, *case.image.shape[2:]).contiguous()


def call_with(call: Callable[..., Any], inputs: Inputs, image: Tensor, coc: Tensor, motion: Tensor | None) -> Any:
    """Call a part of this package with a picture."""
    first, others = inputs(image, coc, motion)
    return call(first, **others)


def blur_renderer(name: str, kind: str, blur: LensBlur, inputs: Inputs, **more: Any) -> Renderer:
    """A `LensBlur`: its oracle is `composed`, or itself in double where it merges or asks a bank."""
    run, plan, slow = (partial(call_with, call, inputs) for call in (blur, blur.plan, partial(composed, blur)))
    oracle, sums = (slow, None) if blur.quality == "exact" and kind != "bank" else (run, slow)
    return Renderer(name, kind, run, oracle, plan, quality=blur.quality, sums=sums, **more)


def splatting_renderer(name: str, kind: str, splatting: KernelSplatting, slow: Run, **more: Any) -> Renderer:
    """A `KernelSplatting`: its oracle is ``slow``, or itself in double where it merges or asks a bank."""
    run, plan = partial(call_with, splatting, picture), partial(call_with, splatting.plan, picture)
    oracle, sums = (slow, None) if kind == "splat" else (run, slow)
    return Renderer(name, kind, run, oracle, plan, quality=splatting.quality, sums=sums, **more)


def picture(image: Tensor, coc: Tensor, motion: Tensor | None) -> tuple[Tensor, dict[str, Any]]:
    """A picture and its CoC."""
    return image, {"coc": coc}


def moving(image: Tensor, coc: Tensor, motion: Tensor | None) -> tuple[Tensor, dict[str, Any]]:
    """The same in motion."""
    return image, {"coc": coc, "motion": motion}


def layered(image: Tensor, coc: Tensor, motion: Tensor | None) -> tuple[Tensor, dict[str, Any]]:
    """The two layers of `layers_of`."""
    rgba, radius = layers_of(image, coc)
    return rgba, {"coc": radius}


def moving_layers(image: Tensor, coc: Tensor, motion: Tensor | None) -> tuple[Tensor, dict[str, Any]]:
    """The same, moving in opposite ways."""
    assert motion is not None
    rgba, radius = layers_of(image, coc)
    return rgba, {"coc": radius, "motion": torch.stack([motion, -motion], 1)}


@lru_cache
def bank_of(name: str) -> PsfBank:
    """A bank that comes with the package."""
    return PsfBank.load(name)


def layers_of(image: Tensor, coc: Tensor) -> tuple[Tensor, Tensor]:
    """Two layers: a soft spot of the picture in front of the focus, and the picture mirrored behind it."""
    height, width = image.shape[2:]
    y, x = (torch.linspace(-1, 1, n, dtype=torch.float64, device=image.device) for n in (height, width))
    alpha = (4 - 8 * torch.hypot(y[:, None], x).sub(0.3).clamp_min(0)).clamp(0, 1).to(image.dtype)
    alpha = alpha.expand(len(image), 1, height, width)
    front, back = torch.cat([image * alpha, alpha], 1), torch.cat([image.flip(-1), torch.ones_like(alpha)], 1)
    return torch.stack([front, back], 1), torch.stack([-coc.abs(), coc.abs()], 1)
