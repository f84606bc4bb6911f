"""The baselines by name: well-known ways to blur one layer, each at its best settings.

A baseline that needs a package which is not installed is left out; `absent` says which and why.
"""

import math
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from itertools import product

import numpy as np
import torch
from torch import Tensor

from torchbokeh.report.speed.discs import disc
from torchbokeh.report.speed.layered import BLOCK, direct_convolution, fft_convolution, layer_work, layered
from torchbokeh.report.speed.methods import Method

LAYERS = (8, 16, 32)
JOINS = {"layered FFT": ("over", "over, normalised", "sum, normalised"), "layered direct": ("over", "over, normalised")}

# Seconds of one thread per elementary step, on a processor of about 3 GHz with vectors of 512 bits.
_POINT, _ROW_POINT, _TEST, _FFT_STEP, _PRODUCT = 1.8e-9, 1.2e-9, 1.4e-9, 1.5e-10, 2.5e-10


def baselines() -> dict[str, Method]:
    """Every baseline that can run here, by name."""
    found = [*_scatters(), *_layered_methods(), *_fixed_kernels()]
    return {method.name: method for method in found}


def absent() -> list[str]:
    """A line for every baseline whose package is not installed."""
    if find_spec("numba") is None:
        return ["dense scatter and gather filter: numba is not installed (`pip install torchbokeh[cpu]`)"]
    return []


def _scatters() -> list[Method]:
    if find_spec("numba") is None:
        return []
    from torchbokeh.report.speed.scatter import dense_scatter, gather

    def area(coc: Tensor) -> float:
        return math.pi * (coc.double().square() + 1).sum().item()

    discs = "every pixel adds its disc, from a table of discs in steps of 1/4 px, compiled with numba"
    points, rows = partial(dense_scatter, by_rows=False), partial(dense_scatter, by_rows=True)
    about = (
        "every pixel collects from all pixels of a search window whose disc, with an edge 1 px wide, covers it; "
        "the window is that of the largest disc that reaches a tile of 16 px; compiled with numba"
    )
    family = "dense scatter"
    return [
        Method(family, family, f"{discs}, point by point", points, lambda coc: _POINT * area(coc)),
        Method(
            f"{family} by rows", family, f"{discs}, whole rows of a disc at once", rows, lambda c: _ROW_POINT * area(c)
        ),
        Method("gather", "gather", about, gather, _gather_work),
    ]


def _gather_work(coc: Tensor) -> float:
    from torchbokeh.report.speed.scatter import TILE, search_windows

    return _TEST * math.pi * TILE**2 * float(np.square(search_windows(coc), dtype=np.float64).sum())


def _layered_methods() -> list[Method]:
    kinds = {"layered FFT": (fft_convolution, _FFT_STEP), "layered direct": (direct_convolution, _PRODUCT)}
    bins, over = "each convolved with its disc", "put over one another"
    explained = {
        "over": f"hard bins of the signed CoC, {bins}, {over}",
        "over, normalised": f"hard bins of the signed CoC, {bins}, {over} and divided by alpha",
        "sum, normalised": f"hard bins of the radius, {bins}, added up and divided by coverage",
    }
    found = []
    for which, (family, (convolve, step)) in enumerate(kinds.items()):
        for count, join in product(LAYERS, JOINS[family]):
            run = partial(layered, layers=count, join=join, convolve=convolve)
            work = partial(_layer_seconds, count=count, which=which, step=step)
            name, about = f"{family} {count}, {join}", f"{count} {explained[join]}"
            found.append(Method(name, family, about, run, work, normalised=join != "over"))
    return found


def _layer_seconds(coc: Tensor, count: int, which: int, step: float) -> float:
    return step * layer_work(coc, count)[which]


def _fixed_kernels() -> list[Method]:
    """Baselines that know one radius for the whole picture."""
    from kornia.filters import fft_conv, filter2d

    def direct_work(coc: Tensor) -> float:
        side = 2 * coc.abs().max().item() + 1
        return (_PRODUCT if side <= BLOCK else 25 * _PRODUCT) * 4 * coc.numel() * side**2

    def fft_work(coc: Tensor) -> float:
        return _FFT_STEP * 9 * 2.5 * coc.numel() * math.log2(coc.numel())

    found = []
    for convolve, work in ((filter2d, direct_work), (fft_conv, fft_work)):
        name = convolve.__name__
        about = f"kornia.filters.{name} with one disc, zeros beyond the border, divided by coverage"
        run = partial(_one_kernel, convolve=convolve)
        found.append(Method(f"kornia {name}", "fixed kernel", about, run, work, one_depth=True))
    return found


def _one_kernel(image: Tensor, coc: Tensor, convolve: Callable[..., Tensor]) -> Tensor:
    """One disc for the whole picture, through a filter of kornia's; ``coc`` is the same everywhere."""
    kernel = torch.from_numpy(disc(coc.flatten()[0].abs().item())).to(image)[None]
    blurred = convolve(torch.cat([image, torch.ones_like(coc)], 1), kernel, border_type="constant")
    return blurred[:, :3] / blurred[:, 3:]
