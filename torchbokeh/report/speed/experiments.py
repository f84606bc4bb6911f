"""The experiments on one layer: error against run time, and what run time depends on.

Each returns rows, plain dictionaries for JSON. A row of a method that was not run has ``skipped``, the reason.
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple, Self

import torch
from torch import Tensor

from torchbokeh.ops.splat import splat_spans
from torchbokeh.psfs.aperture import Disc
from torchbokeh.report.machine import processors
from torchbokeh.report.measure import errors, measure, pareto_front
from torchbokeh.report.scenes import PHOTO, Picture, photo, picture
from torchbokeh.report.settings import Settings
from torchbokeh.report.speed.baselines import baselines
from torchbokeh.report.speed.memory import peak_memory
from torchbokeh.report.speed.methods import Method, own_methods

Row = dict[str, Any]
Say = Callable[[str], None]


class Limits(NamedTuple):
    """How often something is timed, and how long that may take.

    Attributes:
        repeat: timed runs.
        budget: seconds for all of them.
        cap: seconds that one run may take; what would take more is left out.
    """

    repeat: int
    budget: float
    cap: float

    @classmethod
    def of(cls, settings: Settings, kind: str) -> Self:
        """Those of the experiments whose settings begin so: ``""``, ``"recipe_"`` or ``"sweep_"``."""
        return cls(settings.repeat, getattr(settings, f"{kind}budget"), getattr(settings, f"{kind}cap"))


DEFINITION = 512 * 512
"""Pixels up to which the reference is the torch definition in double."""

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


def methods() -> dict[str, Method]:
    """Everything that is compared on one layer, by name: this package's operating points first."""
    return {**own_methods(), **baselines()}


def reference(seen: Picture) -> Tensor:
    """The picture that one-layer errors are measured against: the exact splat.

    Every pixel spreads evenly over its disc, what comes out is divided by its coverage. Pictures of up to `DEFINITION`
    pixels take the torch definition, all in double. Larger ones, for which that takes long, take the float32 kernel,
    which sums in double and rounds once.

    Returns:
        ``(1, 3, H, W)``, float64 for small pictures.
    """
    dtype = torch.float64 if seen.coc.numel() <= DEFINITION else torch.float32
    values = torch.cat([seen.image, torch.ones_like(seen.coc)], 1)
    out = splat_spans(values.to(dtype), seen.coc.to(dtype), Disc().profile(), integrate=True)
    return out[:, :3] / out[:, 3:]


def one_layer(settings: Settings, say: Say) -> list[Row]:
    """Error against run time of every method: ``photo`` at each of its radii, and every recipe."""
    rows = []
    for name in settings.scenes:
        photograph = name == PHOTO
        size = settings.photo_size if photograph else settings.recipe_size
        for radius in settings.photo_radii if photograph else (settings.recipe_radius,):
            say(f"error against run time: {name}, {size} px, radius {radius:g} px")
            seen = picture(name, size, radius)
            limits = Limits.of(settings, "" if photograph else "recipe_")
            measured = compare(methods(), seen, reference(seen), limits)
            rows += [{"scene": name, "size": size, "radius": radius, **row} for row in measured]
    return rows


def compare(
    chosen: Mapping[str, Method],
    seen: Picture,
    wanted: Tensor,
    limits: Limits,
    *,
    flip: bool = True,
) -> list[Row]:
    """Time methods on one picture, and measure their errors.

    Args:
        chosen: the methods, by name.
        seen: the picture.
        wanted: the reference ``(1, 3, H, W)``.
        limits: of the time that they take.
        flip: take FLIP as well.

    Returns:
        One row for each method, with ``pareto`` true where no other is both faster and nearer by SSIM.
    """
    obstacles = {name: method.obstacle(seen.coc, limits.cap) for name, method in chosen.items()}
    timings = time_methods([m for name, m in chosen.items() if obstacles[name] is None], seen, limits)
    rows: list[Row] = []
    for name, method in chosen.items():
        row: Row = {"method": name, "family": method.family}
        if obstacles[name] is not None:
            rows.append({**row, "skipped": obstacles[name]})
            continue
        rows.append({**row, **timings[name].row, **errors(timings[name].result, wanted, flip=flip)})
    run = [row for row in rows if "skipped" not in row]
    front = pareto_front([(row["seconds"], 1 - row["ssim"]) for row in run])
    for k, row in enumerate(run):
        row["pareto"] = k in front
    return rows


def time_methods(chosen: list[Method], seen: Picture, limits: Limits) -> Mapping[str, Any]:
    """Timings of methods by name; each has run on a small picture first: code is compiled, tables are made."""
    corner = (..., slice(64), slice(64))
    image, coc = seen.image[corner].clone(), seen.coc[corner].clone()
    coc[..., 0] = seen.coc.abs().max()
    for method in chosen:
        with torch.inference_mode():
            method.run(image, coc)
    works = {m.name: (lambda m=m: m.run(seen.image, seen.coc)) for m in chosen}
    return measure(works, limits.repeat, limits.budget)


def against_radius(settings: Settings, say: Say) -> list[Row]:
    """Run time and error of ``photo`` against the radius, at one size."""
    chosen = {n: m for n, m in methods().items() if n in SWEEP_RADIUS or n in own_methods()}
    rows = []
    for radius in settings.sweep_radii:
        say(f"run time against radius: {radius:g} px")
        seen = photo(settings.photo_size, radius)
        measured = compare(chosen, seen, reference(seen), Limits.of(settings, "sweep_"), flip=False)
        rows += [{"size": settings.photo_size, "radius": radius, **row} for row in measured]
    return rows


def against_pixels(settings: Settings, say: Say) -> list[Row]:
    """Run time and peak memory of ``photo`` against the number of pixels, at one radius."""
    chosen = {n: m for n, m in methods().items() if n in SWEEP_PIXELS or n in own_methods()}
    limits = Limits.of(settings, "sweep_")
    rows = []
    for size in settings.sweep_sizes:
        say(f"run time against pixels: {size} x {size}")
        seen = photo(size, settings.sweep_radius)
        head = {"size": size, "megapixels": size * size / 1e6, "radius": settings.sweep_radius}
        obstacles = {name: method.obstacle(seen.coc, limits.cap) for name, method in chosen.items()}
        timings = time_methods([m for name, m in chosen.items() if obstacles[name] is None], seen, limits)
        for name, method in chosen.items():
            row = {**head, "method": name, "family": method.family}
            if obstacles[name] is not None:
                rows.append({**row, "skipped": obstacles[name]})
                continue
            memory = peak_memory(name, size, settings.sweep_radius) if size in settings.memory_sizes else None
            per_megapixel = None if memory is None else memory / head["megapixels"]
            rows.append({**row, **timings[name].row, "peak_bytes": memory, "bytes_per_megapixel": per_megapixel})
    return rows


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
