"""What the commands that blur a picture share: the flags of picture, depth, lens and blur, and how they are read."""

import argparse
from pathlib import Path

from torch import Tensor

from torchbokeh.commands.arguments import count, finite, length, pixel, positive
from torchbokeh.io.pictures import read_image, read_map, sample_map
from torchbokeh.lens import DisparityLens, ThinLens
from torchbokeh.lens.dispersion import Dispersion
from torchbokeh.plan.quality import QUALITIES
from torchbokeh.psfs.aperture import Aperture, parse_aperture
from torchbokeh.renderers.lens_blur import LensBlur

_DISPERSION_FLAGS = ("dispersion", "lateral", "glass", "spectrum")
_THIN_LENS_FLAGS = ("focus", "f_number", "focal_length", "sensor_width", "depth_scale", *_DISPERSION_FLAGS)


def add_picture_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of a picture, its depth, what it is seen through and how it is blurred."""
    parser.description = "Lengths are metres, or carry a unit: 50mm, 3.6cm, 2m. The depth has the image's size."
    add = parser.add_argument
    add("image", type=Path, metavar="IMAGE", help="PNG, JPEG, TIFF, EXR, NPY or PFM")
    maps = parser.add_mutually_exclusive_group(required=True)
    maps.add_argument("--depth", type=Path, metavar="FILE", help="distance along the optical axis")
    maps.add_argument("--disparity", type=Path, metavar="FILE", help="larger is nearer; needs --strength")
    focus = parser.add_mutually_exclusive_group(required=True)
    focus.add_argument("--focus", type=length, metavar="LENGTH", help="focus distance; inf for infinity")
    focus.add_argument("--focus-at", type=pixel, metavar="X,Y", help="focus on what this pixel shows")
    focus.add_argument("--focus-disparity", type=finite, metavar="D", help="focus on this disparity")
    add("--depth-scale", type=positive, metavar="S", help="metres per unit of the stored depth (default 1)")
    add("--f-number", type=positive, metavar="N", help="small is blurry (default 2.8)")
    add("--focal-length", type=length, metavar="LENGTH", help="default 50mm")
    add("--sensor-width", type=length, metavar="LENGTH", help="default 36mm")
    add("--strength", type=positive, metavar="PX", help="blur radius in pixels per unit of disparity")
    add(
        "--aperture",
        type=_aperture,
        default="disc",
        metavar="SHAPE",
        help="disc, or a polygon such as 6-gon (default disc)",
    )
    add("--max-coc", type=positive, metavar="PX", help="limit the blur radius (default: no limit)")
    add("--layers", type=_layers, default="auto", metavar="N", help="depth layers (default auto)")
    grade = parser.add_mutually_exclusive_group()
    names = [quality.name for quality in QUALITIES]
    grade.add_argument("--quality", choices=names, default="exact", help="default exact; the others are faster")
    grade.add_argument("--tolerance", type=positive, metavar="E", help="the fastest quality to this relative error")


def read_picture(args: argparse.Namespace) -> tuple[Tensor, Tensor, LensBlur]:
    """The picture, its depth or disparity, and the blur that the flags ask for."""
    image = read_image(args.image)
    depth = _read_depth(args, image)
    grade = {"quality": args.quality, "tolerance": args.tolerance}
    return image, depth, LensBlur(_lens(args, depth), args.aperture, args.layers, max_coc=args.max_coc, **grade)


def refuse_overwriting(args: argparse.Namespace, *others: Path | None) -> None:
    """Raise a ValueError where the output is one of the files that are read."""
    for path in (args.image, args.depth, args.disparity, *others):
        if path is not None and path.exists() and args.output.exists() and path.samefile(args.output):
            raise ValueError(f"{args.output}: is what is read as well; write to another file")


def refuse_unused_flags(args: argparse.Namespace) -> None:
    """Refuse flags that the chosen kind of map would leave unused."""
    unused = _THIN_LENS_FLAGS if args.disparity else ("strength", "focus_disparity")
    for name in unused:
        if getattr(args, name, None) is not None:
            flag, kind = name.replace("_", "-"), "--disparity" if args.disparity else "--depth"
            raise ValueError(
                f"--{flag} has no meaning with {kind}; leave it out (see: torchbokeh {args.command} --help)"
            )
    for name in ("glass", "spectrum"):
        if getattr(args, name, None) is not None and args.dispersion is None and args.lateral is None:
            raise ValueError(f"--{name} has no meaning without --dispersion or --lateral; add one of them")
    if args.disparity and args.strength is None:
        raise ValueError("--disparity needs --strength, the blur radius in pixels per unit of disparity")


def check_same_size(path: Path, values: Tensor, image_path: Path, image: Tensor) -> None:
    """Raise a ValueError unless a map ``(1, C, H, W)`` that was read has the size of the image."""
    if values.shape[2:] != image.shape[2:]:
        (h, w), (ih, iw) = values.shape[2:], image.shape[2:]
        raise ValueError(f"{path}: is {w} x {h}, but {image_path} is {iw} x {ih}; resize one to the other")


def _read_depth(args: argparse.Namespace, image: Tensor) -> Tensor:
    path = args.depth or args.disparity
    values = read_map(path, args.depth_scale or 1.0)
    check_same_size(path, values, args.image, image)
    bad = ~(values > 0) if args.depth else ~values.isfinite()
    if bad.any():
        y, x = bad[0, 0].nonzero()[0].tolist()
        want = "positive" if args.depth else "finite"
        raise ValueError(
            f"{path}: {int(bad.sum())} values are not {want}, the first at {x},{y} is "
            f"{values[0, 0, y, x]:g}; fill them first"
        )
    return values


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
    if not hasattr(args, "dispersion") or (args.dispersion is None and args.lateral is None):
        return None
    strengths = args.dispersion or 0.0, args.lateral or 0.0
    return Dispersion(args.glass or "BK7", *strengths, spectrum=args.spectrum or "rgb")


def _aperture(text: str) -> Aperture:
    try:
        return parse_aperture(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _layers(text: str) -> int | str:
    return text if text == "auto" else count(text)
