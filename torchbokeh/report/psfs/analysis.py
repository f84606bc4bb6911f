"""How well sparse PSFs do: the analysis of LKS section 7.3 and figure 10, repeated with ours.

A PSF here is a capsule of `torchbokeh.psfs.combined.Combined` unless something else is said. *Sparsity* is the number
of points, or of squares of a quad tree, over the pixels that the dense PSF covers.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import islice

import numpy as np
import torch
from numpy.typing import NDArray

from torchbokeh.psfs.combined import CELLS, Combined, capsule
from torchbokeh.psfs.model import FRAME, PsfModel, Symmetry, mean_picture
from torchbokeh.psfs.quadtree import quadtree
from torchbokeh.psfs.refit import Fit, Sparse, reconstruction, reflections
from torchbokeh.psfs.represent import Target, candidates, laplacian, represent
from torchbokeh.psfs.similarity import Score, centred, neighbourhood, score
from torchbokeh.psfs.sparsify import NOISE, ablation, sparsify, voronoi_sums
from torchbokeh.report.rows import Row, Say
from torchbokeh.report.settings import Sizes, sized

Array = NDArray[np.float64]

SPARSITY = 0.093
"""Mean sparsity of LKS's `Combined`."""

SHARES = (0.03, SPARSITY / 2, SPARSITY, 2 * SPARSITY)
"""Sparsities at which methods are compared."""

METHODS = ("ours", "Voronoi sums", "LKS", "quad tree")
"""Elimination and refit; LKS's values at the same points; LKS's four steps; constant squares."""

STEPS = {"darts": 1.0, "relaxation": 0.967, "annealing": 0.871, "both": 0.865}
"""What LKS says of the fields of `torchbokeh.psfs.sparsify.Ablation`."""

SEED = 0

THICK = 4
"""Radius in px from which on a PSF is not thin."""


@dataclass(frozen=True)
class PsfSettings(Sizes):
    """How large an analysis is.

    Attributes:
        psfs: random PSFs at which methods are compared.
        support: fewest and most pixels that these cover. Of fewer, a few per cent are hardly a point; more take
            LKS's annealing many seconds each.
        ablated: of these PSFs, how many the steps of LKS are taken apart on.
        sizes: radius or sigma in px of the discs, Gaussians and capsules, and length of these.
        shares: sparsities to try with each size.
        large: radii and lengths in px of the large PSFs.
        cells: of the grids that are compared.
        coordinates: of PSFs that each of these grids is asked for.
    """

    psfs: int = sized(32, 3)
    support: tuple[int, int] = sized((100, 25_000), (100, 300))
    ablated: int = sized(12, 1)
    sizes: tuple[tuple[float, float, float, float], ...] = sized(
        ((25, 25, 50, 50), (50, 40, 50, 128), (100, 55, 100, 128)), ((6, 3, 6, 10),)
    )
    shares: int = sized(13, 5)
    large: tuple[tuple[float, float], ...] = sized(
        ((25, 50), (25, 128), (50, 50), (50, 128), (50, 256), (100, 50), (100, 128), (100, 256)), ((12, 20),)
    )
    cells: tuple[int, ...] = sized((CELLS // 8, CELLS // 4, CELLS // 2, CELLS), (10, 20))
    coordinates: int = sized(200, 3)


@lru_cache(maxsize=1)
def random_psfs(count: int, support: tuple[int, int]) -> tuple[Array, ...]:
    """PSFs of `Combined` ``(1, h, w)`` at random coordinates, of those that cover neither fewer nor more pixels.

    Example:
        >>> [100 <= covers(psf) <= 200 for psf in random_psfs(2, (100, 200))]
        [True, True]
    """
    model = Combined()
    fitting = (psf for psf in map(model.dense, coordinates(model)) if support[0] <= covers(psf) <= support[1])
    return tuple(islice(fitting, count))


def covers(psf: Array) -> int:
    """How many pixels a PSF covers, but for what rounding left."""
    return int(np.count_nonzero(psf > NOISE * psf.max()))


def equal_sparsity(psfs: Sequence[Array], say: Say) -> list[Row]:
    """Each PSF by each of `METHODS` at each of `SHARES`: sparsity, and the fields of `Score`.

    ``radius`` is that of the disc, in whole px.
    """
    rows = []
    for number, psf in enumerate(psfs):
        covered = covers(psf)
        say(f"equal sparsity: PSF {number + 1} of {len(psfs)}, {covered} px")
        elimination = Elimination(psf, Combined.symmetry)
        for share in SHARES:
            count = round(share * covered)
            ours = elimination.within(count)
            summed = Sparse(ours.points, voronoi_sums(ours.points, laplacian(psf)))
            found = [(len(x.points), quality(psf, x)) for x in (ours, summed, sparsify(psf, count, SEED))]
            found.append((count, score(psf, centred(quadtree(psf, count), neighbourhood(psf)))))
            for method, (used, errors) in zip(METHODS, found, strict=True):
                where = {"radius": psf.shape[1] // 2, "share": share, "method": method}
                rows.append({**where, "sparsity": used / covered, **errors._asdict()})
    return rows


class Elimination:
    """Sets of points of every size for a PSF ``(C, h, w)``, from one run of `Fit.elimination`."""

    def __init__(self, psf: Array, symmetry: Symmetry) -> None:
        self.fit = Fit(psf, candidates(psf, symmetry), symmetry)
        self.order = self.fit.elimination()
        images = np.stack(reflections(self.fit.candidates[self.order[::-1]], symmetry), 1)
        self.points = np.cumsum([len(np.unique(orbit, axis=0)) for orbit in images])
        """How many points the last 1, 2, ... orbits have."""

    def within(self, count: int) -> Sparse:
        """The largest set of at most ``count`` points, but at least one orbit."""
        orbits = max(int(self.points.searchsorted(count, side="right")), 1)
        return self.fit.sparse(self.order[-orbits:])

    def least(self, psf: Array, name: str, wanted: float) -> int | None:
        """The fewest points with which a field of `Score` reaches a value; None if all do not."""
        low, high = 0, len(self.order)
        while high - low > 1:
            middle = (low + high) // 2
            enough = getattr(quality(psf, self.fit.sparse(self.order[-middle:])), name) >= wanted
            low, high = (low, middle) if enough else (middle, high)
        return None if high == len(self.order) else int(self.points[high - 1])


def quality(psf: Array, sparse: Sparse) -> Score:
    """How near a sparse Laplacian comes to a dense PSF."""
    return score(psf, reconstruction(sparse, neighbourhood(psf)))


def needed(psfs: Sequence[Array], say: Say) -> list[Row]:
    """The sparsity of each PSF as banks represent it, and that of a quad tree with the same L1 error."""
    rows = []
    say(f"sparsity that {len(psfs)} PSFs need")
    for psf in psfs:
        covered = covers(psf)
        domain, sparse = represent(psf, Combined.symmetry, turns=True, target=Target())
        l1 = quality(psf, sparse).l1 if domain == "laplacian" else 0.0
        rows.append({"domain": domain, "ours": len(sparse.points) / covered, "quad tree": leaves(psf, l1) / covered})
    return rows


def leaves(psf: Array, l1: float) -> int:
    """The fewest squares of a quad tree whose relative L1 error is no larger, to 1 %.

    Example:
        >>> leaves(np.array([[[4.0, 1.0, 1.0], [2.0, 9.0, 9.0], [2.0, 9.0, 9.0]]]), 0.0)
        4
    """
    low, high = 0, covers(psf)  # as many squares as pixels are exact
    while high - low > max(low // 100, 1):
        middle = (low + high) // 2
        near = np.abs(quadtree(psf, middle) - psf).sum() <= l1 * psf.sum()
        low, high = (low, middle) if near else (middle, high)
    return high


def gaussian(sigma: float) -> Array:
    """An isotropic Gaussian ``(1, h, w)``, cut at 4 sigma and at the frame, with a sum of 1. ``sigma`` is in px."""
    reach = min(int(4 * sigma), FRAME // 2)
    squared = np.arange(-reach, reach + 1) ** 2
    distance = squared[:, None] + squared
    picture = np.where(distance <= (4 * sigma) ** 2, np.exp(-distance / (2 * sigma**2)), 0.0)[None]
    return picture / picture.sum()


def sizes(settings: PsfSettings, say: Say) -> list[Row]:
    """Similarity against sparsity, for discs, Gaussians and capsules of several sizes."""
    rows = []
    for radius, sigma, wide, length in settings.sizes:
        kinds: list[tuple[str, str, Symmetry, Array]] = [
            ("Gaussian", f"sigma = {sigma:g} px", "octants", gaussian(sigma)),
            ("disc", f"r = {radius:g} px", "octants", capsule(radius, 0.0)),
            ("capsule", f"r = {wide:g} px, l = {length:g} px", "quadrants", capsule(wide, length)),
        ]
        for kind, name, symmetry, psf in kinds:
            say(f"sizes: {kind}, {name}")
            elimination, covered = Elimination(psf, symmetry), covers(psf)
            counts = (np.geomspace(1e-3, 0.3, settings.shares) * covered).astype(int)
            # Few points are of no use, and more than all candidates there are not.
            for count in counts[(counts >= 8) & (counts <= elimination.points[-1])]:
                sparse = elimination.within(int(count))
                found = quality(psf, sparse)._asdict()
                rows.append({"kind": kind, "name": name, "sparsity": len(sparse.points) / covered, **found})
    return rows


def steps(psfs: Sequence[Array], say: Say) -> list[Row]:
    """What each step of LKS is worth: L1 error relative to that of darts alone, here and as published."""
    say(f"ablation of the four steps on {len(psfs)} PSFs")
    found = ablation(psfs, SPARSITY, SEED)._asdict()
    return [{"step": name, "here": found[name], "LKS": published} for name, published in STEPS.items()]


def large(settings: PsfSettings, say: Say) -> list[Row]:
    """The sparsity at which large capsules reach a similarity of 0.99, near (``ssim``) and in the frame; None if
    no set of the candidates does. ``best`` is the similarity near of all of them.
    """
    rows = []
    for radius, length in settings.large:
        say(f"large PSFs: r = {radius:g} px, l = {length:g} px")
        psf = capsule(radius, length)
        elimination, covered = Elimination(psf, Combined.symmetry), covers(psf)
        row: Row = {"radius": radius, "length": length, "support": covered}
        for name in ("ssim", "ssim_frame"):
            count = elimination.least(psf, name, 0.99)
            row[name] = None if count is None else count / covered
        row["best"] = quality(psf, elimination.within(covered)).ssim
        rows.append(row)
    return rows


def coordinates(model: PsfModel) -> Iterator[tuple[float, ...]]:
    """Random coordinates without end, spread as the samples are: a box of the grid, and a place in it."""
    draw = np.random.default_rng(SEED)
    boxes = np.array(model.grid.boxes(), dtype=np.float64)
    while True:
        place = draw.uniform(*boxes[draw.integers(len(boxes))])
        yield tuple(model.grid.unmap(torch.from_numpy(place)).tolist())


def with_cells(cells: int) -> Combined:
    """`Combined` on a grid of another resolution."""
    model = Combined()
    model.axes = tuple(replace(axis, cells=cells) for axis in model.axes)
    return model


def sample_count(count: int, cells: Sequence[int], say: Say) -> list[Row]:
    """Mean similarity of the dense PSF at the same random coordinates with what grids have for it.

    That is the sample of its box, taken in the middle or pre-filtered, or linear interpolation between the middles.

    Args:
        count: coordinates, spread as the samples are.
        cells: of each grid along each axis.
        say: is told in a line what comes next.
    """
    rows = []
    draw = coordinates(Combined())
    places = [next(draw) for _ in range(count)]
    for fineness in cells:
        model = with_cells(fineness)
        say(f"sample count: {len(model.grid)} samples")
        found = np.array([grid_errors(model, place) for place in places]).mean(0)
        names = [f"{way}{what}" for way in ("middle", "prefiltered", "linear") for what in ("", "_frame")]
        rows.append({"cells": fineness, "samples": len(model.grid), **dict(zip(names, found.tolist(), strict=True))})
    return rows


def grid_errors(model: PsfModel, place: tuple[float, ...]) -> list[float]:
    """Similarity near and in the frame of three stand-ins for a PSF, see `sample_count`."""
    psf = model.dense(place)
    where = torch.tensor(place, dtype=torch.float64)
    centres = model.grid.centres()
    pairs = [(model.dense(centres[int(k)].tolist()), float(share)) for k, share in model.grid.neighbours(where)]
    number = int(model.grid.index(where))
    stand_ins = [
        model.dense(centres[number].tolist()),
        model.prefiltered(*model.grid.box(number)),
        mean_picture(*zip(*pairs, strict=True)),
    ]
    found = [score(psf, centred(picture, neighbourhood(psf))) for picture in stand_ins]
    return [value for each in found for value in (each.ssim, each.ssim_frame)]
