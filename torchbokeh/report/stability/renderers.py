"""The renderers that stiff cases are run through, each with an oracle in double.

Where a renderer does what its definition says but for rounding, the oracle is that definition, by plain sums
(`torchbokeh.report.stability.oracles`). Where it approximates it, by merging or by the border of a buffer, there are
two: itself in double, for rounding, and the definition, for the approximation.
"""

from collections.abc import Iterator
from functools import partial

import torch
from torch import Tensor

from torchbokeh import AccumulationBuffer, KernelSplatting, LensBlur, Samples, reconstruct
from torchbokeh.ops.composite import TINY
from torchbokeh.ops.dense import dense_spans
from torchbokeh.ops.dispatch import compute_dtype
from torchbokeh.psfs.aperture import Disc
from torchbokeh.report.internals import QUALITIES, pixel_positions
from torchbokeh.report.stability.options import options
from torchbokeh.report.stability.oracles import gathered, splatted, viewed
from torchbokeh.report.stability.renderer import (
    VIEWS,
    Renderer,
    ask,
    bank_of,
    layered,
    layers_of,
    moving,
    of_blur,
    of_splatting,
    picture,
)


def renderers() -> Iterator[Renderer]:
    """All of them."""
    for quality in QUALITIES:
        kind = "splat" if quality.merging is None else "merged"
        name = f"KernelSplatting, {quality.name}"
        yield of_splatting(name, kind, KernelSplatting(quality=quality.name), dense)
    for quality in QUALITIES:
        blur = LensBlur(quality=quality.name)
        yield of_blur(f"LensBlur image, {quality.name}", "composed", blur, picture)
        yield of_blur(f"LensBlur layers, {quality.name}", "layers", blur, layered)
        yield of_blur(f"LensBlur motion, {quality.name}", "bank", blur, moving, moves=True, bank="combined")
    for name in ("stylized", "physical-lens"):
        bank = bank_of(name)
        splatting, slow = KernelSplatting(quality="exact", bank=bank), lambda i, c, _, bank=bank: splatted(bank, i, c)
        yield of_splatting(f"KernelSplatting, bank {name}", "bank", splatting, slow, bank=name)
    run = partial(ask, AccumulationBuffer(views=VIEWS), layered)
    yield Renderer("AccumulationBuffer layers", "views", run, lambda i, c, _: viewed(*layers_of(i, c), VIEWS))
    yield from options()
    yield Renderer("reconstruct", "samples", _samples, _samples, moves=True, bank="combined", sums=gathered)


def dense(image: Tensor, coc: Tensor, motion: Tensor | None = None) -> Tensor:
    """Every pixel's disc, row by row, divided by the coverage: float64."""
    out = dense_spans(torch.cat([image, torch.ones_like(coc)], 1), coc, Disc().profile())
    return out[:, :-1] / out[:, -1:].clamp_min(TINY)


def coverage(coc: Tensor) -> Tensor:
    """What all discs together cover of each pixel, ``(B, 1, H, W)`` float64."""
    return dense_spans(torch.ones_like(coc), coc, Disc().profile())


def _samples(image: Tensor, coc: Tensor, motion: Tensor | None) -> Tensor:
    """Samples in the middle of their pixels, of the lens and of the exposure: a plain picture."""
    assert motion is not None
    # Half precision cannot tell the columns of a wide picture apart.
    position = pixel_positions(image.to(compute_dtype(image))).expand(len(image), 2, *image.shape[2:])
    zero = torch.zeros_like(position)
    present = torch.ones_like(coc, dtype=torch.bool)
    return reconstruct(Samples(*(t[:, None] for t in (image, position, zero, zero[:, :1], coc, motion, present))))
