"""Forward and backward by plain autograd, and by this package: the methods, and what their graphs keep."""

import math
from functools import partial

import torch
from torch import Tensor
from torch.nn import functional as F

import torchbokeh
from torchbokeh.ops.composite import TINY
from torchbokeh.psfs.aperture import Disc
from torchbokeh.report.internals import splat_definition
from torchbokeh.report.speed.methods import Method, own_methods, own_name

QUALITIES = ("exact", "balanced")
COMPOSED = "LensBlur"
SPANS = "autograd, row intervals"
DENSE = "autograd, dense"

# Bytes that a graph keeps: for each row interval of a pixel, for each pixel and offset, for each pixel and bin of a
# sub-aperture, and for each pixel besides.
_INTERVAL, _OFFSET, _BIN, _PIXEL = 1900, 8, 85, 300


def gradient_methods() -> dict[str, Method]:
    """What is compared, by name: this package's operating points, and the same sums left to autograd."""
    found = [own_methods()[own_name(quality)] for quality in QUALITIES]
    for quality in QUALITIES:
        blur = torchbokeh.LensBlur(quality=quality)
        about = f"LensBlur(quality={quality!r}) of an image: foreground, filled background and composition"
        found.append(Method(f"{COMPOSED} {quality}", COMPOSED, about, partial(_lens_blur, blur), _seconds))
    rows = "the torch definition of the exact splat, row by row in double, its graph built by autograd"
    discs = "every pixel adds its disc, offset by offset with an edge 1 px wide, its graph built by autograd"
    found.append(Method(SPANS, "autograd", rows, interval_splat, _seconds))
    found.append(Method(DENSE, "autograd", discs, dense_splat, _seconds))
    return {method.name: method for method in found}


def _seconds(coc: Tensor) -> float:
    return 0.0  # memory is what limits these


def _lens_blur(blur: torchbokeh.LensBlur, image: Tensor, coc: Tensor) -> Tensor:
    return blur(image, coc=coc)


def interval_splat(image: Tensor, coc: Tensor) -> Tensor:
    """The torch definition of the exact one-layer blur, without the adjoint that this package gives it."""
    out = splat_definition(torch.cat([image, torch.ones_like(coc)], 1), coc, Disc().profile(), True)
    return out[:, :-1] / out[:, -1:].clamp_min(TINY)


def dense_splat(image: Tensor, coc: Tensor) -> Tensor:
    """Every pixel adds its disc, with an edge 1 px wide, and the sum is divided by its coverage."""
    height, width = image.shape[-2:]
    radius = coc.abs().clamp_min(0.5)
    reach = math.ceil(radius.max().item())
    shares = torch.cat([image, torch.ones_like(coc)], 1) / (math.pi * radius.square())
    shares, radius = F.pad(shares, (reach,) * 4), F.pad(radius, (reach,) * 4)
    out = torch.zeros_like(shares[..., :height, :width])
    for y in range(2 * reach + 1):
        for x in range(2 * reach + 1):
            away = math.hypot(y - reach, x - reach)
            if away < reach + 0.5:
                seen = (..., slice(y, y + height), slice(x, x + width))
                out.addcmul_(shares[seen], (radius[seen] + (0.5 - away)).clamp(0, 1))  # in place: the least to keep
    return out[:, :-1] / out[:, -1:].clamp_min(TINY)


def held(name: str, coc: Tensor) -> float:
    """Bytes that a method keeps for its backward pass, at most, about. It decides what is left out, nothing else.

    Args:
        name: of `gradient_methods`.
        coc: ``(1, 1, H, W)``.
    """
    radius = coc.abs()
    if name == SPANS:
        return _INTERVAL * (2 * radius.double() + 3).sum().item()
    each = 0.0
    if name == DENSE:
        each = _OFFSET * math.pi * (radius.max().item() + 0.5) ** 2
    elif name.startswith(COMPOSED):
        plan = torchbokeh.LensBlur(quality=name.split()[1]).plan(coc, coc=coc)
        each = 2000 + _BIN * plan.subapertures**2 * sum(map(len, plan.bins))
    return coc.numel() * (_PIXEL + each)
