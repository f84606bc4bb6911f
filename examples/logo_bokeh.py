"""Lights of a night that are out of focus take the shape of a logo: any PNG with an alpha channel, or a star."""

import argparse
import os
from pathlib import Path

import numpy as np
import torch
from PIL import Image

import torchbokeh as tb
from torchbokeh.io.pictures import write_image
from torchbokeh.psfs.build import build
from torchbokeh.psfs.stylized import Stylized


def night(height: int, width: int, radius: float) -> tuple[torch.Tensor, torch.Tensor]:
    """A street by night with a sharp post: image ``(1, 3, H, W)`` and CoC ``(1, 1, H, W)`` in px, up to ``radius``."""
    draw = np.random.default_rng(4)
    y, x = np.mgrid[:height, :width] / height
    image = 0.01 + 0.03 * np.stack([0.5 * y, 0.6 * y, 1.2 - y])
    coc = radius * np.clip((0.95 - y) / 0.35, 0, 1)  # the street comes into focus at the lower border
    colours = np.array([[1.0, 0.75, 0.45], [1.0, 0.9, 0.8], [0.6, 0.8, 1.0], [1.0, 0.35, 0.25]])
    count = 36
    rows, columns = draw.integers(height * 3 // 4, size=count), draw.integers(width, size=count)
    light = colours[draw.integers(len(colours), size=count)] * draw.uniform(0.5, 1.5, (count, 1))
    image[:, rows, columns] += light.T * radius**2
    post = np.abs(x - 0.45) < 0.03
    image[:, post], coc[post] = 0.08 + 0.1 * draw.random((3, post.sum())), 0.0
    return torch.from_numpy(image).float()[None], torch.from_numpy(coc).float()[None, None]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("logo", nargs="?", type=Path, help="a PNG; default: a star")
    parser.add_argument("--out", type=Path, default=Path("out/logo_bokeh.png"))
    parser.add_argument("--radius", type=float, default=24.0, help="largest CoC radius in px, half of the logo")
    parser.add_argument("--workers", type=int, default=os.cpu_count(), help="processes that build the PSFs")
    parser.add_argument("--tiny", action="store_true", help="an eighth of the size, for tests")
    args = parser.parse_args()
    radius, height, width = (3.0, 48, 80) if args.tiny else (args.radius, 384, 640)
    workers = 1 if args.tiny else args.workers

    mask = None
    if args.logo is not None:
        with Image.open(args.logo) as logo:
            logo.thumbnail((256, 256))
            mask = np.array(logo.convert("RGBA"))
    args.out.parent.mkdir(parents=True, exist_ok=True)
    path = args.out.with_suffix(".safetensors")
    bank = build(Stylized(mask, radius=radius), path, workers=workers, progress=not args.tiny)
    print(f"{path}: {len(bank)} PSFs, {len(bank.offsets)} points")

    image, coc = night(height, width, radius)
    write_image(args.out, tb.KernelSplatting(bank=bank, quality="exact")(image, coc))
    print(args.out)


if __name__ == "__main__":
    main()
