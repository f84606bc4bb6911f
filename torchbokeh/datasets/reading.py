"""Shards read back as the tensors that they were written from, though nobody vouches for the files."""

import io
import json
import math
import tarfile
import zipfile
from collections.abc import Iterable, Iterator, Sequence
from functools import partial as partial_of
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from torchbokeh.datasets.layout import KEYS, LAYERS, MANIFEST, MAPS, SUFFIXES, read_manifest, shard_indices
from torchbokeh.ops.checks import check_whole

if TYPE_CHECKING:
    from webdataset import DataPipeline

_MOST_BYTES = 1 << 31  # of an entry, and of an array in one: what claims more is not read


def read_shards(
    source: str | Path | Sequence[str | Path],
    *,
    keys: Sequence[str] | str | None = None,
    shuffle: int = 0,
    seed: int = 0,
    partial: bool = False,
) -> "DataPipeline":
    """Read what :func:`write_shards` wrote, as the same dicts of tensors, from tar files in sequence.

    Files are divided among the processes of ``torch.distributed`` (or ``torchrun``) and then among the workers of a
    ``DataLoader``, so each sample comes once per pass. Shares differ by up to one file: in distributed training
    take a fixed number of steps of ``read_shards(...).repeat()``, or processes wait for each other at the end.

    Args:
        source: a folder, one file, a URL or pattern of WebDataset such as ``"out/shard-{000000..000009}.tar"``, or a
            sequence of those. Only take patterns from people you trust: one that begins with ``pipe:`` is a command.
        keys: what of each sample to decode, such as ``("image", "coc", "target")``; ``None``: all of it.
        shuffle: samples that each worker holds to draw the next from; 0 keeps the order of writing. Above 0 the
            files are shuffled too.
        seed: of the shuffling. Under ``repeat()`` each pass has another order; a ``DataLoader`` with workers starts
            anew with each epoch, so pass ``seed=epoch`` to a new ``read_shards`` for another order.
        partial: accept a folder where files are missing.

    Returns:
        A ``webdataset.DataPipeline``, an ``IterableDataset`` of dicts as those of
        :class:`~torchbokeh.scenes.ProceduralDataset`, which a ``DataLoader`` can put into batches.

    Raises:
        ImportError: the package webdataset is missing; it comes with the extra ``torchbokeh[data]``.
        ValueError: nothing to read, a file that does not exist, an unknown key, or ``shuffle`` below 0; on iteration
            also fewer files than processes, or an entry that is missing.

    Example:
        >>> loader = DataLoader(read_shards("out/set", shuffle=100), batch_size=8, num_workers=4)  # doctest: +SKIP
        >>> next(iter(loader))["image"].shape  # doctest: +SKIP
        torch.Size([8, 3, 256, 256])
    """
    try:
        import webdataset as wds
    except ImportError:
        raise ImportError("reading shards needs the package webdataset; pip install torchbokeh[data]") from None
    check_whole("shuffle", shuffle, 0)
    keys = (keys,) if isinstance(keys, str) else keys
    unknown = {*(keys or ())} - {*KEYS}
    if unknown:
        raise ValueError(f"keys: expected some of {', '.join(KEYS)}, got {min(unknown)!r}")
    each = [source] if isinstance(source, str | Path) else source
    urls = [url for one in each for url in _expand(one, partial)]
    if not urls:
        raise ValueError(f"source: expected at least one file, got {source!r}")
    return wds.DataPipeline(
        wds.SimpleShardList(urls, seed=seed if shuffle else None),
        _refuse_too_few,
        wds.split_by_node,
        wds.split_by_worker,
        wds.detshuffle(len(urls), initial=len(urls), seed=seed) if shuffle else None,
        _entries_of,
        wds.tariterators.group_by_keys,
        partial_of(_decoded, keys=KEYS if keys is None else tuple(keys)),
        wds.detshuffle(shuffle, initial=min(shuffle, 100), seed=seed) if shuffle else None,
    )


def _expand(source: str | Path, partial: bool) -> list[str]:
    """The files in a folder, or those that a pattern means; local ones exist."""
    from webdataset.shardlists import expand_urls

    if not Path(source).is_dir():
        urls: list[str] = [str(source)] if isinstance(source, Path) else expand_urls(source)
        for url in urls:
            if ":" not in url and not Path(url).is_file():
                raise ValueError(f"{url}: does not exist; check the name")
        return urls
    folder = Path(source)
    paths = sorted(folder.glob("shard-*.tar"))
    if (folder / MANIFEST).exists() and not partial:
        manifest = read_manifest(folder / MANIFEST)
        expected = shard_indices(manifest["count"], manifest["per_shard"])
        missing = expected.keys() - {path.name for path in paths}
        if missing:
            what = f"{len(missing)} of {len(expected)} shards are missing, the first is {min(missing)}"
            raise ValueError(f"{folder}: {what}; write them, or pass partial=True")
    if not paths:
        raise ValueError(f"{folder}: holds no shards; write some with write_shards")
    return [str(path) for path in paths]


def _refuse_too_few(shards: Iterable[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """Refuse fewer shards than processes: one of them would have nothing, and the others would wait for it."""
    from webdataset.utils import pytorch_worker_info

    shards, processes = list(shards), pytorch_worker_info()[1]
    if len(shards) < processes:
        want = f"expected at least one file for each of {processes} processes"
        raise ValueError(f"source: {want}, got {len(shards)}; write them with a smaller per_shard")
    yield from shards


def _entries_of(shards: Iterable[dict[str, Any]]) -> Iterator[dict[str, Any]]:
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


def _decoded(samples: Iterable[dict[str, Any]], keys: tuple[str, ...]) -> Iterator[dict[str, Any]]:
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
