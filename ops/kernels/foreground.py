"""numba kernels for a foreground over the rest of a plain picture, CPU float32 without gradients.

The same numbers as the torch functions of `torchbokeh.compose.surfaces`, each in one pass over the picture.
"""

from functools import partial
from typing import NamedTuple

import numba as nb
import numpy as np

from torchbokeh.ops.composite import TINY
from torchbokeh.ops.kernels.merge_collect import bands
from torchbokeh.ops.system.threads import run_all

BLOCK = 4
"""Pixels of a block each way."""


class Layer(NamedTuple):
    """A picture ``(C, H, W)``, and a map of it ``(H, W)``: its CoC, or the coverage of its splats."""

    colour: np.ndarray
    map: np.ndarray


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _front(row, start, stop, out):  # type: ignore[no-untyped-def]
    scale = np.float32(1.0) / (stop - start)
    for x in range(len(row)):
        out[x] = min(max((stop - row[x]) * scale, np.float32(0.0)), np.float32(1.0))


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _split(scene, between, front, known, sums, y0, y1):  # type: ignore[no-untyped-def]
    (image, coc), (start, stop) = scene, between
    channels, height, width = image.shape
    zero, one = np.float32(0.0), np.float32(1.0)
    near, widest = np.empty(width, np.float32), np.empty(width + 2, np.float32)
    weight, here = np.empty(width, np.float32), np.empty(width, np.float32)
    totals = np.empty((len(sums), BLOCK * sums.shape[2]), np.float32)
    for block in range(y0 // BLOCK, -(-y1 // BLOCK)):
        totals[:] = zero
        for y in range(BLOCK * block, min(BLOCK * (block + 1), height)):
            _front(coc[y], start, stop, front[y])
            widest[:] = zero
            widest[1:-1] = front[y]
            for other in (y - 1, y + 1):
                if 0 <= other < height:
                    _front(coc[other], start, stop, near)
                    for x in range(width):
                        widest[x + 1] = max(widest[x + 1], near[x])
            seen, ahead, signed = known[y], front[y], coc[y]
            for x in range(width):
                seen[x] = one - max(max(widest[x], widest[x + 1]), widest[x + 2])
                weight[x] = max(seen[x], np.float32(1e-9) * (one - ahead[x]))
                here[x] = one if ahead[x] > zero else zero
            for x in range(width):
                totals[0, x] += weight[x]
                totals[1, x] += weight[x] * signed[x]
                totals[2, x] += here[x]
                totals[3, x] += here[x] * signed[x]
            for k in range(channels):
                plane, total = image[k, y], totals[4 + k]
                for x in range(width):
                    total[x] += weight[x] * plane[x]
        for k in range(len(sums)):
            for x in range(sums.shape[2]):
                p = BLOCK * x
                sums[k, block, x] = totals[k, p] + totals[k, p + 1] + totals[k, p + 2] + totals[k, p + 3]


def split(image: np.ndarray, coc: np.ndarray, start: float, stop: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Front and known ``(H, W)`` of ``image (C, H, W)``, and means over blocks ``(4 + C, h, w)``.

    The means are of the weight of what is known, that times CoC, what has any foreground, that times CoC, and
    the weight times the image.
    """
    channels, height, width = image.shape
    front, known = np.empty((height, width), np.float32), np.empty((height, width), np.float32)
    sums = np.empty((4 + channels, -(-height // BLOCK), -(-width // BLOCK)), np.float32)
    between = np.float32(start), np.float32(stop)
    work = partial(_split, Layer(image, coc), between, front, known, sums)
    run_all(work, bands(height), "split")
    return front, known, sums / np.float32(BLOCK**2)


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _enlarge(small, y, line, out):  # type: ignore[no-untyped-def]
    """Row ``y`` of ``small (h, w)``, enlarged bilinearly; ``line (w + 2)`` is scratch, ``out`` a multiple of 4."""
    place = max((y + 0.5) / BLOCK - 0.5, 0.0)
    row = int(place)
    f = np.float32(place - row)
    upper, lower = small[row], small[min(row + 1, len(small) - 1)]
    inner = line[1:]
    for x in range(len(upper)):
        inner[x] = upper[x] + f * (lower[x] - upper[x])
    line[0], line[len(upper) + 1] = line[1], line[len(upper)]
    for x in range(len(upper)):
        a, b, c = line[x], line[x + 1], line[x + 2]
        out[4 * x] = a + np.float32(0.625) * (b - a)
        out[4 * x + 1] = a + np.float32(0.875) * (b - a)
        out[4 * x + 2] = b + np.float32(0.125) * (c - b)
        out[4 * x + 3] = b + np.float32(0.375) * (c - b)


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _rest(scene, known, behind, target, y0, y1):  # type: ignore[no-untyped-def]
    (image, coc), (hidden, hidden_coc), (out, out_coc) = scene, behind, target
    channels, _, width = image.shape
    line, large = np.empty(hidden.shape[2] + 2, np.float32), np.empty(BLOCK * hidden.shape[2], np.float32)
    for y in range(y0, y1):
        seen = known[y]
        least = np.float32(1.0)
        for x in range(width):
            least = min(least, seen[x])
        for k in range(channels + 1):
            source, small = (image[k, y], hidden[k]) if k < channels else (coc[y], hidden_coc)
            row = out[k, y] if k < channels else out_coc[y]
            if least == 1.0:
                row[:] = source
                continue
            _enlarge(small, y, line, large)
            for x in range(width):
                row[x] = seen[x] * source[x] + (np.float32(1.0) - seen[x]) * large[x]


def rest(
    image: np.ndarray, coc: np.ndarray, known: np.ndarray, hidden: np.ndarray, hidden_coc: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The picture ``(C, H, W)`` and CoC ``(H, W)`` without foreground: what is hidden comes from block means."""
    out = Layer(np.empty_like(image), np.empty_like(coc))
    run_all(partial(_rest, Layer(image, coc), known, Layer(hidden, hidden_coc), out), bands(len(coc)), "split")
    return out


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _over(front, certain, ahead, whole, behind, y0, y1):  # type: ignore[no-untyped-def]
    (colour, coverage), (target, density) = ahead, behind
    channels, _, width = colour.shape
    zero, one, tiny = np.float32(0.0), np.float32(1.0), np.float32(TINY)
    share, rest = np.empty(width, np.float32), np.empty(width, np.float32)
    for y in range(y0, y1):
        covered, share_ahead, count = coverage[y], front[y], density[y]
        most = zero
        for x in range(width):
            most = max(most, covered[x])
        if most == zero:
            continue
        full = whole[y]
        for x in range(width):
            stopped = min(covered[x] / max(full[x], tiny), one)
            known = min(certain * max(full[x], zero), one)
            absent = one if share_ahead[x] == zero else zero
            told = min(certain * count[x], one)
            vote = stopped * known * (stopped + (one - stopped) * told)
            left = (absent + known * (one - stopped - absent)) * told
            total = max(vote + left, tiny * tiny)
            share[x], rest[x] = vote / total, left / total
        for k in range(channels):
            row, source = target[k, y], colour[k, y]
            for x in range(width):
                row[x] = share[x] * source[x] + rest[x] * row[x]


def over(
    front: np.ndarray,
    certain: float,
    colour: np.ndarray,
    coverage: np.ndarray,
    whole: np.ndarray,
    behind: np.ndarray,
    density: np.ndarray,
) -> None:
    """Put a foreground over ``behind (C, H, W)``, in place, as `compose` does for the whole lens."""
    ahead, back = Layer(colour, coverage), Layer(behind, density)
    run_all(partial(_over, front, np.float32(certain), ahead, whole, back), bands(len(front)), "over")
