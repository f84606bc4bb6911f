"""The pictures of an analysis of sparse PSFs."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, MaxNLocator, NullLocator

from torchbokeh.report.psfs.analysis import METHODS, SHARES, SPARSITY
from torchbokeh.report.psfs.tables import THICK, mean, of

Row = dict[str, Any]

COLOURS = dict(zip(METHODS, ("#d62728", "#f0a08c", "#1f77b4", "#7f7f7f"), strict=True))
SHADES = ("#f6a58c", "#d62728", "#7a0c0c")
LEAST = 1e-5
"""Where plots put errors below this."""

PUBLISHED = {"LKS": (SPARSITY, 0.97), "quad tree": (SPARSITY, 0.89)}
"""Sparsity and similarity of LKS figure 10 a."""


def draw(rows: dict[str, list[Row]]) -> dict[str, Figure]:
    """All plots of an analysis.

    Args:
        rows: the ``experiments`` that `torchbokeh.report.psfs.analysis.analyse` returns.

    Returns:
        Figures by the names of their files.
    """
    return {
        "psfs_equal.png": _equal(rows["equal"]),
        "psfs_similarity.png": _similarity(of(rows["equal"], share=SPARSITY)),
        "psfs_needed.png": _needed(rows["needed"]),
        "psfs_sizes.png": _sizes(rows["sizes"]),
        "psfs_samples.png": _samples(rows["samples"]),
        "psfs_rotation.png": _rotation(rows["rotation"]),
    }


def _equal(rows: list[Row]) -> Figure:
    figure = Figure(figsize=(11, 3.6), layout="constrained")
    thick = [row for row in rows if row["radius"] >= THICK]
    panels = [("near", "ssim", rows), (f"near, r >= {THICK} px", "ssim", thick), ("in the frame", "ssim_frame", rows)]
    for axes, (title, key, shown) in zip(figure.subplots(1, 3), panels, strict=True):
        for method, colour in COLOURS.items():
            chosen = [c for c in (of(shown, method=method, share=share) for share in SHARES) if c]
            x, y = [mean(c, "sparsity") for c in chosen], [mean(c, key) for c in chosen]
            axes.plot(x, y, "o-", color=colour, label=method, markersize=4)
        for method, place in PUBLISHED.items():
            axes.plot(*place, "*", color=COLOURS[method], markersize=10, label=f"{method}, published", linestyle="")
        axes.set(xscale="log", xlabel="mean sparsity", title=title)
        _per_cent(axes, SHARES)
        axes.grid(alpha=0.25)
    figure.axes[0].set_ylabel("mean SSIM")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside right upper", frameon=False, fontsize=9)
    return figure


def _similarity(rows: list[Row]) -> Figure:
    """How often a similarity occurs, a panel for each method."""
    figure = Figure(figsize=(9, 2.6), layout="constrained")
    grid = figure.subplots(1, len(METHODS), sharex=True, sharey=True)
    for axes, (method, colour) in zip(grid, COLOURS.items(), strict=True):
        values = [row["ssim"] for row in of(rows, method=method)]
        axes.hist(np.clip(values, 0, 1), np.linspace(0, 1, 21), color=colour)
        _mean_line(axes, method, float(np.mean(values)), ".2f")
        axes.set_xlabel("SSIM near")
    grid[0].set_ylabel("PSFs")
    figure.suptitle(f"at a sparsity of {SPARSITY:.1%}", fontsize=10)
    return figure


def _needed(rows: list[Row]) -> Figure:
    """How often a sparsity occurs, a panel for each method."""
    figure = Figure(figsize=(7, 2.8), layout="constrained")
    least = min(row[method] for row in rows for method in ("ours", "quad tree"))
    bins = np.geomspace(least / 1.01, 1.0, 21)
    grid = figure.subplots(1, 2, sharex=True, sharey=True)
    for axes, method in zip(grid, ("ours", "quad tree"), strict=True):
        axes.hist(np.minimum([row[method] for row in rows], 1.0), bins, color=COLOURS[method])
        _mean_line(axes, method, mean(rows, method), ".0%")
        axes.set(xscale="log", xlabel="sparsity")
        _per_cent(axes, [tick for tick in (0.003, 0.01, 0.03, 0.1, 0.3, 1.0) if tick > least / 2])
    grid[0].set_ylabel("PSFs")
    figure.suptitle("of the same L1 error", fontsize=10)
    return figure


def _sizes(rows: list[Row]) -> Figure:
    figure = Figure(figsize=(10, 3.6), layout="constrained")
    kinds = list(dict.fromkeys(row["kind"] for row in rows))
    for axes, kind in zip(figure.subplots(1, len(kinds), sharex=True, sharey=True), kinds, strict=True):
        for name, colour in zip(dict.fromkeys(row["name"] for row in of(rows, kind=kind)), SHADES, strict=False):
            chosen = of(rows, kind=kind, name=name)
            errors = [max(1 - row["ssim"], LEAST) for row in chosen]
            axes.plot([row["sparsity"] for row in chosen], errors, "o-", color=colour, label=name, markersize=3)
        axes.set(xscale="log", yscale="log", xlabel="sparsity", title=kind)
        _per_cent(axes, (0.001, 0.01, 0.1))
        axes.grid(alpha=0.25)
        axes.legend(frameon=False, fontsize=8, loc="lower left")
        axes.label_outer()
    figure.axes[0].set_ylabel("1 - SSIM near")
    return figure


def _samples(rows: list[Row]) -> Figure:
    figure = Figure(figsize=(6, 3.6), layout="constrained")
    axes = figure.subplots()
    ways = {"middle": "middle of the box", "prefiltered": "pre-filtered over the box", "linear": "linear interpolation"}
    for (way, name), colour in zip(ways.items(), ("#7f7f7f", "#d62728", "#1f77b4"), strict=True):
        axes.plot([row["samples"] for row in rows], [row[way] for row in rows], "o-", color=colour, label=name)
    axes.set(xscale="log", xlabel="samples", ylabel="mean SSIM near")
    axes.set_xticks([row["samples"] for row in rows], [str(row["samples"]) for row in rows])
    axes.xaxis.set_minor_locator(NullLocator())
    axes.grid(alpha=0.25)
    axes.legend(frameon=False, fontsize=9)
    return figure


def _rotation(rows: list[Row]) -> Figure:
    """A line for each sample, in the colour of its radius."""
    figure = Figure(figsize=(6.5, 3.8), layout="constrained")
    axes = figure.subplots()
    radii = [row["radius"] for row in rows]
    colours = ScalarMappable(LogNorm(min(radii), max(radii)), "viridis_r")
    for radius, length in dict.fromkeys((row["radius"], row["length"]) for row in rows):
        chosen = of(rows, radius=radius, length=length)
        axes.plot([row["degrees"] for row in chosen], [row["l1"] for row in chosen], color=colours.to_rgba(radius))
    axes.set(xlabel="angle in degrees", ylabel="relative L1 error", ylim=(0, None))
    axes.set_xticks(range(0, 46, 15))
    bar = figure.colorbar(colours, ax=axes, label="radius in px", format=FuncFormatter(lambda value, _: f"{value:g}"))
    bar.ax.yaxis.set_minor_formatter(FuncFormatter(lambda value, _: f"{value:g}" if f"{value:e}"[0] in "25" else ""))
    axes.grid(alpha=0.25)
    return figure


def _mean_line(axes: Axes, name: str, value: float, form: str) -> None:
    """A line at the mean, which is told in the title; counts are whole."""
    axes.axvline(value, color="0.2", linewidth=1, linestyle="--")
    axes.set_title(f"{name}, mean {value:{form}}", fontsize=10)
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))


def _per_cent(axes: Axes, ticks: Sequence[float]) -> None:
    axes.set_xticks(ticks, [f"{100 * tick:.3g} %" for tick in ticks])
    axes.xaxis.set_minor_locator(NullLocator())
