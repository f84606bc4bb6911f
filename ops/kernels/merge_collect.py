"""The first pass of `splat_merged` for CPU float32: which level a pixel belongs to, and the sums of all cells."""

from functools import partial
from typing import NamedTuple

import numba as nb
import numpy as np
from torch import Tensor

from torchbokeh.ops.composite import TINY
from torchbokeh.ops.highlights import LEAST_CONTRAST
from torchbokeh.ops.merge import FADE, LIT, Merging
from torchbokeh.ops.system.threads import row_bands, run_all

BAND = 64
"""Rows of a piece of work: 64 rows of 1024 columns in double fill the second-level cache of common processors."""

RECORD = 8
"""Floats of a cell: four channels, then the sums of share, of share times radius and of share times signed CoC."""


TINIEST = np.finfo(np.float32).tiny


class Picture(NamedTuple):
    """A picture of a batch, or the gradients of one: ``values (C, H, W)``; ``coc (H, W)``, the signed radius in px;
    and ``weight (H, W)``, factor of the values, of no rows where there is none.
    """

    values: np.ndarray
    coc: np.ndarray
    weight: np.ndarray

    @classmethod
    def each(cls, values: Tensor, coc: Tensor, weight: Tensor | None) -> "list[Picture]":
        """The pictures of a batch, float32: ``(B, C, H, W)``, ``(B, 1, H, W)`` and ``(B, 1, H, W)``."""
        if weight is None:
            weight = coc.new_empty(len(coc), 1, 0, 0)
        arrays = (t.detach().contiguous().numpy() for t in (values, coc, weight))
        return [cls(v, r[0], w[0]) for v, r, w in zip(*arrays, strict=True)]


class Lanes(NamedTuple):
    """Which channels a pass of four takes, from the ``first`` on: their numbers ``channel (4,)``, or -1 where there is
    none and the ``constant (4,)`` is taken in its place.
    """

    first: int
    channel: np.ndarray
    constant: np.ndarray

    @classmethod
    def of(cls, group: int, channels: int, ones: bool) -> "Lanes":
        """The lanes of a group of four of ``channels`` channels, and one more of ones."""
        wanted = np.arange(4 * group, 4 * group + 4)
        constant = ((wanted == channels) & ones).astype(np.float32)
        return cls(4 * group, np.where(wanted < channels, wanted, -1), constant)


class Thresholds(NamedTuple):
    """What the level of a pixel depends on: highlights are bright against the ``means (C,)`` of the channels."""

    merging: Merging
    highest: int
    means: np.ndarray


class Levels(NamedTuple):
    """What stands where.

    Attributes:
        thresholds: what decided on it.
        sizes: ``(L+1, 3)``: rows and columns of each level, and the number of its first cell.
        cells: flat records of all cells, see `RECORD`.
        reach: ``(L+1, H)`` largest radius in px in each row of a level; on the lowest, of what is no highlight.
        marks: flat indices of the highlights.
        lit: ``(M,)`` share of each of these in what is a highlight; the rest is merged.
    """

    thresholds: Thresholds
    sizes: np.ndarray
    cells: np.ndarray
    reach: np.ndarray
    marks: np.ndarray
    lit: np.ndarray


class Shares(NamedTuple):
    """Where the pixels of a row belong, as rows ``(W,)`` of float32, so that many can be worked on at a time.

    Attributes:
        level: the level; -2 for a pixel without weight.
        share: of the pixel there; the rest belongs to the level below.
        lit: how far it is a highlight, which is drawn apart from all levels.
    """

    level: np.ndarray
    share: np.ndarray
    lit: np.ndarray


@nb.njit(cache=True, nogil=True, error_model="numpy")
def row_shares(width):  # type: ignore[no-untyped-def]
    """Room for the `Shares` of a row."""
    return Shares(np.empty(width, np.float32), np.empty(width, np.float32), np.empty(width, np.float32))


@nb.njit(cache=True, nogil=True, fastmath=True)
def _largest(row):  # type: ignore[no-untyped-def]
    top = np.float32(0.0)
    for x in range(len(row)):
        top = max(top, abs(row[x]))
    return top


@nb.njit(cache=True, nogil=True, error_model="numpy")
def classify(picture, thresholds, y, shares):  # type: ignore[no-untyped-def]
    """Fill the `Shares` of row ``y``. Returns the columns between which pixels have weight."""
    (values, coc, weight), (level, share, lit) = picture, shares
    merging, highest, means = thresholds
    finest, highlight = np.float32(merging.cells), np.float32(merging.highlight)
    one, zero, least, tiny = np.float32(1.0), np.float32(0.0), np.float32(LEAST_CONTRAST), TINIEST
    start, slope = np.float32(LIT), np.float32(1.0 / (1.0 - LIT))
    row = coc[y]
    top = _largest(row)
    begin, end = 0, len(row)
    level[:] = zero
    share[:] = one
    lit[:] = zero
    if weight.shape[0] > 0:
        weights = weight[y]
        for x in range(len(row)):
            level[x] = zero if weights[x] > zero else np.float32(-2.0)
        while end > 0 and level[end - 1] < zero:
            end -= 1
        while begin < end and level[begin] < zero:
            begin += 1
    if highest == 0 or begin == end or top < np.float32(2.0) * finest:
        return begin, end
    for number in range(1, highest + 1):
        threshold = finest * np.float32(1 << number)
        if threshold > top:
            break
        here, scale = np.float32(number), np.float32(1.0 / FADE) / threshold
        for x in range(len(row)):
            r = abs(row[x])
            level[x] = here if (r >= threshold) & (level[x] >= zero) else level[x]
            share[x] = min((r - threshold) * scale, one) if r >= threshold else share[x]
    for k in range(values.shape[0]):
        plane, mean = values[k, y], means[k]
        for x in range(len(row)):
            bound = max(mean * max(highlight * row[x] * row[x], least), tiny)
            high = min((abs(plane[x]) / bound - start) * slope, one)
            lit[x] = high if (level[x] > zero) & (high > lit[x]) else lit[x]
    return begin, end


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _add(cells, p, lanes, w, r, signed):  # type: ignore[no-untyped-def]
    """Add to the record at ``p``."""
    for k in range(4):
        cells[p + k] += lanes[k]
    cells[p + 4] += w
    cells[p + 5] += r
    cells[p + 6] += signed


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _collect_row(picture, lanes, levels, y, starts, row, farthest, marks):  # type: ignore[no-untyped-def]
    """Sum the pixels of row ``y`` into the cells of their levels, whose rows begin at ``starts (L+1,)``.

    ``row`` is scratch of `classify`. ``farthest (L+1,)`` takes the largest radius of each level, and ``marks``, two
    rows ``(W,)``, the flat indices of the highlights and their shares; their number is returned. Sums are kept in
    registers as long as neighbours go to the same cell.
    """
    values, coc, weight = picture
    cells, (numbers, shares, lit), (indices, highs) = levels.cells, row, marks
    c0, c1, c2, c3 = lanes.channel[0], lanes.channel[1], lanes.channel[2], lanes.channel[3]
    a, b, c, d = lanes.constant[0], lanes.constant[1], lanes.constant[2], lanes.constant[3]
    zero, one = np.float32(0.0), np.float32(1.0)
    weighted, width = weight.shape[0] > 0, coc.shape[1]
    begin, end = classify(picture, levels.thresholds, y, row)
    count, current = 0, -1
    s0 = s1 = s2 = s3 = sw = sr = ss = zero
    for x in range(begin, end):
        level = int(numbers[x])
        signed = coc[y, x]
        r = abs(signed)
        if level <= 0:
            if level == 0:
                farthest[0] = max(farthest[0], r)
            continue
        if lit[x] > zero:
            indices[count], highs[count] = y * width + x, lit[x]
            count += 1
            if lit[x] >= one:
                continue
        if c0 >= 0:
            a = values[c0, y, x]
        if c1 >= 0:
            b = values[c1, y, x]
        if c2 >= 0:
            c = values[c2, y, x]
        if c3 >= 0:
            d = values[c3, y, x]
        p = RECORD * (starts[level] + (x >> level))
        if p != current:
            if current >= 0:
                _add(cells, current, (s0, s1, s2, s3), sw, sr, ss)
            current = p
            s0 = s1 = s2 = s3 = sw = sr = ss = zero
        whole = (weight[y, x] if weighted else one) * (one - lit[x])
        w = shares[x] * whole
        s0 += w * a
        s1 += w * b
        s2 += w * c
        s3 += w * d
        sw += w
        sr += w * r
        ss += w * signed
        farthest[level] = max(farthest[level], r)
        if shares[x] < one:
            level -= 1
            farthest[level] = max(farthest[level], r)
            if level > 0:
                w = whole - w
                p = RECORD * (starts[level] + (x >> level))
                _add(cells, p, (w * a, w * b, w * c, w * d), w, w * r, w * signed)
    if current >= 0:
        _add(cells, current, (s0, s1, s2, s3), sw, sr, ss)
    return count


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _collect(picture, lanes, levels, marks, counts, y0, y1):  # type: ignore[no-untyped-def]
    """Sum the pixels of rows ``y0 .. y1-1`` into the cells of their levels.

    ``marks``, two arrays ``(H, W)``, take the flat indices of the highlights of each row and their shares, and
    ``counts (H,)`` how many there are.
    """
    sizes, cells, reach = levels.sizes, levels.cells, levels.reach
    highest, width = levels.thresholds.highest, picture.coc.shape[1]
    for level in range(1, highest + 1):
        columns, start = sizes[level, 1], sizes[level, 2]
        first, last = y0 >> level, (y1 - 1) >> level
        cells[RECORD * (start + first * columns) : RECORD * (start + (last + 1) * columns)] = 0.0
        reach[level, first : last + 1] = 0.0
    row = row_shares(width)
    farthest = np.zeros(highest + 1, np.float32)
    starts = np.empty(highest + 1, np.int64)
    for y in range(y0, y1):
        for level in range(1, highest + 1):
            starts[level] = sizes[level, 2] + (y >> level) * sizes[level, 1]
        farthest[:] = 0.0
        farthest[0] = -1.0
        counts[y] = _collect_row(picture, lanes, levels, y, starts, row, farthest, (marks[0][y], marks[1][y]))
        reach[0, y] = farthest[0]
        for level in range(1, highest + 1):
            reach[level, y >> level] = max(reach[level, y >> level], farthest[level])


@nb.njit(cache=True, nogil=True, fastmath={"reassoc", "contract", "nsz"})
def _row_sums(values, weight, sums, y0, y1):  # type: ignore[no-untyped-def]
    """For rows ``y0 .. y1-1``: ``sums (H, C+1)`` of weight times magnitude, and of the weight."""
    channels, _, width = values.shape
    counted = np.ones(width, np.float32)
    for y in range(y0, y1):
        if weight.shape[0] > 0:
            counted[:] = weight[y]
        for k in range(channels):
            plane, total = values[k, y], np.float32(0.0)
            for x in range(width):
                total += abs(plane[x]) * counted[x] if counted[x] > 0.0 else np.float32(0.0)
            sums[y, k] = total
        count = np.float32(0.0)
        for x in range(width):
            count += counted[x]
        sums[y, channels] = count


def channel_means(values: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """`torchbokeh.ops.highlights.ordinary_brightness` ``(C,)`` of one picture."""
    sums = np.empty((values.shape[1], len(values) + 1))
    run_all(partial(_row_sums, values, weight, sums), bands(values.shape[1]), "mean")
    *totals, count = sums.sum(0)
    return (np.array(totals) / max(count, TINY)).astype(np.float32)


def collect(picture: Picture, lanes: Lanes, merging: Merging, highest: int) -> Levels:
    """Sum a picture into the cells of all levels."""
    height, width = picture.coc.shape
    thresholds = Thresholds(merging, highest, channel_means(picture.values, picture.weight))
    sizes = np.zeros((highest + 1, 3), np.int64)
    count = 0
    for level in range(1, highest + 1):
        sizes[level] = -(-height >> level), -(-width >> level), count
        count += sizes[level, 0] * sizes[level, 1]
    cells = np.empty(RECORD * count, np.float32)
    reach = np.empty((highest + 1, height), np.float64)
    marks = np.empty((height, width), np.int32), np.empty((height, width), np.float32)
    counts = np.empty(height, np.int64)
    levels = Levels(thresholds, sizes, cells, reach, np.empty(0, np.int64), np.empty(0, np.float32))
    work = partial(_collect, picture, lanes, levels, marks, counts)
    run_all(work, row_bands(height, max(1 << highest, BAND // 2)), "collect")  # no cell lies in two of them
    used = np.flatnonzero(counts)
    indices, lit = (np.concatenate([t[:0, 0], *(t[y, : counts[y]] for y in used)]) for t in marks)
    return levels._replace(marks=indices, lit=lit)


def bands(height: int) -> list[tuple[int, int]]:
    """Pieces of work that together make up ``height`` rows; low pictures come in eight or so, for all threads."""
    return row_bands(height, min(max(-(-height // 8), 16), BAND))
