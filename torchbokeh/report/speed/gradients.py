"""Forward and backward: time and memory of this package beside plain autograd."""

import math
import statistics
import time
from collections.abc import Sequence
from functools import partial

import torch
from torch import Tensor
from torch.nn import functional as F

import torchbokeh
from torchbokeh.ops.composite import TINY
from torchbokeh.ops.splat import _splat_spans_torch
from torchbokeh.psfs.aperture import Disc
from torchbokeh.report.markdown import seconds, section, skipped, table
from torchbokeh.report.measure import by_turns
from torchbokeh.report.scenes import Picture, photo
from torchbokeh.report.settings import Settings
from torchbokeh.report.speed.experiments import Row, Say
from torchbokeh.report.speed.memory import peak_memory
from torchbokeh.report.speed.methods import Method, own_methods, own_name

QUALITIES = ("exact", "balanced")
COMPOSED = "LensBlur"
SPANS = "autograd, row intervals"
DENSE = "autograd, dense"

# Bytes that a graph keeps: for each row interval of a pixel, for each pixel and offset, for each pixel and bin of a
# sub-aperture, and for each pixel besides.
_INTERVAL, _OFFSET, _BIN, _PIXEL = 500, 8, 85, 300


def gradient_methods() -> dict[str, Method]:
    """What is compared, by name: this package's operating points, and the same sums left to autograd."""
    found = [own_methods()[own_name(quality)] for quality in QUALITIES]
    for quality in QUALITIES:
        blur = torchbokeh.LensBlur(quality=quality)
        about = f"LensBlur(quality={quality!r}) of an image: foreground, filled background and composition"
        found.append(Method(f"{COMPOSED} {quality}", COMPOSED, about, partial(_lens_blur, blur), _seconds))
    rows = "the torch definition of the exact splat, row by row in double, its graph built by autograd"
    discs = "every pixel adds its disc, offset by offset with an edge 1 px wide, its graph built by autograd"
    found.append(Method(SPANS, "autograd", rows, interval_splat, _seconds))
    found.append(Method(DENSE, "autograd", discs, dense_splat, _seconds))
    return {method.name: method for method in found}


def _seconds(coc: Tensor) -> float:
    return 0.0  # memory is what limits these


def _lens_blur(blur: torchbokeh.LensBlur, image: Tensor, coc: Tensor) -> Tensor:
    return blur(image, coc=coc)


def interval_splat(image: Tensor, coc: Tensor) -> Tensor:
    """The torch definition of the exact one-layer blur, without the adjoint that this package gives it."""
    out = _splat_spans_torch(torch.cat([image, torch.ones_like(coc)], 1), coc, Disc().profile(), True)
    return out[:, :-1] / out[:, -1:].clamp_min(TINY)


def dense_splat(image: Tensor, coc: Tensor) -> Tensor:
    """Every pixel adds its disc, with an edge 1 px wide, and the sum is divided by its coverage."""
    height, width = image.shape[-2:]
    radius = coc.abs().clamp_min(0.5)
    reach = math.ceil(radius.max().item())
    shares = torch.cat([image, torch.ones_like(coc)], 1) / (math.pi * radius.square())
    shares, radius = F.pad(shares, (reach,) * 4), F.pad(radius, (reach,) * 4)
    out = torch.zeros_like(shares[..., :height, :width])
    for y in range(2 * reach + 1):
        for x in range(2 * reach + 1):
            away = math.hypot(y - reach, x - reach)
            if away < reach + 0.5:
                seen = (..., slice(y, y + height), slice(x, x + width))
                out.addcmul_(shares[seen], (radius[seen] + (0.5 - away)).clamp(0, 1))  # in place: the least to keep
    return out[:, :-1] / out[:, -1:].clamp_min(TINY)


def held(name: str, coc: Tensor) -> float:
    """Bytes that a method keeps for its backward pass, at most, about. It decides what is left out, nothing else.

    Args:
        name: of `gradient_methods`.
        coc: ``(1, 1, H, W)``.
    """
    radius = coc.abs()
    if name == SPANS:
        return _INTERVAL * (2 * radius.double() + 3).sum().item()
    each = 0.0
    if name == DENSE:
        each = _OFFSET * math.pi * (radius.max().item() + 0.5) ** 2
    elif name.startswith(COMPOSED):
        plan = torchbokeh.LensBlur(quality=name.split()[1]).plan(coc, coc=coc)
        each = 2000 + _BIN * plan.subapertures**2 * sum(map(len, plan.bins))
    return coc.numel() * (_PIXEL + each)


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


def gradient_section(rows: Sequence[Row], settings: Row) -> str:
    """The rows of `gradients` as a section of ``report.md``; empty without rows."""
    if not rows:
        return ""
    memory = settings["gradient_memory"]
    about = (
        "photo; radius up to so many px. Seconds of a forward pass and of the backward pass to image and CoC. Peak "
        "memory of both together beyond the inputs, in MB (10^6) per megapixel, each in a process of its own; what is "
        f"larger than {memory / 1e9:g} GB is left out. *Times faster* and *times smaller* are beside {SPANS!r}, plain "
        "autograd through the torch definition, in whole time and in memory. LensBlur does more than the others: it "
        "composes two surfaces."
    )
    head = ["size", "radius", "method", "forward", "backward", "MB per megapixel", "times faster", "times smaller"]
    cells = []
    for row in rows:
        what = [str(row["size"]), f"{row['radius']:g}", row["method"]]
        if "skipped" in row:
            cells.append([*what, *["-"] * 5])
            continue
        peak = "-" if row["peak_bytes"] is None else f"{row['bytes_per_megapixel'] / 1e6:.0f}"
        times = ("-" if row[key] is None else f"{row[key]:.2g}" for key in ("times_faster", "times_smaller"))
        both = (seconds(row[f"{way}_seconds"]) for way in ("forward", "backward"))
        cells.append([*what, *both, peak, *times])
    left = skipped([{**row, "where": f"{row['size']} px, radius {row['radius']:g} px"} for row in rows])
    return section("Forward and backward", about, table(head, cells), left)
