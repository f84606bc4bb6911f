"""The renderers that stiff cases are run through, each with an oracle in double.

Where a renderer does what its definition says but for rounding, the oracle is that definition, by plain sums
(`torchbokeh.report.stability.oracles`). Where it approximates it, by merging or by the border of a buffer, there are
two: itself in double, for rounding, and the definition, for the approximation.
"""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import torch
from torch import Tensor

from torchbokeh.ops.composite import TINY
from torchbokeh.ops.dense import dense_spans
from torchbokeh.ops.dispatch import compute_dtype
from torchbokeh.plan.quality import QUALITIES
from torchbokeh.psfs.aperture import Disc
from torchbokeh.psfs.bank import PsfBank
from torchbokeh.renderers.accumulation import AccumulationBuffer
from torchbokeh.renderers.kernel_splatting import KernelSplatting
from torchbokeh.renderers.lens_blur import LensBlur
from torchbokeh.renderers.reconstruction import Samples, pixel_positions, reconstruct
from torchbokeh.report.stability.options import options
from torchbokeh.report.stability.oracles import composed, gathered, splatted, viewed
from torchbokeh.report.stability.renderer import VIEWS, Renderer, bank_of, layers_of


def renderers() -> Iterator[Renderer]:
    """All of them."""
    for quality in QUALITIES:
        splatting = KernelSplatting(quality=quality.name)
        run, plan = partial(_still, splatting), partial(_still, splatting.plan)
        kind, oracle, sums = ("splat", dense, None) if quality.merging is None else ("merged", run, dense)
        yield Renderer(f"KernelSplatting, {quality.name}", kind, run, oracle, plan, quality=quality.name, sums=sums)
    for quality in QUALITIES:
        blur, name = LensBlur(quality=quality.name), quality.name
        for what, call, kind in (("image", _image, "composed"), ("layers", _layered, "layers")):
            run, plan, slow = partial(call, blur), partial(call, blur.plan), partial(call, partial(composed, blur))
            oracle, sums = (slow, None) if quality.merging is None else (run, slow)
            yield Renderer(f"LensBlur {what}, {name}", kind, run, oracle, plan, quality=name, sums=sums)
        run, plan, sums = partial(_moving, blur), partial(_moving, blur.plan), partial(_moving, partial(composed, blur))
        more: dict[str, Any] = {"moves": True, "quality": name, "bank": "combined", "sums": sums}
        yield Renderer(f"LensBlur motion, {name}", "bank", run, run, plan, **more)
    for name in ("stylized", "physical-lens"):
        splatting = KernelSplatting(quality="exact", bank=bank_of(name))
        run, plan, sums = partial(_still, splatting), partial(_still, splatting.plan), partial(_banked, bank_of(name))
        yield Renderer(f"KernelSplatting, bank {name}", "bank", run, run, plan, bank=name, sums=sums)
    yield Renderer("AccumulationBuffer layers", "views", _views, _viewed)
    yield from options()
    yield Renderer("reconstruct", "samples", _samples, _samples, moves=True, bank="combined", sums=gathered)


def dense(image: Tensor, coc: Tensor, motion: Tensor | None = None) -> Tensor:
    """Every pixel's disc, row by row, divided by the coverage: float64."""
    out = dense_spans(torch.cat([image, torch.ones_like(coc)], 1), coc, Disc().profile())
    return out[:, :-1] / out[:, -1:].clamp_min(TINY)


def coverage(coc: Tensor) -> Tensor:
    """What all discs together cover of each pixel, ``(B, 1, H, W)`` float64."""
    return dense_spans(torch.ones_like(coc), coc, Disc().profile())


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


def _viewed(image: Tensor, coc: Tensor, motion: Tensor | None) -> Tensor:
    return viewed(*layers_of(image, coc), VIEWS)


def _banked(bank: PsfBank, image: Tensor, coc: Tensor, motion: Tensor | None) -> Tensor:
    return splatted(bank, image, coc)


def _samples(image: Tensor, coc: Tensor, motion: Tensor | None) -> Tensor:
    """Samples in the middle of their pixels, of the lens and of the exposure: a plain picture."""
    assert motion is not None
    # Half precision cannot tell the columns of a wide picture apart.
    position = pixel_positions(image.to(compute_dtype(image))).expand(len(image), 2, *image.shape[2:])
    zero = torch.zeros_like(position)
    present = torch.ones_like(coc, dtype=torch.bool)
    return reconstruct(Samples(*(t[:, None] for t in (image, position, zero, zero[:, :1], coc, motion, present))))
