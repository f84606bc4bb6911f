"""Row spans beside a dense scatter: the same picture, the same threads, in the same run.

The dense scatter is the obvious one: every pixel adds its disc, point by point, from a table of discs in steps of a
quarter pixel, compiled with numba, in float32 with the four channels interleaved, into one buffer per thread. "By rows"
is the same scatter, written so that the compiler turns each row of a disc into wide vector operations. The spans are
`splat_spans(..., integrate=True)`. Prints a Markdown table: median seconds, their ratio to the first, and the SSIM of
the pictures with the first after division by coverage (on ``clip(x, 0, 1) ** (1/2.2)``).

    python examples/benchmarks/splat_speed.py [--size 1024] [--radius 50] [--repeat 5]
"""

import argparse
import math
import os
import platform
import statistics
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numba as nb
import numpy as np
import skimage
import torch
from skimage.metrics import structural_similarity
from torch import Tensor

from torchbokeh.ops.splat import splat_spans
from torchbokeh.psfs import Disc

STEPS = 4  # discs of the table per pixel of radius


def scene(size: int, radius: float) -> tuple[Tensor, Tensor]:
    """A linear photograph with coverage 1 ``(1, 4, S, S)``, and radii ``(1, 1, S, S)``: a slanted ramp and discs."""
    photo = skimage.transform.resize(skimage.data.astronaut(), (size, size), anti_aliasing=True)
    values = torch.from_numpy(photo.astype(np.float32)).permute(2, 0, 1) ** 2.2
    y, x = torch.meshgrid(*[torch.linspace(0, 1, size)] * 2, indexing="ij")
    radii = radius * (0.8 * x + 0.2 * y)
    for u, v, reach, share in ((0.25, 0.3, 0.12, 1.0), (0.7, 0.25, 0.15, 0.0), (0.6, 0.75, 0.18, 0.5)):
        radii = torch.where((x - u) ** 2 + (y - v) ** 2 < reach**2, radius * share, radii)
    return torch.cat([values, torch.ones(1, size, size)])[None], radii[None, None]


def disc_table(radius: float, stride: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Discs of radius 0, 1/4, 1/2, ... as steps in an interleaved buffer, weights, and cumulative counts."""
    steps, weights, counts = [], [], [0]
    for k in range(math.ceil(radius * STEPS) + 1):
        r = max(k / STEPS, 0.5)
        n = math.floor(r + 0.5)
        column = np.arange(-n, n + 1)
        y = column[:, None] + (np.arange(16) + 0.5) / 16 - 0.5
        half = np.sqrt(np.maximum(r * r - y * y, 0.0))[..., None]
        overlap = np.minimum(half, column + 0.5) - np.maximum(-half, column - 0.5)
        psf = np.maximum(overlap, 0.0).mean(1)
        dy, dx = np.nonzero(psf)
        steps.append(4 * ((dy - n) * stride + dx - n))
        weights.append((psf / psf.sum())[dy, dx])
        counts.append(counts[-1] + len(dy))
    return np.concatenate(steps), np.concatenate(weights).astype(np.float32), np.array(counts)


@nb.njit(nogil=True, fastmath=True)
def _scatter(src, psf, steps, weights, counts, pad, first, stride, out):  # type: ignore[no-untyped-def]
    """Rows ``first, first + stride, ...`` of ``src (H, W, 4)`` into the padded ``out``, flat."""
    height, width = psf.shape
    for y in range(first, height, stride):
        for x in range(width):
            a, b, c, d = src[y, x, 0], src[y, x, 1], src[y, x, 2], src[y, x, 3]
            o = 4 * ((y + pad) * (width + 2 * pad) + x + pad)
            for k in range(counts[psf[y, x]], counts[psf[y, x] + 1]):
                i, w = o + steps[k], weights[k]
                out[i] += w * a
                out[i + 1] += w * b
                out[i + 2] += w * c
                out[i + 3] += w * d


def row_table(steps: np.ndarray, weights: np.ndarray, counts: np.ndarray) -> tuple[np.ndarray, ...]:
    """The same discs as rows: where each starts, its weights repeated for four channels, and cumulative counts."""
    begins = np.flatnonzero(np.diff(steps, prepend=-1) != 4)
    begins = np.union1d(begins, counts[:-1])
    return steps[begins], np.append(begins, len(steps)) * 4, np.repeat(weights, 4), np.searchsorted(begins, counts)


@nb.njit(nogil=True, fastmath=True)
def _scatter_rows(src, psf, steps, ends, weights, counts, pad, first, stride, out):  # type: ignore[no-untyped-def]
    """`_scatter` by rows of discs."""
    height, width = psf.shape
    pixel = np.empty(8 * pad, np.float32)
    for y in range(first, height, stride):
        for x in range(width):
            for k in range(0, len(pixel), 4):
                pixel[k : k + 4] = src[y, x]
            o = 4 * ((y + pad) * (width + 2 * pad) + x + pad)
            for k in range(counts[psf[y, x]], counts[psf[y, x] + 1]):
                n = ends[k + 1] - ends[k]
                target, w = out[o + steps[k] : o + steps[k] + n], weights[ends[k] : ends[k + 1]]
                for i in range(n):
                    target[i] += w[i] * pixel[i]


def dense_scatter(
    kernel: Callable[..., None], table: tuple[np.ndarray, ...], values: Tensor, radii: Tensor, pad: int
) -> Tensor:
    """Every pixel adds its disc; ``values (1, 4, H, W)``, radii rounded to the discs of the table."""
    src = values[0].permute(1, 2, 0).contiguous().numpy()
    psf = (radii[0, 0] * STEPS).round().long().numpy()
    height, width = psf.shape
    threads = torch.get_num_threads()
    buffers = [np.zeros((height + 2 * pad) * (width + 2 * pad) * 4, np.float32) for _ in range(threads)]
    with ThreadPoolExecutor(threads) as pool:
        done = [pool.submit(kernel, src, psf, *table, pad, k, threads, out) for k, out in enumerate(buffers)]
        for part in done:
            part.result()
    out = torch.from_numpy(sum(buffers[1:], buffers[0])).reshape(height + 2 * pad, width + 2 * pad, 4)
    return out[pad : pad + height, pad : pad + width].permute(2, 0, 1)[None]


def display(blurred: Tensor) -> np.ndarray:
    """``(1, 4, H, W)`` as the picture a screen shows, ``(H, W, 3)``."""
    picture = (blurred[0, :3] / blurred[0, 3:]).clamp(0, 1) ** (1 / 2.2)
    return picture.permute(1, 2, 0).numpy()


def there_and_back(values: Tensor, radii: Tensor) -> Tensor:
    """The splat, and its gradients to the values and the radii."""
    leaves = values.clone().requires_grad_(), radii.clone().requires_grad_()
    out = splat_spans(*leaves, Disc().profile(), integrate=True)
    out.square().sum().backward()
    return out.detach()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=1024, help="side of the picture in pixels")
    parser.add_argument("--radius", type=float, default=50.0, help="largest radius in pixels")
    parser.add_argument("--repeat", type=int, default=5, help="timed runs of each way")
    parser.add_argument("--tiny", action="store_true", help="64 pixels, radius 6, one run")
    options = parser.parse_args()
    size, radius, repeat = (64, 6.0, 1) if options.tiny else (options.size, options.radius, options.repeat)

    values, radii = scene(size, radius)
    pad = math.ceil(radius) + 1
    table = disc_table(radius, size + 2 * pad)
    ways: dict[str, Callable[[], Tensor]] = {
        "dense scatter": partial(dense_scatter, _scatter, table, values, radii, pad),
        "dense scatter by rows": partial(dense_scatter, _scatter_rows, row_table(*table), values, radii, pad),
        "`splat_spans`": partial(splat_spans, values, radii, Disc().profile(), integrate=True),
        "`splat_spans`, forward and backward": partial(there_and_back, values, radii),
    }
    pictures = [display(run()) for run in ways.values()]  # compiles as well
    seconds: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(repeat):
        for name, run in ways.items():
            start = time.perf_counter()
            run()
            seconds[name].append(time.perf_counter() - start)

    medians = [statistics.median(s) for s in seconds.values()]
    mean = np.diff(table[2])[(radii * STEPS).round().long().numpy()].mean()
    print(f"{size} x {size} RGBA float32, radius 0 to {radius:g} px, {mean:.0f} pixels per disc, median of {repeat}\n")
    print("| way | seconds | times faster | SSIM |")
    print("| --- | --- | --- | --- |")
    for name, median, picture in zip(ways, medians, pictures, strict=True):
        ssim = structural_similarity(pictures[0], picture, channel_axis=2, data_range=1.0)
        print(f"| {name} | {median:.4f} | {medians[0] / median:.1f} | {ssim:.4f} |")
    print()
    print(
        f"{platform.platform()}, {platform.machine()}, {os.cpu_count()} processors, {torch.get_num_threads()} threads; "
        f"Python {platform.python_version()}, torch {torch.__version__}, numba {nb.__version__}"
    )


if __name__ == "__main__":
    main()
