"""One layer, forward and backward, beside a dense scatter: the same picture, the same threads, in the same run.

The dense scatters are those of `torchbokeh report`, compiled with numba: every pixel adds its disc, point by point or
row by row. `KernelSplatting` is measured at exact and at balanced quality, with and without the gradients to image and
radii. Prints a Markdown table: median seconds, their ratio to the first, and the SSIM of the pictures with the first
(on ``clip(x, 0, 1) ** (1/2.2)``).

    python examples/benchmarks/splat_speed.py [--size 1024] [--radius 50] [--repeat 5]
"""

import argparse
import os
import platform
import statistics
import time
from collections.abc import Callable
from functools import partial

import numba as nb
import numpy as np
import skimage
import torch
from skimage.metrics import structural_similarity
from torch import Tensor

from torchbokeh import KernelSplatting
from torchbokeh.report.speed.scatter import dense_scatter


def scene(size: int, radius: float) -> tuple[Tensor, Tensor]:
    """A linear photograph ``(1, 3, S, S)``, and radii ``(1, 1, S, S)``: a slanted ramp and discs."""
    photo = skimage.transform.resize(skimage.data.astronaut(), (size, size), anti_aliasing=True)
    values = torch.from_numpy(photo.astype(np.float32)).permute(2, 0, 1) ** 2.2
    y, x = torch.meshgrid(*[torch.linspace(0, 1, size)] * 2, indexing="ij")
    radii = radius * (0.8 * x + 0.2 * y)
    for u, v, reach, share in ((0.25, 0.3, 0.12, 1.0), (0.7, 0.25, 0.15, 0.0), (0.6, 0.75, 0.18, 0.5)):
        radii = torch.where((x - u) ** 2 + (y - v) ** 2 < reach**2, radius * share, radii)
    return values[None], radii[None, None]


def display(blurred: Tensor) -> np.ndarray:
    """``(1, 3, H, W)`` as the picture a screen shows, ``(H, W, 3)``."""
    return (blurred[0].clamp(0, 1) ** (1 / 2.2)).permute(1, 2, 0).numpy()


def there_and_back(splatting: KernelSplatting, image: Tensor, radii: Tensor) -> Tensor:
    """The splat, and its gradients to the image and the radii."""
    leaves = image.clone().requires_grad_(), radii.clone().requires_grad_()
    out = splatting(*leaves)
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

    image, radii = scene(size, radius)
    ways: dict[str, Callable[[], Tensor]] = {
        "dense scatter": partial(dense_scatter, image, radii, by_rows=False),
        "dense scatter by rows": partial(dense_scatter, image, radii),
    }
    for quality in ("exact", "balanced"):
        splatting = KernelSplatting(quality=quality)
        ways[f"`{quality}`"] = partial(splatting, image, radii)
        ways[f"`{quality}`, forward and backward"] = partial(there_and_back, splatting, image, radii)
    pictures = [display(run()) for run in ways.values()]  # compiles as well
    seconds: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(repeat):
        for name, run in ways.items():
            start = time.perf_counter()
            run()
            seconds[name].append(time.perf_counter() - start)

    medians = [statistics.median(s) for s in seconds.values()]
    print(f"{size} x {size} RGB float32, radius 0 to {radius:g} px, median of {repeat}\n")
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
