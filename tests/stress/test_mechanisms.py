"""What each mechanism of numerical stability is good for: the error without it, and with it, in float32.

``python -P tests/stress/test_mechanisms.py`` prints them.
"""

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any
from unittest import mock

import numpy as np
import torch
from torch import Tensor

from torchbokeh import FFTIntegrator, KernelSplatting, PyramidIntegrator
from torchbokeh.banks import highlights, samples
from torchbokeh.ops.capsules import splat_capsules
from torchbokeh.ops.composite import TINY
from torchbokeh.ops.convolve import convolve
from torchbokeh.ops.dense import dense_spans
from torchbokeh.ops.integrate import laplacian, poisson_fft
from torchbokeh.ops.splat import splat_spans
from torchbokeh.picture.request import WIDEST
from torchbokeh.psfs.aperture import Disc
from torchbokeh.psfs.combined import Combined, capsule
from torchbokeh.psfs.refit import drawn
from torchbokeh.report.stability.cases import even, slope
from torchbokeh.report.stability.pictures import off
from torchbokeh.report.stability.renderers import bank_of

Row = dict[str, Any]


def _row(mechanism: str, case: str, without: float | Tensor, kept: float | Tensor) -> Row:
    return {"mechanism": mechanism, "case": case, "without": float(without), "with": float(kept)}


def mechanism_rows(side: int = 96) -> Iterator[Row]:
    """All of them, on pictures of about ``side`` px; errors are absolute, on a ground of 1, if nothing else is said."""
    yield _running_sum(side)
    yield _convolution(side)
    yield from _highlights(side)
    yield _moments()
    yield from _integrals(side)
    yield from _normalisation(side)
    yield _reciprocals()
    yield _confined(side)


def _lit(side: int) -> Tensor:
    image = torch.ones(1, 1, side, side)
    image[..., side // 4, side // 3] = 1e6 / 3
    return image


def _far(side: int, radius: float) -> Tensor:
    y, x = torch.arange(side)[:, None] - side // 4, torch.arange(side) - side // 3
    return torch.hypot(y + 0.0 * x, x + 0.0 * y) > radius + 3


def _running_sum(side: int) -> Row:
    """One splat of a highlight, its differences summed in float32 and in double."""
    radius, profile = side / 8, Disc().profile()
    image, coc = _lit(side), slope(side, side, 0.9 * radius, radius).float()
    single = splat_spans(image, coc, profile).numpy().cumsum(-1, dtype=np.float32)
    double = splat_spans(image, coc, profile, integrate=True)
    want, far = dense_spans(image, coc, profile), _far(side, radius)
    errors = ((t.double() - want)[..., far].abs().max() for t in (torch.from_numpy(single), double))
    return _row("running sums in double", "far-field leak of 3e5", *errors)


def _convolution(side: int) -> Row:
    """One convolution with a disc, by FFT in float32 and in double."""
    disc = torch.from_numpy(capsule(side / 8, 0.0))[None].float()
    image, far = _lit(side), _far(side, side / 8)
    size = [2 * side, 2 * side]
    reach = disc.shape[2] // 2
    product = torch.fft.rfft2(image, s=size) * torch.fft.rfft2(disc, s=size)
    single = torch.fft.irfft2(product, s=size)[..., reach : reach + side, reach : reach + side]
    want = convolve(image.double(), disc.double())
    errors = ((t.double() - want)[..., far].abs().max() for t in (single, convolve(image, disc)))
    return _row("FFT of an even blur in double", "far-field leak of 3e5", *errors)


def _highlights(side: int) -> Iterator[Row]:
    """Highlights through sparse PSFs like all pixels, and drawn by themselves: the error within their PSF."""
    at, splatting = (side // 4, side // 3), KernelSplatting(quality="exact", bank=bank_of("combined"))
    way = torch.tensor([6.0, -3.0]).view(1, 2, 1, 1).expand(1, 2, side, side).contiguous()
    for size, radius, name, change in (
        (1, side / 20, "highlights in the direct domain", ("MOST", 0)),
        (5, side / 5, "a mean without highlights to find them by", ("CLIPPED", 0)),
    ):
        coc, image = even(side, side, radius).float(), torch.ones(1, 1, side, side)
        image[..., at[0] : at[0] + size, at[1] : at[1] + size] = 1e6 / 3
        pixels, still = torch.arange(image.numel()), torch.zeros(image.numel(), 2)
        source = torch.cat([image, torch.ones_like(image)], 1)
        dense = splat_capsules(source, pixels, coc.flatten(), way[0].flatten(1).T.contiguous(), still)
        want, errors = dense[:, :1] / dense[:, 1:], []
        for setting in (change[1], getattr(highlights, change[0])):
            with mock.patch.object(highlights, change[0], setting):
                plan = replace(splatting.plan(image, coc, motion=way), surrounded=0, lit=0.0)
                errors.append(float((splatting(image, coc, motion=way, plan=plan) - want).abs().max() / want.max()))
        yield _row(name, f"error of a bokeh of {size} x {size} pixels of 3e5, of its maximum", *errors)
    yield _region(side)


def _region(side: int) -> Row:
    """A bright region like all else, and apart, with nothing beyond the support of its PSFs."""
    image, coc = torch.ones(1, 3, side, side), even(side, side, 5.0).float()
    image[..., : side // 2, : side // 2] = 1000.0
    way = torch.tensor([5.0, -3.0]).view(1, 2, 1, 1).expand(1, 2, side, side).contiguous()
    splatting, leaks = KernelSplatting(quality="exact", bank=bank_of("combined")), []
    for contrast in (math.inf, highlights.CONTRAST):
        with mock.patch.object(highlights, "CONTRAST", contrast):
            lit, dark = splatting(image, coc, motion=way), splatting(torch.ones_like(image), coc, motion=way)
        leaks.append(float((lit - dark)[..., side // 2 + 12 :, :].abs().max()))
    return _row("bright regions apart", "far-field leak of a region of 1000", *leaks)


def _moments() -> Row:
    """A sparse Laplacian whose values are rounded to half precision, so that its moments do not vanish any more."""
    bank = bank_of("combined")
    chosen = (bank.domains == 2).nonzero()[-1]
    sparse = bank.sample(int(chosen)).sparse
    reach = int(np.abs(sparse.points).max())
    rounded = sparse._replace(values=sparse.values.astype(np.float16).astype(np.float64))
    leaks = []
    for s in (rounded, sparse):
        field = poisson_fft(torch.from_numpy(drawn(s, (2 * reach + 1,) * 2))[None], compact=False)[0, 0]
        leaks.append(float(field[0].abs().max() / field.abs().max()))
    return _row("moments of sparse PSFs that vanish", "relative, at twice the half side", *leaks)


def _integrals(side: int) -> Iterator[Row]:
    """Laplacians that do not sum to 0, on a torus and in free space; the pyramid beside the FFT."""
    point = torch.zeros(1, 1, side, side)
    point[..., side // 2, side // 2] = 1.0
    free = poisson_fft(point.double(), compact=False)
    errors = [float((FFTIntegrator(compact=c)(point).double() - free).abs().max()) for c in (True, False)]
    yield _row("free space, not a torus", "a Laplacian that sums to 1", *errors)
    with torch.no_grad():
        pyramid = float((PyramidIntegrator()(point).double() - free).abs().max())
    yield _row("FFT, not the pyramid", "a Laplacian that sums to 1", pyramid, errors[1])
    y, x = torch.arange(side)[:, None] - side / 2, torch.arange(side) - side / 2
    disc = (torch.hypot(y + 0 * x, x + 0 * y) < side / 4).float()[None, None]
    with torch.no_grad():
        both = [float((i(laplacian(disc)) - disc).abs().max()) for i in (PyramidIntegrator(), FFTIntegrator(True))]
    yield _row("FFT, not the pyramid", "a disc of 1", *both)


def _normalisation(side: int) -> Iterator[Row]:
    """The coverage under what was spread, for a constant under a blur that jumps; and radii beyond all measure."""
    coc = slope(side, side, 0.0, 30.0).float() * (torch.arange(side) % 2)
    image, profile = torch.ones(1, 1, side, side), Disc().profile()
    sums = splat_spans(image, coc, profile, integrate=True)
    splatting = KernelSplatting(quality="exact")
    found = [off(t, 1) for t in (sums, splatting(image, coc))]
    yield _row("division by coverage", "a constant, radii that jump", *found)
    holes = splat_spans(image, even(side, side, 1e8).float(), profile, integrate=True)
    kept = splatting(image, even(side, side, 1e8).float())
    lost = torch.where(holes < TINY, 0.0, holes / holes)
    yield _row(f"radii cut to {WIDEST:g} px", "a constant, radius 1e8", off(lost, 1), off(kept, 1))


def _reciprocals() -> Row:
    """The defocus equation as printed, and in reciprocal distances, for the sky: parts that are not finite."""
    depth, focus = torch.tensor([1.0, 1e20, math.inf]), 2.0
    printed, kept = (depth - focus) / depth / focus, 1 / focus - depth.reciprocal()
    strange = [(~t.isfinite()).sum() for t in (printed, kept)]
    return _row("reciprocal distances", "CoC that is not finite", *strange)


def _confined(side: int) -> Row:
    """Pixels of the buffer around a small picture whose ways are far longer than it is wide, in millions."""
    small, sizes = max(side // 4, 8), []
    way = torch.full((1, 2, small, small), 20.0 * small)
    image, coc = torch.ones(1, 3, small, small), even(small, small, 3.0).float()

    def integrated(buffer: Tensor, *, compact: bool) -> Tensor:
        sizes.append(1e-6 * buffer.shape[2] * buffer.shape[3])
        return poisson_fft(buffer, compact=compact)

    with mock.patch.object(samples, "poisson_fft", integrated):
        for extreme in (False, True):
            with mock.patch.object(Combined, "needs_clipping", lambda *_, found=extreme: found):
                KernelSplatting(quality="exact", bank=bank_of("combined"))(image, coc, motion=way)
    return _row("ways no longer than the picture asks for", f"Mpx of a buffer, {small} x {small} px", *sizes)


def test_every_mechanism_is_of_use() -> None:
    rows = list(mechanism_rows())
    assert len(rows) >= 10
    for found in rows:
        assert found["with"] < 0.1 * found["without"], found["mechanism"]


if __name__ == "__main__":
    for found in mechanism_rows():
        print("{mechanism}; {case}: {without:.2g} without, {with:.2g} with".format(**found))
