import numba as nb
import numpy as np
import pytest

from torchbokeh.ops.kernels.rows import PsfRows, draw_rows, gather_rows, running_sum


@nb.njit
def _draw(band, o, stride, src, p, rows, span):  # type: ignore[no-untyped-def]
    draw_rows(band, o, stride, src, p, rows, span)


@nb.njit
def _gather(sums, o, stride, rows, span, found):  # type: ignore[no-untyped-def]
    gather_rows(sums, o, stride, rows, span, found)


@nb.njit
def _sum_along(band, o, skipped, fine, row, count):  # type: ignore[no-untyped-def]
    running_sum(band, o, skipped, fine, row, count)


def test_rows_are_drawn_where_they_belong_and_gathered_from_there() -> None:
    draw = np.random.default_rng(0)
    rows, width = 9, 20
    stride = 4 * width
    columns, weights, slopes = draw.integers(-4, 5, (rows, 2)), draw.normal(size=(rows, 4)), draw.normal(size=(rows, 4))
    src = draw.normal(size=12).astype(np.float32)
    for start, stop, centre, p in ((0, 9, 7, 0), (2, 5, 5, 4), (3, 3, 6, 8), (8, 9, 12, 5)):
        before = draw.normal(size=rows * stride)
        want, band = before.copy().reshape(rows, width, 4), before.copy()
        for k in range(start, stop):
            for end in range(2):
                for side in range(2):
                    at = centre + columns[k, end] + side
                    want[1 + k - start if stop - start < rows else k, at] += weights[k, 2 * end + side] * src[p : p + 4]
        o = (stride if stop - start < rows else 0) + 4 * centre
        _draw(band, o, stride, src, p, PsfRows(columns, weights, slopes), (start, stop))
        np.testing.assert_allclose(band.reshape(want.shape), want, rtol=0, atol=1e-14)
        # The transpose: what a pixel of 1 would have added, times what is there.
        sums, found = draw.normal(size=rows * stride), np.full(8, np.nan)
        _gather(sums, o, stride, PsfRows(columns, weights, slopes), (start, stop), found)
        for lane in range(4):
            one = np.zeros(4, np.float32)
            one[lane] = 1
            for table, got in ((weights, found[lane]), (slopes, found[4 + lane])):
                band = np.zeros(rows * stride)
                _draw(band, o, stride, one, 0, PsfRows(columns, table, slopes), (start, stop))
                assert got == pytest.approx(band @ sums, abs=1e-12)


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
