"""Forward and backward: time and memory of this package beside plain autograd."""

import statistics
import time
from collections.abc import Sequence
from functools import partial

import torch

from torchbokeh.report.experiment import Experiment
from torchbokeh.report.markdown import row_table, section, skipped
from torchbokeh.report.measure import by_turns
from torchbokeh.report.rows import Row, Say
from torchbokeh.report.scenes import Picture, photo
from torchbokeh.report.settings import Settings
from torchbokeh.report.speed.autograd import SPANS, gradient_methods, held
from torchbokeh.report.speed.memory import peak_memory
from torchbokeh.report.speed.methods import Method


def gradients(settings: Settings, say: Say) -> list[Row]:
    """Forward and backward of ``photo`` at several sizes and radii: seconds of each, and peak memory of both.

    Returns:
        Rows with ``size``, ``radius``, ``method``, ``family``, ``forward_seconds`` and ``backward_seconds`` (medians),
        ``runs``, ``peak_bytes`` beyond the inputs and ``bytes_per_megapixel``, and how many times as much time and
        memory plain autograd through the torch definition takes: ``times_faster`` and ``times_smaller``. None where the
        system does not tell memory, or plain autograd was not run.
    """
    rows = []
    for size in settings.gradient_sizes:
        for radius in settings.gradient_radii:
            say(f"gradients: {size} px, radius {radius:g} px")
            rows += _compare(size, radius, settings)
    return rows


def _compare(size: int, radius: float, settings: Settings) -> list[Row]:
    seen, small = photo(size, radius), photo(64, radius)
    chosen, limit = gradient_methods(), settings.gradient_memory
    needs = {name: held(name, seen.coc) for name in chosen}
    works = {name: partial(timed, method, seen) for name, method in chosen.items() if needs[name] <= limit}
    for name in works:
        timed(chosen[name], small)  # compiles
    timings = by_turns(works, settings.repeat, settings.sweep_budget)
    rows: list[Row] = []
    for name, method in chosen.items():
        row: Row = {"size": size, "radius": radius, "method": name, "family": method.family}
        if name not in works:
            reason = f"would take about {needs[name] / 1e9:.2g} GB, more than the limit of {limit / 1e9:g} GB"
            rows.append({**row, "skipped": reason})
            continue
        forward, backward = (statistics.median(parts) for parts in zip(*timings[name], strict=True))
        memory = peak_memory(name, size, radius, backward=True)
        row |= {"forward_seconds": forward, "backward_seconds": backward, "runs": len(timings[name])}
        per_megapixel = None if memory is None else memory / (size * size / 1e6)
        rows.append({**row, "peak_bytes": memory, "bytes_per_megapixel": per_megapixel})
    return [row if "skipped" in row else row | _beside(row, rows) for row in rows]


def timed(method: Method, seen: Picture) -> tuple[float, float]:
    """Seconds of one forward and one backward pass, to the image and its CoC."""
    image, coc = seen.image.clone().requires_grad_(), seen.coc.clone().requires_grad_()
    start = time.perf_counter()
    out = method.run(image, coc)
    middle = time.perf_counter()
    out.backward(torch.ones_like(out))
    return middle - start, time.perf_counter() - middle


def _whole(row: Row) -> float:
    return row["forward_seconds"] + row["backward_seconds"]


def _beside(row: Row, rows: Sequence[Row]) -> Row:
    """How much less time and memory than plain autograd a row takes."""
    plain = next(other for other in rows if other["method"] == SPANS)
    if "skipped" in plain:
        return {"times_faster": None, "times_smaller": None}
    memory = None if row["peak_bytes"] is None else plain["peak_bytes"] / row["peak_bytes"]
    return {"times_faster": _whole(plain) / _whole(row), "times_smaller": memory}


def gradient_section(rows: list[Row], settings: Row, plots: Sequence[str]) -> str:
    """The rows of `gradients` as a section of ``report.md``."""
    memory = settings["gradient_memory"]
    about = (
        "photo; radius up to so many px. Seconds of a forward pass and of the backward pass to image and CoC. Peak "
        "memory of both together beyond the inputs, in MB (10^6) per megapixel, each in a process of its own; what is "
        f"larger than {memory / 1e9:g} GB is left out. *Times faster* and *times smaller* are beside {SPANS!r}, plain "
        "autograd through the torch definition, in whole time and in memory. LensBlur does more than the others: it "
        "composes two surfaces."
    )
    header = "size | radius | method | forward | backward | MB per megapixel | times faster | times smaller"
    cells = "{size} | {radius:g} | {method} | {forward_seconds:t} | {backward_seconds:t} | {bytes_per_megapixel:M} | "
    cells += "{times_faster:.2g} | {times_smaller:.2g}"
    left = skipped(rows, " at {size} px, radius {radius:g} px")
    return section("Forward and backward", about, row_table(rows, header, cells), left)


GRADIENTS = Experiment("gradients", gradients, gradient_section)
