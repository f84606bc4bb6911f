"""The experiments on dispersion: against the truth, against the number of views, bands of colour."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise, product

import numpy as np
import torch
from torch import Tensor

import torchbokeh
from torchbokeh.report.experiment import Experiment, Figures
from torchbokeh.report.markdown import pictures, row_table, seconds, section, table
from torchbokeh.report.measure import Work, errors, measure
from torchbokeh.report.rows import Row, Say, distinct, of
from torchbokeh.report.scenes import still, with_dispersion
from torchbokeh.report.settings import Settings
from torchbokeh.scenes import Camera, Scene

SPECTRA = ("rgb", "continuous")
BLURS = ("exact", "balanced")
ACCUMULATION = "ChromaticAccumulation"

DOT = 128, 20.0
"""Side of the picture of the dot, and its radius in red light, in px."""

PERIOD = 8.0
"""Changes of colour along a radius of the dot that are shorter than this, in px, count as bands."""


def dispersing(camera: Camera, spectrum: str, axial: float, lateral: float) -> Camera:
    """The same camera with a lens of BK7 that disperses."""
    dispersion = torchbokeh.Dispersion("BK7", axial, lateral, spectrum=spectrum)  # type: ignore[arg-type]
    return with_dispersion(camera, dispersion)


@dataclass(frozen=True)
class _Case:
    """A recipe, what its camera sees, and the px over which its colours spread."""

    scene: Scene
    camera: Camera
    seen: dict[str, Tensor]
    spread: float

    @classmethod
    def of(cls, settings: Settings, name: str, spectrum: str, strength: tuple[float, float]) -> "_Case":
        scene, camera = still(name, settings.chromatic_size, settings.chromatic_radius)
        camera = dispersing(camera, spectrum, *strength)
        seen = {key: t[None] for key, t in scene.render(camera).items()}
        return cls(scene, camera, seen, torchbokeh.LensBlur(camera.lens).plan(seen["image"], seen["depth"]).spread)

    def accumulated(self, views: int, seed: int) -> Tensor:
        return torchbokeh.ChromaticAccumulation(views=views, seed=seed)(self.scene, self.camera)[:, :3]

    def works(self, views: Sequence[int]) -> dict[tuple[str, str], Work]:
        """By method, and by quality or number of views."""
        works: dict[tuple[str, str], Work] = {}
        for (given, depth), quality in product((("layers", "layer_depth"), ("image", "depth")), BLURS):
            blur = torchbokeh.LensBlur(self.camera.lens, quality=quality)
            works[f"LensBlur, {given}", quality] = partial(blur, self.seen[given], self.seen[depth])
        return works | {(ACCUMULATION, str(n)): partial(self.accumulated, n, 2) for n in views}


def chromatic_truth(settings: Settings, say: Say) -> list[Row]:
    """Error and run time of LensBlur and of few views, against many views, with axial, lateral and both aberrations.

    The truth is the mean of two halves, each ``ChromaticAccumulation`` with a seed of its own; few views take a third.
    The row with the method ``truth`` compares the halves. Of a continuous spectrum only the last strengths are taken.
    Errors leave out a border as wide as the largest radius, the spread of colours and 2 px. ``times_equal``, of
    LensBlur, says how many times longer the accumulation takes to come as near by SSIM; see `times_equal`.
    """
    rows: list[Row] = []
    for work in _Case.of(replace(settings, chromatic_size=48), "coins", "rgb", (0.5, 0.03)).works((3,)).values():
        work()  # compiles
    every = settings.chromatic_strengths
    cases = [("rgb", strength) for strength in every] + [("continuous", every[-1])]
    for name, (spectrum, strength) in product(settings.chromatic_scenes, cases):
        say(f"dispersion against the truth: {name}, {spectrum}, axial {strength[0]:g}, lateral {strength[1]:g}")
        case = _Case.of(settings, name, spectrum, strength)
        head = {"scene": name, "spectrum": spectrum, "axial": strength[0], "lateral": strength[1]}
        rows += [{**head, "spread": case.spread, **row} for row in _truth_rows(case, settings)]
    return rows


def _truth_rows(case: _Case, settings: Settings) -> list[Row]:
    border = min(math.ceil(settings.chromatic_radius + case.spread) + 2, (settings.chromatic_size - 8) // 2)
    one, other = (case.accumulated(settings.chromatic_truth // 2, seed) for seed in (1, 3))
    truth = (one + other) / 2
    rows: list[Row] = [{"method": "truth", "setting": "halves", **errors(one, other, border, flip=False)}]
    works = case.works(settings.chromatic_views)
    found = measure({" ".join(key): w for key, w in works.items()}, settings.chromatic_repeat, settings.sweep_budget)
    for method, setting in works:
        timing = found[f"{method} {setting}"]
        row: Row = {"method": method, "setting": setting, **timing.row}
        rows.append(row | errors(timing.result[:, :3], truth, border, flip=False))
    line = [(row["seconds"], 1 - row["ssim"]) for row in rows if row["method"] == ACCUMULATION]
    for row in rows:
        if row["method"].startswith("LensBlur"):
            row["times_equal"], row["bound"] = times_equal(row["seconds"], 1 - row["ssim"], line)
    return rows


def times_equal(taken: float, error: float, line: Sequence[tuple[float, float]]) -> tuple[float, str]:
    """How many times longer another method takes to come to the same error, and how that is bounded.

    Args:
        taken: seconds of this method.
        error: of this method.
        line: seconds and errors of the other, the fewest seconds first; straight in between on logarithmic axes.

    Returns:
        The ratio, and ``""``; or that to the last point and ``">"``, where the other does not come to this error; or
        that to the first point and ``"<"``, where it does so from there on.

    Example:
        >>> times_equal(0.5, 0.1, [(1.0, 0.2), (4.0, 0.05)])
        (4.0, '')
    """
    if line[0][1] <= error:
        return line[0][0] / taken, "<"
    for (start, high), (end, low) in pairwise(line):
        if low <= error:
            share = math.log(high / max(error, 1e-12)) / math.log(high / max(low, 1e-12))
            return start * (end / start) ** share / taken, ""
    return line[-1][0] / taken, ">"


def chromatic_samples(settings: Settings, say: Say) -> list[Row]:
    """Run time against the number of views, table 4.1 of the dissertation, with a straight line through it.

    ``per_view`` and ``fixed`` are its slope and its value at 0 in seconds, ``r2`` is the share of the variance that it
    explains. ``drawn`` are the views that are drawn: with ``"rgb"``, whole thirds.
    """
    say(f"run time against views with dispersion: {', '.join(map(str, settings.sample_views))}")
    rows: list[Row] = []
    for spectrum in SPECTRA:
        name = settings.chromatic_scenes[0]
        case = _Case.of(settings, name, spectrum, settings.chromatic_strengths[-1])
        works: dict[str, Work] = {str(n): partial(case.accumulated, n, 2) for n in settings.sample_views}
        timings = measure(works, settings.chromatic_repeat, settings.sweep_budget)
        drawn = [3 * max(n // 3, 1) if spectrum == "rgb" else n for n in settings.sample_views]
        line = straight(drawn, [timing.row["seconds"] for timing in timings.values()])
        line |= {"scene": name, "size": settings.chromatic_size, "spectrum": spectrum}
        for views, count, timing in zip(settings.sample_views, drawn, timings.values(), strict=True):
            rows.append({"views": views, "drawn": count, **timing.row, **line})
    return rows


def straight(counts: Sequence[int], taken: Sequence[float]) -> Row:
    """The straight line of least squares through seconds."""
    slope, start = np.polyfit(counts, taken, 1)
    return {"per_view": float(slope), "fixed": float(start), "r2": float(np.corrcoef(counts, taken)[0, 1] ** 2)}


def chromatic_bands(settings: Settings, say: Say) -> list[Row]:
    """Bands of colour in the blur of a bright dot, figure 4.9 of the dissertation: `banding` of its `profile`.

    The radius of its blur is that of `DOT` in red light and half as much more in blue, everywhere in the picture.
    """
    size, radius = DOT
    say(f"bands of colour: a dot, {size} px, radius {radius:g} px")
    at = torch.arange(size) - (size - 1) / 2
    light = 100 * torch.exp(-0.5 * (at.square() + at[:, None].square()) / 1.5**2)
    image, coc = light.expand(1, 3, size, size).contiguous(), torch.full((1, 1, size, size), radius)
    layers = torch.cat([image, torch.ones_like(coc)], 1)[:, None]
    rows: list[Row] = []
    for spectrum in SPECTRA:
        lens = dot_lens(size, radius / 2, spectrum)
        buffer = torchbokeh.ChromaticAccumulation(lens, views=settings.band_views)
        works: dict[str, Work] = {
            f"{ACCUMULATION}, {settings.band_views} views": partial(buffer, layers, coc=coc[:, None]),
            "LensBlur, exact": partial(torchbokeh.LensBlur(lens), image, coc=coc),
        }
        for method, work in works.items():
            colours = profile(work()[0, :3])
            row: Row = {"size": size, "radius": radius, "method": method, "spectrum": spectrum}
            rows.append(row | {"banding": banding(colours), "profile": [round(float(c), 5) for c in colours]})
    return rows


def dot_lens(width: int, spread: float, spectrum: str) -> torchbokeh.ThinLens:
    """A lens whose radii for blue and red light differ by so many px, everywhere in the picture."""
    dispersion = torchbokeh.Dispersion(axial_map=None, spectrum=spectrum)  # type: ignore[arg-type]
    one = torchbokeh.ThinLens(0.05, 1.0, 2.0, 0.036, dispersion=dispersion)
    return torchbokeh.ThinLens(0.05, one.coc_shift(475.0, width) / spread, 2.0, 0.036, dispersion=dispersion)


def profile(image: Tensor) -> np.ndarray:
    """Chromaticity ``(R - B) / (R + G + B)`` along the radius of a dot in the middle of ``(3, H, W)``.

    Each channel is averaged over rings of one px. Where they hold too few pixels, in the middle, and where there is
    less than 1 % of the most light, outside, the nearest chromaticity goes on.
    """
    at = torch.arange(image.shape[1], dtype=torch.float64) - (image.shape[1] - 1) / 2
    ring = torch.hypot(at, at[:, None]).long().flatten()
    count = torch.bincount(ring)
    red, green, blue = (torch.bincount(ring, c.flatten().double()) / count for c in image)
    total = red + green + blue
    inside = range(image.shape[1] // 2)
    lit = [r for r in inside if r >= 3 and total[r] > 0.01 * total[3:].max()]
    return np.interp(inside, lit, ((red - blue) / total)[lit].numpy())


def banding(colours: np.ndarray) -> float:
    """Energy of quick changes of a profile relative to that of slow ones.

    The profile less its mean is weighted with a Hann window, so that its ends count for nothing. Energies are squares
    of its Fourier coefficients: of periods below `PERIOD` px over those of longer ones. Steps, of few wavelengths, have
    much of the former, smooth transitions have little.
    """
    window = np.hanning(len(colours) + 2)[1:-1]
    energy = np.abs(np.fft.rfft((colours - np.average(colours, weights=window)) * window, 8 * len(colours))) ** 2
    quick = np.fft.rfftfreq(8 * len(colours)) > 1 / PERIOD
    return float(energy[quick].sum() / max(energy[~quick].sum(), 1e-30))


def _truth_section(rows: list[Row], settings: Row, plots: Sequence[str]) -> str:
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


DISPERSION_TRUTH = Experiment("chromatic_truth", chromatic_truth, _truth_section, _truth_figures)
DISPERSION_VIEWS = Experiment("chromatic_samples", chromatic_samples, _samples)
DISPERSION_BANDS = Experiment("chromatic_bands", chromatic_bands, _bands)
