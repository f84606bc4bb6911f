"""The pictures of an analysis of sparse PSFs."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, NullLocator

from torchbokeh.report.experiment import Figures
from torchbokeh.report.figures import legend, one_panel, per_cent
from torchbokeh.report.psfs.analysis import METHODS, SHARES, SPARSITY, THICK
from torchbokeh.report.rows import Row, distinct, mean, of

COLOURS = dict(zip(METHODS, ("#d62728", "#f0a08c", "#1f77b4", "#7f7f7f"), strict=True))
SHADES = ("#f6a58c", "#d62728", "#7a0c0c")
LEAST = 1e-5
"""Where plots put errors below this."""

PUBLISHED = {"LKS": (SPARSITY, 0.97), "quad tree": (SPARSITY, 0.89)}
"""Sparsity and similarity of LKS figure 10 a."""


def equal(rows: list[Row]) -> Figures:
    """Similarity against sparsity, a line for each method; and how often a similarity occurs."""
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
        per_cent(axes, SHARES)
        axes.grid(alpha=0.25)
    figure.axes[0].set_ylabel("mean SSIM")
    legend(figure, *axes.get_legend_handles_labels())
    return {"psfs_equal.png": figure, "psfs_similarity.png": _similarity(of(rows, share=SPARSITY))}


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


def needed(rows: list[Row]) -> Figures:
    """How often a sparsity occurs, a panel for each method."""
    figure = Figure(figsize=(7, 2.8), layout="constrained")
    least = min(row[method] for row in rows for method in ("ours", "quad tree"))
    bins = np.geomspace(least / 1.01, 1.0, 21)
    grid = figure.subplots(1, 2, sharex=True, sharey=True)
    for axes, method in zip(grid, ("ours", "quad tree"), strict=True):
        axes.hist(np.minimum([row[method] for row in rows], 1.0), bins, color=COLOURS[method])
        _mean_line(axes, method, mean(rows, method), ".0%")
        axes.set(xscale="log", xlabel="sparsity")
        per_cent(axes, [tick for tick in (0.003, 0.01, 0.03, 0.1, 0.3, 1.0) if tick > least / 2])
    grid[0].set_ylabel("PSFs")
    figure.suptitle("of the same L1 error", fontsize=10)
    return {"psfs_needed.png": figure}


def sizes(rows: list[Row]) -> Figures:
    """Error against sparsity, a panel for each kind."""
    figure = Figure(figsize=(10, 3.6), layout="constrained")
    kinds = distinct(rows, "kind")
    for axes, kind in zip(figure.subplots(1, len(kinds), sharex=True, sharey=True), kinds, strict=True):
        for name, colour in zip(distinct(of(rows, kind=kind), "name"), SHADES, strict=False):
            chosen = of(rows, kind=kind, name=name)
            errors = [max(1 - row["ssim"], LEAST) for row in chosen]
            axes.plot([row["sparsity"] for row in chosen], errors, "o-", color=colour, label=name, markersize=3)
        axes.set(xscale="log", yscale="log", xlabel="sparsity", title=kind)
        per_cent(axes, (0.001, 0.01, 0.1))
        axes.grid(alpha=0.25)
        axes.legend(frameon=False, fontsize=8, loc="lower left")
        axes.label_outer()
    figure.axes[0].set_ylabel("1 - SSIM near")
    return {"psfs_sizes.png": figure}


def samples(rows: list[Row]) -> Figures:
    """Similarity against the number of samples."""
    figure, axes = one_panel(6, 3.6)
    ways = {"middle": "middle of the box", "prefiltered": "pre-filtered over the box", "linear": "linear interpolation"}
    for (way, name), colour in zip(ways.items(), ("#7f7f7f", "#d62728", "#1f77b4"), strict=True):
        axes.plot([row["samples"] for row in rows], [row[way] for row in rows], "o-", color=colour, label=name)
    axes.set(xscale="log", xlabel="samples", ylabel="mean SSIM near")
    axes.set_xticks([row["samples"] for row in rows], [str(row["samples"]) for row in rows])
    axes.xaxis.set_minor_locator(NullLocator())
    axes.grid(alpha=0.25)
    axes.legend(frameon=False, fontsize=9)
    return {"psfs_samples.png": figure}


def _mean_line(axes: Axes, name: str, value: float, form: str) -> None:
    """A line at the mean, which is told in the title; counts are whole."""
    axes.axvline(value, color="0.2", linewidth=1, linestyle="--")
    axes.set_title(f"{name}, mean {value:{form}}", fontsize=10)
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
