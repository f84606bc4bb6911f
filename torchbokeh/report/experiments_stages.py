"""The share of each stage of the one-layer splat."""

import statistics
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import partial
from importlib import import_module
from importlib.util import find_spec

import torch
from torch import Tensor

from torchbokeh.report.experiments import Row, Say
from torchbokeh.report.methods import QUALITIES, own_methods, own_name
from torchbokeh.report.scenes import photo
from torchbokeh.report.settings import Settings

Recorder = Callable[[], AbstractContextManager[dict[str, float]]]

REST = "everything else"
"""What no stage accounts for."""


def stages(settings: Settings, say: Say) -> list[Row]:
    """Seconds of every stage of a splat of ``photo``, for every quality and radius.

    Returns:
        Rows with ``quality``, ``radius``, ``stage``, ``seconds`` (median), ``share`` of the whole, and
        ``least_seconds``, a lower bound by what has to be read, written and computed; None where none is known.
        Nothing where the recorder of stages is not there.
    """
    recorded = recorder()
    if recorded is None:
        return []
    rows: list[Row] = []
    for radius in settings.photo_radii:
        say(f"share of each stage: radius {radius:g} px")
        seen = photo(settings.photo_size, radius)
        for quality in QUALITIES:
            run = own_methods()[own_name(quality)].run
            found = shares(partial(run, seen.image, seen.coc), recorded, settings.repeat)
            rows += [{"quality": quality, "radius": radius, **row, "least_seconds": None} for row in found]
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


def recorder() -> Recorder | None:
    """The recorder of the stages of the operators; None where they have none."""
    if find_spec("torchbokeh.ops._stages") is None:
        return None
    return import_module("torchbokeh.ops._stages").recorded
