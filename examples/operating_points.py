"""One picture at every quality: how long it takes, how far it is from the exact one, and all of them in one PNG."""

import argparse
import time
from pathlib import Path

import torch

import torchbokeh as tb
from torchbokeh.commands.demo import motorcycle, motorcycle_lens
from torchbokeh.io.pictures import write_image
from torchbokeh.plan.quality import QUALITIES

FOCUS = 2.1  # metres: the turn signal


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/operating_points.png"))
    parser.add_argument("--scale", type=float, default=1.0, help="1 is 741 x 500 pixels")
    parser.add_argument("--tiny", action="store_true", help="a tenth of the size, for tests")
    args = parser.parse_args()
    image, depth = motorcycle(0.1 if args.tiny else args.scale)
    lens = motorcycle_lens(FOCUS)

    pictures = []
    for quality in QUALITIES:
        blur = tb.LensBlur(lens, quality=quality.name)
        plan = blur.plan(image, depth)
        blur(image, depth, plan=plan)  # compiles
        start = time.perf_counter()
        pictures.append(blur(image, depth, plan=plan))
        seconds = time.perf_counter() - start
        error = ((pictures[-1] - pictures[0]).abs().sum() / pictures[0].abs().sum()).item()
        print(f"{quality.name:9} {1e3 * seconds:7.1f} ms, relative error {error:.4f}")
    print(tb.LensBlur(lens, tolerance=0.01).plan(image, depth))

    top, bottom = torch.cat(pictures[:2], 3), torch.cat(pictures[2:], 3)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    write_image(args.out, torch.cat([top, bottom], 2))
    print(args.out)


if __name__ == "__main__":
    main()
