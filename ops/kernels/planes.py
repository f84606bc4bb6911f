"""numba kernel of `torchbokeh.ops.planes.render_planes` for CPU float32.

A row of a view is cut where a rectangle begins or ends in it. Between two cuts the same rectangles are met, and as
``1 / z`` is linear along the row, their order is settled once wherever it is the same at both ends. Bands of rows
are independent and do not depend on the number of threads.
"""

import math
from functools import partial
from typing import NamedTuple

import numba as nb
import numpy as np
import torch
from torch import Tensor

from torchbokeh.ops.planes import SOLID, Plates
from torchbokeh.ops.system.threads import row_bands, run_all

MEMORY = 1 << 26
"""Bytes of copies that each thread keeps."""

BAND = 16
"""Rows of a band: small enough that bands keep all threads busy, large enough that a view's tables are reused."""


class Textures(NamedTuple):
    """The textures of K rectangles: their ``texels``, flat, each level with a rim of one texel; the ``first (K, L)`` of
    each level, and its ``sizes (K, L, 2)``, width and height; the ``full (K, 2)`` sizes of level 0; and the flags
    ``(K,)`` of `Plates`.
    """

    texels: np.ndarray
    first: np.ndarray
    sizes: np.ndarray
    full: np.ndarray
    mirror: np.ndarray
    infinite: np.ndarray


class Views(NamedTuple):
    """V views: ``inverse (V, K, 3, 3)`` and ``level (V, K)`` as in `torchbokeh.ops.planes.render_planes`, the
    rectangles in ``order (V, K)`` of depth, roughly; and of the copies that views share the numbers ``copy (V, K)``,
    -1 for none, and the ``columns (N, 2)``, the first and how many.
    """

    inverse: np.ndarray
    level: np.ndarray
    order: np.ndarray
    copy: np.ndarray
    columns: np.ndarray


class Row(NamedTuple):
    """Scratch for a row of ``W`` pixels and K rectangles.

    Attributes:
        lines: ``(K, 6)``: of ``s / z``, ``t / z`` and ``1 / z`` the value in the first pixel and the step to the next.
        begin: ``(K,)``, the first pixel that meets each rectangle.
        end: ``(K,)``, one past the last.
        met: ``(K,)``, the rectangles that the row meets, roughly by depth.
        cuts: ``(W + 1,)``, whether a rectangle begins or ends there.
        active: ``(K,)``, the rectangles that a part of the row meets, nearest first.
        depths: ``(K,)`` ``1 / z`` of each in a pixel.
        rgba: ``(4,)``, what is seen of one.
        total: ``(4,)``, what is seen of all.
    """

    lines: np.ndarray
    begin: np.ndarray
    end: np.ndarray
    met: np.ndarray
    cuts: np.ndarray
    active: np.ndarray
    depths: np.ndarray
    rgba: np.ndarray
    total: np.ndarray


class Copies(NamedTuple):
    """What several views share: for each a strip of BAND rows, flat from its place in ``starts (N + 1,)`` on, of
    ``rgba (P, 4)``, and whether each pixel is ``filled (P,)``.
    """

    starts: np.ndarray
    rgba: np.ndarray
    filled: np.ndarray


# Only functions of numbers are inlined: numba counts references to arrays at each inlined call, with atomic
# operations that take longer than the work itself.


@nb.njit(inline="always")
def _reflected(s, size):  # type: ignore[no-untyped-def]
    """A coordinate mirrored into ``[0, size]``."""
    if 0.0 <= s <= size:
        return s
    return size - abs(s % (2.0 * size) - size)


@nb.njit(inline="always")
def _cut(a, b, low, high):  # type: ignore[no-untyped-def]
    """Keep of the interval from ``low`` to ``high`` the part in which ``a + b x > 0``."""
    if b > 0.0:
        return max(low, -a / b), high
    if b < 0.0:
        return low, min(high, -a / b)
    if a > 0.0:
        return low, high
    return low, -math.inf


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _sort(active, count, depths):  # type: ignore[no-untyped-def]
    """Nearest first; of equals the one that comes first in the scene. Insertion: they are nearly sorted."""
    for a in range(1, count):
        k = active[a]
        b = a
        while b > 0:
            other = active[b - 1]
            if depths[other] > depths[k] or (depths[other] == depths[k] and other < k):
                break
            active[b] = other
            b -= 1
        active[b] = k


@nb.njit(inline="always")
def _texel(s, scale, size, rim):  # type: ignore[no-untyped-def]
    """Which texel of a level of that size, counted from its rim, a coordinate lies behind, and the share of the next.

    ``scale`` is the size of a texel of level 0 in the level; the coordinate may lie ``rim`` outside.
    """
    s = min(max(s * scale - 0.5, -rim), size - 1.0 + 0.999999 * rim) + 1.0
    i = int(s)  # not negative: the floor
    return i, np.float32(s - i)


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _meet(textures, shown, v, y, row):  # type: ignore[no-untyped-def]
    """Fill ``row`` with the rectangles that row ``y`` of view ``v`` meets, and return how many they are."""
    sizes, mirror = textures.sizes, textures.mirror
    inverse, level, order = shown.inverse[v], shown.level[v], shown.order[v]
    lines, begin, end, met, cuts = row.lines, row.begin, row.end, row.met, row.cuts
    centre, width = y + 0.5, len(cuts) - 1
    found = 0
    cuts[:] = False
    for k in order:
        for c in range(3):
            # The value at x = 0.5, the centre of the first pixel, and the step from pixel to pixel.
            step = inverse[k, c, 0]
            lines[k, 2 * c] = inverse[k, c, 1] * centre + inverse[k, c, 2] + 0.5 * step
            lines[k, 2 * c + 1] = step
        start, slope = lines[k, 4], lines[k, 5]
        low, high = _cut(start, slope, -1.0, float(width))
        if not mirror[k]:
            lod = level[k]
            rim = 0.5 * (1 << lod)
            for c in range(2):
                a, b = lines[k, 2 * c], lines[k, 2 * c + 1]
                low, high = _cut(a + rim * start, b + rim * slope, low, high)
                far = float(sizes[k, lod, c] << lod) + rim  # a level of odd size may end beyond level 0
                low, high = _cut(far * start - a, far * slope - b, low, high)
                if low >= high:
                    break
        if low < high:
            begin[k] = max(math.floor(low) + 1, 0)
            end[k] = min(math.ceil(high), width)
            if begin[k] < end[k]:
                met[found] = k
                found += 1
                cuts[begin[k]] = True
                cuts[end[k]] = True
    return found


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _measure(row, infinite, x, count):  # type: ignore[no-untyped-def]
    """The depths of the active rectangles in column ``x``."""
    lines, active, depths = row.lines, row.active, row.depths
    for m in range(count):
        k = active[m]
        depths[k] = 0.0 if infinite[k] else lines[k, 4] + lines[k, 5] * x


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _activate(row, infinite, found, start, stop):  # type: ignore[no-untyped-def]
    """Sort the rectangles that the columns ``start .. stop-1`` meet by their depth in the first of them.

    Returns how many they are, and whether their order is the same in all of these columns.
    """
    begin, end, met, active, depths = row.begin, row.end, row.met, row.active, row.depths
    count = 0
    for m in range(found):
        k = met[m]
        if begin[k] <= start and end[k] >= stop:
            active[count] = k
            count += 1
    _measure(row, infinite, start, count)
    _sort(active, count, depths)
    _measure(row, infinite, stop - 1, count)
    settled = True
    for m in range(1, count):
        k, other = active[m], active[m - 1]
        if depths[other] < depths[k] or (depths[other] == depths[k] and other > k):
            settled = False
    return count, settled


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _render_part(textures, shown, place, row, part, copies, out, nearest):  # type: ignore[no-untyped-def]
    """Render the columns ``start .. stop-1`` of a row of a view, all of which meet the same rectangles.

    ``place`` is the view and the row of the band, ``part`` are the columns and what `_activate` returns. Adds to
    ``out (W, 4)``, and writes to ``nearest (W,)`` unless it is empty. The one loop is not cut into functions that take
    arrays: handing these on would take longer than the work itself, see above.
    """
    texels, first, sizes, full, mirror, infinite = textures
    (v, strip), (start, stop, count, settled) = place, part
    level, copy, columns = shown.level[v], shown.copy[v], shown.columns
    lines, active, rgba, total = row.lines, row.active, row.rgba, row.total
    each = len(nearest) > 0
    for x in range(start, stop):
        if not settled:
            _measure(row, infinite, x, count)
            _sort(active, count, row.depths)
        left, most, seen = np.float32(1.0), np.float32(0.0), 0.0
        for c in range(4):
            total[c] = 0.0
        for m in range(count):
            k = active[m]
            kept, p = copy[k], 0
            if kept >= 0:
                p = copies.starts[kept] + strip * columns[kept, 1] + x - columns[kept, 0]
            if kept >= 0 and copies.filled[p]:
                for c in range(4):
                    rgba[c] = copies.rgba[p, c]
            else:
                z = lines[k, 4] + lines[k, 5] * x
                scale = 1.0 / z
                s = (lines[k, 0] + lines[k, 1] * x) * scale
                t = (lines[k, 2] + lines[k, 3] * x) * scale
                # Rounding at the end of an interval; NaN fails too.
                if not (z > 0.0 and abs(s) < 1e15 and abs(t) < 1e15):
                    continue
                lod, rim = level[k], 1.0
                if mirror[k]:
                    s, t, rim = _reflected(s, full[k, 0]), _reflected(t, full[k, 1]), 0.0
                i, f = _texel(s, 1.0 / (1 << lod), sizes[k, lod, 0], rim)
                j, g = _texel(t, 1.0 / (1 << lod), sizes[k, lod, 1], rim)
                stride = sizes[k, lod, 0] + 2
                upper = 4 * (first[k, lod] + j * stride + i)
                lower = upper + 4 * stride
                for c in range(4):
                    top = texels[upper + c] + f * (texels[upper + 4 + c] - texels[upper + c])
                    bottom = texels[lower + c] + f * (texels[lower + 4 + c] - texels[lower + c])
                    rgba[c] = top + g * (bottom - top)
                if kept >= 0:
                    copies.filled[p] = True
                    for c in range(4):
                        copies.rgba[p, c] = rgba[c]
            for c in range(4):
                total[c] += left * rgba[c]
            if each and left * rgba[3] > most:
                most = left * rgba[3]
                seen = 0.0 if infinite[k] else lines[k, 4] + lines[k, 5] * x
            left *= np.float32(1.0) - rgba[3]
            if left < SOLID:
                break
        for c in range(4):
            out[x, c] += total[c]
        if each:
            nearest[x] = seen if most > left else 0.0


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _scratch(count, width):  # type: ignore[no-untyped-def]
    lines, depths, cuts = np.empty((count, 6), np.float64), np.empty(count, np.float64), np.zeros(width + 1, np.bool_)
    places = np.empty((4, count), np.int64)
    return Row(
        lines,
        places[0],
        places[1],
        places[2],
        cuts,
        places[3],
        depths,
        np.empty(4, np.float32),
        np.empty(4, np.float32),
    )


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _render_band(textures, shown, each, out, nearest, y0, y1):  # type: ignore[no-untyped-def]
    """Render rows ``y0 .. y1`` of every view; add to ``out[0]``, or write to ``out[v]`` and ``nearest[v]``."""
    views, rectangles = shown.level.shape
    columns, width = shown.columns, out.shape[2]
    row, nowhere = _scratch(rectangles, width), np.empty(0, np.float32)
    starts = np.zeros(len(columns) + 1, np.int64)
    for c in range(len(columns)):
        starts[c + 1] = starts[c] + columns[c, 1] * (y1 - y0)
    copies = Copies(starts, np.empty((starts[-1], 4), np.float32), np.zeros(starts[-1], np.bool_))
    cuts = row.cuts
    for v in range(views):
        slot = v if each else 0
        for y in range(y0, y1):
            found = _meet(textures, shown, v, y, row)
            target, depth = out[slot, y], nearest[slot, y] if each else nowhere
            start = 0
            while start < width:
                stop = start + 1
                while stop < width and not cuts[stop]:
                    stop += 1
                count, settled = _activate(row, textures.infinite, found, start, stop)
                part = start, stop, count, settled
                _render_part(textures, shown, (v, y - y0), row, part, copies, target, depth)
                start = stop


def render_planes(
    plates: Plates, inverse: Tensor, level: Tensor, size: tuple[int, int], parents: Tensor | None, frames: bool
) -> tuple[Tensor, Tensor]:
    """`torchbokeh.ops.planes.render_planes` for CPU float32."""
    views, count = level.shape
    most = max((len(pyramid) for pyramid in plates.levels), default=1)
    first = np.zeros((count, most), np.int64)
    sizes = np.zeros((count, most, 2), np.int64)
    flat: list[Tensor] = []
    places: dict[tuple[int, bool], int] = {}  # a texture that many rectangles share is there once
    total = 0
    for k, pyramid in enumerate(plates.levels):
        for lod, texture in enumerate(pyramid):
            key = id(texture), plates.mirror[k]
            if key not in places:
                places[key] = total
                rim = torch.nn.functional.pad(
                    texture.detach()[None], (1, 1, 1, 1), mode="replicate" if plates.mirror[k] else "constant"
                )
                flat.append(rim[0].permute(1, 2, 0).reshape(-1, 4))
                total += len(flat[-1])
            first[k, lod] = places[key]
            sizes[k, lod] = texture.shape[2], texture.shape[1]
    texels = torch.cat(flat).reshape(-1).numpy()
    full = sizes[:, 0].astype(np.float64)
    homographies = inverse.detach().double().contiguous().numpy()
    corner = homographies[:, :, 2] @ np.array([0.5 * size[1], 0.5 * size[0], 1.0])
    order = np.ascontiguousarray(np.argsort(-corner, axis=1, kind="stable"))
    copy, columns = _copies(plates, sizes, homographies, level, size, parents)
    out = torch.zeros(views if frames else 1, *size, 4, dtype=torch.float32 if frames else torch.float64)
    nearest = torch.zeros(views if frames else 0, *size)
    textures = Textures(texels, first, sizes, full, np.array(plates.mirror), np.array(plates.infinite))
    shown = Views(homographies, level.numpy(), order, copy, columns)
    work = partial(_render_band, textures, shown, frames, out.numpy(), nearest.numpy())
    run_all(work, row_bands(size[0], BAND))
    mean = out if frames else out / max(views, 1)
    return mean.permute(0, 3, 1, 2).float().contiguous(), nearest[:, None] if frames else nearest.new_zeros(0)


def _copies(
    plates: Plates,
    sizes: np.ndarray,
    homographies: np.ndarray,
    level: Tensor,
    size: tuple[int, int],
    parents: Tensor | None,
) -> tuple[np.ndarray, np.ndarray]:
    """Which renderings are kept for other views, ``(V, K)`` numbers or -1, and the columns each of them takes.

    Those with the most children come first, until `MEMORY` is full.
    """
    views, count = level.shape
    copy = np.full((views, count), -1, np.int64)
    if parents is None:
        return copy, np.zeros((0, 2), np.int64)
    codes = (parents.numpy() * count + np.arange(count)).reshape(-1)
    _, index, member, children = np.unique(codes, return_index=True, return_inverse=True, return_counts=True)
    view, k = index // count, index % count
    lod = level.numpy()[view, k]
    rim = 0.5 * 2.0**lod
    w, h = (sizes[k, lod] * 2.0 ** lod[:, None]).T
    corners = np.stack([np.stack([s, t, np.ones_like(s)], -1) for s in (-rim, w + rim) for t in (-rim, h + rim)], 1)
    matrix = homographies[view, k]
    there = np.abs(np.linalg.det(matrix)) > 0
    points = np.linalg.inv(np.where(there[:, None, None], matrix, np.eye(3)))[:, None] @ corners[..., None]
    z = points[:, :, 2, 0]
    x = points[:, :, 0, 0] / np.where(z == 0, 1, z)
    whole = (z <= 0).any(1) | np.array(plates.mirror)[k]
    low = np.where(whole, 0, np.clip(np.floor(x.min(1)), 0, size[1])).astype(np.int64)
    high = np.where(whole, size[1], np.clip(np.ceil(x.max(1)) + 1, 0, size[1])).astype(np.int64)
    best = np.argsort(-children, kind="stable")
    best = best[(children[best] > 1) & there[best] & (high[best] > low[best])]
    best = best[np.cumsum(high[best] - low[best]) * BAND * 16 <= MEMORY]
    number = np.full(len(index), -1)
    number[best] = np.arange(len(best))
    return number[member.reshape(views, count)], np.stack([low, high - low], 1)[best]
