"""Data sets on disk: samples written as WebDataset shards by any number of machines, and read back as tensors."""

import io
import json
import math
import os
import secrets
import tarfile
import warnings
import zipfile
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial as partial_of
from importlib.metadata import version
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from torchbokeh.datasets.shard_entries import KEYS, LAYERS, MAPS, SUFFIXES, decoded, entries_of
from torchbokeh.io.pictures import replacing
from torchbokeh.ops.checks import check_whole
from torchbokeh.ops.system.processes import end_with_parent, ending_children, starting_children

if TYPE_CHECKING:
    from webdataset import DataPipeline

_MANIFEST = "dataset.json"
_MOST_FILES = 10**6  # what the six digits of their names can tell apart


def write_shards(
    dataset: Dataset[dict[str, Any]],
    out: str | Path,
    count: int,
    *,
    per_shard: int = 100,
    shard: tuple[int, int] = (1, 1),
    workers: int = 0,
    show_progress: bool = True,
) -> list[Path]:
    """Write the first ``count`` samples of a data set as tar files that WebDataset reads; go on where a run ended.

    ``shard-000000.tar`` holds the samples 0 to ``per_shard - 1``, and so on; the last file may be shorter. A file
    appears only when it is whole. A later call with the same arguments writes only what is missing, whether the
    earlier one ended by an error, Ctrl-C or a power cut. The bytes of a file depend on the data set and its indices
    alone, not on workers or time, nor on machines where these have the same versions of everything (zlib, which
    deflates the layers, among it).

    Machine k of m takes every m-th file. They need not know of each other, may share the folder or have one each to
    be merged by copying, and m may change from run to run. Should two runs write the same file, that only costs time.

    Each sample is seven entries: ``00000012.image.npy``, ``.depth.npy``, ``.motion.npy``, ``.coc.npy``,
    ``.target.npy`` (float32), ``.layers.npz`` (``layers``, ``depth``, ``motion``) and ``.meta.json`` (``index``,
    ``recipe``, ``lens``). ``dataset.json`` beside the files says what they hold.

    Args:
        dataset: gives at index i a dict as :class:`~torchbokeh.scenes.ProceduralDataset` does, always the same one.
            Its method ``settings()``, where it has one, returns a dict for ``dataset.json``.
        out: folder, created where it is missing.
        count: samples in the whole data set, over all machines.
        per_shard: samples in one file.
        shard: ``(k, m)``: this is machine k of m, from 1 to m.
        workers: processes that make samples; 0 makes them in this one.
        show_progress: show a progress bar where there is a terminal.

    Returns:
        The files that this call wrote, in order; those that were there already are not among them.

    Raises:
        ChildProcessError: a worker was killed.
        OSError: a file cannot be written.
        TypeError: ``settings()`` holds what JSON cannot.
        ValueError: an argument out of its range, a folder that cannot be made or holds another data set (the message
            names the setting that differs), or a sample without the expected keys.

    Warns:
        RuntimeWarning: a file that is there is truncated or holds other entries than it should; it is replaced.

    Example:
        >>> write_shards(ProceduralDataset(seed=0), "out/set", 1000, shard=(2, 4))  # doctest: +SKIP
        [PosixPath('out/set/shard-000001.tar'), PosixPath('out/set/shard-000005.tar'), ...]
    """
    from tqdm import tqdm

    files = shard_indices(count, per_shard, shard)
    check_whole("workers", workers, 0)
    length = len(dataset) if hasattr(dataset, "__len__") else count
    if length < count:
        raise ValueError(f"count: expected at most the {length} samples of the dataset, got {count}")
    out = Path(out)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"{out}: cannot be made a folder ({error.strerror}); choose another") from None
    _claim(out, dataset, count, per_shard)
    missing = {out / name: indices for name, indices in files.items() if not _is_whole(out / name, indices)}
    for path in missing:
        if path.exists():
            warnings.warn(f"{path}: is broken, so it is written again", RuntimeWarning, stacklevel=2)
    stale = _remove_stale(out, [out / name for name in files if out / name not in missing])
    if not missing:
        return []
    loader = DataLoader(
        _Encoded(dataset),
        batch_size=None,
        sampler=chain.from_iterable(missing.values()),
        num_workers=workers,
        collate_fn=list,  # what a worker made, as it is
        generator=torch.Generator(),  # the loader draws a seed; the caller's random numbers stay as they are
        worker_init_fn=_end_with_parent,
    )
    total, left = (sum(map(len, some.values())) for some in (files, missing))
    bar = tqdm(total=total, initial=total - left, unit="sample", disable=None if show_progress else True)
    with bar as progress, ending_children():
        with starting_children():
            loading = iter(loader)
        samples = _made(loading)
        for path, indices in missing.items():
            with _publishing(path) as file, tarfile.open(fileobj=file, mode="w", format=tarfile.USTAR_FORMAT) as tar:
                for _ in indices:
                    for name, data in next(samples):
                        entry = tarfile.TarInfo(name)  # time, owner and mode are constants
                        entry.size = len(data)
                        tar.addfile(entry, io.BytesIO(data))
                    progress.update()
            for temporary in stale[path]:
                temporary.unlink(missing_ok=True)
    return list(missing)


def shard_indices(count: int, per_shard: int = 100, shard: tuple[int, int] = (1, 1)) -> dict[str, range]:
    """Which files one machine writes, and the samples in each.

    Args:
        count: samples in the whole data set.
        per_shard: samples in one file.
        shard: ``(k, m)``: machine k of m, from 1 to m. File j is that of machine ``j % m + 1``.

    Returns:
        Indices by file name, in order. Empty for a machine that has nothing to do.

    Raises:
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
        _enough,
        wds.split_by_node,
        wds.split_by_worker,
        wds.detshuffle(len(urls), initial=len(urls), seed=seed) if shuffle else None,
        entries_of,
        wds.tariterators.group_by_keys,
        partial_of(decoded, keys=KEYS if keys is None else tuple(keys)),
        wds.detshuffle(shuffle, initial=min(shuffle, 100), seed=seed) if shuffle else None,
    )


def _made(loading: Iterator[Any]) -> Iterator[list[tuple[str, bytes]]]:
    try:
        yield from loading
    except RuntimeError as error:
        if not str(error).startswith("DataLoader worker (pid"):
            raise
        what = "a worker ended before its sample was made, perhaps for want of memory; call it again to go on"
        raise ChildProcessError(what) from error


def _end_with_parent(worker: int) -> None:
    end_with_parent()


class _Encoded(Dataset[list[tuple[str, bytes]]]):
    """The entries of each sample: workers encode and compress too, and pass on bytes without shared memory."""

    def __init__(self, dataset: Dataset[dict[str, Any]]) -> None:
        self.dataset = dataset

    def __getitem__(self, index: int) -> list[tuple[str, bytes]]:
        sample = self.dataset[index]
        if sample.keys() != {*KEYS}:
            raise ValueError(f"sample {index}: expected the keys {', '.join(KEYS)}, got {', '.join(sample)}")
        meta = {
            "index": sample["index"],
            "recipe": sample["recipe"],
            "lens": {name: float(value) for name, value in sample["lens"].items()},  # float32 comes back as it was
        }
        packed = _npz({name: _npy(sample[key]) for key, name in LAYERS.items()})
        data = [*(_npy(sample[name]) for name in MAPS), packed, json.dumps(meta).encode()]
        return list(zip(_names(index), data, strict=True))


def _names(index: int) -> list[str]:
    return [f"{index:08d}.{suffix}" for suffix in SUFFIXES]


def _npy(values: Tensor) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, np.ascontiguousarray(values.detach().cpu().numpy(), dtype="<f4"), allow_pickle=False)
    return buffer.getvalue()


def _npz(arrays: dict[str, bytes]) -> bytes:
    """What ``np.savez_compressed`` writes, but for certain without the time and the name of the system."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in arrays.items():
            entry = zipfile.ZipInfo(f"{name}.npy", date_time=(1980, 1, 1, 0, 0, 0))
            entry.create_system = 3
            # Empty parts of layers shrink to nothing at any level; on the rest higher levels only cost time.
            archive.writestr(entry, data, zipfile.ZIP_DEFLATED, compresslevel=1)
    return buffer.getvalue()


def _claim(out: Path, dataset: Dataset[dict[str, Any]], count: int, per_shard: int) -> None:
    """Write the manifest, or hold the one that is there against this call."""
    settings: dict[str, Any] = getattr(dataset, "settings", dict)()
    wanted = {"torchbokeh": version("torchbokeh"), "count": count, "per_shard": per_shard, "settings": settings}
    text = json.dumps(wanted, indent=2) + "\n"
    path = out / _MANIFEST
    # In this order: another machine that has just begun writes its manifest before its first file.
    has_shards = any(out.glob("shard-*.tar"))
    if not path.exists():
        if has_shards:
            raise ValueError(f"{out}: holds shards, but no {_MANIFEST} that says of what; choose another folder")
        with replacing(path) as temporary:  # machines that begin together write the same
            temporary.write_text(text, encoding="utf-8")
        return
    found, wanted = _read_manifest(path), json.loads(text)
    before, now = ({**manifest, **manifest["settings"]} for manifest in (found, wanted))
    differing = [name for name in {**before, **now} if name != "settings" and before.get(name) != now.get(name)]
    if differing and not has_shards and not any(out.glob(".shard-*.tmp")):
        with replacing(path) as temporary:  # a run that failed before its first file holds nobody back
            temporary.write_text(text, encoding="utf-8")
    elif differing:
        what = ", ".join(
            f"{name} {json.dumps(before.get(name))}, not {json.dumps(now.get(name))}" for name in differing
        )
        raise ValueError(f"{out}: was begun with {what}; go on with the same settings or choose another folder")


def _read_manifest(path: Path) -> dict[str, Any]:
    try:
        manifest = json.loads(path.read_text(encoding="utf-8"))
        settings, *numbers = (manifest[name] for name in ("settings", "count", "per_shard"))
        if not isinstance(settings, dict) or not all(type(n) is int for n in numbers):
            raise ValueError
        shard_indices(*numbers)
    except (ValueError, TypeError, KeyError, RecursionError):
        raise ValueError(f"{path}: is not the manifest of a data set; choose another folder") from None
    return manifest


def _is_whole(path: Path, indices: range) -> bool:
    """Whether the file is there, has the entries it should and its full length. Reads the headers only."""
    try:
        with tarfile.open(path, "r:") as tar:
            entries = tar.getmembers()
    except (FileNotFoundError, tarfile.TarError):
        return False
    if [entry.name for entry in entries] != [name for index in indices for name in _names(index)]:
        return False
    last = entries[-1]
    blocks = math.ceil(last.size / tarfile.BLOCKSIZE) + 2  # an archive ends with two empty blocks
    end = last.offset_data + blocks * tarfile.BLOCKSIZE
    return path.stat().st_size == math.ceil(end / tarfile.RECORDSIZE) * tarfile.RECORDSIZE


@contextmanager
def _publishing(path: Path) -> Iterator[BinaryIO]:
    """Yield a file beside ``path`` that becomes ``path`` when the block ends without an error.

    Its name is its own, so a second run that writes the same shard cannot write into it.
    """
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(6)}.tmp")
    try:
        with temporary.open("xb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())  # or a power cut may leave the name without the bytes
        try:
            os.replace(temporary, path)
        except FileNotFoundError:
            if not path.exists():  # else a second run has just published the same bytes, and cleaned up
                raise
    except OSError as error:
        if error.errno is None or error.filename not in (None, str(temporary)):  # it is of the samples
            raise
        raise OSError(f"{path}: cannot be written ({error.strerror})") from error
    finally:
        temporary.unlink(missing_ok=True)


def _remove_stale(out: Path, done: list[Path]) -> defaultdict[Path, list[Path]]:
    """Remove what killed runs left of files that are done; return the rest, by the file they were to become.

    Those may be of a run that is at work, and stay until their file is published: then nobody needs them.
    """
    found = defaultdict(list)
    for temporary in out.glob(".shard-*.tar.*.tmp"):
        found[out / ".".join(temporary.name.split(".")[1:3])].append(temporary)
    for path in done:
        for temporary in found.pop(path, []):
            temporary.unlink(missing_ok=True)
    return found


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
    if (folder / _MANIFEST).exists() and not partial:
        manifest = _read_manifest(folder / _MANIFEST)
        expected = shard_indices(manifest["count"], manifest["per_shard"])
        missing = expected.keys() - {path.name for path in paths}
        if missing:
            what = f"{len(missing)} of {len(expected)} shards are missing, the first is {min(missing)}"
            raise ValueError(f"{folder}: {what}; write them, or pass partial=True")
    if not paths:
        raise ValueError(f"{folder}: holds no shards; write some with write_shards")
    return [str(path) for path in paths]


def _enough(shards: Iterable[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """Refuse fewer shards than processes: one of them would have nothing, and the others would wait for it."""
    from webdataset.utils import pytorch_worker_info

    shards, processes = list(shards), pytorch_worker_info()[1]
    if len(shards) < processes:
        want = f"expected at least one file for each of {processes} processes"
        raise ValueError(f"source: {want}, got {len(shards)}; write them with a smaller per_shard")
    yield from shards
