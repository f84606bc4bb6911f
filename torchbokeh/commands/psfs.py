"""The command ``torchbokeh psfs``: build banks of point-spread functions, look at them, tabulate and analyse them."""

import argparse
import time
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from torchbokeh.commands.arguments import share, whole

SHOWN = 8
"""Samples on a contact sheet."""

TILE = 160
"""Pixels of one picture on a contact sheet."""


def add_psfs(parser: argparse.ArgumentParser) -> None:
    """Add the subcommands to the parser of ``torchbokeh psfs``.

    Example:
        >>> parser = argparse.ArgumentParser()
        >>> add_psfs(parser)
        >>> parser.parse_args(["build", "combined", "--workers", "2"]).workers
        2
    """
    from torchbokeh.psfs.models import MODELS

    names, many = sorted(MODELS), whole(1, 100_000)
    commands = parser.add_subparsers(metavar="ACTION", required=True)
    build = commands.add_parser("build", help="compute the bank of a model", allow_abbrev=False)
    build.description = "Run it again to go on after an interruption."
    build.add_argument("model", choices=names, metavar="MODEL", help=", ".join(names))
    build.add_argument("--out", type=Path, metavar="FILE", help="default: MODEL.safetensors")
    build.add_argument("--workers", type=many, default=1, metavar="W", help="processes (default 1)")
    build.add_argument("--ssim", type=share, metavar="S", help="least similarity of a sample (default: the model's)")
    build.set_defaults(run=_build)
    show = commands.add_parser("show", help="draw a contact sheet", allow_abbrev=False)
    show.add_argument("bank", metavar="BANK", help=f"a file, or one of {', '.join(names)}")
    show.add_argument("-o", "--output", type=Path, metavar="OUT", help="PNG (default: MODEL.png)")
    show.set_defaults(run=_show)
    table = commands.add_parser("table", help="samples, size, sparsity and similarity of banks", allow_abbrev=False)
    table.add_argument("banks", nargs="*", metavar="BANK", help="files or models (default: all that are installed)")
    table.add_argument("--held-out", type=many, default=100, metavar="N", help="coordinates to test (default 100)")
    table.set_defaults(run=_table)
    analyse = commands.add_parser("analyse", help="how well sparse PSFs do, in tables and plots", allow_abbrev=False)
    analyse.description = "Repeats the analysis of LKS, section 7.3. Takes about four minutes."
    analyse.add_argument("--out", type=Path, default=Path("out/psfs"), metavar="DIR", help="default: out/psfs")
    analyse.add_argument("--quick", action="store_true", help="shows that everything runs, the numbers mean little")
    analyse.set_defaults(run=_analyse)


def _build(args: argparse.Namespace) -> None:
    from torchbokeh.io.pictures import check_writable
    from torchbokeh.psfs.build import build
    from torchbokeh.psfs.models import model_from
    from torchbokeh.psfs.represent import Target

    path = args.out or Path(f"{args.model}.safetensors")
    if path.is_dir():
        raise ValueError(f"{path}: is a folder; name a file in it")
    check_writable(path.with_suffix(".png"))
    target = None if args.ssim is None else Target(ssim=args.ssim)
    start = time.perf_counter()
    bank = build(model_from(args.model), path, target=target, workers=args.workers, progress=True)
    print(f"{path}: {len(bank)} samples, {path.stat().st_size / 1e6:.2f} MB, {time.perf_counter() - start:.0f} s")


def _show(args: argparse.Namespace) -> None:
    from torchbokeh.io.pictures import check_writable, write_image
    from torchbokeh.psfs.bank import PsfBank
    from torchbokeh.psfs.sheet import contact_sheet

    bank = PsfBank.load(args.bank)
    path = args.output or Path(f"{bank.model.name}.png")
    check_writable(path)
    write_image(path, contact_sheet(bank, SHOWN, TILE))
    print(f"{path}: dense, Laplacian, points, reconstruction, 10 x error")


def _table(args: argparse.Namespace) -> None:
    from torchbokeh.psfs.bank import PsfBank, installed
    from torchbokeh.psfs.table import LKS, held_out, sparsity
    from torchbokeh.report.markdown import table

    rows = []
    for source in args.banks or installed():
        bank = PsfBank.load(source)
        found = list(held_out(bank, args.held_out))
        ssim, frame = (float(np.mean([getattr(f, name) for f in found])) for name in ("ssim", "ssim_frame"))
        betas = ", ".join(f"{b:g}" for b in bank.model.grid.betas)
        megabytes = sum(t.nbytes for t in bank.buffers()) / 1e6
        mean = f"{100 * sparsity(bank).mean():.1f}"
        theirs = LKS.get(bank.model.name)
        there = ("-",) * 3 if theirs is None else (str(theirs[0]), f"{theirs[2]:.1f}", f"{theirs[3]:.1f}")
        ours = (str(len(bank)), f"{megabytes:.2f}", mean)
        beside = [cell for pair in zip(ours, there, strict=True) for cell in pair]
        rows.append([f"`{bank.model.name}`", betas, *beside, f"{ssim:.3f}", f"{frame:.4f}"])
    head = ["model", "beta", "samples", "LKS", "MB", "LKS", "sparsity %", "LKS", "SSIM near", "SSIM in the frame"]
    print(table(head, rows))


def _analyse(args: argparse.Namespace) -> None:
    if find_spec("matplotlib") is None:
        raise ValueError("the analysis draws plots with matplotlib: pip install torchbokeh[report]")
    from torchbokeh.report.chapters import PSFS
    from torchbokeh.report.command import make

    make(PSFS, args.out, quick=args.quick)
