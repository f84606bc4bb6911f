"""The renderers that stiff cases are run through, each with an oracle in double."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import torch
from torch import Tensor

from torchbokeh.accumulation import AccumulationBuffer
from torchbokeh.kernel_splatting import KernelSplatting
from torchbokeh.lens_blur import LensBlur
from torchbokeh.ops._dispatch import compute_dtype
from torchbokeh.ops.composite import TINY
from torchbokeh.ops.dense import dense_spans
from torchbokeh.psfs.aperture import Disc
from torchbokeh.psfs.bank import PsfBank
from torchbokeh.psfs.model import Labels
from torchbokeh.quality import QUALITIES
from torchbokeh.reconstruction import Samples, pixel_positions, reconstruct
from torchbokeh.report.stability_cases import Case, reach_of

Run = Callable[[Tensor, Tensor, Tensor | None], Tensor]

WAY = (5.0, -3.0)
"""Motion in px where a renderer needs one and a case has none."""

VIEWS = 16
"""Of the accumulation buffer."""

WIDEST = 100.0
"""Radius in px up to which banks other than that of motion are asked: they are not for more."""


@dataclass(frozen=True, eq=False)
class Renderer:
    """One way to render a case.

    Attributes:
        name: for tables.
        kind: which bound holds for it, see `torchbokeh.report.stability_bounds`.
        run: renders ``(image, coc, motion)`` in their dtype.
        oracle: the same in double, by other means where there are any.
        plan: decides on such a picture, where it does that before.
        moves: whether it looks at motion.
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

    def takes(self, case: Case) -> bool:
        """Whether a case says anything about this renderer, and is among what it is for."""
        empty, channels = case.image.numel() == 0, case.image.shape[1]
        if (case.group == "motion" and not self.moves) or (empty and self.kind in ("samples", "views")):
            return False
        if channels != 3 and (self.kind in ("samples", "views", "layers") or self.bank not in (None, "combined")):
            return False
        return empty or self.bank in (None, "combined") or float(case.coc.abs().max()) <= WIDEST

    def gain(self) -> float:
        """The largest factor of the values: 1 of a mean, more where PSFs are tinted."""
        return 1.0 if self.bank is None else max(1.0, float(bank_of(self.bank).gains().max()) - 0.01)

    def reach(self, case: Case) -> float:
        """How far in px the PSFs of a case reach."""
        if self.bank in (None, "combined"):
            return reach_of(case, self.motion(case))
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


def renderers() -> Iterator[Renderer]:
    """All of them."""
    for quality in QUALITIES:
        splatting = KernelSplatting(quality=quality.name)
        kind = "splat" if quality.merging is None else "merged"
        plan = partial(_still, splatting.plan)
        yield Renderer(
            f"KernelSplatting, {quality.name}", kind, partial(_still, splatting), dense, plan, quality=quality.name
        )
    for name in (quality.name for quality in QUALITIES):
        blur = LensBlur(quality=name)
        for what, call, kind in (("image", _image, "composed"), ("layers", _layered, "layers")):
            run = partial(call, blur)
            yield Renderer(f"LensBlur {what}, {name}", kind, run, run, partial(call, blur.plan), quality=name)
        run, plan = partial(_moving, blur), partial(_moving, blur.plan)
        yield Renderer(f"LensBlur motion, {name}", "bank", run, run, plan, moves=True, quality=name, bank="combined")
    for name in ("stylized", "physical-lens"):
        splatting = KernelSplatting(quality="exact", bank=bank_of(name))
        run = partial(_still, splatting)
        yield Renderer(f"KernelSplatting, bank {name}", "bank", run, run, partial(_still, splatting.plan), bank=name)
    yield Renderer("AccumulationBuffer layers", "views", _views, _views)
    yield Renderer("reconstruct", "samples", _samples, _samples, moves=True, bank="combined")


@lru_cache
def bank_of(name: str) -> PsfBank:
    """A bank that comes with the package."""
    return PsfBank.load(name)


def dense(image: Tensor, coc: Tensor, motion: Tensor | None = None) -> Tensor:
    """Every pixel's disc, row by row, divided by the coverage: float64."""
    out = dense_spans(torch.cat([image, torch.ones_like(coc)], 1), coc, Disc().profile())
    return out[:, :-1] / out[:, -1:].clamp_min(TINY)


def coverage(coc: Tensor) -> Tensor:
    """What all discs together cover of each pixel, ``(B, 1, H, W)`` float64."""
    return dense_spans(torch.ones_like(coc), coc, Disc().profile())


def layers_of(image: Tensor, coc: Tensor) -> tuple[Tensor, Tensor]:
    """Two layers: a soft spot of the picture in front of the focus, and the picture mirrored behind it."""
    height, width = image.shape[2:]
    y, x = (torch.linspace(-1, 1, n, dtype=torch.float64, device=image.device) for n in (height, width))
    alpha = (4 - 8 * torch.hypot(y[:, None], x).sub(0.3).clamp_min(0)).clamp(0, 1).to(image.dtype)
    alpha = alpha.expand(len(image), 1, height, width)
    front, back = torch.cat([image * alpha, alpha], 1), torch.cat([image.flip(-1), torch.ones_like(alpha)], 1)
    return torch.stack([front, back], 1), torch.stack([-coc.abs(), coc.abs()], 1)


def _still(call: Callable[..., Any], image: Tensor, coc: Tensor, motion: Tensor | None) -> Any:
    return call(image, coc)


def _image(call: Callable[..., Any], image: Tensor, coc: Tensor, motion: Tensor | None) -> Any:
    return call(image, coc=coc)


def _moving(call: Callable[..., Any], image: Tensor, coc: Tensor, motion: Tensor | None) -> Any:
    return call(image, coc=coc, motion=motion)


def _layered(call: Callable[..., Any], image: Tensor, coc: Tensor, motion: Tensor | None) -> Any:
    rgba, radius = layers_of(image, coc)
    return call(rgba, coc=radius)


def _views(image: Tensor, coc: Tensor, motion: Tensor | None) -> Tensor:
    rgba, radius = layers_of(image, coc)
    return AccumulationBuffer(views=VIEWS)(rgba, coc=radius)


def _samples(image: Tensor, coc: Tensor, motion: Tensor | None) -> Tensor:
    """Samples in the middle of their pixels, of the lens and of the exposure: a plain picture."""
    assert motion is not None
    # Half precision cannot tell the columns of a wide picture apart.
    position = pixel_positions(image.to(compute_dtype(image))).expand(len(image), 2, *image.shape[2:])
    zero = torch.zeros_like(position)
    present = torch.ones_like(coc, dtype=torch.bool)
    return reconstruct(Samples(*(t[:, None] for t in (image, position, zero, zero[:, :1], coc, motion, present))))
