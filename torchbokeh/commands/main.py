"""Command line: ``torchbokeh`` and its commands, also as ``python -m torchbokeh``."""

import argparse
import io
import logging
import os
import re
import sys
from collections.abc import Sequence
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any, NoReturn

import torch

import torchbokeh
from torchbokeh.commands.dataset import add_dataset
from torchbokeh.commands.export import add_export
from torchbokeh.commands.psfs import add_psfs
from torchbokeh.commands.render import add_render
from torchbokeh.commands.signals import Terminated, stoppable
from torchbokeh.report.command import add_report


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        argv: the arguments after the program's name; None takes those of the process.

    Returns:
        The exit status: 0, 2 after one line on stderr that says what was wrong, 130 after Ctrl-C, 143 after SIGTERM,
        or 141 where nobody reads what is printed, as after ``| head``.

    Raises:
        SystemExit: with status 0, after ``--help`` and ``--version``.

    Example:
        >>> main(["render", "a.png", "--depth", "d.npy", "--focus", "2m", "-o", "b.png"])  # doctest: +SKIP
        0
    """
    _open_streams()
    if isinstance(sys.stdout, io.TextIOWrapper):  # a file name may be no text; and unbuffered, `_flush` saw no error
        sys.stdout.reconfigure(errors="backslashreplace", write_through=False)
    logging.getLogger("tifffile").setLevel(logging.CRITICAL)  # what is wrong with a file is said once
    try:
        with stoppable():
            args = _parser().parse_args(argv)
            args.run(args)
            _flush()
    except KeyboardInterrupt:
        print("torchbokeh: interrupted", file=sys.stderr)
        return 130
    except Terminated:
        print("torchbokeh: terminated", file=sys.stderr)
        return 143
    except torch.OutOfMemoryError:
        print("torchbokeh: the GPU is out of memory; use --device cpu or a smaller picture", file=sys.stderr)
        return 2
    except BrokenPipeError:
        return 141
    except (ValueError, OSError) as error:
        print("torchbokeh:", " ".join(str(error).split()), file=sys.stderr)
        return 2
    finally:
        with suppress(OSError):
            _flush()
    return 0


def _open_streams() -> None:
    """Put the null device where a standard stream is closed: `print` would write errors to the other one."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115


def _flush() -> None:
    try:
        sys.stdout.flush()
    except OSError as error:  # a full disk, or nobody who reads
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # or the interpreter tries, and complains, again
        if isinstance(error, BrokenPipeError):
            raise
        raise OSError(f"standard output: cannot be written ({error.strerror})") from error


class _Parser(argparse.ArgumentParser):
    """Reports a wrong argument as a ValueError, so that every error ends as one line in :func:`main`."""

    def parse_known_args(self, args: Sequence[str] | None = None, namespace: Any = None) -> Any:  # type: ignore[override]
        """Refuse ``--flag=--``, which argparse takes for no value at all and passes on as an empty list."""
        for text in sys.argv[1:] if args is None else args:
            if re.fullmatch("-[^=]*=--", text):
                self.error(f"argument {text[:-3]}: expected one argument")
        return super().parse_known_args(args, namespace)

    def exit(self, status: int = 0, message: str | None = None) -> NoReturn:
        """End after ``--help`` or ``--version``, unless that could not be written."""
        _flush()
        super().exit(status, message)

    def error(self, message: str) -> NoReturn:
        raise ValueError(f"{message} (see: {self.prog} --help)")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="torchbokeh", description=torchbokeh.__doc__, allow_abbrev=False)
    parser.add_argument("--version", action="version", version=f"torchbokeh {version('torchbokeh')}")
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    add_render(commands.add_parser("render", help="blur a picture by its depth", allow_abbrev=False))
    add_export(commands.add_parser("export", help="write a blur as an ONNX file", allow_abbrev=False))
    demo = commands.add_parser("demo", help="refocus a photograph with measured depth", allow_abbrev=False)
    demo.add_argument("--out", type=Path, default=Path("out/demo"), metavar="DIR", help="default: out/demo")
    demo.set_defaults(run=_demo)
    add_dataset(commands.add_parser("dataset", help="write scenes with ground truth to train on", allow_abbrev=False))
    add_report(commands.add_parser("report", help="measure error against run time here", allow_abbrev=False))
    add_psfs(commands.add_parser("psfs", help="build and show banks of point-spread functions", allow_abbrev=False))
    return parser


def _demo(args: argparse.Namespace) -> None:
    from torchbokeh.commands.demo import run_demo

    run_demo(args.out)
