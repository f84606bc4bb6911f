"""The command ``torchbokeh dataset``: write a procedural data set as shards."""

import argparse
import math
import re
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any


def add_dataset(parser: argparse.ArgumentParser) -> None:
    """Add the command's flags to its parser, and :func:`run` as what it does.

    Args:
        parser: that of the subcommand.

    Example:
        >>> parser = argparse.ArgumentParser()
        >>> add_dataset(parser)
        >>> parser.parse_args(["--out", "set", "--count", "1000", "--shard", "2/4"]).shard
        (2, 4)
    """
    parser.description = (
        "Run it again to go on after an interruption. To share the work, run it on M machines "
        "with --shard 1/M to --shard M/M and otherwise the same flags."
    )
    add = parser.add_argument
    add("--out", type=Path, metavar="DIR", required=True, help="folder of the shards")
    add("--count", type=_whole(1), metavar="N", required=True, help="samples in all, over all machines")
    add("--shard", type=_shard, default=(1, 1), metavar="K/M", help="this is machine K of M (default 1/1)")
    add("--workers", type=_whole(0, 1024), default=0, metavar="W", help="processes that make samples (default 0)")
    add("--seed", type=_whole(0), default=0, metavar="S", help="default 0")
    add("--size", type=_size, metavar="WxH", help="pixels (default 256x256)")
    add("--recipes", type=_names, metavar="A,B", help="kinds of scene (default: all)")
    add("--blur", type=_pair, metavar="LO,HI", help="range of the largest blur radius in pixels")
    add("--views", type=_whole(1), metavar="N", help="lens points per sample of the ground truth (default 256)")
    add("--per-shard", type=_whole(1), default=100, metavar="P", help="samples per file (default 100)")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Write the shards of this machine that are missing, and print how many samples that were and how fast.

    Args:
        args: what a parser with :func:`add_dataset` made of the command line.

    Raises:
        ValueError: as :class:`~torchbokeh.scenes.ProceduralDataset` and
            :func:`~torchbokeh.datasets.shards.write_shards`.
    """
    from torchbokeh.datasets.shards import shard_indices, write_shards
    from torchbokeh.scenes import ProceduralDataset

    given = {"resolution": args.size, "recipes": args.recipes, "blur": args.blur, "views": args.views}
    options: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    dataset = ProceduralDataset(seed=args.seed, length=args.count, **options)
    mine = shard_indices(args.count, args.per_shard, args.shard)
    start = time.perf_counter()
    written = write_shards(
        dataset, args.out, args.count, per_shard=args.per_shard, shard=args.shard, workers=args.workers
    )
    seconds = time.perf_counter() - start
    samples = sum(len(mine[path.name]) for path in written)
    print(
        f"{args.out}: {samples} samples in {len(written)} files, {seconds:.1f} s, {samples / seconds:.1f} samples/s"
        f"; {len(mine) - len(written)} files were there already"
    )


def _whole(least: int, most: int = 10**9) -> Callable[[str], int]:
    """A parser of whole numbers from ``least`` to ``most``."""

    def parse(text: str) -> int:
        if not re.fullmatch(r"[0-9]{1,10}", text) or not least <= int(text) <= most:
            raise argparse.ArgumentTypeError(f"expected a whole number from {least} to {most}, got {text!r}")
        return int(text)

    return parse


def _shard(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"([0-9]{1,6})/([0-9]{1,6})", text)
    if not match or not 1 <= int(match[1]) <= int(match[2]):
        raise argparse.ArgumentTypeError(f"expected K/M with K from 1 to M, such as 2/4, got {text!r}")
    return int(match[1]), int(match[2])


def _size(text: str) -> tuple[int, int]:
    """``WxH`` -> ``(H, W)``."""
    match = re.fullmatch(r"([0-9]{1,5})x([0-9]{1,5})", text)
    if not match or not int(match[1]) or not int(match[2]):
        raise argparse.ArgumentTypeError(f"expected a size WxH such as 320x240, got {text!r}")
    return int(match[2]), int(match[1])


def _names(text: str) -> tuple[str, ...]:
    names = tuple(name.strip() for name in text.split(","))
    if not all(names):
        raise argparse.ArgumentTypeError(f"expected names with commas between them, got {text!r}")
    return names


def _pair(text: str) -> tuple[float, float]:
    try:
        low, high = (float(number) for number in text.split(","))
    except ValueError:
        low = high = math.nan
    if not (math.isfinite(low) and math.isfinite(high)):
        raise argparse.ArgumentTypeError(f"expected two numbers LO,HI such as 2,20, got {text!r}")
    return low, high
