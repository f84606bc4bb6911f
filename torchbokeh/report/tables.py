"""``report.md``: the tables of a report, and what a reader has to know about them."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any

from torchbokeh.report.chromatic.tables import chromatic_sections
from torchbokeh.report.markdown import Row, number, pictures, seconds, section, skipped, spread, table
from torchbokeh.report.speed.exported import export_section
from torchbokeh.report.speed.gradients import gradient_section


def markdown(found: dict[str, Any], plots: Sequence[str]) -> str:
    """The whole report.

    Args:
        found: what `torchbokeh.report.run.run_experiments` returns.
        plots: names of the pictures beside the report; each is shown in the section whose name it begins with.

    Returns:
        Markdown.
    """
    rows, settings = found["experiments"], found["settings"]
    sections = [
        _head(found),
        _one_layer(rows["one_layer"], plots),
        _truth(rows["truth"], plots),
        _radius(rows["radius"], plots),
        _pixels(rows["pixels"], plots),
        _layers(rows["layers"], plots),
        _threads(rows["threads"], settings, plots),
        gradient_section(rows["gradients"], settings),
        export_section(rows["export"], settings),
        _motion(rows["motion"]),
        _like_lks(rows["like_lks"], settings),
        *chromatic_sections(rows, settings, plots),
        _left_out(rows["left_out"], settings),
        _stages(rows["stages"]),
        _methods(found["methods"], found["absent"]),
    ]
    return "\n\n".join(section for section in sections if section) + "\n"


def _head(found: dict[str, Any]) -> str:
    made, settings = found["machine"], found["settings"]
    versions = ", ".join(f"{k} {v}" for k, v in made.items() if k not in ("processor", "processors", "threads"))
    return "\n\n".join(
        [
            "# Error and run time",
            f"{made['processor']}, processors: {made['processors']}, threads: {made['threads']}; {versions}. "
            f"The whole report took {found['seconds'] / 60:.1f} minutes.",
            f"Run times are medians of up to {settings['repeat']} runs after one to warm up, all methods of a table by "
            f"turns. Where these would take more than {settings['budget']:g} s ({settings['recipe_budget']:g} s for "
            f"recipes as one layer, {settings['sweep_budget']:g} s from then on) there are fewer (column *runs*). The "
            "spread is from the first to the third quartile. Compiling, and tables that depend on the largest radius "
            "only, are not counted. SSIM, PSNR and FLIP are of `clip(x, 0, 1) ** (1/2.2)`, L1 is the sum of absolute "
            "differences of linear values over the sum of the reference. All numbers, with fastest and slowest run, "
            "are in `report.json`.",
        ]
    )


def _one_layer(rows: list[Row], plots: Sequence[str]) -> str:
    if not rows:
        return ""
    text = (
        "One layer: every pixel spreads evenly over its disc, and what comes out is divided by its coverage. The "
        "reference is this package's exact splat: the torch definition in double for up to 512 x 512 pixels, the "
        "float32 kernel, which sums in double, beyond. Methods that put layers *over* one another do something else on "
        "purpose, occlusion: that is in their error here; those that *sum* do not. No method is both faster and nearer "
        "than one with a *."
    )
    parts = [text]
    for radius in dict.fromkeys(row["radius"] for row in rows if row["scene"] == "photo"):
        chosen = [row for row in rows if row["scene"] == "photo" and row["radius"] == radius]
        parts.append(f"### photo, {chosen[0]['size']} x {chosen[0]['size']}, radius up to {radius:g} px")
        parts += [*pictures(plots, f"one_layer_{radius:g}"), _error_table(chosen), skipped(chosen)]
    recipes = [row for row in rows if row["scene"] != "photo"]
    if recipes:
        parts.append(
            f"### recipes, {recipes[0]['size']} x {recipes[0]['size']}, radius up to {recipes[0]['radius']:g} px"
        )
        parts += [*pictures(plots, "one_layer_recipes"), "SSIM (seconds)", _recipe_table(recipes)]
    return section("Error against run time", *parts)


def _error_table(rows: list[Row]) -> str:
    run = sorted((row for row in rows if "skipped" not in row), key=lambda row: row["seconds"])
    header = ["method", "seconds", "spread", "runs", "SSIM", "PSNR", "L1", "FLIP", ""]
    return table(
        header,
        (
            (
                *(row["method"], seconds(row["seconds"]), spread(row), str(row["runs"]), f"{row['ssim']:.5f}"),
                *(number(row["psnr"], ".1f"), f"{row['l1']:.2g}", number(row["flip"], ".4f"), "*" * row["pareto"]),
            )
            for row in run
        ),
    )


def _recipe_table(rows: list[Row]) -> str:
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    cells: dict[str, dict[str, str]] = {}
    for row in rows:
        star = "*" if row.get("pareto") else ""
        text = "-" if "skipped" in row else f"{row['ssim']:.4f} ({seconds(row['seconds'])}){star}"
        cells.setdefault(row["method"], {})[row["scene"]] = text
    run = {name: by for name, by in cells.items() if set(by.values()) != {"-"}}
    return table(["method", *scenes], ([name, *(by.get(scene, "-") for scene in scenes)] for name, by in run.items()))


def _truth(rows: list[Row], plots: Sequence[str]) -> str:
    if not rows:
        return ""
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    kinds = list(dict.fromkeys((row["input"], row["quality"]) for row in rows))
    of = {(row["scene"], row["input"], row["quality"]): row for row in rows}

    def to_truth(row: Row) -> str:
        return f"{row['ssim_truth']:.4f} / {number(row['psnr_truth'], '.1f')}"

    def to_exact(row: Row) -> str:
        return f"{row['ssim_exact']:.4f} ({seconds(row['seconds'])}, {row['times_one_layer']:.1f})"

    def lines(shown: Iterable[tuple[str, str]], form: Callable[[Row], str]) -> str:
        found = ((kind, [of[scene, *kind] for scene in scenes]) for kind in shown)
        return table(
            ["input, quality", *scenes, "mean"],
            ([", ".join(kind), *map(form, each), form(_mean(each))] for kind, each in found),
        )

    return section(
        "LensBlur against the truth",
        "The truth is the mean of many pinhole pictures through the lens, with the shutter open for no time. Its two "
        "independent halves agree as the first row says; the truth is their mean. A border as wide as the largest "
        "radius is left out. *One layer* is KernelSplatting, the other inputs are those of LensBlur: an image with its "
        "CoC, the same with what the foreground really hides, and all layers.",
        *pictures(plots, "truth"),
        "SSIM / PSNR against the truth:",
        lines(kinds, to_truth),
        "SSIM against the exact quality (seconds, and how many times those of one layer at the same quality):",
        lines([kind for kind in kinds if kind[0] != "truth"], to_exact),
    )


def _mean(rows: list[Row]) -> Row:
    """The mean of every number that all rows have."""
    keys = [key for key in rows[0] if all(isinstance(row.get(key), float) for row in rows)]
    return {"psnr_truth": None} | {key: sum(row[key] for row in rows) / len(rows) for key in keys}


def _by_method(rows: list[Row], column: str, form: Callable[[Row], str]) -> str:
    """A table with a row for each method and a column for each value of ``column``."""
    values = list(dict.fromkeys(row[column] for row in rows))
    names = dict.fromkeys(row["method"] for row in rows)
    of = {(row["method"], row[column]): row for row in rows}

    def cell(name: str, value: Any) -> str:
        row = of.get((name, value))
        return "-" if row is None or "skipped" in row else form(row)

    header = ["method", *(f"{value:.3g}" for value in values)]
    return table(header, ([name, *(cell(name, value) for value in values)] for name in names))


def _radius(rows: list[Row], plots: Sequence[str]) -> str:
    if not rows:
        return ""
    return section(
        "Run time against radius",
        f"photo, {rows[0]['size']} x {rows[0]['size']}; columns: largest radius in px. Seconds (SSIM):",
        *pictures(plots, "radius"),
        _by_method(rows, "radius", lambda row: f"{seconds(row['seconds'])} ({row['ssim']:.4f})"),
        skipped([{**row, "where": f"{row['radius']:g} px"} for row in rows]),
    )


def _pixels(rows: list[Row], plots: Sequence[str]) -> str:
    if not rows:
        return ""
    parts = [
        f"photo, radius up to {rows[0]['radius']:g} px; columns: megapixels (10^6). Seconds:",
        *pictures(plots, "pixels"),
        _by_method(rows, "megapixels", lambda row: seconds(row["seconds"])),
    ]
    if any(row.get("peak_bytes") for row in rows):
        parts += [
            "Peak memory of one call beyond its inputs, in MB (10^6) per megapixel, each in a process of its own: the "
            "highest resident memory during the call less that before it.",
            _by_method([row for row in rows if row.get("peak_bytes")], "megapixels", _megabytes),
        ]
    return section("Run time and memory against pixels", *parts, skipped(rows))


def _megabytes(row: Row) -> str:
    return f"{row['bytes_per_megapixel'] / 1e6:.0f}"


def _layers(rows: list[Row], plots: Sequence[str]) -> str:
    if not rows:
        return ""
    counts = list(dict.fromkeys(row["layers"] for row in rows))
    of = {(row["kind"], row["layers"]): row for row in rows}
    kinds = dict.fromkeys(row["kind"] for row in rows)
    return section(
        "Run time against layers",
        f"photo, {rows[0]['size']} x {rows[0]['size']}, radius up to {rows[0]['radius']:g} px; seconds of LensBlur:",
        *pictures(plots, "layers"),
        table(
            ["", *map(str, counts)],
            ([kind, *(seconds(of[kind, count]["seconds"]) for count in counts)] for kind in kinds),
        ),
    )


def _threads(rows: list[Row], settings: Row, plots: Sequence[str]) -> str:
    if not rows:
        return ""
    same = all(row["same_bits"] for row in rows)
    differ = dict.fromkeys(row["method"] for row in rows if not row["same_bits"])
    return section(
        "Run time against threads",
        f"photo, {settings['photo_size']} x {settings['photo_size']}, radius up to {settings['sweep_radius']:g} px; "
        "columns: threads. Seconds:",
        *pictures(plots, "threads"),
        _by_method(rows, "threads", lambda row: seconds(row["seconds"])),
        "The bits are those of one thread, always."
        if same
        else f"The bits depend on the threads: {', '.join(differ)}.",
    )


def _motion(rows: list[Row]) -> str:
    if not rows:
        return ""
    size = f"{rows[0]['size']} x {rows[0]['size']}"
    cells = []
    for row in rows:
        errors = [number(row["ssim"], ".4f"), number(row["psnr"], ".1f"), number(row["l1"], ".4f")]
        what = [f"{row['radius']:g}", f"{row['longest']:g}", row["method"]]
        cells.append([*what, seconds(row["seconds"]), f"{row['times_dense']:.1f}", *errors])
    head = ["radius", "motion", "method", "seconds", "times dense", "SSIM", "PSNR", "L1"]
    about = f"photo, {size}, turning; up to so many px of radius and motion; errors against the dense scatter."
    return section("Defocus with motion", about, table(head, cells))


def like_lks_table(rows: list[Row]) -> str:
    """The rows of `torchbokeh.report.motion.experiments.like_lks` as a Markdown table."""
    head = ["scene", "kind", "method", "seconds", "times dense", "SSIM", "PSNR", "L1"]
    cells = [
        [row["scene"], row["kind"], row["method"], seconds(row["seconds"]), number(row["times_dense"], ".1f")]
        + [number(row[key], form) for key, form in (("ssim", ".4f"), ("psnr", ".1f"), ("l1", ".4f"))]
        for row in rows
    ]
    return table(head, cells)


def _like_lks(rows: list[Row], settings: Row) -> str:
    if not rows:
        return ""
    size = settings["truth_size"]
    about = (
        f"Tables 2 and 3 of LKS with recipes of this package, {size} x {size}, radius up to "
        f"{settings['truth_radius']:g} px: synthesis from the pinhole picture or its layers, and reconstruction from "
        f"one sample per pixel; the truth is an accumulation buffer of {2 * settings['truth_views']} views. Times are "
        "beside the dense scatter of the same input: picture, layers or samples. Re-weighted: layers over one "
        "another, as LKS composes them after Lee et al. (2008). The time of non-local means is that of five "
        "strengths, of which the best one counts."
    )
    return section("Synthesis and reconstruction", about, like_lks_table(rows))


def _left_out(rows: list[Row], settings: Row) -> str:
    if not rows:
        return ""

    def beside(row: Row) -> str:
        return "; ".join(f"{name} {seconds(value)} s" for name, value in row["beside"].items())

    size = settings["photo_size"]
    return section(
        "What a plan leaves out",
        f"{size} x {size}, radius up to {settings['sweep_radius']:g} px. Seconds of LensBlur with its plan, their "
        "share of those of the full scene, and seconds of the one-layer splat of the same picture.",
        table(
            ["scene", "seconds", "of full", "one layer", "beside", "plan"],
            (
                (
                    *(row["scene"], seconds(row["seconds"]), f"{row['share_of_full']:.0%}"),
                    *(seconds(row["one_layer_seconds"]), beside(row)),
                    row["plan"].replace("\n", "<br>").replace("|", "\\|"),
                )
                for row in rows
            ),
        ),
    )


def _stages(rows: list[Row]) -> str:
    if not rows:
        return ""
    header = ["quality", "radius", "stage", "seconds", "share", "least seconds"]
    return section(
        "Share of each stage",
        table(
            header,
            (
                (
                    *(row["quality"], f"{row['radius']:g}", row["stage"], seconds(row["seconds"])),
                    f"{row['share']:.0%}",
                    "-" if row.get("least_seconds") is None else seconds(row["least_seconds"]),
                )
                for row in rows
            ),
        ),
    )


def _methods(methods: list[Row], absent: list[str]) -> str:
    missing = "Not measured here:\n\n" + "\n".join(f"- {line}" for line in absent) if absent else ""
    rows = ([row["name"], row["description"]] for row in methods)
    return section("What the methods are", table(["method", "what it does"], rows), missing)
