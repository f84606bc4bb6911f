"""The share of each stage of the one-layer splat."""

import statistics
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from functools import partial

import torch
from torch import Tensor

from torchbokeh.ops.dispatch import numba_is_there
from torchbokeh.ops.system.threads import recorded
from torchbokeh.report.experiment import Experiment
from torchbokeh.report.internals import QUALITY_NAMES
from torchbokeh.report.markdown import row_table, section
from torchbokeh.report.rows import Row, Say
from torchbokeh.report.scenes import photo
from torchbokeh.report.settings import Settings
from torchbokeh.report.speed.methods import own_methods, own_name

Recorder = Callable[[], AbstractContextManager[dict[str, float]]]

REST = "everything else"
"""What no stage accounts for."""


def stages(settings: Settings, say: Say) -> list[Row]:
    """Seconds of every stage of a splat of ``photo``, for every quality and radius.

    Returns:
        Rows with ``quality``, ``radius``, ``stage``, ``seconds`` (median) and ``share`` of the whole. Nothing without
        numba, whose kernels record their stages.
    """
    if not numba_is_there():
        return []
    rows: list[Row] = []
    for radius in settings.photo_radii:
        say(f"share of each stage: radius {radius:g} px")
        seen = photo(settings.photo_size, radius)
        for quality in QUALITY_NAMES:
            run = own_methods()[own_name(quality)].run
            found = shares(partial(run, seen.image, seen.coc), recorded, settings.repeat)
            rows += [{"quality": quality, "radius": radius, **row} for row in found]
    return rows


def shares(work: Callable[[], Tensor], recorded: Recorder, repeat: int) -> list[Row]:
    """Median seconds of every stage of some work, and their share of its whole.

    Args:
        work: it runs once more, to warm up.
        recorded: a context manager that gives the dictionary it writes seconds by stage into.
        repeat: how often.
    """
    whole, parts = [], []
    with torch.inference_mode():
        work()
        for _ in range(repeat):
            start = time.perf_counter()
            with recorded() as found:
                work()
            whole.append(time.perf_counter() - start)
            parts.append({**found, REST: whole[-1] - sum(found.values())})
    total = statistics.median(whole)
    names = dict.fromkeys(name for part in parts for name in part)
    medians = {name: statistics.median(part.get(name, 0.0) for part in parts) for name in names}
    return [{"stage": name, "seconds": value, "share": value / total} for name, value in medians.items()]


def _section(rows: list[Row], settings: Row, plots: Sequence[str]) -> str:
    header = "quality | radius | stage | seconds | share"
    cells = "{quality} | {radius:g} | {stage} | {seconds:t} | {share:.0%}"
    return section("Share of each stage", row_table(rows, header, cells))


STAGES = Experiment("stages", stages, _section)
