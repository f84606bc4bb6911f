"""What samples are worth: how near the next one is, how far it is seen, and how well it turns."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchbokeh.ops.integrate import lattice_green, poisson_fft
from torchbokeh.ops.points import splat_points
from torchbokeh.ops.spans import MIN_RADIUS
from torchbokeh.psfs.bank import PsfBank, installed
from torchbokeh.psfs.combined import Combined
from torchbokeh.psfs.model import PsfModel, mean_picture
from torchbokeh.psfs.refit import Sparse, reconstruction
from torchbokeh.psfs.represent import DOMAINS
from torchbokeh.psfs.similarity import NEAR, centred, neighbourhood, score
from torchbokeh.report.rows import Row, Say

Array = NDArray[np.float64]

FACTORS = (1.0, 1.5, 2.0, 4.0)
"""Distances of the far field, in half sides of the neighbourhood: the PSF and `NEAR` px around it."""

FINE = 3
"""Pixels of a picture that is turned to one of the result."""

SEED = 0


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


def far_field(count: int, say: Say) -> list[Row]:
    """What is seen far away of a spread of the Laplacian samples of every installed bank.

    Args:
        count: most samples of a bank.
        say: is told in a line what comes next.

    Returns:
        For each bank and factor, mean and largest of `beyond`.
    """
    rows = []
    for name in installed():
        bank = PsfBank.load(name)
        samples = laplacian_samples(bank)
        chosen = samples[np.unique(np.linspace(0, len(samples) - 1, min(count, len(samples))).astype(int))]
        say(f"far field: {len(chosen)} samples of {name}")
        found = [beyond(bank.sample(int(k)).sparse) for k in chosen]
        for factor, values in zip(FACTORS, zip(*found, strict=True), strict=True):
            rows.append({"bank": name, "factor": factor, "mean": float(np.mean(values)), "largest": max(values)})
    return rows


def laplacian_samples(bank: PsfBank) -> NDArray[np.int64]:
    """Numbers of the samples that are Laplacians."""
    return np.flatnonzero(bank.domains.numpy() == DOMAINS.index("laplacian"))


def beyond(sparse: Sparse) -> list[float]:
    """The largest magnitude outside of boxes of `FACTORS`, over the largest within the PSF.

    Where there are no points, what they integrate to is harmonic, and vanishes at infinity: outside of a box it is
    largest on the box's rim.

    Example:
        >>> dipole = Sparse(np.array([[-1, 0], [1, 0]]), np.array([[1.0], [-1.0]]))
        >>> [round(share, 3) for share in beyond(dipole)]
        [0.098, 0.063, 0.049, 0.024]
    """
    half = np.abs(sparse.points).max(0)
    top = np.abs(reconstruction(sparse, (2 * int(half[1]) + 1, 2 * int(half[0]) + 1))).max()
    found = []
    for factor in FACTORS:
        x, y = np.round(factor * (half + NEAR)).astype(int)
        rim = np.array(
            [(i, j) for i in range(-x, x + 1) for j in (-y, y)] + [(i, j) for i in (-x, x) for j in range(1 - y, y)]
        )
        found.append(float(np.abs(values_at(sparse, rim)).max() / top))
    return found


def values_at(sparse: Sparse, places: NDArray[np.int64]) -> Array:
    """What a sparse Laplacian integrates to at places ``(m, 2)``, (x, y) in px from its centre: ``(m, C)``."""
    far_x, far_y = np.abs(places).max(0) + np.abs(sparse.points).max(0)
    green = lattice_green(int(far_y) + 1, int(far_x) + 1).numpy()
    out = np.zeros((len(places), sparse.values.shape[1]))
    for point, value in zip(sparse.points, sparse.values, strict=True):
        x, y = np.abs(places - point).T
        out += green[y, x][:, None] * value
    return out


class Sample(NamedTuple):
    """A sample of the bank of `Combined`.

    Attributes:
        number: in the bank.
        radius: in the middle of its box, in px.
        length: likewise.
        fine: the dense PSF it stands for, ``(h, w)``, with `FINE` pixels to one.
    """

    number: int
    radius: float
    length: float
    fine: Array


@lru_cache(maxsize=1)
def random_samples(count: int, reach: int) -> tuple[Sample, ...]:
    """Laplacian samples of the bank of `Combined`, drawn at random, that reach no farther than so many px."""
    bank = PsfBank.load("combined")
    samples = laplacian_samples(bank)
    samples = samples[bank.reach().numpy()[samples] <= reach]
    draw = np.random.default_rng(SEED)
    return tuple(sample_of(bank.model, int(k)) for k in draw.choice(samples, count, replace=False))


def rotation(count: int, angles: int, reach: int, say: Say) -> list[Row]:
    """Turn samples of the bank of `Combined` as a renderer does, and compare them with turned dense PSFs.

    Args:
        count: samples, drawn at random.
        angles: how many angles from 0 to 45 degrees; symmetry does the others.
        reach: of the largest sample, in px.
        say: is told in a line what comes next.

    Returns:
        For each sample and angle, the relative L1 error.
    """
    bank = PsfBank.load("combined")
    rows: list[Row] = []
    for sample in sorted(random_samples(count, reach), key=lambda sample: sample.radius):
        where = {"radius": sample.radius, "length": sample.length}
        say(f"rotation: a sample of r = {sample.radius:.1f} px, l = {sample.length:.1f} px")
        for angle in np.linspace(0, math.pi / 4, angles).tolist():
            error = relative(*both(bank, sample, angle, half_of(reach)))
            rows.append({**where, "degrees": math.degrees(angle), "l1": error})
    return rows


def sample_of(model: PsfModel, number: int) -> Sample:
    """A sample of `Combined`, and what it stands for, pre-filtered as it is, but `FINE` times as large."""
    low, high = model.grid.box(number)
    place = model.grid.centres()[number].tolist()
    corners = [(FINE * (r + MIN_RADIUS) - MIN_RADIUS, FINE * length) for r, length in (low, high)]
    return Sample(number, place[0] + MIN_RADIUS, place[1], Combined().prefiltered(*corners)[0])


def half_of(reach: int) -> int:
    """Half the side of a picture in which a sample is splatted: with room to turn, and to fade."""
    return math.ceil(1.5 * reach)


def turned(fine: Array, angle: float, half: int) -> Array:
    """A fine picture, turned and brought down to pixels: ``(2 half + 1, 2 half + 1)``.

    It turns as `splat_points` does, from x to y. ``angle`` is in radians.
    """
    from scipy.ndimage import map_coordinates

    side = 2 * half + 1
    steps = np.arange(FINE * side) - FINE * side // 2
    x, y = steps, steps[:, None]
    cos, sin = math.cos(angle), math.sin(angle)
    there = [cos * y - sin * x + fine.shape[0] // 2, cos * x + sin * y + fine.shape[1] // 2]
    return map_coordinates(fine, there, order=3).reshape(side, FINE, side, FINE).sum((1, 3))


def both(bank: PsfBank, sample: Sample, angle: float, half: int) -> tuple[Array, Array]:
    """A turned sample as it is splatted alone, and dense: ``(2 half + 1, 2 half + 1)`` each."""
    one = torch.ones(1, 1, 1, 1, dtype=torch.float64)
    splatted = integrated(bank, one, torch.full((1, 1, 1, 1), sample.number), matrices(torch.tensor([[angle]])), half)
    return splatted[0], turned(sample.fine, angle, half)


def integrated(bank: PsfBank, values: Tensor, index: Tensor, turns: Tensor, pad: int) -> Array:
    """Splat and integrate, ``(C, h + 2 pad, w + 2 pad)``."""
    table = bank.table("laplacian")
    return poisson_fft(splat_points(values, index, table, pad=pad, rotation=turns), compact=True)[0].numpy()


def matrices(angle: Tensor) -> Tensor:
    """Rotations ``(1, 2, 2, h, w)`` by angles ``(h, w)`` in radians."""
    cos, sin = angle.cos(), angle.sin()
    return torch.stack([torch.stack([cos, -sin]), torch.stack([sin, cos])])[None].double()


def relative(splatted: Array, dense: Array) -> float:
    """Relative L1 error."""
    return float(np.abs(splatted - dense).sum() / dense.sum())


def many(bank: PsfBank, chosen: Sequence[Sample], splats: int, reach: int) -> Row:
    """The sum of splats at random places, of random colours and rotations, in a square of twice the reach.

    Returns:
        ``one``: the mean relative L1 error of a splat alone; ``all``: that of the sum; ``expected``: what it would be
        if the errors of the splats that meet in a pixel were independent of each other and of mean 0. Their sum is
        then normal, with a mean magnitude of ``sqrt(2 / pi)`` of its standard deviation.
    """
    draw = np.random.default_rng(SEED)
    side, half = 2 * reach, half_of(reach)
    places = draw.choice(side * side, splats, replace=False)
    values, angles = torch.zeros(1, 3, side, side, dtype=torch.float64), torch.zeros(side, side)
    index = torch.zeros(1, 1, side, side, dtype=torch.int64)
    dense = np.zeros((3, side + 2 * half, side + 2 * half))
    squares, errors = np.zeros_like(dense), []
    for place in places:
        y, x = divmod(int(place), side)
        sample, angle = chosen[int(draw.integers(len(chosen)))], draw.uniform(0, math.pi)
        colour = draw.random(3)
        values[0, :, y, x], index[0, 0, y, x], angles[y, x] = torch.from_numpy(colour), sample.number, angle
        splatted, truth = both(bank, sample, angle, half)
        errors.append(relative(splatted, truth))
        window = np.s_[:, y : y + 2 * half + 1, x : x + 2 * half + 1]
        dense[window] += colour[:, None, None] * truth
        squares[window] += (colour[:, None, None] * (splatted - truth)) ** 2
    found = integrated(bank, values, index, matrices(angles), half)
    expected = math.sqrt(2 / math.pi) * float(np.sqrt(squares).sum() / dense.sum())
    return {"splats": splats, "one": float(np.mean(errors)), "all": relative(found, dense), "expected": expected}
