"""The sections of ``report.md`` on dispersion."""

from collections.abc import Sequence

from torchbokeh.report.markdown import Row, number, pictures, seconds, section, table


def chromatic_sections(rows: dict[str, list[Row]], settings: Row, plots: Sequence[str]) -> list[str]:
    """Those of all experiments on dispersion; empty ones without rows.

    Args:
        rows: of every experiment.
        settings: of the report.
        plots: names of the pictures beside it.
    """
    return [
        _truth(rows["chromatic_truth"], settings, plots),
        _samples(rows["chromatic_samples"]),
        _bands(rows["chromatic_bands"]),
        _importance(rows["importance"]),
    ]


def _truth(rows: list[Row], settings: Row, plots: Sequence[str]) -> str:
    if not rows:
        return ""
    size = settings["chromatic_size"]
    about = (
        f"{size} x {size}, radius up to {settings['chromatic_radius']:g} px, BK7. The truth is ChromaticAccumulation "
        f"of {settings['chromatic_truth']} views; the row *truth* compares its two halves, which have more noise than "
        "their mean. A border as wide as the largest radius, the spread of colours and 2 px is left out. *Times equal* "
        "is how many times longer the accumulation takes to come as near by SSIM; > where it does not with the views "
        "tried: then that is the ratio to the most views; < where it does so with the fewest. Medians of up to "
        f"{settings['chromatic_repeat']} runs."
    )
    head = ["scene", "spectrum", "axial", "lateral", "spread", "method", "", "seconds", "SSIM", "PSNR", "L1"]
    cells = []
    for row in rows:
        case = [row["scene"], row["spectrum"], *(f"{row[key]:g}" for key in ("axial", "lateral"))]
        time = seconds(row["seconds"]) if "seconds" in row else "-"
        found = [f"{row['ssim']:.4f}", number(row["psnr"], ".1f"), f"{row['l1']:.4f}"]
        equal = f"{row['bound']} {row['times_equal']:.2g}".strip() if "times_equal" in row else "-"
        cells.append([*case, f"{row['spread']:.1f}", row["method"], row["setting"], time, *found, equal])
    title = "Dispersion against the truth"
    return section(title, about, *pictures(plots, "chromatic"), table([*head, "times equal"], cells))


def _samples(rows: list[Row]) -> str:
    if not rows:
        return ""
    counts = list(dict.fromkeys(row["views"] for row in rows))
    lines = []
    for spectrum in dict.fromkeys(row["spectrum"] for row in rows):
        of = {row["views"]: row for row in rows if row["spectrum"] == spectrum}
        last = of[counts[-1]]
        line = [f"{1000 * last[key]:.3g}" for key in ("per_view", "fixed")]
        lines.append([spectrum, *(seconds(of[n]["seconds"]) for n in counts), *line, f"{last['r2']:.4f}"])
    size = f"{rows[0]['size']} x {rows[0]['size']}"
    return section(
        "Dispersion: run time against views",
        f"{rows[0]['scene']}, {size}, axial and lateral aberration: seconds of ChromaticAccumulation by views, the "
        "form of table 4.1 of the dissertation. The last columns are those of a straight line through them: "
        "milliseconds per view and of none, and the share of the variance that it explains.",
        table(["spectrum", *map(str, counts), "ms per view", "ms fixed", "R2"], lines),
    )


def _bands(rows: list[Row]) -> str:
    if not rows:
        return ""
    cells = [[row["method"], row["spectrum"], f"{1000 * row['banding']:.3g}"] for row in rows]
    return section(
        "Dispersion: bands of colour",
        f"A bright dot, blurred by {rows[0]['radius']:g} px in red light and {1.5 * rows[0]['radius']:g} px in blue. "
        "Banding is the energy of quick changes of its chromaticity (R - B) / (R + G + B) along the radius, those "
        "of periods below 8 px, in thousandths of that of slow ones. Noise of few views counts as well.",
        table(["method", "spectrum", "banding"], cells),
    )


def _importance(rows: list[Row]) -> str:
    if not rows:
        return ""
    row = rows[0]
    names = ("ratio", "ratio_red", "ratio_green", "ratio_blue")
    cells = [f"{row['variance_without']:.3g}", f"{row['variance']:.3g}", *(f"{row[name]:.3g}" for name in names)]
    return section(
        "Dispersion: importance sampling",
        f"A blurred dot from {row['samples']} samples of the spectrum under an equaliser that is a Gaussian about "
        f"{row['peak']:g} nm with a standard deviation of {row['width']:g} nm. Variance over {row['seeds']} seeds, "
        "the mean over pixels and channels, without importance and with it; their ratio, also of each channel.",
        table(["without", "with", "ratio", "red", "green", "blue"], [cells]),
    )
