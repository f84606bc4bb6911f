"""The command ``torchbokeh render``: blur a picture by its depth."""

import argparse
import time
from pathlib import Path

import torch
from torch import Tensor

from torchbokeh.commands.arguments import count, finite, stops
from torchbokeh.commands.picture_flags import (
    add_picture_flags,
    check_same_size,
    read_picture,
    refuse_overwriting,
    refuse_unused_flags,
)
from torchbokeh.io.flow import read_flow
from torchbokeh.io.pictures import check_writable, write_image


def add_render(parser: argparse.ArgumentParser) -> None:
    """Add the command's flags to its parser, and what it does."""
    add_picture_flags(parser)
    add = parser.add_argument
    add("-o", "--output", type=Path, metavar="OUT", required=True, help="PNG, TIFF (16 bits) or EXR")
    add("--dispersion", type=finite, metavar="STRENGTH", help="colours focused apart: 1 is a single lens (default 0)")
    add("--lateral", type=finite, metavar="STRENGTH", help="colours of unlike size toward the border (default 0)")
    add("--glass", metavar="NAME", help="what disperses the colours (default BK7)")
    add("--spectrum", choices=("rgb", "continuous"), help="three wavelengths or all of them (default rgb)")
    add("--motion", type=Path, metavar="FILE", help="displacement over the open shutter in px: .flo, or .npy (2, H, W)")
    add("--exposure", type=stops, default=0.0, metavar="STOPS", help="brighten the result (default 0)")
    add("--device", choices=("cpu", "cuda"), default="cpu")
    add("--threads", type=count, metavar="N", help="CPU threads (default: PyTorch's choice)")
    parser.set_defaults(run=run, command="render")


def run(args: argparse.Namespace) -> None:
    """Blur the picture and write it."""
    refuse_unused_flags(args)
    check_writable(args.output)
    refuse_overwriting(args, args.motion)
    if args.device == "cuda" and not torch.cuda.is_available():
        raise ValueError("--device cuda: PyTorch finds no CUDA device; use --device cpu")
    if args.threads:
        torch.set_num_threads(args.threads)
    image, depth, blur = read_picture(args)
    motion = _read_motion(args, image)
    image, depth, blur = image.to(args.device), depth.to(args.device), blur.to(args.device)
    with torch.no_grad():
        start = time.perf_counter()
        plan = blur.plan(image, depth, motion=motion)
        print(plan)
        result = (blur(image, depth, motion=motion, plan=plan) * 2.0**args.exposure).cpu()  # .cpu() waits for the GPU
        seconds = time.perf_counter() - start
    write_image(args.output, result)
    print(f"{args.output}: {image.shape[3]} x {image.shape[2]}, {seconds:.2f} s")


def _read_motion(args: argparse.Namespace, image: Tensor) -> Tensor | None:
    if args.motion is None:
        return None
    motion = read_flow(args.motion)
    check_same_size(args.motion, motion, args.image, image)
    return motion.to(args.device)
