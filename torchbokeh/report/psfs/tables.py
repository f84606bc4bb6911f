"""``psfs.md``: the tables of an analysis of sparse PSFs, and what a reader has to know about them."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from torchbokeh.report.markdown import row_table, section, table
from torchbokeh.report.psfs.analysis import METHODS, SHARES, SPARSITY, THICK
from torchbokeh.report.rows import Row, mean, of


def head(found: dict[str, Any]) -> str:
    """What the analysis is, and on which machine it ran."""
    made = found["machine"]
    return (
        "# Sparse PSFs\n\n"
        "The analysis of Leimkühler et al. 2018 (LKS), section 7.3 and figure 10, with the PSFs of this package.\n\n"
        f"{made['processor']}, {made['threads']} threads, torch {made['torch']}, numpy {made['numpy']}. It took "
        f"{found['seconds'] / 60:.1f} minutes. All numbers are in `psfs.json`.\n\n"
        "*Sparsity* is the number of points, or of squares of the quad tree, over the pixels that the dense PSF "
        "covers. *SSIM near* is taken in the PSF and 8 px around it, *in the frame* in 513 x 513 px as in LKS, "
        "where what is empty counts as right. L1 is the sum of absolute differences over the sum of the PSF."
    )


def equal(rows: list[Row], settings: Row, plots: Sequence[str]) -> str:
    """Similarity of every method at equal sparsity."""
    fewest, most = settings["support"]
    parts = [
        f"{settings['psfs']} capsules at random coordinates of the grid of `combined`, those that cover {fewest} to "
        f"{most} px. Every method gets the same number of points for each. *Ours* is elimination and refit, *Voronoi "
        "sums* has the same points with the values of LKS, *LKS* is their four steps. Efficiency is the mean SSIM "
        "over the mean sparsity, near / in the frame. Published are 0.97 at 9.3 %, an efficiency of 10.75, and with a "
        "quad tree 0.89 and 9.67; but LKS's PSFs are others, their 9.3 % is the mean of sparsities that differ from "
        "PSF to PSF, and it is not said which pixels the SSIM is of. Thin PSFs are lines along x here, which suits the "
        "quad tree; it cannot be turned.",
        "![similarity against sparsity](psfs_equal.png)",
        row_table(
            [_equal_row(of(rows, share=share, method=method)) for share in SHARES for method in METHODS],
            f"asked | method | sparsity % | SSIM near | of r >= {THICK} px | SSIM in the frame | L1 | efficiency",
            "{share:.1%} | {method} | {sparsity:.2f} | {ssim:.3f} | {thick:.3f} | {ssim_frame:.4f} | {l1:.3f} | "
            "{near:.2f} / {frame:.2f}",
        ),
        "![distribution of similarity](psfs_similarity.png)",
    ]
    return section("Equal sparsity", *parts)


def _equal_row(rows: list[Row]) -> Row:
    """The means of one method at one sparsity."""
    thick = [row for row in rows if row["radius"] >= THICK]
    means = {key: mean(rows, key) for key in ("sparsity", "ssim", "ssim_frame", "l1")}
    efficiency = {"near": means["ssim"] / means["sparsity"], "frame": means["ssim_frame"] / means["sparsity"]}
    near_thick = mean(thick, "ssim") if thick else None
    return {**rows[0], **means, **efficiency, "sparsity": 100 * means["sparsity"], "thick": near_thick}


def needed(rows: list[Row], settings: Row, plots: Sequence[str]) -> str:
    """The sparsity that every PSF needs."""
    domains = [row["domain"] for row in rows]
    counts = ", ".join(f"{domains.count(name)} {name}" for name in dict.fromkeys(domains))
    shares = {name: [100 * row[name] for row in rows] for name in ("ours", "quad tree")}
    lines = [{"name": name, "mean": np.mean(share), "median": np.median(share)} for name, share in shares.items()]
    return section(
        "Sparsity that a PSF needs",
        "The same capsules as banks represent them (the fewest points at SSIM near >= 0.97 and L1 <= 4 %, or each "
        f"pixel where that is no more; here {counts}), and the quad tree of the same L1.",
        "![distribution of sparsity](psfs_needed.png)",
        row_table(lines, " | mean % | median %", "{name} | {mean:.1f} | {median:.1f}"),
    )


def sizes(rows: list[Row], settings: Row, plots: Sequence[str]) -> str:
    """Similarity against sparsity for several sizes: the plot says it."""
    return section(
        "Sparsity and size",
        "Three sizes of each kind. Lines end where all candidates are taken.",
        "![similarity against sparsity for three sizes](psfs_sizes.png)",
    )


def samples(rows: list[Row], settings: Row, plots: Sequence[str]) -> str:
    """How near the samples of grids are."""
    ways = ("middle", "prefiltered", "linear")
    header = "cells | samples" + "".join(f" | {way}, near | {way}, frame" for way in ways)
    cells = "{cells} | {samples}" + "".join(f" | {{{way}:.3f}} | {{{way}_frame:.4f}}" for way in ways)
    return section(
        "Number of samples",
        f"Mean similarity of the PSF at {settings['coordinates']} random coordinates with the dense sample of its box "
        "(in the middle of the box, or pre-filtered over it), and with linear interpolation between middles.",
        "![similarity against the number of samples](psfs_samples.png)",
        row_table(rows, header, cells),
    )


def ablation(rows: list[Row], settings: Row, plots: Sequence[str]) -> str:
    """What each step of LKS is worth."""
    return section(
        "The steps of LKS",
        f"Mean L1 error of {settings['ablated']} of the capsules at {SPARSITY:.1%}, over that of darts alone.",
        table(
            ["", *(row["step"] for row in rows)],
            [[name, *(f"{row[name]:.1%}" for row in rows)] for name in ("here", "LKS")],
        ),
    )


def large(rows: list[Row], settings: Row, plots: Sequence[str]) -> str:
    """The sparsity that large PSFs need."""
    header = "r px | l px | covers px | near | in the frame | SSIM near of all"
    cells = "{radius:g} | {length:g} | {support} | {ssim:.2%} | {ssim_frame:.2%} | {best:.4f}"
    return section(
        "Large PSFs",
        "The least sparsity at which the similarity is 0.99, and the similarity that all candidates have.",
        row_table(rows, header, cells),
    )
