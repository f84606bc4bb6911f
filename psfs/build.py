"""Building a bank: every sample of a model, on several processors, to be taken up again where it was left."""

import json
import multiprocessing
import os
import pickle
import shutil
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np

from torchbokeh.ops.checks import check_whole
from torchbokeh.ops.system.files import replacing
from torchbokeh.ops.system.processes import end_with_parent, ending_children, starting_children
from torchbokeh.psfs.bank import PsfBank
from torchbokeh.psfs.model import PsfModel
from torchbokeh.psfs.refit import Sparse, reconstruction
from torchbokeh.psfs.represent import Represented, Target, represent
from torchbokeh.psfs.similarity import Score, neighbourhood, score

_THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")


class Built(NamedTuple):
    """One sample and how good it is.

    Attributes:
        represented: its points.
        support: pixels that its dense PSF covers.
        ssim: see `torchbokeh.psfs.similarity.Score`, as the next two; 1, 1 and 0 where the points are exact.
        ssim_frame: likewise.
        l1: likewise.
        seconds: that one processor took.
    """

    represented: Represented
    support: int
    ssim: float
    ssim_frame: float
    l1: float
    seconds: float


def build_sample(model: PsfModel, number: int, target: Target) -> Built:
    """Pre-filter a sample over its box of the grid, and find the domain and the points for it.

    The same on every machine but for rounding, and the same bits on one.
    """
    start = time.perf_counter()
    psf = model.prefiltered(*model.grid.box(number))
    found = represent(psf, model.symmetry, turns=model.turns, target=target)
    rounded = Sparse(found.sparse.points, found.sparse.values.astype(np.float32).astype(np.float64))
    reached = Score(1.0, 1.0, 0.0)
    if found.domain == "laplacian":
        reached = score(psf, reconstruction(rounded, neighbourhood(psf)))
    support = int((psf > 0).any(0).sum())
    return Built(Represented(found.domain, rounded), support, *reached, time.perf_counter() - start)


def build(
    model: PsfModel, path: str | Path, *, target: Target | None = None, workers: int = 1, progress: bool = False
) -> PsfBank:
    """Build the bank of a model and write it to a file.

    Samples are kept in the folder ``path`` + ``".parts"`` as they are finished: what was interrupted goes on from
    there. The folder is removed when the bank is whole.

    Args:
        model: one of `torchbokeh.psfs.MODELS`, or your own; it must pickle.
        path: of the file.
        target: what is asked of each sample; None for the similarity that the model names.
        workers: processes.
        progress: show a bar.

    Returns:
        The bank. Its ``info`` holds the target, and for every sample what `Built` says of it.

    Raises:
        ChildProcessError: a worker was killed.
        OSError: a file cannot be written.
        TypeError: ``workers`` is no int.
        ValueError: ``workers`` is below 1.
    """
    from tqdm import tqdm

    check_whole("workers", workers, 1)
    target = Target(ssim=model.similarity) if target is None else target
    path = Path(path)
    parts = path.with_name(path.name + ".parts")
    parts.mkdir(parents=True, exist_ok=True)
    order = {"model": model.name, "settings": model.settings(), "target": target._asdict()}
    _remove_other_parts(parts, json.dumps(order, sort_keys=True))
    count = len(model.grid)
    missing = [k for k in range(count) if not _part(parts, k).is_file()]
    work = _finished(model, missing, target, workers, parts)
    done = count - len(missing)
    for _ in tqdm(work, total=count, initial=done, desc=model.name, unit="PSF", disable=not progress):
        pass
    samples = [_read(_part(parts, k)) for k in range(count)]
    measured = ("support", "ssim", "ssim_frame", "l1")
    columns = {name: [round(getattr(sample, name), 5) for sample in samples] for name in measured}
    bank = PsfBank(model, [s.represented for s in samples], {"target": target._asdict(), **columns})
    bank.save(path)
    shutil.rmtree(parts)
    return bank


def _remove_other_parts(parts: Path, order: str) -> None:
    """Remove parts that were built to another order, and note the order of those to come."""
    note = parts / "order.json"
    if note.is_file() and note.read_text() == order:
        return
    for file in parts.glob("*.npz"):
        file.unlink()
    with replacing(note) as temporary:
        temporary.write_text(order)


def _part(parts: Path, number: int) -> Path:
    return parts / f"{number:05d}.npz"


def _finished(model: PsfModel, numbers: list[int], target: Target, workers: int, parts: Path) -> Iterator[int]:
    """Build samples, largest first, and tell the number of each when it is written."""
    # By value: tensors would be handed over by a thread that a killed worker leaves with an error of its own.
    pickled = pickle.dumps(model)
    jobs = [(pickled, k, target, _part(parts, k)) for k in reversed(numbers)]
    if not jobs:
        return
    pool = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), end_with_parent)
    try:
        with ending_children():
            with _single_threads(), starting_children():
                running = [pool.submit(_job, *job) for job in jobs]
            for done in as_completed(running):
                yield done.result()
    except BrokenProcessPool as error:
        what = "a worker ended before its sample was done, perhaps for want of memory; run it again to go on"
        raise ChildProcessError(f"{parts}: {what}") from error
    finally:
        pool.shutdown(cancel_futures=True)
        for temporary in parts.glob(".*"):  # of workers that were ended
            temporary.unlink(missing_ok=True)


@contextmanager
def _single_threads() -> Iterator[None]:
    """Workers that start meanwhile use one thread each, which also makes their sums the same on any machine's count."""
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _job(pickled: bytes, number: int, target: Target, path: Path) -> int:
    found = build_sample(pickle.loads(pickled), number, target)
    (domain, (points, values)), *scores = found
    with replacing(path) as temporary:
        np.savez(temporary, domain=domain, points=points, values=values, scores=np.array(scores))
    return number


def _read(path: Path) -> Built:
    with np.load(path, allow_pickle=False) as file:
        represented = Represented(str(file["domain"]), Sparse(file["points"], file["values"]))  # type: ignore[arg-type]
        support, *scores = file["scores"].tolist()
    return Built(represented, int(support), *scores)
