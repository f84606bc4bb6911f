"""Defocus with motion: splats from the bank beside a dense scatter of every capsule, and the tables of LKS."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from torch import Tensor

import torchbokeh
from torchbokeh.ops.composite import bin_weights
from torchbokeh.ops.dispatch import numba_is_there
from torchbokeh.psfs.model import Labels
from torchbokeh.report.experiment import Experiment
from torchbokeh.report.internals import QUALITY_NAMES, bank_of_motion, bin_centres, splat_bank
from torchbokeh.report.markdown import row_table, section
from torchbokeh.report.measure import Work, displayed, errors, measure
from torchbokeh.report.rows import Row, Say
from torchbokeh.report.scenes import photo
from torchbokeh.report.settings import Settings
from torchbokeh.scenes import RECIPES, samples

DENSE = "dense scatter of capsules"

DENSE_LAYERS = "dense scatter of capsules, layers"

FILTER = "filter with capsules"

LKS_LAYERS = 8
"""Bins of constant parallax, at most."""

Keep = Callable[[str, str, Tensor], None]
"""Is given the name of a scene, what a picture is, and the picture ``(1, 3, H, W)``."""

RECIPES_IN_MOTION = ("whirl", "coins", "rain", "gears")
"""Recipes that go by the names of the scenes of LKS."""

STRENGTHS = (0.02, 0.05, 0.1, 0.2, 0.4)
"""Of non-local means: the best one counts."""


def spinning(size: int, longest: float) -> Tensor:
    """Motion ``(1, 2, size, size)`` about a place beside the centre, up to a length in px at the farthest corner."""
    at = torch.linspace(-1, 1, size)
    y, x = torch.meshgrid(at - 0.2, at + 0.1, indexing="ij")
    motion = torch.stack([-y, x])[None]
    return motion * (longest / motion.norm(dim=1).max())


def with_motion(settings: Settings, say: Say) -> list[Row]:
    """Error and run time of `KernelSplatting` with the bank of `Combined`, for every quality.

    The photograph turns about a place beside its centre. The reference is the dense scatter itself, which draws every
    pixel's own capsule. Nothing without numba, with which that is compiled.
    """
    if not numba_is_there():
        return []
    from torchbokeh.report.motion.capsules import dense_capsules

    bank = torchbokeh.PsfBank.load("combined")
    rows: list[Row] = []
    for radius, longest in settings.motions:
        say(f"defocus with motion: radius {radius:g} px, motion {longest:g} px")
        seen, motion = photo(settings.motion_size, radius), spinning(settings.motion_size, longest)
        works: dict[str, Work] = {DENSE: partial(dense_capsules, seen.image, seen.coc, motion)}
        for quality in QUALITY_NAMES:
            for interpolate in (False, True) if quality == "exact" else (False,):
                name = f"bank, {quality}" + (", interpolated" if interpolate else "")
                blur = torchbokeh.KernelSplatting(bank=bank, quality=quality, interpolate=interpolate)
                works[name] = partial(blur, seen.image, seen.coc, motion=motion)
        timings = measure(works, settings.repeat, settings.sweep_budget)
        dense = timings[DENSE]
        for name, timing in timings.items():
            row = {"radius": radius, "longest": longest, "size": settings.motion_size, "method": name, **timing.row}
            row["times_dense"] = dense.row["seconds"] / timing.row["seconds"]
            rows.append(row | errors(timing.result, dense.result))
    return rows


@dataclass(frozen=True)
class _Scene:
    """A recipe as all methods see it, and its truth ``(1, 3, H, W)``."""

    seen: dict[str, Tensor]
    coc: Tensor
    layer_coc: Tensor
    lens: torchbokeh.ThinLens
    noisy: torchbokeh.Samples
    truth: Tensor


def _scene(name: str, settings: Settings) -> _Scene:
    size = (settings.truth_size, settings.truth_size)
    scene, camera = RECIPES[name](0, size=size, blur=settings.truth_radius)
    seen = {key: t[None] for key, t in scene.render(camera).items()}
    truth = torchbokeh.AccumulationBuffer(views=2 * settings.truth_views)(scene, camera)[:, :3]
    coc, layer_coc = (camera.lens.coc(seen[key], size[1]) for key in ("depth", "layer_depth"))
    return _Scene(seen, coc, layer_coc, camera.lens, samples(scene, camera, 1, 0), truth)


def _synthesis(scene: _Scene) -> dict[str, Work]:
    from torchbokeh.report.motion.capsules import dense_capsules, dense_layers, filter_capsules

    seen = scene.seen
    pinhole, layers = (
        (seen["image"], scene.coc, seen["motion"]),
        (seen["layers"], scene.layer_coc, seen["layer_motion"]),
    )
    works: dict[str, Work] = {
        DENSE: partial(dense_capsules, *pinhole),
        DENSE_LAYERS: partial(dense_layers, *layers),
        FILTER: partial(filter_capsules, *pinhole),
        "bank, image, re-weighted bins": partial(_reweighted_bins, *pinhole),
        "bank, layers, re-weighted": partial(_reweighted_layers, *layers),
    }
    for quality in ("exact", "balanced"):
        blur = torchbokeh.LensBlur(scene.lens, quality=quality)
        works[f"LensBlur, image, {quality}"] = partial(blur, seen["image"], seen["depth"], motion=seen["motion"])
        layered = partial(blur, seen["layers"], seen["layer_depth"], motion=seen["layer_motion"])
        works[f"LensBlur, layers, {quality}"] = layered
    return works


def _reweighted_bins(image: Tensor, coc: Tensor, motion: Tensor) -> Tensor:
    """Soft layers of constant parallax, as LKS composes them: see `over_reweighted`."""
    from torchbokeh.report.motion.capsules import over_reweighted

    bank, labels = bank_of_motion(image.device), Labels(coc, motion=motion)
    low, high = coc.aminmax()
    rgba, centres = torch.cat([image, torch.ones_like(coc)], 1), bin_centres(float(low), float(high), LKS_LAYERS)
    return over_reweighted([splat_bank(rgba * weight, labels, bank) for weight in bin_weights(coc, centres)])


def _reweighted_layers(layers: Tensor, coc: Tensor, motion: Tensor) -> Tensor:
    """The same with layers that are known."""
    from torchbokeh.report.motion.capsules import over_reweighted

    bank = bank_of_motion(layers.device)
    every = zip(layers.unbind(1), coc.unbind(1), motion.unbind(1), strict=True)
    return over_reweighted([splat_bank(rgba, Labels(radius, motion=way), bank) for rgba, radius, way in every])


def _reconstruction(scene: _Scene) -> dict[str, Work]:
    from torchbokeh.report.motion.capsules import dense_samples

    mean = scene.noisy.colour[:, 0]
    works: dict[str, Work] = {"one sample per pixel": mean.clone, DENSE: partial(dense_samples, scene.noisy)}
    for layers in (1, 4):
        works[f"reconstruct, {layers} layers"] = partial(torchbokeh.reconstruct, scene.noisy, layers=layers)
    works["non-local means"] = partial(non_local_means, mean, scene.truth)
    return works


KINDS: dict[str, Callable[[_Scene], dict[str, Work]]] = {"synthesis": _synthesis, "reconstruction": _reconstruction}


def like_lks(
    settings: Settings, say: Say, keep: Keep | None = None, kinds: tuple[str, ...] = tuple(KINDS)
) -> list[Row]:
    """Tables 2 and 3 of LKS with recipes of this package: synthesis, and reconstruction from one sample per pixel.

    The truth is the accumulation buffer. ``times_dense`` is the time of the dense scatter over that of the method: of
    the pinhole picture, of its layers for what takes layers, and of the samples. Nothing without numba.

    Args:
        settings: sizes and repetitions.
        say: is told in a line what comes next.
        keep: is given the scene, the method and the picture of every row, and the truth.
        kinds: of `KINDS`.
    """
    if not numba_is_there():
        return []
    rows: list[Row] = []
    for name in RECIPES_IN_MOTION:
        say(f"synthesis and reconstruction with motion: {name}, {settings.truth_size} px")
        scene = _scene(name, settings)
        if keep is not None:
            keep(name, "truth", scene.truth)
        for kind in kinds:
            timings = measure(KINDS[kind](scene), settings.repeat, settings.sweep_budget)
            for method, timing in timings.items():
                beside = DENSE_LAYERS if "layers" in method and kind == "synthesis" else DENSE
                ratio = timings[beside].row["seconds"] / timing.row["seconds"]
                row = {"scene": name, "kind": kind, "method": method, **timing.row, "times_dense": ratio}
                border = min(int(settings.truth_radius) + 1, (settings.truth_size - 8) // 2)
                rows.append(row | errors(timing.result[:, :3], scene.truth, border))
                if keep is not None:
                    keep(name, f"{kind}: {method}", timing.result[:, :3])
    return rows


def non_local_means(image: Tensor, truth: Tensor) -> Tensor:
    """The best that non-local means make of the displayed picture, whatever the strength."""
    from skimage.restoration import denoise_nl_means

    shown = displayed(image)
    tried = (denoise_nl_means(shown, patch_size=5, h=h, channel_axis=2) for h in STRENGTHS)
    linear = [torch.from_numpy(np.clip(t, 0, 1) ** 2.2).permute(2, 0, 1)[None] for t in tried]
    return max(linear, key=lambda t: float(errors(t, truth, flip=False)["ssim"] or 0))


HEADER = "method | seconds | times dense | SSIM | PSNR | L1"
CELLS = "{method} | {seconds:t} | {times_dense:.1f} | {ssim:.4f} | {psnr:.1f} | {l1:.4f}"
"""The last columns of both tables."""


def _motion_section(rows: list[Row], settings: Row, plots: Sequence[str]) -> str:
    about = (
        f"photo, {rows[0]['size']} x {rows[0]['size']}, turning; up to so many px of radius and motion; errors against "
        "the dense scatter."
    )
    return section(
        "Defocus with motion",
        about,
        row_table(rows, f"radius | motion | {HEADER}", "{radius:g} | {longest:g} | " + CELLS),
    )


def like_lks_table(rows: list[Row]) -> str:
    """The rows of `like_lks` as a Markdown table."""
    return row_table(rows, f"scene | kind | {HEADER}", "{scene} | {kind} | " + CELLS)


def _like_lks_section(rows: list[Row], settings: Row, plots: Sequence[str]) -> str:
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


MOTION = Experiment("motion", with_motion, _motion_section)
LIKE_LKS = Experiment("like_lks", like_lks, _like_lks_section)
