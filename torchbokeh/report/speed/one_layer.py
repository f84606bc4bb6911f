"""Error against run time of every method as one layer, and how methods are compared on a picture."""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple, Self

import torch
from torch import Tensor

from torchbokeh.ops.splat import splat_spans
from torchbokeh.psfs.aperture import Disc
from torchbokeh.report.experiment import Experiment, Figures
from torchbokeh.report.markdown import cross_table, pictures, row_table, section, skipped
from torchbokeh.report.measure import Timing, errors, measure, pareto_front
from torchbokeh.report.rows import Row, Say, distinct, not_skipped, of
from torchbokeh.report.scenes import PHOTO, Picture, picture
from torchbokeh.report.settings import Settings
from torchbokeh.report.speed.methods import Method
from torchbokeh.report.speed.registry import one_layer_methods


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
            measured = compare(one_layer_methods(), seen, reference(seen), limits)
            rows += [{"scene": name, "size": size, "radius": radius, **row} for row in measured]
    return rows


def compare(
    chosen: Mapping[str, Method], seen: Picture, wanted: Tensor, limits: Limits, *, flip: bool = True
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
    found = run_methods(chosen, seen, limits)
    rows = [row if out is None else row | errors(out, wanted, flip=flip) for row, out in found]
    run = not_skipped(rows)
    front = pareto_front([(row["seconds"], 1 - row["ssim"]) for row in run])
    for k, row in enumerate(run):
        row["pareto"] = k in front
    return rows


def run_methods(chosen: Mapping[str, Method], seen: Picture, limits: Limits) -> Iterator[tuple[Row, Tensor | None]]:
    """Time those methods that can be run on a picture.

    Yields:
        For each method its row, and the picture that it makes; None where it was not run, of which the row says why.
    """
    obstacles = {name: method.obstacle(seen.coc, limits.cap) for name, method in chosen.items()}
    timings = time_methods([m for name, m in chosen.items() if obstacles[name] is None], seen, limits)
    for name, method in chosen.items():
        row: Row = {"method": name, "family": method.family}
        if name in timings:
            yield row | timings[name].row, timings[name].result
        else:
            yield row | {"skipped": obstacles[name]}, None


def time_methods(chosen: list[Method], seen: Picture, limits: Limits) -> Mapping[str, Timing]:
    """Timings of methods by name; each has run on a small picture first: code is compiled, tables are made."""
    corner = (..., slice(64), slice(64))
    image, coc = seen.image[corner].clone(), seen.coc[corner].clone()
    coc[..., 0] = seen.coc.abs().max()
    for method in chosen:
        with torch.inference_mode():
            method.run(image, coc)
    works = {m.name: (lambda m=m: m.run(seen.image, seen.coc)) for m in chosen}
    return measure(works, limits.repeat, limits.budget)


def _section(rows: list[Row], settings: Row, plots: Sequence[str]) -> str:
    text = (
        "One layer: every pixel spreads evenly over its disc, and what comes out is divided by its coverage. The "
        "reference is this package's exact splat: the torch definition in double for up to 512 x 512 pixels, the "
        "float32 kernel, which sums in double, beyond. Methods that put layers *over* one another do something else on "
        "purpose, occlusion: that is in their error here; those that *sum* do not. No method is both faster and nearer "
        "than one with a *."
    )
    parts = [text]
    for radius in distinct(of(rows, scene=PHOTO), "radius"):
        chosen = of(rows, scene=PHOTO, radius=radius)
        parts.append(f"### {_title(chosen, PHOTO)}")
        parts += [*pictures(plots, f"one_layer_{radius:g}"), _error_table(chosen), skipped(chosen)]
    recipes = [row for row in rows if row["scene"] != PHOTO]
    if recipes:
        parts.append(f"### {_title(recipes, 'recipes')}")
        parts += [*pictures(plots, "one_layer_recipes"), "SSIM (seconds)", _recipe_table(recipes)]
    return section("Error against run time", *parts)


def _title(rows: list[Row], what: str) -> str:
    return f"{what}, {rows[0]['size']} x {rows[0]['size']}, radius up to {rows[0]['radius']:g} px"


def _error_table(rows: list[Row]) -> str:
    header = "method | seconds | spread | runs | SSIM | PSNR | L1 | FLIP | "
    cells = "{method} | {seconds:t} | {quartile_low:t} - {quartile_high:t} | {runs} | {ssim:.5f} | {psnr:.1f} | "
    cells += "{l1:.2g} | {flip:.4f} | {star}"
    return row_table(sorted(_starred(rows), key=lambda row: row["seconds"]), header, cells)


def _recipe_table(rows: list[Row]) -> str:
    return cross_table(_starred(rows), "method", "scene", "{ssim:.4f} ({seconds:t}){star}", "")


def _starred(rows: list[Row]) -> list[Row]:
    """What was run; no method is both faster and nearer than one with a star."""
    return [{**row, "star": "*" * row["pareto"]} for row in not_skipped(rows)]


def _draw(rows: list[Row]) -> Figures:
    from torchbokeh.report.speed.error_plots import photo_figure, recipe_figure

    photo = of(rows, scene=PHOTO)
    figures = {
        f"one_layer_{radius:g}.png": photo_figure(of(photo, radius=radius)) for radius in distinct(photo, "radius")
    }
    recipes = [row for row in rows if row["scene"] != PHOTO]
    return figures | ({"one_layer_recipes.png": recipe_figure(recipes)} if recipes else {})


ONE_LAYER = Experiment("one_layer", one_layer, _section, _draw)
