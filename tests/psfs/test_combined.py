"""The capsule against brute force and its limits; the places of `Combined` and `SimpleLens`."""

import doctest
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import torchbokeh.psfs.combined
import torchbokeh.psfs.simple_lens
from torchbokeh.psfs.combined import SHARING, Combined, capsule, turned_capsule
from torchbokeh.psfs.model import FRAME, Labels
from torchbokeh.psfs.similarity import centred
from torchbokeh.psfs.simple_lens import SimpleLens

F64 = torch.float64


def brute_force(radius: float, length: float, points: int = 2_000_000) -> np.ndarray:
    """Points of the disc and of the segment, by a low-discrepancy sequence, counted by pixel."""
    n = np.arange(points) + 0.5
    a, b, c = (np.mod(n * x, 1.0) for x in (0.8191725134, 0.6710436067, 0.5497004779))
    r, angle = radius * np.sqrt(a), 2 * math.pi * b
    x, y = r * np.cos(angle) + (c - 0.5) * length, r * np.sin(angle)
    height, width = math.ceil(radius - 0.5), math.ceil(radius + length / 2 - 0.5)
    edges = [np.arange(-m - 0.5, m + 1) for m in (height, width)]
    return np.histogram2d(y, x, bins=edges)[0][None] / points


@pytest.mark.parametrize(("radius", "length"), [(4.3, 11.0), (7.0, 0.0), (2.2, 30.5), (0.8, 5.0), (12.5, 3.0)])
def test_a_capsule_is_what_points_of_light_leave(radius: float, length: float) -> None:
    got, want = capsule(radius, length), brute_force(radius, length)
    assert got.shape == want.shape
    assert np.abs(got - want).sum() < 0.01


@given(st.floats(0, 90), st.floats(0, 200))
@settings(max_examples=40, deadline=None)
def test_a_capsule_is_symmetric_and_loses_nothing(radius: float, length: float) -> None:
    psf = capsule(radius, length)
    assert psf.min() >= 0
    assert psf.sum() == pytest.approx(1)
    assert max(psf.shape) <= FRAME
    np.testing.assert_allclose(psf, psf[:, ::-1], rtol=1e-7, atol=1e-12)
    np.testing.assert_allclose(psf, psf[:, :, ::-1], rtol=1e-7, atol=1e-12)
    x = np.arange(psf.shape[2]) - psf.shape[2] // 2
    spread = (psf.sum((0, 1)) * x**2).sum()
    assert spread == pytest.approx(radius**2 / 4 + length**2 / 12, rel=0.002, abs=0.3)  # of a disc and a segment


def test_without_length_it_is_a_disc_and_without_radius_a_line() -> None:
    disc = capsule(9.0, 0.0)
    assert disc[0, 9, 9] == pytest.approx(1 / (math.pi * 81), rel=1e-4)
    np.testing.assert_allclose(disc, disc.transpose(0, 2, 1), atol=2e-6)
    np.testing.assert_allclose(capsule(9.0, 1e-5), disc, atol=1e-7)
    line = capsule(0.0, 10.0)
    assert line.shape == (1, 1, 11)
    np.testing.assert_allclose(line[0, 0], [0.05, *[0.1] * 9, 0.05], atol=1e-3)
    assert capsule(0.0, 0.0).shape == (1, 1, 1)


def labels(radius: float, dx: float, dy: float) -> Labels:
    motion = torch.tensor([dx, dy], dtype=F64).view(1, 2, 1, 1)
    return Labels(coc=torch.full((1, 1, 1, 1), radius, dtype=F64), motion=motion)


def test_the_place_of_a_pixel() -> None:
    place = Combined().place(labels(-8.0, 3.0, 4.0))
    assert place.coordinates.flatten().tolist() == pytest.approx([math.sqrt(64 - SHARING) - 0.5, 5.0])
    torch.testing.assert_close(place.frame[0, :, :, 0, 0], torch.tensor([[0.6, -0.8], [0.8, 0.6]], dtype=F64))
    assert place.scale is None
    still = Combined().place(labels(2.0, 0.0, 0.0))
    torch.testing.assert_close(still.frame[0, :, :, 0, 0], torch.eye(2, dtype=F64))


def test_a_disc_beyond_the_bound_is_a_larger_one_of_it() -> None:
    (place,) = Combined(radius=50.0, length=64.0).places(labels(200.0, 80.0, 0.0))
    assert place.coordinates.flatten().tolist() == pytest.approx([49.5, 20.0], rel=1e-4)
    assert place.scale is not None
    assert place.scale.item() == pytest.approx(4, rel=1e-4)
    torch.testing.assert_close(place.frame[0, :, :, 0, 0], 4 * torch.eye(2, dtype=F64), rtol=1e-4, atol=0)
    (disc,) = SimpleLens(radius=50.0).places(Labels(coc=torch.full((1, 1, 1, 1), 75.0)))
    assert disc.scale is not None
    assert disc.scale.item() == 1.5


def test_a_long_motion_is_a_row_of_segments() -> None:
    places = Combined(length=100.0).places(labels(3.0, 0.0, -250.0))
    assert len(places) == 3
    assert [p.offset[0, 1].item() for p in places] == pytest.approx([250 / 3, 0, -250 / 3])
    assert [p.share.item() for p in places] == pytest.approx([1 / 3] * 3)
    assert places[0].coordinates.flatten().tolist() == pytest.approx([2.5, 250 / 3])
    both = Labels(
        coc=torch.full((1, 1, 1, 2), 3.0),
        motion=torch.tensor([[[[0.0, 60.0]], [[-250.0, 0.0]]]]),
    )
    assert [p.share[..., 1].item() for p in Combined(length=100.0).places(both)] == [1, 0, 0]


def test_in_blocks_lengths_are_shorter() -> None:
    (place,) = Combined().places(labels(20.0, 0.0, 12.0), 4)
    assert place.coordinates.flatten().tolist() == pytest.approx([4.5, 3.0])


def test_places_are_differentiable() -> None:
    coc = torch.tensor([[[[3.0, 5.0]]]], dtype=F64, requires_grad=True)
    motion = torch.tensor([[[[2.0, 0.0]], [[1.0, 0.0]]]], dtype=F64, requires_grad=True)
    place = Combined().place(Labels(coc=coc, motion=motion))
    (place.coordinates.sum() + place.frame.sum()).backward()
    assert coc.grad.isfinite().all()
    assert motion.grad.isfinite().all()
    assert motion.grad[..., 0].abs().max() > 0


def test_what_does_not_move_is_a_disc() -> None:
    model = Combined()
    assert [model.still(labels(3.0, x, 0.0)).item() for x in (0.0, 0.4, 1.0, 2.0)] == pytest.approx([1, 1, 0.5, 0])
    assert model.still(Labels(coc=torch.zeros(1, 1, 1, 1))) is None
    assert SimpleLens().still(labels(3.0, 0.0, 0.0)) is None


def test_the_area_is_that_of_the_mean_capsule() -> None:
    both = [labels(3.0, 8.0, 0.0), labels(-5.0, 0.0, 4.0)]
    assert Combined().area(both, torch.zeros(0)).item() == pytest.approx(4 * (4 * math.pi + 2 * 12) / 2)
    still = Labels(coc=torch.zeros(1, 1, 1, 1))
    assert Combined().area([still], torch.zeros(0)).item() == pytest.approx(math.pi / 4)


def test_only_what_is_longer_than_the_diagonal_is_clipped() -> None:
    model, size = Combined(), (3, 4)
    for found in (labels(4.9, 0.0, 0.0), labels(0.0, 3.0, -3.9), labels(1.0, 4.9, 0.0)):
        assert not model.needs_clipping([found], size)
        assert model.needs_clipping([found, labels(-5.1, 0.0, 0.0)], size)
    assert model.needs_clipping([labels(1.0, 0.0, 0.0)._replace(offset=torch.full((1, 2, 1, 1), 4.0))], size)
    values = torch.ones(1, 1, 1, 1)
    near, kept = model.clipped(values, labels(2.0, 1.0, 0.0), 1)
    assert torch.equal(near, values)
    assert all(torch.equal(a, b) for a, b in zip(kept[:3:2], labels(2.0, 1.0, 0.0)[:3:2], strict=True))
    far, passing = model.clipped(values, labels(2.0, 1000.0, 0.0), 1)
    assert float(passing.motion.norm()) == pytest.approx(1000 * float(far), rel=1e-5)
    assert float(far) < 0.02
    wide, disc = model.clipped(values, labels(1000.0, 5.0, 0.0), 1)
    assert not disc.motion.any()
    assert float(wide) == pytest.approx((float(disc.coc) / 1000) ** 2)


def test_missing_maps_are_named() -> None:
    with pytest.raises(ValueError, match="combined: expected coc and motion, got no motion"):
        Combined().place(Labels(coc=torch.zeros(1, 1, 1, 1)))
    with pytest.raises(ValueError, match="simple-lens: expected coc, got none"):
        SimpleLens().place(Labels())


def test_the_extent_is_that_of_the_light() -> None:
    model = Combined()
    for radius, length in ((12.0, 0.0), (5.0, 60.0), (20.0, 20.0)):
        psf = model.dense((radius - 0.5, length))[0]
        x = np.arange(psf.shape[1]) - psf.shape[1] // 2
        extent = model.extent(torch.tensor([radius - 0.5, length], dtype=F64)).item()
        assert extent == pytest.approx(4 * math.sqrt((psf.sum(0) * x**2).sum()), rel=0.01)


def test_prefiltering_is_a_mean_over_shapes_of_one_size() -> None:
    model = Combined()
    low, high = (9.5, 20.0), (14.5, 30.0)
    middle = model.grid.unmap(model.grid.remap(torch.tensor([low, high], dtype=F64)).mean(0))
    blurred, sharp = model.prefiltered(low, high), model.dense(middle.tolist())
    assert blurred.sum() == pytest.approx(1)
    for psf in (blurred, sharp):
        x = np.arange(psf.shape[2]) - psf.shape[2] // 2
        assert 4 * math.sqrt((psf.sum((0, 1)) * x**2).sum()) == pytest.approx(model.extent(middle).item(), rel=0.01)
    size = tuple(max(a, b) for a, b in zip(blurred.shape[1:], sharp.shape[1:], strict=True))
    assert 0.005 < np.abs(centred(blurred, size) - centred(sharp, size)).sum() < 0.15
    same = model.prefiltered((9.5, 20.0), (9.5, 20.0))
    np.testing.assert_allclose(same, model.dense((9.5, 20.0)), atol=1e-15)


def test_examples() -> None:
    for module in (torchbokeh.psfs.combined, torchbokeh.psfs.simple_lens):
        assert doctest.testmod(module).failed == 0


@pytest.mark.parametrize(("radius", "length"), [(6.0, 20.0), (0.5, 15.0), (2.0, 7.0), (30.0, 40.0)])
def test_a_turned_capsule_is_a_capsule(radius: float, length: float) -> None:
    straight = capsule(radius, length)[0]
    for motion, want in (((length, 0.0), straight), ((0.0, -length), straight.T)):
        got = turned_capsule(radius, motion)
        assert got.sum() == pytest.approx(1)
        assert np.abs(centred(got[None], want.shape)[0] - want).sum() < 0.02
    oblique = turned_capsule(radius, (0.6 * length, -0.8 * length))
    y, x = np.indices(oblique.shape) - np.array(oblique.shape)[:, None, None] // 2
    assert (oblique * (0.6 * x - 0.8 * y) ** 2).sum() == pytest.approx(
        radius**2 / 4 + length**2 / 12, rel=0.01, abs=0.1
    )
    assert abs((oblique * x).sum()) + abs((oblique * y).sum()) < 1e-9
    ahead = turned_capsule(radius, (0.6 * length, -0.8 * length), 0.5)
    y, x = np.indices(ahead.shape) - np.array(ahead.shape)[:, None, None] // 2
    assert [(ahead * x).sum(), (ahead * y).sum()] == pytest.approx([0.3 * length, -0.4 * length], abs=0.05)
    assert turned_capsule(0.0, (0.0, 0.0)).max() == pytest.approx(1, abs=0.3)


def test_a_turned_capsule_is_cut_where_nobody_looks() -> None:
    whole = turned_capsule(3.0, (40.0, -30.0), 0.5)
    cut = turned_capsule(3.0, (40.0, -30.0), 0.5, (12, 9))
    inner = centred(whole[None], (19, 25))[0]
    assert cut.shape == (19, 25)
    np.testing.assert_allclose(cut, inner / inner.sum(), atol=1e-12)
    assert turned_capsule(2.0, (1e5, 1e5), 0.0, (7, 5)).shape == (11, 15)
