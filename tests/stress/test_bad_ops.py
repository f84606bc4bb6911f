"""Bad arguments to the tensor functions: shapes, dtypes and devices are named before any kernel sees them.

Their values are the business of who calls them: looking at those would cost a synchronisation in every splat.
"""

import importlib
import inspect
import math
import pkgutil
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from torchbokeh import ops
from torchbokeh.ops import (
    capsules,
    composite,
    convolve,
    dense,
    integrate,
    merge,
    nbuffers,
    planes,
    points,
    raycast,
    sampling,
    sellmeier,
    spans,
    spectrum,
    splat,
    surface,
)
from torchbokeh.psfs import Disc

H, W = 6, 8


def image(*shape: int) -> Tensor:
    return torch.linspace(0.1, 1.0, math.prod(shape)).reshape(shape)


def good(function: Callable[..., object], *fine: str, **arguments: Any) -> Any:
    """See `one_by_one`."""
    return function, arguments, fine


def sizes(name: str, *axes: int) -> tuple[str, ...]:
    """Sizes of an argument that nothing else is bound to."""
    return tuple(f"{name}: size {axis}" for axis in axes)


ANY = ("?: nan", "?: inf", "?: -1")
RGB, COC, SHARE = image(2, 3, H, W), 3 * image(2, 1, H, W), image(2, 1, H, W)
PROFILE, MERGING = Disc().profile(), merge.Merging(4.0, 0.015)
TABLE = points.PointTable(torch.zeros(1, 2), torch.ones(1), torch.tensor([0, 1]))
ZERO = torch.zeros(2, 1, H, W, dtype=torch.int64)
PLATES = planes.Plates.build([torch.full((4, 2, 2), 0.5)], [True], [True], count=1)
VIEW, LEVEL = torch.eye(3, dtype=torch.float64)[None, None], torch.zeros(1, 1, dtype=torch.int64)
BUFFERS = nbuffers.NBuffers.build(image(1, 1, H, W))
ONE = torch.ones(1, 1, H, W, dtype=torch.int64)
KERNEL = torch.tensor([0.15, 0.5, 0.7, 0.5, 0.15])
BANDS = {"weight": torch.ones_like, "formula": "empirical"}

CALLS = {
    "capsules.splat_capsules": good(
        capsules.splat_capsules,
        *ANY,
        *sizes("values", 0, 1, 2, 3),
        values=RGB,
        pixels=torch.tensor([0, 5]),
        radius=torch.ones(2),
        motion=torch.ones(2, 2),
        centre=torch.zeros(2, 2),
    ),
    "composite.bin_weights": good(
        composite.bin_weights,
        *ANY,
        *sizes("coc", 0, 2, 3),
        coc=COC,
        centres=[-1.0, 0.0, 1.0],
        blend=0.5,
    ),
    "composite.fill_until_full": good(composite.fill_until_full, bins=[(RGB, SHARE)]),
    "composite.pull_push": good(composite.pull_push, *ANY, *sizes("values", 1), values=RGB, weight=SHARE),
    "convolve.blur_uniform": good(
        convolve.blur_uniform,
        *ANY,
        *sizes("values", 0, 1, 2, 3),
        *(f"radius: {w}" for w in ("-1", "0", "1e30")),
        values=RGB,
        radius=2.0,
        profile=PROFILE,
    ),
    "convolve.blur_with": good(convolve.blur_with, *ANY, *sizes("values", 1, 2, 3), values=RGB, psf=image(2, 1, 3, 3)),
    "convolve.convolve": good(convolve.convolve, *ANY, *sizes("values", 1, 2, 3), values=RGB, psf=image(2, 1, 3, 3)),
    "dense.dense_points": good(
        dense.dense_points,
        *ANY,
        *sizes("values", 1),
        "pad: 0",
        values=RGB,
        index=ZERO,
        table=TABLE,
        pad=1,
    ),
    "dense.dense_spans": good(dense.dense_spans, *ANY, *sizes("values", 1), values=RGB, coc=COC, profile=PROFILE),
    "integrate.difference_x": good(integrate.difference_x, *ANY, *sizes("u", 0, 1, 2, 3), u=RGB),
    "integrate.laplacian": good(integrate.laplacian, *ANY, *sizes("u", 0, 1, 2, 3), u=RGB),
    "integrate.lattice_green": good(integrate.lattice_green, height=3, width=4),
    "integrate.poisson_fft": good(integrate.poisson_fft, *ANY, *sizes("b", 0, 1, 2, 3), b=RGB, compact=True),
    "integrate.poisson_pyramid": good(
        integrate.poisson_pyramid, *ANY, *sizes("b", 0, 1, 2, 3), b=RGB, h1=KERNEL, h2=KERNEL, g=KERNEL[1:4]
    ),
    "integrate.running_sum_x": good(integrate.running_sum_x, *ANY, *sizes("b", 0, 1, 2, 3), b=RGB),
    "merge.splat_merged": good(
        merge.splat_merged,
        *ANY,
        *sizes("values", 1),
        "highest: none",
        "highest: 0",
        "weight: none",
        values=RGB,
        coc=COC,
        profile=PROFILE,
        merging=MERGING,
        highest=1,
        weight=SHARE,
        ones=True,
        normalise=True,
    ),
    "nbuffers.NBuffers.build": good(
        nbuffers.NBuffers.build,
        *sizes("values", 0, 2, 3),
        "values: inf",
        "values: -1",
        "largest: none",
        "largest: huge",
        values=COC,
        largest=3,
    ),
    "nbuffers.NBuffers.rectangle": good(BUFFERS.rectangle, x0=ONE, x1=ONE + 1, y0=ONE, y1=ONE + 1),
    "nbuffers.NBuffers.square": good(BUFFERS.square, half=ONE),
    "planes.Plates.build": good(
        planes.Plates.build, "count: huge", textures=[image(4, 2, 2)], mirror=[True], infinite=[False], count=2
    ),
    "planes.render_planes": good(
        planes.render_planes,
        *ANY,
        "parents: none",
        plates=PLATES,
        inverse=VIEW,
        level=LEVEL,
        size=(H, W),
        parents=LEVEL,
        frames=True,
    ),
    "points.splat_points": good(
        points.splat_points,
        *ANY,
        *sizes("values", 1),
        "pad: 0",
        "rotation: none",
        "size: none",
        values=RGB,
        index=ZERO,
        table=TABLE,
        pad=1,
        rotation=image(2, 2, 2, H, W),
        position=image(2, 2, H, W),
        size=(H, W),
    ),
    "raycast.subsample_blur": good(
        raycast.subsample_blur,
        *ANY,
        "background: none",
        "far: 0",
        "far: 1e30",
        "far: -inf",
        "far: inf",
        "far: -1",
        "tolerance: 0",
        "tolerance: inf",
        "tolerance: 1e30",
        "iterations: 0",
        *sizes("offsets", 0),
        colour=RGB,
        coc=COC,
        offsets=image(3, 2),
        far=9.0,
        background=RGB,
        iterations=1,
        tolerance=1.0,
    ),
    "sampling.aperture_points": good(
        sampling.aperture_points, *ANY, "square: size 0", profile=PROFILE, square=0.9 * image(5, 2)
    ),
    "sampling.halton": good(
        sampling.halton,
        *("count: 0", "first: 0", "seed: 0", "seed: huge", "seed: none"),
        count=5,
        first=2,
        seed=3,
    ),
    "sampling.stratified": good(sampling.stratified, *ANY, "points: size 0", points=image(5)),
    "sellmeier.refractive_index": good(sellmeier.refractive_index, glass="BK7", wavelength=500.0),
    "spans.subdivide": good(spans.subdivide, profile=PROFILE, side=2, samples=16),
    "spectrum.linear_rgb": good(
        spectrum.linear_rgb,
        *ANY,
        "wavelength: size 0",
        "wavelength: rank + 1",
        "wavelength: rank - 1",
        wavelength=400 * image(5),
        formula="cie",
    ),
    "spectrum.spectral_bands": good(
        spectrum.spectral_bands, "weight: none", edges=torch.tensor([400.0, 500.0]), **BANDS
    ),
    "spectrum.spectral_samples": good(
        spectrum.spectral_samples, "weight: none", "unit: size 0", unit=0.9 * image(5), importance=True, **BANDS
    ),
    "spectrum.xyz": good(
        spectrum.xyz,
        *ANY,
        "wavelength: size 0",
        "wavelength: rank + 1",
        "wavelength: rank - 1",
        wavelength=400 * image(5),
    ),
    "splat.splat_spans": good(
        splat.splat_spans, *ANY, *sizes("values", 1), values=RGB, coc=COC, profile=PROFILE, integrate=True
    ),
    "surface.blur_surface": good(
        surface.blur_surface,
        *ANY,
        *sizes("colour", 1),
        "weight: none",
        "highest: 0",
        colour=RGB,
        weight=SHARE,
        coc=COC,
        centres=[-1.0, 1.0],
        profile=PROFILE,
        merging=MERGING,
        highest=1,
    ),
}

STEPS = {
    **dict.fromkeys(("level_shares", "merge_cells", "merged", "upsample", "highest_level"), "steps of splat_merged"),
    "rounded": "a step of splat_merged",
    **dict.fromkeys(("flatten", "unflatten"), "steps of splat_points"),
    **dict.fromkeys(("edge_slopes", "heights_above", "piece_at"), "steps of splat_spans"),
    **dict.fromkeys(("coc_bounds", "window"), "steps of subsample_blur"),
    **dict.fromkeys(("area", "clamp_radius", "edge_integrals", "edges_at"), "steps of splat_spans"),
    "knot_integrals": "a step of splat_spans",
    **dict.fromkeys(("arcs_of", "crossings", "edge_at", "mean_edge", "row_pieces"), "steps of splat_spans"),
    "pixel_centres": "a step of render_planes",
    **dict.fromkeys(("check_centres", "check_profile"), "checks themselves"),
    "working_dtype": "asks for a device only",
    **dict.fromkeys(
        ("Arcs", "Merging", "NBuffers", "Pieces", "Placement", "Plates", "PointTable", "Profile"), "records"
    ),
}


@pytest.mark.parametrize("name", CALLS)
def test_each_bad_argument_is_named(name: str, one_by_one: Callable[[Any], list[str]]) -> None:
    wrong = one_by_one(CALLS[name])
    assert not wrong, "\n".join(wrong)


HELPERS = {"checks", "dispatch", "onnx_functions", "onnx_outline", "cie_1931", "outline_gradient", "highlights"}
"""Modules that take no arguments of a caller's: checks themselves, which way is taken, tables, parts of an operator."""


def test_the_table_is_complete() -> None:
    public = set()
    for module in pkgutil.iter_modules(ops.__path__):
        if not module.ispkg and module.name not in HELPERS:
            loaded = importlib.import_module(f"{ops.__name__}.{module.name}")
            for name, value in vars(loaded).items():
                own = getattr(value, "__module__", "") == loaded.__name__ and not name.startswith("_")
                if own and (inspect.isfunction(value) or inspect.isclass(value)):
                    public.add(name)
    seen = {name.split(".")[1] for name in CALLS}
    assert public - seen == {*STEPS} - {"NBuffers", "Plates"}
