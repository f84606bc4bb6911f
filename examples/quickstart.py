"""Blur a photograph by its depth, in five lines of torchbokeh."""

import argparse
from pathlib import Path

import torchbokeh as tb
from torchbokeh.commands.demo import motorcycle
from torchbokeh.io.pictures import write_image

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--out", type=Path, default=Path("out/quickstart.png"))
parser.add_argument("--tiny", action="store_true", help="a tenth of the size, for tests")
args = parser.parse_args()

image, depth = motorcycle(scale=0.1 if args.tiny else 1.0)  # (1, 3, H, W) linear, (1, 1, H, W) metres
lens = tb.ThinLens(focal_length=0.0483, f_number=0.3, focus_distance=2.3, sensor_width=0.036)
blur = tb.LensBlur(lens)
print(blur.plan(image, depth))
args.out.parent.mkdir(parents=True, exist_ok=True)
write_image(args.out, blur(image, depth))
print(args.out)
