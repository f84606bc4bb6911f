"""The experiments on dispersion, with their sections of ``report.md`` and their plot."""

from collections.abc import Sequence

from torchbokeh.report.chromatic.experiments import chromatic_bands, chromatic_samples, chromatic_truth, importance
from torchbokeh.report.experiment import Experiment, Figures
from torchbokeh.report.markdown import pictures, row_table, seconds, section, table
from torchbokeh.report.rows import Row, distinct, of


def _truth(rows: list[Row], settings: Row, plots: Sequence[str]) -> str:
    size = settings["chromatic_size"]
    about = (
        f"{size} x {size}, radius up to {settings['chromatic_radius']:g} px, BK7. The truth is ChromaticAccumulation "
        f"of {settings['chromatic_truth']} views; the row *truth* compares its two halves, which have more noise than "
        "their mean. A border as wide as the largest radius, the spread of colours and 2 px is left out. *Times equal* "
        "is how many times longer the accumulation takes to come as near by SSIM; > where it does not with the views "
        "tried: then that is the ratio to the most views; < where it does so with the fewest. Medians of up to "
        f"{settings['chromatic_repeat']} runs."
    )
    rows = [
        {**row, "equal": f"{row['bound']} {row['times_equal']:.2g}".strip()} if "bound" in row else row for row in rows
    ]
    header = "scene | spectrum | axial | lateral | spread | method |  | seconds | SSIM | PSNR | L1 | times equal"
    cells = "{scene} | {spectrum} | {axial:g} | {lateral:g} | {spread:.1f} | {method} | {setting} | {seconds:t} | "
    cells += "{ssim:.4f} | {psnr:.1f} | {l1:.4f} | {equal}"
    return section("Dispersion against the truth", about, *pictures(plots, "chromatic"), row_table(rows, header, cells))


def _truth_figures(rows: list[Row]) -> Figures:
    from torchbokeh.report.figures import against_truth

    names = [name for name in distinct(rows, "method") if name != "truth"]
    colours = dict(zip(names, ("#9467bd", "#d62728", "#1f77b4"), strict=True))
    title = "With dispersion, mean over scenes, spectra and strengths"
    return {"chromatic.png": against_truth(rows, "method", "setting", "ssim", colours, title)}


def _samples(rows: list[Row], settings: Row, plots: Sequence[str]) -> str:
    lines = []
    for spectrum in distinct(rows, "spectrum"):
        chosen = of(rows, spectrum=spectrum)
        line = [f"{1000 * chosen[0][key]:.3g}" for key in ("per_view", "fixed")]
        lines.append([spectrum, *(seconds(row["seconds"]) for row in chosen), *line, f"{chosen[0]['r2']:.4f}"])
    size = f"{rows[0]['size']} x {rows[0]['size']}"
    return section(
        "Dispersion: run time against views",
        f"{rows[0]['scene']}, {size}, axial and lateral aberration: seconds of ChromaticAccumulation by views, the "
        "form of table 4.1 of the dissertation. The last columns are those of a straight line through them: "
        "milliseconds per view and of none, and the share of the variance that it explains.",
        table(["spectrum", *map(str, distinct(rows, "views")), "ms per view", "ms fixed", "R2"], lines),
    )


def _bands(rows: list[Row], settings: Row, plots: Sequence[str]) -> str:
    thousandths = [{**row, "banding": 1000 * row["banding"]} for row in rows]
    return section(
        "Dispersion: bands of colour",
        f"A bright dot, blurred by {rows[0]['radius']:g} px in red light and {1.5 * rows[0]['radius']:g} px in blue. "
        "Banding is the energy of quick changes of its chromaticity (R - B) / (R + G + B) along the radius, those "
        "of periods below 8 px, in thousandths of that of slow ones. Noise of few views counts as well.",
        row_table(thousandths, "method | spectrum | banding", "{method} | {spectrum} | {banding:.3g}"),
    )


def _importance(rows: list[Row], settings: Row, plots: Sequence[str]) -> str:
    row = rows[0]
    header = "without | with | ratio | red | green | blue"
    cells = (
        "{variance_without:.3g} | {variance:.3g} | {ratio:.3g} | {ratio_red:.3g} | {ratio_green:.3g} | {ratio_blue:.3g}"
    )
    return section(
        "Dispersion: importance sampling",
        f"A blurred dot from {row['samples']} samples of the spectrum under an equaliser that is a Gaussian about "
        f"{row['peak']:g} nm with a standard deviation of {row['width']:g} nm. Variance over {row['seeds']} seeds, "
        "the mean over pixels and channels, without importance and with it; their ratio, also of each channel.",
        row_table(rows, header, cells),
    )


TRUTH = Experiment("chromatic_truth", chromatic_truth, _truth, _truth_figures)
SAMPLES = Experiment("chromatic_samples", chromatic_samples, _samples)
BANDS = Experiment("chromatic_bands", chromatic_bands, _bands)
IMPORTANCE = Experiment("importance", importance, _importance)
