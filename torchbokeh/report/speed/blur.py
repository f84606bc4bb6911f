"""The experiments on the front door, `torchbokeh.LensBlur`: against the truth, against layers, what a plan saves."""

from collections.abc import Sequence
from functools import partial

import torch
from torch import Tensor

import torchbokeh
from torchbokeh.report.experiment import Experiment, Figures
from torchbokeh.report.internals import QUALITY_NAMES
from torchbokeh.report.markdown import cross_table, pictures, row_table, seconds, section
from torchbokeh.report.measure import Timing, Work, errors, measure
from torchbokeh.report.rows import Row, Say, distinct, of
from torchbokeh.report.scenes import PHOTO, LayeredPicture, Picture, layered_picture, photo, special
from torchbokeh.report.settings import Settings
from torchbokeh.report.speed.baselines import baselines
from torchbokeh.report.speed.layered import bins
from torchbokeh.report.speed.methods import own_methods, own_name

QUALITY = "balanced"
"""The quality of the experiments that vary something else: that of a `LensBlur` which is told none."""

INPUTS = ("image", "image and background", "layers")


def against_truth(settings: Settings, say: Say) -> list[Row]:
    """Every quality and kind of input on the recipes: against the exact quality, and against the truth.

    The truth is the mean of many pinhole pictures through the lens; the row with the input ``truth`` compares its two
    independent halves, and so says how far it can be trusted. Errors leave out a border as wide as the largest radius,
    since light from beyond it is in the truth only.
    """
    rows = []
    for name in settings.scenes:
        if name == PHOTO:
            continue
        say(f"LensBlur against the truth: {name}, {settings.truth_size} px, radius {settings.truth_radius:g} px")
        seen = layered_picture(name, settings.truth_size, settings.truth_radius, settings.truth_views)
        rows += [{"scene": name, **row} for row in _truth_rows(seen, settings)]
    return rows


def _truth_rows(seen: LayeredPicture, settings: Settings) -> list[Row]:
    border = min(-int(-settings.truth_radius // 1), (settings.truth_size - 8) // 2)
    splats = own_methods()
    works: dict[str, Work] = {}
    for quality in QUALITY_NAMES:
        works[f"one layer, {quality}"] = partial(splats[own_name(quality)].run, seen.image, seen.coc)
        for given in INPUTS:
            works[f"{given}, {quality}"] = partial(_blur, seen, given, torchbokeh.LensBlur(quality=quality))
    timings = measure(works, settings.repeat, settings.sweep_budget)
    noise = _named("truth", errors(*seen.halves, border))
    rows: list[Row] = [{"input": "truth", "quality": "half of the views", **noise}]
    for quality in QUALITY_NAMES:
        base = timings[f"one layer, {quality}"].row["seconds"]
        for given in ("one layer", *INPUTS):
            timing, exact = timings[f"{given}, {quality}"], timings[f"{given}, exact"]
            row = {"input": given, "quality": quality, **timing.row, "times_one_layer": timing.row["seconds"] / base}
            row |= _named("truth", errors(timing.result, seen.truth, border))
            rows.append(row | _named("exact", errors(timing.result, exact.result, border)))
    return rows


def _blur(seen: LayeredPicture, given: str, blur: torch.nn.Module) -> Tensor:
    if given == "layers":
        return blur(seen.layers, coc=seen.layer_coc)[:, :3]
    background = (seen.background, seen.background_coc) if given == "image and background" else None
    return blur(seen.image, coc=seen.coc, background=background)


def _named(against: str, found: dict[str, float | None]) -> Row:
    return {f"{key}_{against}": value for key, value in found.items()}


def _truth_section(rows: list[Row], settings: Row, plots: Sequence[str]) -> str:
    key = "input, quality"
    rows = [{**row, key: f"{row['input']}, {row['quality']}"} for row in rows]
    means = [{**_mean(of(rows, **{key: kind})), key: kind, "scene": "mean"} for kind in distinct(rows, key)]
    of_blurs = [row for row in rows + means if "ssim_exact" in row]
    return section(
        "LensBlur against the truth",
        "The truth is the mean of many pinhole pictures through the lens, with the shutter open for no time. Its two "
        "independent halves agree as the first row says; the truth is their mean. A border as wide as the largest "
        "radius is left out. *One layer* is KernelSplatting, the other inputs are those of LensBlur: an image with its "
        "CoC, the same with what the foreground really hides, and all layers.",
        *pictures(plots, "truth"),
        "SSIM / PSNR against the truth:",
        cross_table(rows + means, key, "scene", "{ssim_truth:.4f} / {psnr_truth:.1f}", ""),
        "SSIM against the exact quality (seconds, and how many times those of one layer at the same quality):",
        cross_table(of_blurs, key, "scene", "{ssim_exact:.4f} ({seconds:t}, {times_one_layer:.1f})", ""),
    )


def _mean(rows: list[Row]) -> Row:
    """The mean of every number that all rows have."""
    keys = [key for key in rows[0] if all(isinstance(row.get(key), float) for row in rows)]
    return {"psnr_truth": None} | {key: sum(row[key] for row in rows) / len(rows) for key in keys}


def _truth_figures(rows: list[Row]) -> Figures:
    from torchbokeh.report.figures import against_truth

    colours = {"one layer": "#1f77b4", "image": "#d62728", "image and background": "#2ca02c", "layers": "#9467bd"}
    title = "LensBlur by input and quality, mean over the recipes"
    return {"truth.png": against_truth(rows, "input", "quality", "ssim_truth", colours, title)}


def against_layers(settings: Settings, say: Say) -> list[Row]:
    """Run time against the number of bins of an image, ``LensBlur(layers=n)``, and of layers of the input."""
    seen = photo(settings.photo_size, settings.sweep_radius)
    say(f"run time against layers: {', '.join(map(str, settings.layer_counts))}")
    works: dict[tuple[str, int], Work] = {}
    for count in settings.layer_counts:
        one = torchbokeh.LensBlur(layers=count, quality=QUALITY)
        works["bins of an image", count] = partial(one, seen.image, coc=seen.coc)
        layers, coc = slabs(seen, count)
        works["layers of the input", count] = partial(torchbokeh.LensBlur(quality=QUALITY), layers, coc=coc)
    timings = measure(
        {f"{kind}, {count}": work for (kind, count), work in works.items()}, settings.repeat, settings.sweep_budget
    )
    return [
        {"kind": kind, "layers": count, "size": settings.photo_size, "radius": settings.sweep_radius}
        | timings[f"{kind}, {count}"].row
        for kind, count in works
    ]


def _layer_section(rows: list[Row], settings: Row, plots: Sequence[str]) -> str:
    kinds = [{**row, "": row["kind"]} for row in rows]
    return section(
        "Run time against layers",
        f"photo, {rows[0]['size']} x {rows[0]['size']}, radius up to {rows[0]['radius']:g} px; seconds of LensBlur:",
        *pictures(plots, "layers"),
        cross_table(kinds, "", "layers", "{seconds:t}"),
    )


def _layer_figures(rows: list[Row]) -> Figures:
    from torchbokeh.report.figures import one_panel

    figure, axes = one_panel(7.5, 4)
    for kind, colour in zip(distinct(rows, "kind"), ("#d62728", "#9467bd"), strict=True):
        chosen = of(rows, kind=kind)
        axes.plot([r["layers"] for r in chosen], [r["seconds"] for r in chosen], "o-", color=colour, label=kind)
    title = f"LensBlur, {rows[0]['size']} x {rows[0]['size']}"
    axes.set(xlabel="layers", ylabel="seconds", title=title, ylim=(0, None), xticks=sorted(distinct(rows, "layers")))
    axes.grid(alpha=0.25)
    axes.legend(frameon=False)
    return {"layers.png": figure}


def slabs(seen: Picture, count: int) -> tuple[Tensor, Tensor]:
    """A picture cut into layers of equal depth of CoC.

    Args:
        seen: the picture.
        count: the most layers; empty ones are left out.

    Returns:
        ``(1, L, 4, H, W)`` premultiplied, front to back, and their CoC ``(1, L, 1, H, W)``.
    """
    rgba = torch.cat([seen.image, torch.ones_like(seen.coc)], 1)
    layers = [rgba * inside for inside, _ in bins(seen.coc, count)]
    return torch.stack(layers, 1), seen.coc[:, None].expand(-1, len(layers), -1, -1, -1).contiguous()


def left_out(settings: Settings, say: Say) -> list[Row]:
    """What the plan of special scenes leaves out, and how much time that saves; with the obvious way beside it."""
    say("what the plan leaves out")
    pictures = special(settings.photo_size, settings.sweep_radius)
    blur = torchbokeh.LensBlur(quality=QUALITY)
    splat = own_methods()[own_name(QUALITY)]
    fixed = [method for method in baselines().values() if method.one_depth]
    works: dict[str, Work] = {}
    for name, seen in pictures.items():
        works[f"{name}: blur"] = partial(blur, seen.image, coc=seen.coc)
        works[f"{name}: one layer"] = partial(splat.run, seen.image, seen.coc)
    works["all in focus: image.clone()"] = pictures["all in focus"].image.clone
    depth = pictures["one depth"]
    for method in fixed:
        if method.obstacle(depth.coc, settings.cap) is None:
            works[f"one depth: {method.name}"] = partial(method.run, depth.image, depth.coc)
    timings = measure(works, settings.repeat, settings.sweep_budget)
    return [_left_out_row(name, pictures[name], blur, timings) for name in pictures]


def _left_out_row(name: str, seen: Picture, blur: torchbokeh.LensBlur, timings: dict[str, Timing]) -> Row:
    seconds = {key.split(": ")[1]: t.row["seconds"] for key, t in timings.items() if key.startswith(f"{name}: ")}
    full = timings["full: blur"].row["seconds"]
    beside = {other: value for other, value in seconds.items() if other not in ("blur", "one layer")}
    return {
        "scene": name,
        "plan": str(blur.plan(seen.image, coc=seen.coc)),
        **timings[f"{name}: blur"].row,
        "share_of_full": timings[f"{name}: blur"].row["seconds"] / full,
        "one_layer_seconds": seconds["one layer"],
        "beside": beside,
    }


def _left_out_section(rows: list[Row], settings: Row, plots: Sequence[str]) -> str:
    size = settings["photo_size"]
    for row in (rows := [dict(row) for row in rows]):
        row["beside"] = "; ".join(f"{name} {seconds(value)} s" for name, value in row["beside"].items())
        row["plan"] = row["plan"].replace("\n", "<br>").replace("|", "\\|")
    header = "scene | seconds | of full | one layer | beside | plan"
    cells = "{scene} | {seconds:t} | {share_of_full:.0%} | {one_layer_seconds:t} | {beside} | {plan}"
    return section(
        "What a plan leaves out",
        f"{size} x {size}, radius up to {settings['sweep_radius']:g} px. Seconds of LensBlur with its plan, their "
        "share of those of the full scene, and seconds of the one-layer splat of the same picture.",
        row_table(rows, header, cells),
    )


TRUTH = Experiment("truth", against_truth, _truth_section, _truth_figures)
LAYERS = Experiment("layers", against_layers, _layer_section, _layer_figures)
LEFT_OUT = Experiment("left_out", left_out, _left_out_section)
