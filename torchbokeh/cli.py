"""Command line: ``torchbokeh`` and its commands, also as ``python -m torchbokeh``."""

import argparse
import math
import re
import sys
import time
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import NoReturn

import torch
from torch import Tensor

import torchbokeh
from torchbokeh.cli_dataset import add_dataset
from torchbokeh.cli_psfs import add_psfs
from torchbokeh.dispersion import Dispersion
from torchbokeh.flow_io import read_flow
from torchbokeh.image_io import check_writable, read_image, read_map, sample_map, write_image
from torchbokeh.lens import DisparityLens, ThinLens
from torchbokeh.psfs.aperture import Aperture, parse_aperture
from torchbokeh.quality import QUALITIES
from torchbokeh.report.command import add_report

_METRES = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "": 1.0}
_DISPERSION_FLAGS = ("dispersion", "lateral", "glass", "spectrum")
_THIN_LENS_FLAGS = ("focus", "f_number", "focal_length", "sensor_width", "depth_scale", *_DISPERSION_FLAGS)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        argv: the arguments after the program's name; None takes those of the process.

    Returns:
        The exit status: 0, 2 after one line on stderr that says what was wrong, or 130 after Ctrl-C.

    Raises:
        SystemExit: with status 0, after ``--help`` and ``--version``.

    Example:
        >>> main(["render", "a.png", "--depth", "d.npy", "--focus", "2m", "-o", "b.png"])  # doctest: +SKIP
        0
    """
    try:
        args = _parser().parse_args(argv)
        args.run(args)
    except KeyboardInterrupt:
        print("torchbokeh: interrupted", file=sys.stderr)
        return 130
    except torch.OutOfMemoryError:
        print("torchbokeh: the GPU is out of memory; use --device cpu or a smaller picture", file=sys.stderr)
        return 2
    except (ValueError, OSError) as error:
        print("torchbokeh:", " ".join(str(error).split()), file=sys.stderr)
        return 2
    return 0


class _Parser(argparse.ArgumentParser):
    """Reports a wrong argument as a ValueError, so that every error ends as one line in :func:`main`."""

    def error(self, message: str) -> NoReturn:
        raise ValueError(f"{message} (see: {self.prog} --help)")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="torchbokeh", description=torchbokeh.__doc__, allow_abbrev=False)
    parser.add_argument("--version", action="version", version=f"torchbokeh {version('torchbokeh')}")
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    _add_render(commands.add_parser("render", help="blur a picture by its depth", allow_abbrev=False))
    demo = commands.add_parser("demo", help="refocus a photograph with measured depth", allow_abbrev=False)
    demo.add_argument("--out", type=Path, default=Path("out/demo"), metavar="DIR", help="default: out/demo")
    demo.set_defaults(run=_demo)
    add_dataset(commands.add_parser("dataset", help="write scenes with ground truth to train on", allow_abbrev=False))
    add_report(commands.add_parser("report", help="measure error against run time here", allow_abbrev=False))
    add_psfs(commands.add_parser("psfs", help="build and show banks of point-spread functions", allow_abbrev=False))
    return parser


def _add_render(render: argparse.ArgumentParser) -> None:
    render.description = "Lengths are metres, or carry a unit: 50mm, 3.6cm, 2m. The depth has the image's size."
    add = render.add_argument
    add("image", type=Path, metavar="IMAGE", help="PNG, JPEG, TIFF, EXR, NPY or PFM")
    maps = render.add_mutually_exclusive_group(required=True)
    maps.add_argument("--depth", type=Path, metavar="FILE", help="distance along the optical axis")
    maps.add_argument("--disparity", type=Path, metavar="FILE", help="larger is nearer; needs --strength")
    add("-o", "--output", type=Path, metavar="OUT", required=True, help="PNG, TIFF (16 bits) or EXR")
    focus = render.add_mutually_exclusive_group(required=True)
    focus.add_argument("--focus", type=_length, metavar="LENGTH", help="focus distance; inf for infinity")
    focus.add_argument("--focus-at", type=_pixel, metavar="X,Y", help="focus on what this pixel shows")
    focus.add_argument("--focus-disparity", type=_finite, metavar="D", help="focus on this disparity")
    add("--depth-scale", type=_positive, metavar="S", help="metres per unit of the stored depth (default 1)")
    add("--f-number", type=_positive, metavar="N", help="small is blurry (default 2.8)")
    add("--focal-length", type=_length, metavar="LENGTH", help="default 50mm")
    add("--sensor-width", type=_length, metavar="LENGTH", help="default 36mm")
    add("--dispersion", type=_finite, metavar="STRENGTH", help="colours focused apart: 1 is a single lens (default 0)")
    add("--lateral", type=_finite, metavar="STRENGTH", help="colours of unlike size toward the border (default 0)")
    add("--glass", metavar="NAME", help="what disperses the colours (default BK7)")
    add("--spectrum", choices=("rgb", "continuous"), help="three wavelengths or all of them (default rgb)")
    add("--strength", type=_positive, metavar="PX", help="blur radius in pixels per unit of disparity")
    add(
        "--aperture",
        type=_aperture,
        default="disc",
        metavar="SHAPE",
        help="disc, or a polygon such as 6-gon (default disc)",
    )
    add("--motion", type=Path, metavar="FILE", help="displacement over the open shutter in px: .flo, or .npy (2, H, W)")
    add("--max-coc", type=_positive, metavar="PX", help="limit the blur radius (default: no limit)")
    add("--layers", type=_layers, default="auto", metavar="N", help="depth layers (default auto)")
    grade = render.add_mutually_exclusive_group()
    names = [quality.name for quality in QUALITIES]
    grade.add_argument("--quality", choices=names, default="exact", help="default exact; the others are faster")
    grade.add_argument("--tolerance", type=_positive, metavar="E", help="the fastest quality to this relative error")
    add("--exposure", type=_stops, default=0.0, metavar="STOPS", help="brighten the result (default 0)")
    add("--device", choices=("cpu", "cuda"), default="cpu")
    add("--threads", type=_count, metavar="N", help="CPU threads (default: PyTorch's choice)")
    render.set_defaults(run=_render)


def _render(args: argparse.Namespace) -> None:
    _check_flags(args)
    check_writable(args.output)
    if args.device == "cuda" and not torch.cuda.is_available():
        raise ValueError("--device cuda: PyTorch finds no CUDA device; use --device cpu")
    if args.threads:
        torch.set_num_threads(args.threads)
    image = read_image(args.image)
    depth = _read_depth(args, image)
    motion = _read_motion(args, image)
    lens = _lens(args, depth).to(args.device)
    grade = {"quality": args.quality, "tolerance": args.tolerance}
    blur = torchbokeh.LensBlur(lens, aperture=args.aperture, layers=args.layers, max_coc=args.max_coc, **grade)
    image, depth = image.to(args.device), depth.to(args.device)
    with torch.no_grad():
        start = time.perf_counter()
        plan = blur.plan(image, depth, motion=motion)
        print(plan)
        result = (blur(image, depth, motion=motion, plan=plan) * 2.0**args.exposure).cpu()  # .cpu() waits for the GPU
        seconds = time.perf_counter() - start
    write_image(args.output, result)
    print(f"{args.output}: {image.shape[3]} x {image.shape[2]}, {seconds:.2f} s")


def _demo(args: argparse.Namespace) -> None:
    from torchbokeh.demo import run_demo

    run_demo(args.out)


def _check_flags(args: argparse.Namespace) -> None:
    """Refuse flags that the chosen kind of map would leave unused."""
    unused = _THIN_LENS_FLAGS if args.disparity else ("strength", "focus_disparity")
    for name in unused:
        if getattr(args, name) is not None:
            flag, kind = name.replace("_", "-"), "--disparity" if args.disparity else "--depth"
            raise ValueError(f"--{flag} has no meaning with {kind}; leave it out (see: torchbokeh render --help)")
    for name in ("glass", "spectrum"):
        if getattr(args, name) is not None and args.dispersion is None and args.lateral is None:
            raise ValueError(f"--{name} has no meaning without --dispersion or --lateral; add one of them")
    if args.disparity and args.strength is None:
        raise ValueError("--disparity needs --strength, the blur radius in pixels per unit of disparity")


def _read_depth(args: argparse.Namespace, image: Tensor) -> Tensor:
    path = args.depth or args.disparity
    values = read_map(path, args.depth_scale or 1.0)
    if values.shape[2:] != image.shape[2:]:
        (h, w), (ih, iw) = values.shape[2:], image.shape[2:]
        raise ValueError(f"{path}: is {w} x {h}, but {args.image} is {iw} x {ih}; resize one to the other")
    bad = ~(values > 0) if args.depth else ~values.isfinite()
    if bad.any():
        y, x = bad[0, 0].nonzero()[0].tolist()
        want = "positive" if args.depth else "finite"
        raise ValueError(
            f"{path}: {int(bad.sum())} values are not {want}, the first at {x},{y} is "
            f"{values[0, 0, y, x]:g}; fill them first"
        )
    return values


def _read_motion(args: argparse.Namespace, image: Tensor) -> Tensor | None:
    if args.motion is None:
        return None
    motion = read_flow(args.motion)
    if motion.shape[2:] != image.shape[2:]:
        (h, w), (ih, iw) = motion.shape[2:], image.shape[2:]
        raise ValueError(f"{args.motion}: is {w} x {h}, but {args.image} is {iw} x {ih}; they must be of one size")
    return motion.to(args.device)


def _lens(args: argparse.Namespace, depth: Tensor) -> ThinLens | DisparityLens:
    focus = args.focus if args.focus is not None else args.focus_disparity
    if focus is None:
        focus = sample_map(depth, *args.focus_at)
    if args.disparity:
        return DisparityLens(args.strength, focus)
    focal = args.focal_length or 0.050
    if focus <= focal:
        raise ValueError(
            f"the focus distance {focus:g} m is not beyond the focal length {focal:g} m; "
            "focus farther away, and write millimetres as 50mm"
        )
    return ThinLens(focal, args.f_number or 2.8, focus, args.sensor_width or 0.036, dispersion=_dispersion(args))


def _dispersion(args: argparse.Namespace) -> Dispersion | None:
    if args.dispersion is None and args.lateral is None:
        return None
    strengths = args.dispersion or 0.0, args.lateral or 0.0
    return Dispersion(args.glass or "BK7", *strengths, spectrum=args.spectrum or "rgb")


def _number(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if math.isnan(value):
        raise argparse.ArgumentTypeError(f"expected a number, got {text!r}")
    return value


def _finite(text: str) -> float:
    value = _number(text)
    if math.isinf(value):
        raise argparse.ArgumentTypeError(f"expected a finite number, got {text!r}")
    return value


def _positive(text: str) -> float:
    value = _finite(text)
    if value <= 0:
        raise argparse.ArgumentTypeError(f"expected a number above 0, got {text!r}")
    return value


def _stops(text: str) -> float:
    value = _finite(text)
    if abs(value) > 30:
        raise argparse.ArgumentTypeError(f"expected between -30 and 30 stops, got {text!r}")
    return value


def _length(text: str) -> float:
    """``50mm``, ``3.6cm``, ``2m`` or plain metres -> metres."""
    number, unit = re.fullmatch(r"(.*?)\s*(mm|cm|m|)", text.strip(), re.DOTALL).groups()  # type: ignore[union-attr]
    value = _number(number) * _METRES[unit]
    if value <= 0:
        raise argparse.ArgumentTypeError(f"expected a length above 0, such as 50mm or 2.5, got {text!r}")
    return value


def _pixel(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d+),(\d+)", text)
    if not match:
        raise argparse.ArgumentTypeError(f"expected a pixel X,Y such as 320,240, got {text!r}")
    return int(match[1]), int(match[2])


def _count(text: str) -> int:
    if not re.fullmatch(r"\d{1,4}", text) or not 1 <= int(text) <= 1024:
        raise argparse.ArgumentTypeError(f"expected a whole number from 1 to 1024, got {text!r}")
    return int(text)


def _aperture(text: str) -> Aperture:
    try:
        return parse_aperture(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _layers(text: str) -> int | str:
    return text if text == "auto" else _count(text)
