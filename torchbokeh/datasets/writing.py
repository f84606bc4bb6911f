"""Data sets on disk: samples written as WebDataset shards by any number of machines."""

import io
import json
import math
import os
import secrets
import tarfile
import warnings
import zipfile
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from itertools import chain
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from torchbokeh.datasets.layout import KEYS, LAYERS, MANIFEST, MAPS, entry_names, read_manifest, shard_indices
from torchbokeh.ops.checks import check_whole
from torchbokeh.ops.system.files import make_folder, replacing
from torchbokeh.ops.system.processes import end_with_parent, ending_children, starting_children


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
    make_folder(out)
    _check_manifest(out, dataset, count, per_shard)
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
        samples = _loaded(loading)
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


def _loaded(loading: Iterator[Any]) -> Iterator[list[tuple[str, bytes]]]:
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
        return list(zip(entry_names(index), data, strict=True))


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


def _check_manifest(out: Path, dataset: Dataset[dict[str, Any]], count: int, per_shard: int) -> None:
    """Write the manifest, or hold the one that is there against this call."""
    settings: dict[str, Any] = getattr(dataset, "settings", dict)()
    wanted = {"torchbokeh": version("torchbokeh"), "count": count, "per_shard": per_shard, "settings": settings}
    text = json.dumps(wanted, indent=2) + "\n"
    path = out / MANIFEST
    # In this order: another machine that has just begun writes its manifest before its first file.
    has_shards = any(out.glob("shard-*.tar"))
    if path.exists():
        found, wanted = read_manifest(path), json.loads(text)
        before, now = ({**manifest, **manifest["settings"]} for manifest in (found, wanted))
        differing = [name for name in {**before, **now} if name != "settings" and before.get(name) != now.get(name)]
        if not differing:
            return
        if has_shards or any(out.glob(".shard-*.tmp")):  # a run that failed before its first file holds nobody back
            pairs = (f"{name} {json.dumps(before.get(name))}, not {json.dumps(now.get(name))}" for name in differing)
            what = ", ".join(pairs)
            raise ValueError(f"{out}: was begun with {what}; go on with the same settings or choose another folder")
    elif has_shards:
        raise ValueError(f"{out}: holds shards, but no {MANIFEST} that says of what; choose another folder")
    with replacing(path) as temporary:  # machines that begin together write the same
        temporary.write_text(text, encoding="utf-8")


def _is_whole(path: Path, indices: range) -> bool:
    """Whether the file is there, has the entries it should and its full length. Reads the headers only."""
    try:
        with tarfile.open(path, "r:") as tar:
            entries = tar.getmembers()
    except (FileNotFoundError, tarfile.TarError):
        return False
    if [entry.name for entry in entries] != [name for index in indices for name in entry_names(index)]:
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
