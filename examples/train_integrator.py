"""Train the kernels of the integration network, and compare them with the published ones and the FFT.

Prints two Markdown tables: relative L1 error of each kind of picture, and far field, on pictures and sizes it has not
seen; and run time. The weights that come with the package are those of a full run.
"""

import argparse
import statistics
import time
from pathlib import Path

import torch
from safetensors.torch import save_file
from tqdm import tqdm

import torchbokeh as tb
from torchbokeh.io.pictures import replacing
from torchbokeh.learn.training import KINDS, LEVELS, SIZES, fit_integrator, laplacian_pictures, relative_errors


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("out/pyramid.safetensors"))
    parser.add_argument("--levels", type=int, default=LEVELS, help="levels with kernels of their own")
    parser.add_argument("--steps", type=int, default=30)
    parser.add_argument("--tiny", action="store_true", help="small, for tests")
    args = parser.parse_args()
    steps, sizes, learned = (1, (24,), (16,)) if args.tiny else (args.steps, (96, 250, 517), SIZES)

    with tqdm(fit_integrator(args.levels, steps, sizes=learned), total=steps) as progress:
        for loss, pyramid in progress:
            trained = pyramid
            progress.set_postfix(loss=f"{loss:.4f}")
    args.out.parent.mkdir(parents=True, exist_ok=True)
    with replacing(args.out) as temporary:
        save_file({name: kernel.detach().float() for name, kernel in trained.named_parameters()}, temporary)
    print(args.out)

    ways = {"published": tb.PyramidIntegrator("published"), "trained": trained.float(), "FFT": tb.FFTIntegrator()}
    print("\n| size | kernels |", " | ".join(f"{kind}: L1 | far" for kind in KINDS), "| seconds |")
    print("| --- " * (3 + 2 * len(KINDS)) + "|")
    for size in sizes:
        for name, way in ways.items():
            found = [relative_errors(way, laplacian_pictures(kind, 4, size, 10_000).float()) for kind in KINDS]
            buffer, taken = torch.rand(1, 4, size, size), []
            with torch.inference_mode():
                for _ in range(6):
                    start = time.perf_counter()
                    way(buffer)
                    taken.append(time.perf_counter() - start)
            cells = [f"{value:.4f}" for pair in found for value in pair]
            print(f"| {size} | {name} |", " | ".join(cells), f"| {statistics.median(taken[1:]):.4f} |")


if __name__ == "__main__":
    main()
