"""How good a bank is: LKS table 1, and the distributions of figure 10."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch

from torchbokeh.psfs.arrays import Array
from torchbokeh.psfs.bank import PsfBank
from torchbokeh.psfs.refit import Sparse, drawn, reconstruction
from torchbokeh.psfs.represent import Represented
from torchbokeh.psfs.similarity import centred, neighbourhood, score

LKS = {
    "simple-lens": (100, "2.0", 1.1, 31.3),
    "combined": (400, "2.0, 1.0", 4.2, 9.3),
    "physical-lens": (4000, "2.5, 1.2", 30.8, 2.2),
    "volume": (200, "1.0", 5.3, 18.4),
    "stylized": (200, "1.5", 9.0, 24.9),
}
"""Table 1 of LKS: samples, beta, megabytes and mean sparsity in per cent."""


class HeldOut(NamedTuple):
    """A PSF that is no sample, and how near the bank comes to it.

    Attributes:
        coordinates: ``(n,)``.
        ssim: of the sample whose box holds it, see `torchbokeh.psfs.similarity.Score`.
        ssim_frame: likewise, in the frame of LKS.
    """

    coordinates: tuple[float, ...]
    ssim: float
    ssim_frame: float


def integrated(represented: Represented, size: tuple[int, int]) -> Array:
    """The picture ``(C, h, w)`` of a sample, centred, in a given odd size."""
    domain, sparse = represented
    if domain == "laplacian":
        return reconstruction(sparse, size)
    reach = int(np.abs(sparse.points).max(initial=0)) + 1
    out = drawn(sparse, (reach, reach))
    return centred(out.cumsum(2) if domain == "scanline" else out, size)


def resized(represented: Represented, factor: float) -> Represented:
    """A sample drawn larger by a factor, as `torchbokeh.ops.points.splat_points` draws it: shared by four pixels."""
    if factor == 1:
        return represented
    domain, sparse = represented
    place = sparse.points * factor
    corner = np.floor(place).astype(np.int64)
    x, y = (place - corner).T[..., None]
    values = sparse.values / (factor**2 if domain == "laplacian" else 1.0)
    shares = [(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y]
    corners = [corner + step for step in np.array([[0, 0], [1, 0], [0, 1], [1, 1]])]
    return Represented(domain, Sparse(np.concatenate(corners), np.concatenate([values * share for share in shares])))


def held_out(bank: PsfBank, count: int, seed: int = 0) -> Iterator[HeldOut]:
    """Compare PSFs at random coordinates with the samples that stand for them.

    Coordinates are spread as the samples are: a box of the grid at random, and a place in it.
    """
    draw = np.random.default_rng(seed)
    boxes = np.array(bank.model.grid.boxes(), dtype=np.float64)
    for number in draw.integers(len(boxes), size=count):
        low, high = boxes[number]
        place = torch.from_numpy(draw.uniform(low, high))
        coordinates = tuple(bank.model.grid.unmap(place).tolist())
        psf = bank.model.dense(coordinates)
        extent = bank.model.extent(bank.model.grid.unmap(place))
        factor = 1.0 if extent is None else float(extent / bank.extents[number])
        found = score(psf, integrated(resized(bank.sample(int(number)), factor), neighbourhood(psf)))
        yield HeldOut(coordinates, found.ssim, found.ssim_frame)


def sparsity(bank: PsfBank) -> Array:
    """Points of each sample over the pixels that its dense PSF covers, ``(K,)``."""
    return bank.counts.diff().numpy() / np.array(bank.info["support"])
