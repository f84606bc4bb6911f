"""What stands in a shard: its entries, and the samples that they make up, read from files that nobody vouches for."""

import io
import json
import math
import tarfile
import zipfile
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor

MAPS = ("image", "depth", "motion", "coc", "target")
LAYERS = {"layers": "layers", "layer_depth": "depth", "layer_motion": "motion"}  # key of the sample: of the npz
KEYS = (*MAPS, *LAYERS, "lens", "recipe", "index")
SUFFIXES = (*(f"{name}.npy" for name in MAPS), "layers.npz", "meta.json")
_MOST_BYTES = 1 << 31  # of an entry, and of an array in one: what claims more is not read


def entries_of(shards: Iterable[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """The entries of every shard, each in memory; an empty dict ends a shard.

    WebDataset's own reader leaves files open until they are garbage, unpacks whatever it is given, and raises what tar
    files raise. Nothing is ever extracted, so it does no harm what names and links say.
    """
    from webdataset import gopen

    for shard in shards:
        url = shard["url"]
        try:
            with gopen(url) as stream, tarfile.open(fileobj=stream, mode="r|") as tar:
                seen: set[str] = set()
                for entry in tar:
                    plain = entry.isreg() and not entry.issparse() and entry.size <= _MOST_BYTES
                    if not plain or entry.name in seen:
                        raise ValueError(f"the entry {entry.name!r} is a link, too large, or there twice")
                    seen.add(entry.name)
                    yield {"fname": entry.name, "data": tar.extractfile(entry).read(), "__url__": url}  # type: ignore[union-attr]
                    tar.members.clear()  # type: ignore[attr-defined]  # or they are kept for as long as it is open
        except (tarfile.TarError, ValueError, EOFError) as error:
            raise ValueError(f"{url}: cannot be read as a shard: {error}") from error
        yield {}


def decoded(samples: Iterable[dict[str, Any]], keys: tuple[str, ...]) -> Iterator[dict[str, Any]]:
    """The samples that entries make up, by what they are asked for."""
    for entries in samples:
        missing = [suffix for suffix in SUFFIXES if suffix not in entries]
        if missing:
            what = f"sample {entries['__key__']} has no entry {missing[0]}; was it written by write_shards?"
            raise ValueError(f"{entries['__url__']}: {what}")
        try:
            yield _sample(entries, keys)
        except Exception as error:  # json, zipfile and NumPy raise whatever they like on broken data
            what = f"sample {entries['__key__']} cannot be read: {error or type(error).__name__}"
            raise ValueError(f"{entries['__url__']}: {what}") from error


def _sample(entries: dict[str, Any], keys: tuple[str, ...]) -> dict[str, Any]:
    sample = json.loads(entries["meta.json"])
    sample["lens"] = {name: torch.tensor(value, dtype=torch.float32) for name, value in sample["lens"].items()}
    sample |= {name: _array(entries[f"{name}.npy"]) for name in MAPS if name in keys}
    with zipfile.ZipFile(io.BytesIO(entries["layers.npz"])) as archive:
        for key in set(LAYERS) & set(keys):
            entry = archive.getinfo(f"{LAYERS[key]}.npy")
            if entry.file_size > _MOST_BYTES:
                raise ValueError(f"{entry.filename} is said to have {entry.file_size} bytes")
            sample[key] = _array(archive.read(entry))
    return {key: sample[key] for key in keys}


def _array(data: bytes) -> Tensor:
    """The array that `_npy` wrote; what its header says is held against the data before memory is asked for."""
    file = io.BytesIO(data)
    if np.lib.format.read_magic(file) != (1, 0):
        raise ValueError("it is not an NPY file of version 1.0")
    shape, backwards, dtype = np.lib.format.read_array_header_1_0(file)
    rest = data[file.tell() :]
    fits = math.prod(shape) * dtype.itemsize == len(rest) and min(shape, default=0) >= 0
    if dtype != np.dtype("<f4") or backwards or not fits:
        raise ValueError(f"its header promises {dtype} of shape {shape}, but it holds {len(rest)} bytes")
    return torch.from_numpy(np.frombuffer(rest, dtype).reshape(shape).copy())
