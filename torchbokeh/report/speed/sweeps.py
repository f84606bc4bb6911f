"""What the run time of one layer depends on: the radius, the number of pixels, and threads."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import torch
from torch import Tensor

from torchbokeh.report.experiment import Experiment, Figures
from torchbokeh.report.machine import processors
from torchbokeh.report.markdown import cross_table, pictures, section, skipped
from torchbokeh.report.rows import Row, Say, distinct, of
from torchbokeh.report.scenes import photo
from torchbokeh.report.settings import Settings
from torchbokeh.report.speed.memory import peak_memory
from torchbokeh.report.speed.methods import Method, own_methods
from torchbokeh.report.speed.one_layer import Limits, compare, reference, run_methods, time_methods
from torchbokeh.report.speed.registry import one_layer_methods

SWEEP_RADIUS = (
    "dense scatter",
    "dense scatter by rows",
    "gather",
    "layered FFT 8, sum, normalised",
    "layered FFT 32, sum, normalised",
    "layered direct 8, over, normalised",
)
"""Baselines of run time against radius."""

SWEEP_PIXELS = ("dense scatter by rows", "layered FFT 16, sum, normalised")
"""Baselines of run time and memory against pixels."""


def _chosen(names: Sequence[str]) -> dict[str, Method]:
    """The baselines of these names, and this package's own methods."""
    return {name: m for name, m in one_layer_methods().items() if name in names or name in own_methods()}


def against_radius(settings: Settings, say: Say) -> list[Row]:
    """Run time and error of ``photo`` against the radius, at one size."""
    chosen = _chosen(SWEEP_RADIUS)
    rows = []
    for radius in settings.sweep_radii:
        say(f"run time against radius: {radius:g} px")
        seen = photo(settings.photo_size, radius)
        measured = compare(chosen, seen, reference(seen), Limits.of(settings, "sweep_"), flip=False)
        rows += [{"size": settings.photo_size, "radius": radius, **row} for row in measured]
    return rows


def _radius_section(rows: list[Row], settings: Row, plots: Sequence[str]) -> str:
    return section(
        "Run time against radius",
        f"photo, {rows[0]['size']} x {rows[0]['size']}; columns: largest radius in px. Seconds (SSIM):",
        *pictures(plots, "radius"),
        cross_table(rows, "method", "radius", "{seconds:t} ({ssim:.4f})"),
        skipped(rows, " at {radius:g} px"),
    )


def _radius_figures(rows: list[Row]) -> Figures:
    from torchbokeh.report import figures

    figure, axes = figures.one_panel(9, 4.8)
    figures.curves(axes, rows, "radius", "seconds")
    for line, marker in zip([x for x in axes.lines if x.get_linestyle() == "--"], "sD^vP*X<>", strict=False):
        line.set_marker(marker)  # tells baselines of one colour apart
    axes.set(xlabel="largest radius in px", ylabel="seconds", title=f"photo, {rows[0]['size']} x {rows[0]['size']}")
    figures.plain(axes, rows, "radius")
    figures.plain_seconds(axes.yaxis)
    figures.legend(figure)
    return {"radius.png": figure}


def against_pixels(settings: Settings, say: Say) -> list[Row]:
    """Run time and peak memory of ``photo`` against the number of pixels, at one radius."""
    rows = []
    for size in settings.sweep_sizes:
        say(f"run time against pixels: {size} x {size}")
        seen = photo(size, settings.sweep_radius)
        head = {"size": size, "megapixels": size * size / 1e6, "radius": settings.sweep_radius}
        for row, out in run_methods(_chosen(SWEEP_PIXELS), seen, Limits.of(settings, "sweep_")):
            asked = out is not None and size in settings.memory_sizes
            memory = peak_memory(row["method"], size, settings.sweep_radius) if asked else None
            per_megapixel = None if memory is None else memory / head["megapixels"]
            held = {} if out is None else {"peak_bytes": memory, "bytes_per_megapixel": per_megapixel}
            rows.append({**head, **row, **held})
    return rows


def _with_memory(rows: list[Row]) -> list[Row]:
    return [row for row in rows if row.get("peak_bytes")]


def _pixel_section(rows: list[Row], settings: Row, plots: Sequence[str]) -> str:
    parts = [
        f"photo, radius up to {rows[0]['radius']:g} px; columns: megapixels (10^6). Seconds:",
        *pictures(plots, "pixels"),
        cross_table(rows, "method", "megapixels", "{seconds:t}"),
    ]
    if _with_memory(rows):
        parts += [
            "Peak memory of one call beyond its inputs, in MB (10^6) per megapixel, each in a process of its own: the "
            "highest resident memory during the call less that before it.",
            cross_table(_with_memory(rows), "method", "megapixels", "{bytes_per_megapixel:M}"),
        ]
    return section("Run time and memory against pixels", *parts, skipped(rows))


def _pixel_figures(rows: list[Row]) -> Figures:
    from torchbokeh.report import figures

    memory = [{**row, "megabytes": row["bytes_per_megapixel"] / 1e6} for row in _with_memory(rows)]
    figure = figures.Figure(figsize=(12 if memory else 7.5, 4.4), layout="constrained")
    grid = figure.subplots(1, 2 if memory else 1, squeeze=False)[0]
    figures.curves(grid[0], rows, "megapixels", "seconds")
    grid[0].set(ylabel="seconds", title=f"photo, radius up to {rows[0]['radius']:g} px")
    figures.plain_seconds(grid[0].yaxis)
    if memory:
        figures.curves(grid[1], memory, "megapixels", "megabytes")
        grid[1].set(ylabel="peak memory, MB per megapixel", title="one call, beyond its inputs", yscale="linear")
        grid[1].set_ylim(bottom=0)
    for axes, shown in zip(grid, (rows, memory), strict=False):
        axes.set_xlabel("megapixels")
        figures.plain(axes, shown, "megapixels")
    figures.legend(figure, *grid[0].get_legend_handles_labels())
    return {"pixels.png": figure}


def against_threads(settings: Settings, say: Say) -> list[Row]:
    """Run time of this package's operating points against threads, and whether the bits are those of one thread."""
    seen = photo(settings.photo_size, settings.sweep_radius)
    chosen = own_methods()
    rows: list[Row] = []
    first: dict[str, Tensor] = {}
    for count in thread_counts():
        say(f"run time against threads: {count}")
        with threads(count):
            timings = time_methods(list(chosen.values()), seen, Limits.of(settings, "sweep_"))
        for name, timing in timings.items():
            same = torch.equal(first.setdefault(name, timing.result), timing.result)
            rows.append({"method": name, "threads": count, "same_bits": same, **timing.row})
    return rows


def thread_counts() -> list[int]:
    """1, 2, 4, ... and all processors."""
    most = processors()
    return sorted({most, *(1 << k for k in range(most.bit_length()))})


@contextmanager
def threads(count: int) -> Iterator[None]:
    """Let torch, and with it everything here, use so many threads for a while."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _thread_section(rows: list[Row], settings: Row, plots: Sequence[str]) -> str:
    differ = distinct(of(rows, same_bits=False), "method")
    return section(
        "Run time against threads",
        f"photo, {settings['photo_size']} x {settings['photo_size']}, radius up to {settings['sweep_radius']:g} px; "
        "columns: threads. Seconds:",
        *pictures(plots, "threads"),
        cross_table(rows, "method", "threads", "{seconds:t}"),
        f"The bits depend on the threads: {', '.join(differ)}."
        if differ
        else "The bits are those of one thread, always.",
    )


def _thread_figures(rows: list[Row]) -> Figures:
    from torchbokeh.report import figures

    figure, axes = figures.one_panel(7.5, 4)
    figures.curves(axes, rows, "threads", "seconds")
    axes.set(xlabel="threads", ylabel="seconds", title="run time against threads")
    figures.plain(axes, rows, "threads")
    figures.plain_seconds(axes.yaxis)
    most, slowest = max(distinct(rows, "threads")), max(row["seconds"] for row in of(rows, threads=1))
    axes.plot([1, most], [slowest, slowest / most], color="0.6", linestyle=":", label="in proportion")
    figures.legend(figure)
    return {"threads.png": figure}


RADIUS = Experiment("radius", against_radius, _radius_section, _radius_figures)
PIXELS = Experiment("pixels", against_pixels, _pixel_section, _pixel_figures)
THREADS = Experiment("threads", against_threads, _thread_section, _thread_figures)
