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


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _render_band(textures, shown, each, out, nearest, y0, y1):  # type: ignore[no-untyped-def]
    """Render rows ``y0 .. y1`` of every view; add to ``out[0]``, or write to ``out[v]`` and ``nearest[v]``.

    One long function: to hand arrays on within its loops would take longer than the work itself, see above.
    """
    texels, first, sizes, full, mirror, infinite = textures
    inverse, level, order, copy, columns = shown
    views, count = level.shape
    width = out.shape[2]
    begin = np.empty(count, np.int64)
    end = np.empty(count, np.int64)
    lines = np.empty((count, 6), np.float64)
    depths = np.empty(count, np.float64)
    met = np.empty(count, np.int64)
    active = np.empty(count, np.int64)
    cuts = np.zeros(width + 1, np.bool_)
    rgba = np.empty(4, np.float32)
    total = np.empty(4, np.float32)
    # Copies of what several views share: a strip of BAND rows for each, its columns `columns[c, 0]` and on.
    starts = np.zeros(len(columns) + 1, np.int64)
    for c in range(len(columns)):
        starts[c + 1] = starts[c] + columns[c, 1] * (y1 - y0)
    copies = np.empty((starts[-1], 4), np.float32)
    filled = np.zeros(starts[-1], np.bool_)
    for v in range(views):
        slot = v if each else 0
        for y in range(y0, y1):
            centre = y + 0.5
            found = 0
            cuts[:] = False
            for m in range(count):
                k = order[v, m]
                for c in range(3):
                    # The value at x = 0.5, the centre of the first pixel, and the step from pixel to pixel.
                    step = inverse[v, k, c, 0]
                    lines[k, 2 * c] = inverse[v, k, c, 1] * centre + inverse[v, k, c, 2] + 0.5 * step
                    lines[k, 2 * c + 1] = step
                start, slope = lines[k, 4], lines[k, 5]
                low, high = _cut(start, slope, -1.0, float(width))
                if not mirror[k]:
                    lod = level[v, k]
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
            left_end = 0
            while left_end < width:
                right_end = left_end + 1
                while right_end < width and not cuts[right_end]:
                    right_end += 1
                n = 0
                for m in range(found):
                    k = met[m]
                    if begin[k] <= left_end and end[k] >= right_end:
                        active[n] = k
                        n += 1
                        depths[k] = 0.0 if infinite[k] else lines[k, 4] + lines[k, 5] * left_end
                _sort(active, n, depths)
                for m in range(n):
                    k = active[m]
                    depths[k] = 0.0 if infinite[k] else lines[k, 4] + lines[k, 5] * (right_end - 1)
                settled = True
                for m in range(1, n):
                    k, other = active[m], active[m - 1]
                    if depths[other] < depths[k] or (depths[other] == depths[k] and other > k):
                        settled = False
                for x in range(left_end, right_end):
                    if not settled:
                        for m in range(n):
                            k = active[m]
                            depths[k] = 0.0 if infinite[k] else lines[k, 4] + lines[k, 5] * x
                        _sort(active, n, depths)
                    left = np.float32(1.0)
                    most = np.float32(0.0)
                    seen = 0.0
                    for c in range(4):
                        total[c] = 0.0
                    for m in range(n):
                        k = active[m]
                        kept = copy[v, k]
                        place = 0
                        if kept >= 0:
                            place = starts[kept] + (y - y0) * columns[kept, 1] + x - columns[kept, 0]
                        if kept >= 0 and filled[place]:
                            for c in range(4):
                                rgba[c] = copies[place, c]
                        else:
                            z = lines[k, 4] + lines[k, 5] * x
                            scale = 1.0 / z
                            s = (lines[k, 0] + lines[k, 1] * x) * scale
                            t = (lines[k, 2] + lines[k, 3] * x) * scale
                            # Rounding at the end of an interval; NaN fails too.
                            if not (z > 0.0 and abs(s) < 1e15 and abs(t) < 1e15):
                                continue
                            lod = level[v, k]
                            tall, wide = sizes[k, lod, 1], sizes[k, lod, 0]
                            scale = 1.0 / (1 << lod)
                            rim = 1.0
                            if mirror[k]:
                                rim = 0.0
                                s = _reflected(s, full[k, 0])
                                t = _reflected(t, full[k, 1])
                            s = min(max(s * scale - 0.5, -rim), wide - 1.0 + 0.999999 * rim) + 1.0
                            t = min(max(t * scale - 0.5, -rim), tall - 1.0 + 0.999999 * rim) + 1.0
                            i, j = int(s), int(t)  # not negative: the floor
                            p = 4 * (first[k, lod] + j * (wide + 2) + i)
                            q = p + 4 * (wide + 2)
                            f, g = np.float32(s - i), np.float32(t - j)
                            for c in range(4):
                                top = texels[p + c] + f * (texels[p + 4 + c] - texels[p + c])
                                bottom = texels[q + c] + f * (texels[q + 4 + c] - texels[q + c])
                                rgba[c] = top + g * (bottom - top)
                            if kept >= 0:
                                filled[place] = True
                                for c in range(4):
                                    copies[place, c] = rgba[c]
                        for c in range(4):
                            total[c] += left * rgba[c]
                        if each and left * rgba[3] > most:
                            most = left * rgba[3]
                            seen = 0.0 if infinite[k] else lines[k, 4] + lines[k, 5] * x
                        left *= np.float32(1.0) - rgba[3]
                        if left < SOLID:
                            break
                    for c in range(4):
                        out[slot, y, x, c] += total[c]
                    if each:
                        nearest[slot, y, x] = seen if most > left else 0.0
                left_end = right_end


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
