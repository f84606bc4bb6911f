"""Run times and errors, and which points of a plot are worth having."""

import math
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec

import numpy as np
import torch
from torch import Tensor

Work = Callable[[], Tensor]


@dataclass(frozen=True)
class Timing:
    """Seconds of several runs of one thing.

    Attributes:
        seconds: of each run, in order.
        result: of the first run.
    """

    seconds: tuple[float, ...]
    result: Tensor

    @property
    def row(self) -> dict[str, float | int]:
        """Median, quartiles, fastest and slowest run in seconds, and the number of runs, for a table."""
        ordered = np.array(self.seconds)
        low, high = np.quantile(ordered, [0.25, 0.75])
        return {
            "seconds": statistics.median(self.seconds),
            "quartile_low": float(low),
            "quartile_high": float(high),
            "fastest": min(self.seconds),
            "slowest": max(self.seconds),
            "runs": len(self.seconds),
        }


FEWEST = 3
"""Timed runs of what takes longer than its budget."""


def measure(works: Mapping[str, Work], repeat: int, budget: float = math.inf) -> dict[str, Timing]:
    """Time several things by turns, so that what disturbs the machine for a while disturbs them all.

    Each runs once to warm up, which counts as a timed run where it takes longer than the budget.

    Args:
        works: what to time, by name.
        repeat: timed runs of each.
        budget: seconds for the timed runs of each; `FEWEST` are made in any case, unless ``repeat`` is less.

    Returns:
        The timings, by name.

    Example:
        >>> measure({"sum": torch.ones(8).sum}, repeat=3)["sum"].row["runs"]
        3
    """
    results: dict[str, Tensor] = {}

    def timed(name: str, work: Work) -> tuple[float]:
        return work_seconds(lambda: results.setdefault(name, work()))

    with torch.inference_mode():
        found = by_turns({name: partial(timed, name, work) for name, work in works.items()}, repeat, budget)
    return {name: Timing(tuple(run[0] for run in found[name]), results[name]) for name in works}


def work_seconds(work: Work) -> tuple[float]:
    """The seconds that something takes, as the only part of it, for `by_turns`."""
    start = time.perf_counter()
    work()
    return (time.perf_counter() - start,)


def by_turns(
    works: Mapping[str, Callable[[], tuple[float, ...]]], repeat: int, budget: float
) -> dict[str, list[tuple[float, ...]]]:
    """Run several things by turns, as `measure` does, that say themselves how many seconds each of their parts took.

    Args:
        works: what to run, by name.
        repeat: timed runs of each.
        budget: as for `measure`, for all parts together.

    Returns:
        The seconds of the parts in each run, by name.
    """
    found: dict[str, list[tuple[float, ...]]] = {}
    for name, work in works.items():
        first = work()
        found[name] = [first] if sum(first) > budget else []
    for _ in range(repeat):
        for name, work in works.items():
            whole = [sum(parts) for parts in found[name]]
            spent = len(whole) >= FEWEST and sum(whole) + max(whole) > budget
            if not spent and len(whole) < repeat:
                found[name].append(work())
    return found


def displayed(image: Tensor) -> np.ndarray:
    """``(1, 3+, H, W)`` linear -> ``(H, W, 3)``, as the errors see it: ``clip(x, 0, 1) ** (1/2.2)``."""
    return (image[0, :3].double().clamp(0, 1) ** (1 / 2.2)).permute(1, 2, 0).numpy().astype(np.float32)


def errors(image: Tensor, reference: Tensor, border: int = 0, *, flip: bool = True) -> dict[str, float | None]:
    """How far a picture is from its reference.

    Args:
        image: ``(1, 3, H, W)``, linear.
        reference: the same shape.
        border: pixels to leave out at every side.
        flip: take FLIP as well, which needs the package flip-evaluator.

    Returns:
        ``ssim`` and ``psnr`` in dB (None for equal pictures) on `displayed` values; ``l1``, the sum of absolute
        differences of linear values over the sum of the reference; ``flip``, its mean on displayed values, or None.

    Raises:
        ValueError: nothing is left inside the border, or the shapes differ.

    Example:
        >>> picture = torch.rand(1, 3, 16, 16)
        >>> errors(picture, picture)["l1"]
        0.0
    """
    from skimage.metrics import peak_signal_noise_ratio, structural_similarity

    if image.shape != reference.shape:
        raise ValueError(f"image: expected the shape {tuple(reference.shape)}, got {tuple(image.shape)}")
    height, width = image.shape[2:]
    if 2 * border + 7 > min(height, width):
        raise ValueError(f"border: expected to leave at least 7 of {width} x {height} pixels, got {border}")
    inside = (..., slice(border, height - border), slice(border, width - border))
    image, reference = image[inside].double(), reference[inside].double()
    shown, wanted = displayed(image), displayed(reference)
    equal = np.array_equal(shown, wanted)
    return {
        "ssim": float(structural_similarity(wanted, shown, channel_axis=2, data_range=1.0)),
        "psnr": None if equal else float(peak_signal_noise_ratio(wanted, shown, data_range=1.0)),
        "l1": float((image - reference).abs().sum() / reference.abs().sum().clamp_min(1e-30)),
        "flip": _flip(wanted, shown) if flip and flip_is_there() else None,
    }


def flip_is_there() -> bool:
    """Whether the package flip-evaluator is installed."""
    return find_spec("flip_evaluator") is not None


def _flip(wanted: np.ndarray, shown: np.ndarray) -> float:
    import flip_evaluator

    return float(flip_evaluator.evaluate(wanted, shown, "LDR", applyMagma=False)[1])


def pareto_front(points: Sequence[tuple[float, float]]) -> list[int]:
    """The points that no other point beats in both coordinates; small is good.

    Args:
        points: pairs such as (seconds, error).

    Returns:
        Their indices, by the first coordinate. Of equal points the first stays.

    Example:
        >>> pareto_front([(1.0, 3.0), (2.0, 1.0), (3.0, 2.0)])
        [0, 1]
    """
    front: list[int] = []
    for k in sorted(range(len(points)), key=lambda i: (*points[i], i)):
        if not front or points[k][1] < points[front[-1]][1]:
            front.append(k)
    return front
