"""What samples of banks leave far away, and how well they turn: against closed forms and turned dense PSFs.

``python -P tests/psfs/test_bank_samples.py`` prints what the guide says of them.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchbokeh.ops.integrate import lattice_green, poisson_fft
from torchbokeh.ops.points import splat_points
from torchbokeh.ops.spans import MIN_RADIUS
from torchbokeh.psfs.bank import PsfBank, installed
from torchbokeh.psfs.combined import Combined, capsule
from torchbokeh.psfs.model import PsfModel
from torchbokeh.psfs.refit import Fit, Sparse, reconstruction
from torchbokeh.psfs.represent import DOMAINS, candidates
from torchbokeh.psfs.similarity import NEAR, centred

Array = NDArray[np.float64]

FACTORS = (1.0, 1.5, 2.0, 4.0)
"""Distances of the far field, in half sides of the neighbourhood: the PSF and `NEAR` px around it."""

FINE = 3
"""Pixels of a picture that is turned to one of the result."""

SEED = 0


def far_field(count: int) -> dict[tuple[str, float], tuple[float, float]]:
    """Mean and largest of `beyond` over up to so many Laplacian samples, for every installed bank and factor."""
    found = {}
    for name in installed():
        bank = PsfBank.load(name)
        samples = laplacian_samples(bank)
        chosen = samples[np.unique(np.linspace(0, len(samples) - 1, min(count, len(samples))).astype(int))]
        seen = zip(*(beyond(bank.sample(int(k)).sparse) for k in chosen), strict=True)
        for factor, values in zip(FACTORS, seen, strict=True):
            found[name, factor] = float(np.mean(values)), max(values)
    return found


def laplacian_samples(bank: PsfBank) -> NDArray[np.int64]:
    """Numbers of the samples that are Laplacians."""
    return np.flatnonzero(bank.domains.numpy() == DOMAINS.index("laplacian"))


def beyond(sparse: Sparse) -> list[float]:
    """The largest magnitude outside of boxes of `FACTORS`, over the largest within the PSF.

    Where there are no points, what they integrate to is harmonic, and vanishes at infinity: outside of a box it is
    largest on the box's rim.
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


def random_samples(count: int, reach: int) -> tuple[Sample, ...]:
    """Laplacian samples of the bank of `Combined`, drawn at random, that reach no farther than so many px."""
    bank = PsfBank.load("combined")
    samples = laplacian_samples(bank)
    samples = samples[bank.reach().numpy()[samples] <= reach]
    draw = np.random.default_rng(SEED)
    return tuple(sample_of(bank.model, int(k)) for k in draw.choice(samples, count, replace=False))


def rotation(chosen: Sequence[Sample], angles: int, reach: int) -> dict[float, list[float]]:
    """Relative L1 errors of samples, turned as a renderer does it, by angles from 0 to 45 degrees."""
    bank = PsfBank.load("combined")
    turns = np.linspace(0, math.pi / 4, angles).tolist()
    return {
        math.degrees(angle): [relative(*both(bank, sample, angle, half_of(reach))) for sample in chosen]
        for angle in turns
    }


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


def many(bank: PsfBank, chosen: Sequence[Sample], splats: int, reach: int) -> dict[str, float]:
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
    return {"one": float(np.mean(errors)), "all": relative(found, dense), "expected": expected}


PSF = capsule(6.0, 9.0)


@pytest.fixture(scope="module")
def sparse() -> Sparse:
    """A PSF of few points."""
    fit = Fit(PSF, candidates(PSF, "quadrants"), "quadrants")
    return fit.sparse(fit.elimination()[-15:])


@pytest.fixture(scope="module")
def bank() -> PsfBank:
    return PsfBank.load("combined")


@pytest.fixture(scope="module")
def thick(bank: PsfBank) -> Sample:
    """A sample that is neither thin nor round."""
    return sample_of(bank.model, int(bank.model.grid.index(torch.tensor([4.0, 15.0]))))


def test_a_dipole_falls_off() -> None:
    dipole = Sparse(np.array([[-1, 0], [1, 0]]), np.array([[1.0], [-1.0]]))
    assert [round(share, 3) for share in beyond(dipole)] == [0.098, 0.063, 0.049, 0.024]


def test_no_sample_of_a_bank_is_seen_from_twice_its_half_side() -> None:
    for (_, factor), (mean, largest) in far_field(8).items():
        if factor >= 2:
            assert mean < 4e-5
            assert largest < 1.5e-4


def test_turned_samples_are_near_turned_psfs() -> None:
    chosen = random_samples(4, 16)
    errors = rotation(chosen, 3, 16)
    assert np.mean(errors[0.0]) < 0.05
    assert all(np.mean(found) < 0.16 for found in errors.values())
    assert many(PsfBank.load("combined"), chosen, 10, 16)["all"] < 0.1


def test_values_at_places_are_those_of_the_picture(sparse: Sparse) -> None:
    picture = reconstruction(sparse, (41, 61))[0]
    y, x = np.mgrid[-20:21, -30:31]
    values = values_at(sparse, np.stack([x.ravel(), y.ravel()], 1))[:, 0]
    assert np.allclose(values.reshape(41, 61), picture, atol=1e-9)


def test_nothing_beyond_a_box_is_larger_than_on_its_rim(sparse: Sparse) -> None:
    y, x = np.abs(sparse.points).max(0)[::-1] + 8  # NEAR px, the nearest that is far
    picture = np.abs(reconstruction(sparse, (161, 161))[0])
    inner = np.s_[80 - y + 1 : 80 + y, 80 - x + 1 : 80 + x]
    top = picture[inner].max()
    picture[inner] = 0.0
    assert beyond(sparse)[0] == pytest.approx(picture.max() / top, rel=1e-6)


def test_the_far_field_falls_off(sparse: Sparse) -> None:
    found = beyond(sparse)
    assert found == sorted(found, reverse=True)


def test_a_picture_three_times_as_fine_is_brought_down_to_pixels() -> None:
    fine = capsule(18.0, 27.0)[0]
    assert np.allclose(turned(fine, 0.0, 15), centred(PSF, (31, 31))[0], atol=1e-8)


def test_a_quarter_turn_only_moves_pixels() -> None:
    fine = capsule(18.0, 27.0)[0] * np.linspace(0, 1, 63)
    assert np.allclose(turned(fine, math.pi / 2, 15), np.rot90(turned(fine, 0.0, 15), -1), atol=1e-9)


def test_a_turned_picture_keeps_its_light(thick: Sample) -> None:
    assert turned(thick.fine, 0.5, 30).sum() == pytest.approx(1.0, abs=2e-3)


def test_a_sample_turns_the_way_its_dense_psf_does(bank: PsfBank, thick: Sample) -> None:
    splatted, dense = both(bank, thick, 0.5, 30)
    assert relative(splatted, dense) < 0.08
    assert relative(splatted, turned(thick.fine, -0.5, 30)) > 0.3


def test_the_sum_of_one_splat_is_that_splat(bank: PsfBank, thick: Sample) -> None:
    total = many(bank, [thick], 1, 16)
    assert total["all"] == pytest.approx(total["one"], rel=0.05)  # more of what is far away is seen
    assert total["expected"] == pytest.approx(math.sqrt(2 / math.pi) * total["one"], rel=1e-6)


def test_laplacian_samples_are_all_of_them(bank: PsfBank) -> None:
    chosen = laplacian_samples(bank)
    assert all(bank.sample(int(k)).domain == "laplacian" for k in chosen[:: len(chosen) // 20])
    assert len(chosen) == sum(bank.sample(k).domain == "laplacian" for k in range(len(bank)))


if __name__ == "__main__":
    for (name, factor), (mean, largest) in far_field(60).items():
        print(f"{name}, beyond {factor:g} half sides: mean {mean:.1e}, largest {largest:.1e}")
    drawn = random_samples(16, 40)
    for degrees, found in rotation(drawn, 7, 40).items():
        print(f"turned by {degrees:g} degrees: mean error {np.mean(found):.3f}, largest {max(found):.3f}")
    print("the sum of 200 splats:", many(PsfBank.load("combined"), drawn, 200, 40))
