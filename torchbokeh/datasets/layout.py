"""What a data set on disk looks like: its files, the entries of a sample, and the manifest that says what they hold."""

import json
from pathlib import Path
from typing import Any

from torchbokeh.ops.checks import check_whole

MANIFEST = "dataset.json"
MAPS = ("image", "depth", "motion", "coc", "target")
LAYERS = {"layers": "layers", "layer_depth": "depth", "layer_motion": "motion"}  # key of the sample: of the npz
KEYS = (*MAPS, *LAYERS, "lens", "recipe", "index")
SUFFIXES = (*(f"{name}.npy" for name in MAPS), "layers.npz", "meta.json")
_MOST_FILES = 10**6  # what the six digits of their names can tell apart


def shard_indices(count: int, per_shard: int = 100, shard: tuple[int, int] = (1, 1)) -> dict[str, range]:
    """Which files one machine writes, and the samples in each.

    Args:
        count: samples in the whole data set.
        per_shard: samples in one file.
        shard: ``(k, m)``: machine k of m, from 1 to m. File j is that of machine ``j % m + 1``.

    Returns:
        Indices by file name, in order. Empty for a machine that has nothing to do.

    Raises:
        TypeError: ``count`` or ``per_shard`` is no int.
        ValueError: an argument out of its range.

    Example:
        >>> shard_indices(250, per_shard=100, shard=(1, 2))
        {'shard-000000.tar': range(0, 100), 'shard-000002.tar': range(200, 250)}
    """
    check_whole("count", count, 1)
    check_whole("per_shard", per_shard, 1)
    k, m = shard
    if not 1 <= k <= m:
        raise ValueError(f"shard: expected (k, m) with 1 <= k <= m, got ({k}, {m})")
    least = -(-count // _MOST_FILES)
    if per_shard < least:
        raise ValueError(f"per_shard: expected at least {least} for {count} samples, got {per_shard}")
    numbers = range(k - 1, -(-count // per_shard), m)
    return {f"shard-{j:06d}.tar": range(j * per_shard, min((j + 1) * per_shard, count)) for j in numbers}


def entry_names(index: int) -> list[str]:
    """The names of the entries of a sample, in order."""
    return [f"{index:08d}.{suffix}" for suffix in SUFFIXES]


def read_manifest(path: Path) -> dict[str, Any]:
    """The manifest of a data set.

    Raises:
        ValueError: the file is no manifest.
    """
    try:
        manifest = json.loads(path.read_text(encoding="utf-8"))
        settings, *numbers = (manifest[name] for name in ("settings", "count", "per_shard"))
        if not isinstance(settings, dict):
            raise TypeError
        shard_indices(*numbers)
    except (ValueError, TypeError, KeyError, RecursionError):
        raise ValueError(f"{path}: is not the manifest of a data set; choose another folder") from None
    return manifest
