import numba as nb
import numpy as np
import pytest

from torchbokeh.ops.kernels.rows import PsfPoints, draw_points, gather_points, rows_above, rows_within, running_sum


@nb.njit
def _draw(band, o, stride, source, points, span, even):  # type: ignore[no-untyped-def]
    draw_points(band, o, stride, source, points, span, even)


@nb.njit
def _gather(sums, o, stride, points, span, even, found):  # type: ignore[no-untyped-def]
    gather_points(sums, o, stride, points, span, even, found)


@nb.njit
def _sum_along(band, o, skipped, fine, row, count):  # type: ignore[no-untyped-def]
    running_sum(band, o, skipped, fine, row, count)


@pytest.mark.parametrize("even", [False, True])
@pytest.mark.parametrize("both", [False, True])
def test_points_are_drawn_where_they_belong_and_gathered_from_there(even: bool, both: bool) -> None:
    draw = np.random.default_rng(0)
    rows, width = 19, 20
    stride = 4 * width
    weights, slopes = draw.normal(size=9), draw.normal(size=9)
    # Two points of one row stand among those of one each.
    numbers = np.array([[0, 1, 2, 3, 4, 4, 5, 6, 7]]).T
    places = np.concatenate([numbers, draw.integers(-4, 5, (9, 3))], 1).astype(np.int32)
    src = draw.normal(size=12).astype(np.float32)
    points = PsfPoints(places, weights, slopes, np.empty((0, 0)))
    for start, stop, centre, p in ((0, 9, 7, 0), (2, 5, 5, 4), (3, 3, 6, 8), (8, 9, 12, 5)):
        before = draw.normal(size=rows * stride)
        want, band = before.copy().reshape(rows, width, 4), before.copy()
        for k in range(start, stop):
            for row in (9 + places[k, 0], 9 - places[k, 0])[: 1 + both]:
                for side in range(1 + even):
                    want[row, centre + places[k, 1 + side]] += (1 - 2 * side) * weights[k] * src[p : p + 4]
        o = 9 * stride + 4 * centre
        _draw(
            band,
            (o, o if both else -1),
            stride,
            (src, p),
            points,
            (start, stop),
            even,
        )
        np.testing.assert_allclose(band.reshape(want.shape), want, rtol=0, atol=1e-14)
        if both:
            continue
        # The transpose: what a pixel of 1 would have added, times what is there.
        sums, found = draw.normal(size=rows * stride), np.full(8, 0.25)
        _gather(sums, o, stride, points, (start, stop), even, found)
        for lane in range(4):
            one = np.zeros(4, np.float32)
            one[lane] = 1
            for table, got in ((weights, found[lane]), (slopes, found[4 + lane])):
                band = np.zeros(rows * stride)
                _draw(
                    band,
                    (o, -1),
                    stride,
                    (one, 0),
                    points._replace(weights=table),
                    (start, stop),
                    even,
                )
                assert got - 0.25 == pytest.approx(band @ sums, abs=1e-12)


BANDS = [(3, 5, 0, 64), (-5, 8, 0, 64), (60, 9, 0, 64), (-30, 9, 0, 64), (9, 4, 9, 10)]


@pytest.mark.parametrize(("first", "n", "y0", "y1"), BANDS)
def test_rows_within_a_band_are_those_of_it(first: int, n: int, y0: int, y1: int) -> None:
    start, stop = rows_within(first, n, y0, y1)
    assert list(range(first + start, first + stop)) == [y for y in range(first, first + n) if y0 <= y < y1]


HALVES = [(0, 5, 3, 0, 64), (0, 9, 3, 0, 64), (2, 9, 8, 0, 3), (0, 1, 5, 0, 9)]


@pytest.mark.parametrize(("first", "n", "y", "y0", "y1"), HALVES)
def test_rows_above_are_the_mirror_images_but_that_of_the_centre(first: int, n: int, y: int, y0: int, y1: int) -> None:
    start, stop = rows_above(first, y, n, y0, y1)
    wanted = [k for k in range(n) if y0 <= y - first - k < y1 and first + k > 0]
    assert list(range(start, stop)) == wanted


@pytest.mark.parametrize(("o", "skipped", "count"), [(0, 0, 11), (16, 5, 9), (4, 3, 0), (8, 0, 1)])
def test_the_running_sum_is_that_of_numpy(o: int, skipped: int, count: int) -> None:
    draw = np.random.default_rng(1)
    band = draw.normal(size=100) * 1e3
    fine, row = draw.normal(size=4 * count + 4).astype(np.float32), np.full(4 * count + 4, 7, np.float32)
    _sum_along(band, o, skipped, fine, row, count)
    sums = band[o : o + 4 * (skipped + count)].reshape(-1, 4).cumsum(0)[skipped:].astype(np.float32)
    np.testing.assert_array_equal(row[: 4 * count], sums.reshape(-1) + fine[: 4 * count])
    assert (row[4 * count :] == 7).all()


def test_the_running_sum_is_taken_in_double() -> None:
    band = np.zeros(4 * 1000)
    band[:4], band[4:8] = 1e9 + 0.125, -1e9
    row = np.empty(4 * 998, np.float32)
    _sum_along(band, 0, 2, np.zeros_like(row), row, 998)
    assert (row == 0.125).all()
