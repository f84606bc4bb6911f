"""The command ``torchbokeh report``: error against run time on this machine."""

import argparse
import re
import sys
import time
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torchbokeh.report.chapters import Chapter


def add_report(parser: argparse.ArgumentParser) -> None:
    """Add the command's flags to its parser, and :func:`run` as what it does.

    Args:
        parser: that of the subcommand.

    Example:
        >>> parser = argparse.ArgumentParser()
        >>> add_report(parser)
        >>> parser.parse_args(["--scenes", "photo,coins", "--quick"]).scenes
        ('photo', 'coins')
    """
    parser.description = (
        "Measures error and run time of every operating point, beside well-known ways to blur, and writes report.md, "
        "report.json and plots. Takes about half an hour on two processors; leave the machine alone meanwhile."
    )
    add = parser.add_argument
    add("--scenes", type=_names, metavar="A,B", help="scenes to measure errors on (default: all)")
    add("--only", type=_names, metavar="A,B", help="experiments to run, by their names in report.json (default: all)")
    add("--out", type=Path, default=Path("out/report"), metavar="DIR", help="default: out/report")
    add("--quick", action="store_true", help="tiny pictures: shows that everything runs, the numbers mean little")
    add("--threads", type=_count, metavar="N", help="CPU threads (default: PyTorch's choice)")
    add("--stability", action="store_true", help="hold stiff cases to bounds instead, and write stability.md")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Run the experiments, say on stderr what is being measured, and print the files written.

    Args:
        args: what a parser with :func:`add_report` made of the command line.

    Raises:
        ValueError: an unknown scene or experiment, a folder that cannot be written, or the extra ``report`` is not
            installed.
    """
    if find_spec("matplotlib") is None:
        raise ValueError("the report draws plots with matplotlib: pip install torchbokeh[report]")
    from torchbokeh.report.chapters import REPORT, STABILITY
    from torchbokeh.report.experiments import EXPERIMENTS
    from torchbokeh.report.scenes import NAMES

    if args.stability and (args.scenes or args.only):
        raise ValueError("--stability: expected no --scenes and no --only beside it, got one")
    experiments = [experiment.name for experiment in EXPERIMENTS]
    for flag, asked, known in (("--scenes", args.scenes, NAMES), ("--only", args.only, experiments)):
        unknown = [name for name in asked or () if name not in known]
        if unknown:
            raise ValueError(f"{flag}: expected some of {', '.join(known)}, got {unknown[0]!r}")
    chapter = STABILITY if args.stability else REPORT
    if args.only:
        chapter = chapter._replace(run=partial(chapter.run, only=args.only))
    make(chapter, args.out, quick=args.quick, threads=args.threads, **{"scenes": args.scenes} if args.scenes else {})


def make(chapter: "Chapter", folder: Path, *, quick: bool, threads: int | None = None, **settings: Any) -> None:
    """Run a chapter, say on stderr what is being measured, and print the files written.

    Args:
        chapter: one of `torchbokeh.report.chapters`.
        folder: made where it is missing.
        quick: shows that everything runs.
        threads: of the CPU; PyTorch's choice if None.
        settings: those of the chapter that are not as usual.

    Raises:
        ValueError: a folder that cannot be written.
    """
    import torch

    from torchbokeh.report.chapters import write_chapter
    from torchbokeh.report.write import prepare

    prepare(folder)
    if threads:
        torch.set_num_threads(threads)
    start = time.perf_counter()

    def say(line: str) -> None:
        print(f"[{time.perf_counter() - start:4.0f} s] {line}", file=sys.stderr, flush=True)

    found = chapter.run((chapter.settings.quick if quick else chapter.settings)(**settings), say)
    say("writing")
    for path in write_chapter(chapter, found, folder):
        print(path)


def _names(text: str) -> tuple[str, ...]:
    names = tuple(dict.fromkeys(name.strip() for name in text.split(",")))
    if not all(names):
        raise argparse.ArgumentTypeError(f"expected names with commas between them, got {text!r}")
    return names


def _count(text: str) -> int:
    if not re.fullmatch(r"[0-9]{1,4}", text) or not 1 <= int(text) <= 1024:
        raise argparse.ArgumentTypeError(f"expected a whole number from 1 to 1024, got {text!r}")
    return int(text)
