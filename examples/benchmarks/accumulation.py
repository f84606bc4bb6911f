"""The accumulation buffer: noise of the ground truth, its three techniques against brute force, cost of a sample.

Prints three Markdown tables and draws one plot:

* floor: for every recipe, SSIM and PSNR between two independent renders of as many views. It is the best score that
  any other method could show against such a truth.
* techniques: on `stack`, `fence` and `whirl`, what each technique gives for its time, what it gives in the time of
  brute force, and how many times faster than brute force it reaches the same SSIM. The truth is brute force with many
  views. Figures 3.9 and 3.10 of the defocus and bokeh dissertation show the same for a GPU.
* samples: seconds of one core for a training sample, with each technique off and on, and samples per second of two
  workers.

SSIM and PSNR are of ``clip(x, 0, 1) ** (1/2.2)``. One thread, so that times are those of one core; medians.

    python examples/benchmarks/accumulation.py [--parts floor,techniques,samples] [--out FOLDER]
"""

import argparse
import platform
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from skimage.metrics import peak_signal_noise_ratio, structural_similarity
from torch import Tensor
from torch.utils.data import DataLoader

from torchbokeh import AccumulationBuffer
from torchbokeh.io.pictures import write_image
from torchbokeh.scenes import RECIPES, Camera, ProceduralDataset, Scene

SCENES = ("stack", "fence", "whirl")
METHODS: dict[str, dict[str, Any]] = {
    "brute force": {},
    "level of detail, as in the text": {"level_of_detail": 1.0},
    "level of detail, 2 / views": {"level_of_detail": "auto"},
    "reuse, grid 1": {"reuse": 1},
    "reuse, grid 2": {"reuse": 2},
    "4 sub-samples": {"subsamples": 4},
    "8 sub-samples": {"subsamples": 8},
    "level of detail and reuse": {"level_of_detail": "auto", "reuse": 2},
    "all three": {"level_of_detail": "auto", "reuse": 2, "subsamples": 4},
}
PAIRS = ((16, 8), (32, 4), (64, 0))


def score(picture: Tensor, truth: Tensor) -> tuple[float, float]:
    """SSIM and PSNR of the displayed pictures."""
    shown, wanted = ((t[0, :3].clamp(0, 1) ** (1 / 2.2)).permute(1, 2, 0).numpy() for t in (picture, truth))
    ssim = structural_similarity(shown, wanted, channel_axis=-1, data_range=1)
    return float(ssim), float(peak_signal_noise_ratio(wanted, shown, data_range=1))


def timed(work: Callable[[], Tensor], repeat: int) -> tuple[Tensor, float]:
    """The result, and the median seconds of ``repeat`` runs, or of fewer where they take long."""
    seconds: list[float] = []
    while len(seconds) < repeat and sum(seconds) < 2:
        start = time.perf_counter()
        result = work()
        seconds.append(time.perf_counter() - start)
    return result, statistics.median(seconds)


def floor(size: tuple[int, int], counts: list[int]) -> None:
    """Noise of the truth: two independent renders of every recipe."""
    blur = 0.05 * size[1]
    print(f"\nTwo independent renders, {size[1]} x {size[0]}, CoC radius up to {blur:.0f} px: SSIM / PSNR.\n")
    print("| recipe | " + " | ".join(f"{n} views" for n in counts) + " |\n| --- |" + " --- |" * len(counts))
    for name, recipe in RECIPES.items():
        scene, camera = recipe(0, size, blur)
        cells = []
        for n in counts:
            ssim, psnr = score(*(AccumulationBuffer(views=n, seed=seed)(scene, camera) for seed in (1, 2)))
            cells.append(f"{ssim:.4f} / {psnr:.1f}")
        print(f"| `{name}` | " + " | ".join(cells) + " |", flush=True)


def techniques(size: tuple[int, int], counts: list[int], truth: int, repeat: int, out: Path) -> None:
    """Quality against time of every technique."""
    blur = 0.08 * size[1]
    print(f"\n{size[1]} x {size[0]}, CoC radius up to {blur:.0f} px, truth of {truth} views.")
    curves: dict[str, dict[str, list[tuple[int, float, float]]]] = {}
    for name in SCENES:
        scene, camera = RECIPES[name](0, size, blur)
        want = AccumulationBuffer(views=truth, seed=7)(scene, camera)
        write_image(out / f"{name}, truth.png", want[:, :3])
        curves[name] = {
            method: [(n, *_point(scene, camera, want, repeat, views=n, **settings)) for n in counts]
            for method, settings in METHODS.items()
        }
        print(f"\n`{name}`, {len(scene)} cards: SSIM (seconds)\n")
        brute = curves[name]["brute force"]
        budget = brute[len(brute) // 2]
        head = f"SSIM in the time of {budget[0]} brute views | times faster at equal SSIM |"
        print("| technique | " + " | ".join(f"N = {n}" for n in counts) + f" | {head}")
        print("| --- |" + " --- |" * (len(counts) + 2))
        for method, points in curves[name].items():
            cells = [f"{ssim:.4f} ({seconds:.3f})" for _, seconds, ssim in points]
            print(f"| {method} | {' | '.join(cells)} | {_in_time(points, budget[1])} | {_faster(brute, points)} |")
        print("\n| (N, S) | SSIM | seconds |\n| --- | --- | --- |")
        for n, s in PAIRS:
            seconds, ssim = _point(scene, camera, want, repeat, views=n, subsamples=s)
            print(f"| ({n}, {s}) | {ssim:.4f} | {seconds:.3f} |", flush=True)
    _plot(curves, out / "techniques.png")


def _point(scene: Scene, camera: Camera, want: Tensor, repeat: int, **settings: Any) -> tuple[float, float]:
    buffer = AccumulationBuffer(**settings)
    picture, seconds = timed(lambda: buffer(scene, camera), repeat)
    return seconds, score(picture, want)[0]


def _in_time(points: list[tuple[int, float, float]], budget: float) -> str:
    """The SSIM of a technique in the given seconds, between its points in the logarithms of time and of 1 - SSIM."""
    _, seconds, ssim = (np.array(column) for column in zip(*points, strict=True))
    if not seconds[0] <= budget <= seconds[-1]:
        return "-"
    return f"{1 - np.exp(np.interp(np.log(budget), np.log(seconds), np.log1p(-ssim))):.4f}"


def _faster(brute: list[tuple[int, float, float]], points: list[tuple[int, float, float]]) -> str:
    """The largest ratio of seconds at the SSIM of one of the points, between those of brute force as above."""
    _, seconds, ssim = (np.array(column) for column in zip(*brute, strict=True))
    reached = [(own, q) for _, own, q in points if ssim[0] <= q <= ssim[-1]]
    ratios = [np.exp(np.interp(-np.log1p(-q), -np.log1p(-ssim), np.log(seconds))) / own for own, q in reached]
    beyond = max(q for *_, q in points) > ssim[-1]
    return f"{max(ratios, default=0.0):.1f}" + (", and beyond" if beyond else "")


def _plot(curves: dict[str, dict[str, list[tuple[int, float, float]]]], path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(16, 4.5), layout="constrained")
    for axes, (name, methods) in zip(figure.subplots(1, len(curves)), curves.items(), strict=True):
        for method, points in methods.items():
            axes.plot([s for _, s, _ in points], [1 - q for *_, q in points], "o-", label=method, markersize=4)
        axes.set(xscale="log", yscale="log", title=name, xlabel="seconds, one core", ylabel="1 - SSIM")
        axes.grid(alpha=0.3, which="both")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside right upper", fontsize=9)
    figure.savefig(path, dpi=80)
    print(f"\n{path}")


def samples(size: tuple[int, int], views: int, count: int) -> None:
    """What a training sample costs."""
    kinds = [name for name in RECIPES if name != "stack"]
    print(f"\nA sample of about ten cards, {size[1]} x {size[0]}, {views} views, all recipes but `stack`.\n")
    print("| technique | seconds of one core, median | slowest |\n| --- | --- | --- |")
    for method, settings in METHODS.items():
        data = ProceduralDataset(0, size, recipes=kinds)
        data.target = {"views": views, **settings}
        seconds = []
        for i in range(count):
            start = time.perf_counter()
            data[i]
            seconds.append(time.perf_counter() - start)
        print(f"| {method} | {statistics.median(seconds):.2f} | {max(seconds):.2f} |", flush=True)
    loader = DataLoader(ProceduralDataset(1, size, views=views, recipes=kinds, length=3 * count), num_workers=2)
    stream = iter(loader)
    next(stream)  # starting the workers is not what is measured
    start = time.perf_counter()
    made = sum(1 for _ in stream)
    print(f"\nTwo workers: {made / (time.perf_counter() - start):.2f} samples per second.")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--parts", default="floor,techniques,samples", help="which tables, separated by commas")
    parser.add_argument("--out", type=Path, default=Path("out/accumulation"), help="folder for pictures and the plot")
    parser.add_argument("--tiny", action="store_true", help="a few seconds, for the tests")
    args = parser.parse_args()
    torch.set_num_threads(1)
    args.out.mkdir(parents=True, exist_ok=True)
    print(f"{platform.processor() or platform.machine()}, torch {torch.__version__}, one thread")
    for part in args.parts.split(","):
        if part == "floor":
            floor(*(((24, 32), [4, 8]) if args.tiny else ((256, 256), [256, 1024, 4096])))
        elif part == "techniques":
            wide = ((24, 32), [4, 8], 16, 1) if args.tiny else ((288, 384), [8, 16, 32, 64, 128, 256, 512], 4096, 5)
            techniques(*wide, args.out)
        elif part == "samples":
            samples(*(((24, 32), 4, 2) if args.tiny else ((256, 256), 256, 20)))
        else:
            parser.error(f"--parts: expected floor, techniques and samples, got {part}")


if __name__ == "__main__":
    main()
