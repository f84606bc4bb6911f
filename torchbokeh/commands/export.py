"""The command ``torchbokeh export``: write a blur, or the integration network, as an ONNX file."""

import argparse
from pathlib import Path

import torch

from torchbokeh.commands.arguments import count
from torchbokeh.commands.picture_flags import add_picture_flags, read_picture, refuse_overwriting, refuse_unused_flags
from torchbokeh.learn.export import export_onnx
from torchbokeh.learn.integration import PyramidIntegrator
from torchbokeh.ops.system.files import check_place


def add_export(parser: argparse.ArgumentParser) -> None:
    """Add the command's own commands to its parser, and what they do."""
    parser.description = "ONNX files of standard operators, for any size: they run in onnxruntime, without torch."
    kinds = parser.add_subparsers(metavar="KIND", required=True)
    about = "the whole blur, planned for this scene: image, depth, focus and f-number stay inputs"
    blur = kinds.add_parser("blur", help=about, allow_abbrev=False)
    add_picture_flags(blur)
    blur.set_defaults(run=run_blur, command="export blur")
    about = "the network that undoes the Laplacian of a picture"
    pyramid = kinds.add_parser("pyramid", help=about, description=about.capitalize() + ".", allow_abbrev=False)
    pyramid.add_argument("--levels", type=count, default=13, metavar="N", help="halvings (default 13, for 4096 px)")
    pyramid.add_argument("--channels", type=count, default=4, metavar="N", help="default 4")
    pyramid.set_defaults(run=run_pyramid)
    for kind in (blur, pyramid):
        kind.add_argument("-o", "--output", type=Path, metavar="OUT", required=True, help="an .onnx file")


def run_blur(args: argparse.Namespace) -> None:
    """Export the blur of a scene."""
    refuse_unused_flags(args)
    _check_output(args.output)
    refuse_overwriting(args)
    image, depth, blur = read_picture(args)
    with torch.no_grad():
        plan = blur.plan(image, depth)
    print(plan)
    export_onnx(blur, args.output, image, depth, plan=plan)
    _print_size(args.output)


def run_pyramid(args: argparse.Namespace) -> None:
    """Export the integration network."""
    _check_output(args.output)
    export_onnx(PyramidIntegrator(levels=args.levels), args.output, torch.zeros(1, args.channels, 64, 64))
    _print_size(args.output)


def _check_output(path: Path) -> None:
    if path.suffix.lower() != ".onnx":
        raise ValueError(f"{path}: expected a name that ends in .onnx")
    check_place(path)


def _print_size(path: Path) -> None:
    print(f"{path}: {path.stat().st_size / 1000:.0f} kB")
