import doctest
import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

import torchbokeh.views.points
from torchbokeh.ops.sampling import aperture_points, halton
from torchbokeh.psfs import Disc, Polygon
from torchbokeh.views.points import Views, detail_levels, largest_coc, shared_views, smallest_radius, subsample_offsets

F64 = torch.float64
few = settings(deadline=None, max_examples=40)


def spread(count: int, seed: int | None = None) -> Views:
    return Views.spread(count, Disc().profile(), seed=seed)


def numbers(*values: float) -> Tensor:
    return torch.tensor(values, dtype=F64)


@few
@given(count=st.integers(1, 300), first=st.integers(0, 1000), seed=st.none() | st.integers(0, 99))
def test_views_lie_within_lens_shutter_and_pixel(count: int, first: int, seed: int | None) -> None:
    views = Views.spread(count, Polygon(5).profile(), first=first, seed=seed)
    assert len(views) == count
    assert (views.lens.shape, views.time.shape, views.shift.shape) == ((count, 2), (count,), (count, 2))
    assert views.lens.norm(dim=1).max() <= 1 + 1e-9
    assert torch.allclose(views.time.sort().values, (torch.arange(count, dtype=F64) + 0.5) / count - 0.5)
    assert views.shift.min() >= -0.5
    assert views.shift.max() < 0.5


def test_every_dimension_of_the_sequence_has_its_place() -> None:
    """Bases 2 and 7 over the lens, as in the text; 3 over time, 5 and 11 in the pixel."""
    profile, points = Disc().profile(), halton(90, first=5, seed=3)
    views = Views.spread(90, profile, first=5, seed=3)
    assert torch.equal(views.lens, aperture_points(profile, points[:, [0, 3]]))
    assert torch.equal(views.time.argsort(), points[:, 1].argsort())
    assert torch.equal(views.shift, points[:, [2, 4]] - 0.5)


def test_a_mean_over_the_views_is_one_over_lens_shutter_and_pixel() -> None:
    views = spread(2000)
    assert views.lens.mean(0).abs().max() < 2e-3
    assert torch.allclose(views.lens.T @ views.lens / 2000, 0.25 * torch.eye(2, dtype=F64), atol=2e-3)
    assert torch.allclose(views.shift.T @ views.shift / 2000, torch.eye(2, dtype=F64) / 12, atol=2e-3)
    assert views.shift.mean(0).abs().max() < 4e-3
    assert (views.time @ views.lens / 2000).abs().max() < 2e-3  # the blur of what moves is not skewed
    assert (views.time @ views.shift / 2000).abs().max() < 2e-3


def test_smallest_and_largest_within_a_range() -> None:
    low = numbers(2.0, -5.0, -3.0, 0.0, -4.0, -math.inf)
    high = numbers(7.0, -1.5, 4.0, 3.0, 0.0, -9.0)
    assert smallest_radius(low, high).tolist() == [2, 1.5, 0, 0, 0, 9]
    assert largest_coc(low, high).tolist() == [7, -5, 4, 3, -4, -math.inf]


@few
@given(
    radius=st.floats(0, 1e4),
    texel=st.floats(1e-3, 1e3),
    share=st.floats(0, 1),
    count=st.integers(1, 200),
    most=st.integers(0, 12),
)
def test_levels_are_those_of_equation_3_3(radius: float, texel: float, share: float, count: int, most: int) -> None:
    got = detail_levels(numbers(radius), numbers(texel), share, count, torch.tensor([most]))
    assert got.shape == (count, 1)
    assert got.dtype == torch.long
    ratio = share * math.pi * radius**2 / texel
    level = min(max(math.log(ratio, 4), 0), most) if ratio > 0 else 0.0
    coarse = got[:, 0] - math.floor(level + 1e-9)
    assert set(coarse.tolist()) <= {0, 1}
    assert abs(float(got.double().mean()) - level) <= 0.5 / count + 1e-6
    assert (coarse.diff() >= 0).all()  # the finer level takes the first views
    assert got.max() <= most


def test_two_levels_share_the_views() -> None:
    def levels(*wanted: float, share: float = 1.0, count: int = 100, most: int = 9) -> Tensor:
        """Of objects whose CoC has ``4 ** level`` times the area of a texel."""
        texel = torch.stack([math.pi / numbers(4.0**level)[0] for level in wanted])
        return detail_levels(torch.ones_like(texel), texel, share, count, torch.full(texel.shape, most))

    assert levels(2.3)[:, 0].tolist() == [2] * 70 + [3] * 30
    assert levels(4.3, share=1 / 16)[:, 0].tolist() == [2] * 70 + [3] * 30
    several = levels(2.3, 9, -3, 0.5, 3.9, count=4, most=4).T.tolist()
    assert several[0] == [2, 2, 2, 3]
    assert several[1] == [4] * 4  # no coarser than there is
    assert several[2] == [0] * 4  # no finer than the finest
    assert several[3] == [0, 0, 1, 1]
    assert several[4] == [4] * 4
    # What is in focus somewhere, and what has texels of a size that is not known.
    assert (detail_levels(numbers(0, 5), numbers(1, 0), 1.0, 4, torch.tensor([9, 9])) == 0).all()
    # Nothing pops: the mean level grows by steps of one view.
    means = torch.stack([levels(n / 50, count=20).double().mean() for n in range(300)])
    assert means.diff().min() >= 0
    assert means.diff().max() <= 1 / 20 + 1e-9
    assert (means - torch.arange(300) / 50).abs().max() <= 0.5 / 20 + 1e-9


def slow_parents(views: Views, coc: float, motion: float, grid: int, level: Tensor) -> list[int]:
    """One view after the other: those in the cell, and of these the nearest to its middle."""
    cells: dict[tuple[int, ...], list[int]] = {}
    off = []
    for n in range(len(views)):
        x, y = (grid * (coc * views.lens[n] + views.shift[n])).tolist()
        place = (x, y, float(grid * motion * views.time[n]))
        cells.setdefault((*(round(p) for p in place), int(level[n])), []).append(n)
        off.append(sum((p - round(p)) ** 2 for p in place))
    chosen = {cell: min(members, key=lambda n: (off[n], n)) for cell, members in cells.items()}
    return [chosen[cell] for n in range(len(views)) for cell, members in cells.items() if n in members]


@few
@given(
    count=st.integers(1, 90),
    coc=st.floats(-12, 12),
    motion=st.sampled_from([0.0, 0.7, 9.0]),
    grid=st.integers(1, 3),
    seed=st.integers(0, 99),
)
def test_parents_are_the_nearest_to_the_middle_of_their_cells(
    count: int, coc: float, motion: float, grid: int, seed: int
) -> None:
    views = spread(count, seed)
    level = detail_levels(numbers(1.0, 5.0), numbers(1.0, 0.3), 1.0, count, torch.tensor([5, 5]))
    cocs = numbers(coc, 3.0)
    got = shared_views(views, cocs, numbers(motion, 0.0), grid, level)
    assert got.shape == level.shape
    assert got.dtype == torch.long
    assert got[:, 0].tolist() == slow_parents(views, coc, motion, grid, level[:, 0])
    assert got[:, 1].tolist() == slow_parents(views, 3.0, 0.0, grid, level[:, 1])
    assert torch.equal(got.gather(0, got), got)  # a parent is its own parent
    assert torch.equal(level.gather(0, got), level)  # levels are not mixed


@pytest.mark.parametrize("coc", [-9.0, -2.5, -0.4, 0.4, 2.5, 9.0])
@pytest.mark.parametrize("grid", [1, 2, 4])
def test_a_child_is_no_farther_from_its_parent_than_a_cell(coc: float, grid: int) -> None:
    views = spread(400)
    still = replace(views, shift=torch.zeros_like(views.shift))
    level = torch.zeros(400, 1, dtype=torch.long)
    for held, shifted in ((still, False), (views, True)):
        parents = shared_views(held, numbers(coc), numbers(3.0), grid, level)[:, 0]
        assert len(parents.unique()) < 400 or grid * abs(coc) > 20
        assert (3 * (held.time[parents] - held.time)).abs().max() <= 1 / grid + 1e-9
        for share in torch.linspace(0, 1, 11).tolist():  # parts that are less blurred
            place = share * coc * held.lens + held.shift
            away = (place[parents] - place).abs().max()
            # At worst, what is in focus lies where the shift of another view puts it: within the pixel.
            assert away <= (1 / grid if share == 1 or not shifted else 1) + 1e-9
        opposite = (-coc * held.lens)[parents] + coc * held.lens
        assert shifted or opposite.abs().max() <= 1 / grid + 1e-9


def test_less_blur_is_more_reuse_and_a_finer_grid_less() -> None:
    views = spread(512)
    level = torch.zeros(512, 1, dtype=torch.long)

    def parents(coc: float, grid: int, motion: float = 0.0) -> int:
        return len(shared_views(views, numbers(coc), numbers(motion), grid, level).unique())

    by_blur = [parents(coc, 1) for coc in (0.0, 1.0, 3.0, 10.0, 1e4)]
    assert by_blur == sorted(by_blur)
    assert by_blur[0] == 1
    assert by_blur[-1] == 512
    assert [parents(-coc, 1) for coc in (0.0, 1e4)] == [1, 512]
    by_grid = [parents(2.0, grid) for grid in (1, 2, 4, 8)]
    assert by_grid == sorted(by_grid)
    assert by_grid[-1] > 3 * by_grid[0]
    by_motion = [parents(0.0, 1, motion) for motion in (0.0, 2.0, 20.0)]
    assert by_motion == [1, 3, 21]
    # Cells over the disc: about as many as pixels in its area.
    still = replace(views, shift=torch.zeros_like(views.shift))
    count = len(shared_views(still, numbers(5.0), numbers(0.0), 1, level).unique())
    assert math.pi * 5**2 < count < math.pi * 6.5**2


@pytest.mark.parametrize("samples", [1, 3, 4, 12])
@pytest.mark.parametrize("count", [4, 16, 64])
@pytest.mark.parametrize("shape", [Disc(), Polygon(5)], ids=["disc", "pentagon"])
def test_sub_samples_keep_the_spread(count: int, samples: int, shape: Disc | Polygon) -> None:
    lens = Views.spread(count, shape.profile()).lens
    offsets, factor = subsample_offsets(lens, samples)
    assert offsets.shape == (samples, 2)
    assert offsets.mean(0).abs().max() < 1e-12
    assert 0 < factor <= 1
    # All points the blur is made of: the views, drawn in, and the sub-samples around each.
    around = torch.cat([torch.zeros(1, 2, dtype=F64), offsets])
    every = (factor * lens[:, None] + around).reshape(-1, 2)
    assert float(every.square().sum(1).mean()) == pytest.approx(float(lens.square().sum(1).mean()))
    if samples >= 12:  # many have no direction
        second = offsets.T @ offsets / samples
        assert (second[0, 0] / second[1, 1]).log().abs() < 0.3
        assert second[0, 1].abs() < 0.1 * second.trace()


def test_sub_samples_reach_as_far_as_the_nearest_neighbour() -> None:
    lens = spread(50).lens
    nearest = [min(math.dist(a, b) for m, b in enumerate(lens.tolist()) if m != n) for n, a in enumerate(lens.tolist())]
    reach = sum(nearest) / 50
    offsets, _ = subsample_offsets(lens, 4000)
    assert float(offsets.norm(dim=1).max()) == pytest.approx(reach, rel=2e-3)
    # Evenly over the disc: half of them in half its area.
    assert float((offsets.norm(dim=1) < reach * 0.5**0.5).double().mean()) == pytest.approx(0.5, abs=2e-3)
    few_of_them, _ = subsample_offsets(lens, 4)
    assert few_of_them.norm(dim=1).max() < 1.4 * reach
    assert few_of_them.norm(dim=1).min() > 0.2 * reach


def test_one_view_has_its_sub_samples_over_the_whole_lens() -> None:
    offsets, factor = subsample_offsets(numbers(0.3, 0.4)[None], 500)
    assert factor == 0
    assert float(offsets.norm(dim=1).max()) == pytest.approx(1, abs=0.01)
    assert float(offsets.square().sum(1).mean()) == pytest.approx(0.5, abs=0.01)


def test_no_sub_samples_leave_the_views() -> None:
    offsets, factor = subsample_offsets(spread(9).lens, 0)
    assert offsets.shape == (0, 2)
    assert factor == 1


def test_two_views_at_the_same_point() -> None:
    offsets, factor = subsample_offsets(torch.zeros(2, 2, dtype=F64), 3)
    assert torch.equal(offsets, torch.zeros(3, 2, dtype=F64))
    assert math.isfinite(factor)


def test_examples_in_the_docstrings() -> None:
    assert doctest.testmod(torchbokeh.views.points).failed == 0


def test_many_views_take_no_table_of_their_distances() -> None:
    lens = Views.spread(1 << 16, Disc().profile()).lens  # 34 GB, that table
    assert subsample_offsets(lens, 0)[0].shape == (0, 2)
    offsets, factor = subsample_offsets(lens, 4)
    assert float(offsets.norm(dim=1).max()) < 0.01
    assert 0.999 < factor < 1
