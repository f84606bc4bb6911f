"""numba kernels of `splat_spans` for CPU float32: the same numbers as the torch definition, faster.

Pixels are interleaved in fours (RGB and coverage, say), so that one vector operation adds a pixel to two
neighbouring columns. Weights and sums are double: bright pixels leave nothing behind on their row. Work is cut into
bands of output rows whose height does not depend on the number of threads, and each band visits its pixels in
the same order: the result has the same bits for every thread count.
"""

import numba as nb
import numpy as np
import torch
from torch import Tensor

from torchbokeh.ops.kernels.interleave import interleave, separate
from torchbokeh.ops.kernels.outline import at_rows, clamped, draw_arc, psf_buffer, psf_room, rows_to_draw, shape_of
from torchbokeh.ops.kernels.rows import draw_points, gather_points, rows_above, rows_within
from torchbokeh.ops.spans import MIN_RADIUS, Profile
from torchbokeh.ops.system.threads import row_bands, run_all

BAND = 64
"""Rows of a band: 64 rows of 1024 interleaved double pixels fill the second-level cache of common processors."""

TALL, LARGE = 256, 16.0
"""Rows of a band at most where radii are as large as this in px: what a band cuts is drawn once for each."""


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _splat_band(src, coc, reach, shape, integrate, y0, y1, out):  # type: ignore[no-untyped-def]
    """Splat every pixel that reaches rows ``y0 .. y1-1``; write the band of ``out (4, H, W)``."""
    height, width = coc.shape
    stride = 4 * (width + 2)
    band = np.zeros((y1 - y0) * stride, np.float64)
    buffer, borders, ends, even, level = psf_buffer(y1 - y0, width), (0, width), shape.ends, shape.even, shape.level
    room, starts, points = psf_room(shape, buffer), buffer.starts, buffer.points
    for y in range(height):
        if y + reach[y] + 1.0 < y0 or y - reach[y] - 1.0 > y1:
            continue
        for x in range(width):
            p = 4 * (y * width + x)
            if src[p] == 0.0 and src[p + 1] == 0.0 and src[p + 2] == 0.0 and src[p + 3] == 0.0:
                continue
            c = clamped(np.float64(coc[y, x]))
            first, n = rows_to_draw(c, y, y0, y1, ends, level)
            if n <= 0:
                continue
            at_rows(c, (first, n), room)
            for arc in range(2 if even else 0, 4):
                k, m = draw_arc(arc, c, (x, first, n), borders, room, False)
                k, o = first + k, (y - y0) * stride
                if level and k == 0 and m > 0 and y - m >= y0 and y + m <= y1:
                    draw_points(band, (o, -1), stride, (src, p), points, (starts[0], starts[1]), even)
                    draw_points(band, (o, o), stride, (src, p), points, (starts[1], starts[m]), even)
                elif m > 0:
                    i, j = rows_within(y + k, m, y0, y1)
                    draw_points(band, (o + k * stride, -1), stride, (src, p), points, (starts[i], starts[j]), even)
                    if level:
                        i, j = rows_above(k, y, m, y0, y1)
                        span = starts[i], starts[j]
                        draw_points(band, (o - k * stride, -1), -stride, (src, p), points, span, even)
    for y in range(y0, y1):
        o = (y - y0) * stride
        s0 = s1 = s2 = s3 = 0.0
        for x in range(width):
            if integrate:
                s0 += band[o]
                s1 += band[o + 1]
                s2 += band[o + 2]
                s3 += band[o + 3]
            else:
                s0, s1, s2, s3 = band[o], band[o + 1], band[o + 2], band[o + 3]
            out[0, y, x], out[1, y, x], out[2, y, x], out[3, y, x] = s0, s1, s2, s3
            o += 4


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _gather_band(src, coc, shape, grad, y0, y1, grad_src, grad_coc):  # type: ignore[no-untyped-def]
    """Adjoint of the splat for the pixels of rows ``y0 .. y1-1``.

    ``grad (H, W+2, 4)`` is the gradient of the differences. Adds to ``grad_src (H*W*4)``, ``grad_coc (H, W)``.
    """
    height, width = coc.shape
    stride, flat = 4 * (width + 2), grad.reshape(-1)
    buffer, borders, ends, even, level = psf_buffer(height, width), (0, width), shape.ends, shape.even, shape.level
    room, starts, points = psf_room(shape, buffer), buffer.starts, buffer.points
    found = np.empty(8, np.float64)
    for y in range(y0, y1):
        for x in range(width):
            p = 4 * (y * width + x)
            c = clamped(np.float64(coc[y, x]))
            first, n = rows_to_draw(c, y, 0, height, ends, level)
            n = max(n, 0)
            found[:] = 0.0
            at_rows(c, (first, n), room)
            for arc in range(2 if even else 0, 4):
                k, m = draw_arc(arc, c, (x, first, n), borders, room, True)
                k += first
                if m > 0:
                    i, j = rows_within(y + k, m, 0, height)
                    gather_points(flat, (y + k) * stride, stride, points, (starts[i], starts[j]), even, found)
                    if level:
                        i, j = rows_above(k, y, m, 0, height)
                        gather_points(flat, (y - k) * stride, -stride, points, (starts[i], starts[j]), even, found)
            slope = 0.0
            for k in range(4):
                grad_src[p + k] = found[k]
                slope += found[4 + k] * src[p + k]
            if abs(c) > MIN_RADIUS:
                grad_coc[y, x] += slope if c > 0.0 else -slope


def splat_spans(values: Tensor, coc: Tensor, profile: Profile, integrate: bool) -> Tensor:
    """`torchbokeh.ops.splat.splat_spans` for CPU float32."""
    b, c, h, w = values.shape
    groups = -(-c // 4)
    shape = shape_of(profile)
    src = interleave(values.detach()).numpy()
    coc_np = coc.detach().contiguous().numpy()
    extent = max(abs(shape.tables[0, 0, 0]), abs(shape.tables[0, -1, 0]))
    reach = (coc.detach().abs().amax((1, 3)).clamp_min(MIN_RADIUS) * extent).numpy()
    out = torch.empty(b * groups, 4, h, w, dtype=torch.float32)
    out_np = out.numpy()

    def work(k: int, y0: int, y1: int) -> None:
        n = k // groups
        flat = src[k].reshape(-1)
        _splat_band(flat, coc_np[n, 0], reach[n], shape, integrate, y0, y1, out_np[k])

    rows = BAND if reach.max() < LARGE else min(max(BAND, h // 6), TALL)
    run_all(work, [(k, y0, y1) for k in range(b * groups) for y0, y1 in row_bands(h, rows)])
    return out.reshape(b, 4 * groups, h, w)[:, :c].contiguous()


def gather_spans(grad: Tensor, values: Tensor, coc: Tensor, profile: Profile) -> tuple[Tensor, Tensor]:
    """Adjoint: gradient ``(B, C, H, W)`` of the differences to the gradients of ``values`` and ``coc``."""
    b, c, h, w = values.shape
    groups = -(-c // 4)
    shape = shape_of(profile)
    src = interleave(values.detach()).numpy()
    differences = torch.nn.functional.pad(interleave(grad.double()), (0, 0, 0, 2)).numpy()
    coc_np = coc.detach().contiguous().numpy()
    grad_src = torch.empty(src.shape, dtype=torch.float32)
    grad_coc = torch.zeros(groups, b, 1, h, w, dtype=torch.float64)
    grad_src_np, grad_coc_np = grad_src.numpy(), grad_coc.numpy()

    def work(k: int, y0: int, y1: int) -> None:
        n = k // groups
        _gather_band(
            *(src[k].reshape(-1), coc_np[n, 0], shape, differences[k], y0, y1),
            *(grad_src_np[k].reshape(-1), grad_coc_np[k % groups, n, 0]),
        )

    run_all(work, [(k, y0, y1) for k in range(b * groups) for y0, y1 in row_bands(h, BAND)])
    return separate(grad_src, c), grad_coc.sum(0).to(coc.dtype)
