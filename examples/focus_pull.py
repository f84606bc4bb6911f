"""Rack the focus through a photograph, from its front to its back and again to the front, as an animated GIF."""

import argparse
import math
from pathlib import Path

from PIL import Image
from tqdm import tqdm

import torchbokeh as tb
from torchbokeh.commands.demo import motorcycle, motorcycle_lens
from torchbokeh.io.pictures import encode_srgb, replacing

NEAR, FAR = 2.1, 4.8  # metres: the turn signal, the wall


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/focus_pull.gif"))
    parser.add_argument("--frames", type=int, default=24, help="from the front to the back, at least 2")
    parser.add_argument("--scale", type=float, default=0.5, help="1 is 741 x 500 pixels")
    parser.add_argument("--tiny", action="store_true", help="3 frames at a tenth of the size, for tests")
    args = parser.parse_args()
    if args.frames < 2:
        parser.error("--frames: expected at least 2")
    frames, scale = (3, 0.1) if args.tiny else (args.frames, args.scale)

    image, depth = motorcycle(scale)
    # One palette for all frames, taken from the sharp picture, keeps the still parts from flickering.
    palette = Image.fromarray(encode_srgb(image, 8)).quantize(256)
    pull = []
    for i in tqdm(range(frames), disable=None):
        # Even steps in 1/distance are even steps in blur; the cosine starts and stops gently.
        t = (1 - math.cos(math.pi * i / (frames - 1))) / 2
        blur = tb.LensBlur(motorcycle_lens(1 / ((1 - t) / NEAR + t / FAR)))
        pull.append(Image.fromarray(encode_srgb(blur(image, depth), 8)).quantize(palette=palette))
    args.out.parent.mkdir(parents=True, exist_ok=True)
    with replacing(args.out) as temporary:
        first, *rest = pull + pull[-2:0:-1]
        first.save(temporary, format="GIF", save_all=True, append_images=rest, duration=60, loop=0)
    print(f"{args.out}: {len(rest) + 1} frames of {image.shape[3]} x {image.shape[2]}")


if __name__ == "__main__":
    main()
