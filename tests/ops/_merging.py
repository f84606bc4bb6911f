"""Scenes and measures of the tests of merging."""

import math

import torch
from hypothesis import settings
from torch import Tensor

from torchbokeh.ops.merge import Merging, level_shares
from torchbokeh.ops.splat import splat_spans
from torchbokeh.psfs import Aperture, Disc, Ellipse, Polygon

F32, F64 = torch.float32, torch.float64
FINE, MIDDLE, COARSE = Merging(8, 0.005), Merging(4, 0.015), Merging(2.5, 0.03)
PLAIN = Merging(4, 1e6)
"""Merging in which nothing is a highlight."""

SHAPES = {
    "disc": Disc(),
    "ellipse": Ellipse(1.8, 0.5),
    "hexagon": Polygon(6, 0.3),
    "square": Polygon(4, math.pi / 4),
}
few = settings(deadline=None, max_examples=20)


def draw(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def noise(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(shape, generator=draw(seed), dtype=F64)


def radii(b: int, h: int, w: int, reach: float = 60.0, seed: int = 1) -> Tensor:
    """CoC of both signs, its radius evenly spread over the magnitudes from 0.3 up to ``reach``."""
    radius = reach ** torch.empty(b, 1, h, w, dtype=F64).uniform_(-0.3, 1, generator=draw(seed))
    return radius * (torch.randint(0, 2, radius.shape, generator=draw(seed + 1)) * 2 - 1)


def smooth(*shape: int, width: float, seed: int = 0) -> Tensor:
    """Noise without detail finer than about ``width`` px, from 0 to 1."""
    h, w = shape[-2:]
    square = torch.fft.fftfreq(h, dtype=F64)[:, None] ** 2 + torch.fft.rfftfreq(w, dtype=F64) ** 2
    waves = torch.fft.rfft2(torch.randn(shape, generator=draw(seed), dtype=F64)) * (-square * width**2).exp()
    picture = torch.fft.irfft2(waves, s=(h, w))
    return (picture - picture.amin()) / (picture.amax() - picture.amin())


def exact(values: Tensor, coc: Tensor, shape: Aperture) -> Tensor:
    """Without merging, in float32: far more exact than merging is, and faster than in float64."""
    return splat_spans(values.float(), coc.float(), shape.profile(), integrate=True).to(values.dtype)


def relative_l1(got: Tensor, want: Tensor) -> float:
    return float((got - want).abs().sum() / want.abs().sum())


def assert_close(got: Tensor, want: Tensor, relative: float) -> None:
    got, want = got.detach().double(), want.detach().double()
    torch.testing.assert_close(got, want, rtol=0, atol=relative * float(want.abs().max()))


def shares_of(coc: Tensor, merging: Merging = PLAIN, highest: int = 4) -> Tensor:
    """Shares ``(L+1, B, 1, H, W)`` of a picture of ones."""
    return torch.stack(level_shares(torch.ones_like(coc), coc, merging, highest))
