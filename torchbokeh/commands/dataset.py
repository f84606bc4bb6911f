"""The command ``torchbokeh dataset``: write a procedural data set as shards."""

import argparse
import time
from pathlib import Path
from typing import Any

from torchbokeh.commands.arguments import interval, names, shard, size, whole


def add_dataset(parser: argparse.ArgumentParser) -> None:
    """Add the command's flags to the parser of the subcommand, and :func:`run` as what it does.

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
    add("--count", type=whole(1), metavar="N", required=True, help="samples in all, over all machines")
    add("--shard", type=shard, default=(1, 1), metavar="K/M", help="this is machine K of M (default 1/1)")
    add("--workers", type=whole(0, 1024), default=0, metavar="W", help="processes that make samples (default 0)")
    add("--seed", type=whole(0), default=0, metavar="S", help="default 0")
    add("--size", type=size, metavar="WxH", help="pixels (default 256x256)")
    add("--recipes", type=names, metavar="A,B", help="kinds of scene (default: all)")
    add("--blur", type=interval, metavar="LO,HI", help="range of the largest blur radius in pixels")
    add("--views", type=whole(1), metavar="N", help="lens points per sample of the ground truth (default 256)")
    add("--per-shard", type=whole(1), default=100, metavar="P", help="samples per file (default 100)")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Write the shards of this machine that are missing, and print how many samples that were and how fast.

    Raises:
        ValueError: as :class:`~torchbokeh.datasets.ProceduralDataset` and
            :func:`~torchbokeh.datasets.write_shards`.
    """
    from torchbokeh.datasets import ProceduralDataset, write_shards
    from torchbokeh.datasets.layout import shard_indices

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
