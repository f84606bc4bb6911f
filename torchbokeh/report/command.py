"""The command ``torchbokeh report``: error against run time on this machine."""

import argparse
import re
import sys
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path


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
    import torch

    from torchbokeh.report.run import EXPERIMENTS, run_experiments
    from torchbokeh.report.scenes import NAMES
    from torchbokeh.report.settings import Settings, quick
    from torchbokeh.report.write import prepare, write_report

    if args.stability:
        _stability(args)
        return
    scenes, only = args.scenes or NAMES, args.only or tuple(EXPERIMENTS)
    for flag, asked, known in (("--scenes", scenes, NAMES), ("--only", only, EXPERIMENTS)):
        unknown = [name for name in asked if name not in known]
        if unknown:
            raise ValueError(f"{flag}: expected some of {', '.join(known)}, got {unknown[0]!r}")
    prepare(args.out)
    if args.threads:
        torch.set_num_threads(args.threads)
    say = _teller()
    settings = quick(scenes) if args.quick else Settings(scenes=scenes)
    found = run_experiments(settings, say, only)
    say("writing")
    for path in write_report(found, args.out):
        print(path)


def _stability(args: argparse.Namespace) -> None:
    import torch

    from torchbokeh.report.stability.run import QUICK, StabilitySettings, run_stability
    from torchbokeh.report.stability.write import write_stability
    from torchbokeh.report.write import prepare

    if args.scenes or args.only:
        raise ValueError("--stability: expected no --scenes and no --only beside it, got one")
    prepare(args.out)
    if args.threads:
        torch.set_num_threads(args.threads)
    found = run_stability(QUICK if args.quick else StabilitySettings(), _teller())
    for path in write_stability(found, args.out):
        print(path)


def _teller() -> Callable[[str], None]:
    start = time.perf_counter()

    def say(line: str) -> None:
        print(f"[{time.perf_counter() - start:4.0f} s] {line}", file=sys.stderr, flush=True)

    return say


def _names(text: str) -> tuple[str, ...]:
    names = tuple(dict.fromkeys(name.strip() for name in text.split(",")))
    if not all(names):
        raise argparse.ArgumentTypeError(f"expected names with commas between them, got {text!r}")
    return names


def _count(text: str) -> int:
    if not re.fullmatch(r"[0-9]{1,4}", text) or not 1 <= int(text) <= 1024:
        raise argparse.ArgumentTypeError(f"expected a whole number from 1 to 1024, got {text!r}")
    return int(text)
