"""Bad arguments to everything public: each is named in a ValueError or TypeError, whatever is wrong with it."""

import math
import re
from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import torchbokeh as tb
from torchbokeh import psfs, scenes
from torchbokeh.learn import augmentation
from torchbokeh.psfs.refit import Sparse
from torchbokeh.psfs.represent import Represented

H, W = 6, 8


def image(*shape: int) -> Tensor:
    return torch.linspace(0.1, 1.0, math.prod(shape)).reshape(shape)


RGB, COC, DEPTH, MOTION = (image(2, channels, H, W) for channels in (3, 1, 1, 2))
LAYERS, FAR, WAYS = (image(2, 2, channels, H, W) for channels in (4, 1, 2))
LENS, AXIAL = tb.ThinLens(0.05, 2.0, 2.0, 0.036), tb.Dispersion("BK7")
SCENE, CAMERA = scenes.ramp(seed=0, size=(H, W))
SAMPLES = scenes.samples(SCENE, CAMERA)
COMBINED = psfs.Combined(4.0, 4.0)
DIRECT = Represented("direct", Sparse(np.zeros((1, 2), int), np.ones((1, 1))))


def good(function: Callable[..., object], *fine: str, **arguments: Any) -> Any:
    """See `one_by_one`."""
    return function, arguments, fine


def sizes(name: str, *axes: int) -> tuple[str, ...]:
    """Sizes of an argument that nothing else is bound to."""
    return tuple(f"{name}: size {axis}" for axis in axes)


def radiance(name: str) -> tuple[str, ...]:
    return tuple(f"{name}: {what}" for what in ("nan", "inf", "-1"))


def optional(*names: str) -> tuple[str, ...]:
    return tuple(f"{name}: none" for name in names)


APERTURE = {"aperture": "6-gon"}
LENSES = {"lens": LENS, **APERTURE}
CALLS = {
    "AccumulationBuffer": good(
        tb.AccumulationBuffer,
        *optional("lens", "seed"),
        *("level_of_detail: 0", "reuse: 0", "reuse: huge", "subsamples: 0", "seed: 0", "first: 0", "seed: huge"),
        **LENSES,
        views=4,
        level_of_detail=0.5,
        reuse=1,
        subsamples=2,
        seed=3,
        first=1,
    ),
    "AccumulationBuffer.forward": good(
        tb.AccumulationBuffer(LENS, views=2),
        *radiance("source"),
        *optional("motion"),
        "depth: inf",
        "motion: -1",
        source=LAYERS,
        depth=1 + FAR,
        motion=WAYS,
    ),
    "AccumulationBuffer.forward, coc": good(
        tb.AccumulationBuffer(views=2), *radiance("source"), "coc: -1", source=LAYERS, coc=FAR
    ),
    "AccumulationBuffer.forward, scene": good(tb.AccumulationBuffer(views=2), source=SCENE, depth=CAMERA),
    "ChromaticAccumulation": good(tb.ChromaticAccumulation, *optional("lens"), **LENSES, views=4),
    "ChromaticAccumulation.forward": good(
        tb.ChromaticAccumulation(tb.ThinLens(0.05, 2.0, 2.0, 0.036, dispersion=AXIAL), views=3),
        *radiance("source"),
        "depth: inf",
        source=LAYERS,
        depth=1 + FAR,
    ),
    "Disc": good(tb.Disc),
    "DisparityLens": good(
        tb.DisparityLens,
        *(f"{n}: {w}" for n in ("strength", "focus_disparity") for w in ("0", "-1", "number")),
        strength=3.0,
        focus_disparity=0.5,
    ),
    "DisparityLens.coc": good(
        tb.DisparityLens(3.0, 0.5).coc,
        *sizes("depth", 0, 1, 2, 3),
        "depth: rank + 1",
        "depth: rank - 1",
        "depth: -1",
        "width: huge",
        depth=FAR[0],
        width=W,
    ),
    "Dispersion": good(
        tb.Dispersion,
        *optional("axial_map", "lateral_map", "equaliser"),
        *(f"{n}: {w}" for n in ("axial", "lateral") for w in ("0", "-1")),
        "lateral: 1e30",
        glass="BK7",
        axial=0.5,
        lateral=0.1,
        axial_map=tb.FieldMap(),
        lateral_map=tb.FieldMap("square"),
        spectrum="continuous",
        reference=600.0,
        equaliser=torch.ones_like,
    ),
    "Ellipse": good(tb.Ellipse, "rotation: 0", "rotation: -1", squeeze=2.0, rotation=0.5),
    "FFTIntegrator": good(tb.FFTIntegrator, compact=True),
    "FieldMap": good(tb.FieldMap, pre="inversion", post="exp"),
    "KernelSplatting": good(
        tb.KernelSplatting,
        *optional("tolerance"),
        "tolerance: 0",
        "tolerance: inf",
        "tolerance: 1e30",
        **APERTURE,
        quality="fast",
        tolerance=0.1,
        interpolate=False,
    ),
    "KernelSplatting, bank": good(tb.KernelSplatting, *optional("bank"), bank=tb.PsfBank.load("combined")),
    "KernelSplatting.forward": good(
        tb.KernelSplatting(), *radiance("image"), *sizes("image", 1), "coc: -1", image=RGB, coc=COC
    ),
    "KernelSplatting.forward, bank": good(
        tb.KernelSplatting(bank=tb.PsfBank.load("combined")),
        *radiance("image"),
        *sizes("image", 1),
        "coc: -1",
        "motion: -1",
        image=RGB,
        coc=COC,
        motion=MOTION,
    ),
    "KernelSplatting.plan": good(
        tb.KernelSplatting().plan, *radiance("image"), *sizes("image", 1), "coc: -1", image=RGB, coc=COC
    ),
    "LensBlur": good(
        tb.LensBlur,
        *optional("lens", "tolerance", "max_coc"),
        *("tolerance: 0", "tolerance: inf", "tolerance: 1e30", "max_coc: 1e30", "max_coc: inf"),
        *("layers: huge", "margin: 0", "margin: huge"),
        **LENSES,
        layers=3,
        quality="fast",
        tolerance=0.1,
        max_coc=5.0,
        subapertures=2,
        shutter="start",
        margin=1,
    ),
    "LensBlur.forward": good(
        tb.LensBlur(LENS),
        *radiance("image"),
        *optional("motion", "shutter_depth", "background"),
        "depth: inf",
        "motion: -1",
        "shutter_depth: inf",
        *radiance("background"),
        image=RGB,
        depth=1 + DEPTH,
        motion=MOTION,
        shutter_depth=1 + MOTION,
        background=RGB,
    ),
    "LensBlur.forward, layers": good(
        tb.LensBlur(LENS),
        *radiance("image"),
        *optional("motion"),
        "depth: inf",
        "motion: -1",
        image=LAYERS,
        depth=1 + FAR,
        motion=WAYS,
    ),
    "LensBlur.forward, plan": good(
        tb.LensBlur(),
        *radiance("image"),
        *sizes("image", 1),
        *optional("plan"),
        "coc: -1",
        image=RGB,
        coc=COC,
        plan=tb.LensBlur().plan(RGB, coc=COC),
    ),
    "LensBlur.plan": good(
        tb.LensBlur(LENS).plan, *radiance("image"), *sizes("image", 1), "depth: inf", image=RGB, depth=1 + DEPTH
    ),
    "Polygon": good(
        tb.Polygon, *("rotation: 0", "rotation: -1", "curvature: 0"), blades=5, rotation=0.5, curvature=0.5
    ),
    "PsfBank": good(
        tb.PsfBank, *optional("info"), model=COMBINED, samples=[DIRECT] * len(COMBINED.grid), info={"note": "x"}
    ),
    "PsfBank.load": good(tb.PsfBank.load, *optional("model"), source="combined", model=psfs.Combined()),
    "PyramidIntegrator": good(tb.PyramidIntegrator, weights="published"),
    **{
        f"{kind.__name__}.{name}": good(
            getattr(kind(), method),
            *radiance(argument),
            *sizes(argument, 0, 1, 2, 3),
            **{argument: RGB},
        )
        for kind in (tb.FFTIntegrator, tb.PyramidIntegrator, tb.ScanlineIntegrator)
        for name, method, argument in (
            ("forward", "__call__", "buffer"),
            ("differentiate", "differentiate", "image"),
            ("adjoint", "adjoint", "image"),
        )
    },
    "ScanlineIntegrator": good(tb.ScanlineIntegrator),
    "ThinLens": good(
        tb.ThinLens,
        *optional("dispersion"),
        "focus_distance: 1e30",
        "focus_distance: inf",
        focal_length=0.05,
        f_number=2.0,
        focus_distance=2.0,
        sensor_width=0.036,
        dispersion=AXIAL,
    ),
    "ThinLens.coc": good(
        LENS.coc,
        *sizes("depth", 0, 1, 2, 3),
        "depth: rank + 1",
        "depth: rank - 1",
        "depth: inf",
        "width: huge",
        depth=1 + FAR[0],
        width=W,
    ),
    "ThinLens.depth": good(
        LENS.depth,
        *sizes("coc", 0, 1, 2, 3),
        "coc: rank + 1",
        "coc: rank - 1",
        *radiance("coc"),
        "width: huge",
        coc=FAR[0],
        width=W,
    ),
    "ThinLens.coc_shift": good(
        tb.ThinLens(0.05, 2.0, 2.0, 0.036, dispersion=AXIAL).coc_shift, "width: huge", wavelength=500.0, width=W
    ),
    "ThinLens.focus_at": good(tb.ThinLens(0.05, 2.0, 2.0, 0.036, dispersion=AXIAL).focus_at, wavelength=500.0),
    **{
        f"ThinLens.{name}": good(getattr(LENS, name), "max_coc: 1e30", "width: huge", max_coc=0.5, width=W)
        for name in ("hyperfocal", "near_limit", "far_limit")
    },
    "pinhole_position": good(tb.pinhole_position, samples=SAMPLES),
    "reconstruct": good(
        tb.reconstruct, *optional("bank"), "layers: huge", samples=SAMPLES, bank=tb.PsfBank.load("combined"), layers=3
    ),
    # ------------------------------------------------------------------------------------------------- augmentation
    "plausible_lenses": good(
        augmentation.plausible_lenses, *optional("generator"), "count: 0", count=2, generator=torch.Generator()
    ),
    "plausible_lenses, depth": good(
        lambda depth: augmentation.plausible_lenses(2, depth=depth),
        *optional("depth"),
        "depth: inf",
        *sizes("depth", 2, 3),
        depth=1 + DEPTH,
    ),
    "RandomLensBlur": good(
        augmentation.RandomLensBlur,
        *optional("focus_distance", "max_coc"),
        "focus_quantile: 0",
        *("max_coc: 1e30", "max_coc: inf", "f_number: 1e30", "sensor_width: 1e30", "focus_distance: 1e30"),
        focal_length=0.05,
        f_number=2.0,
        sensor_width=0.036,
        focus_distance=2.0,
        focus_quantile=0.5,
        linear=True,
        **APERTURE,
        quality="fast",
        max_coc=5.0,
    ),
    "RandomLensBlur.forward": good(
        augmentation.RandomLensBlur(p=1.0), *radiance("input"), "depth: inf", input=RGB, depth=1 + DEPTH
    ),
}

WITHOUT_ARGUMENTS_TO_CHECK = {
    "Aperture": "abstract",
    "Lens": "abstract",
    "Plan": "a record that only LensBlur makes",
    "Samples": "a record; reconstruct looks at its maps",
    "SplattingPlan": "a record that only KernelSplatting makes",
    "export_onnx": "writes a file: test_export.py",
    "scenes": "a module",
}


@pytest.mark.parametrize("name", CALLS)
def test_each_bad_argument_is_named(name: str, one_by_one: Callable[[Any], list[str]]) -> None:
    wrong = one_by_one(CALLS[name])
    assert not wrong, "\n".join(wrong)


def test_the_table_is_complete() -> None:
    public = {name for name in tb.__all__ if not isinstance(getattr(tb, name), ModuleType) or name == "scenes"} | {
        name
        for name, value in vars(augmentation).items()
        if getattr(value, "__module__", "") == augmentation.__name__ and not name.startswith("_")
    }
    seen = {re.split("[.,]", name)[0] for name in CALLS}
    assert public - seen == {*WITHOUT_ARGUMENTS_TO_CHECK}


@pytest.mark.parametrize("name", ["colour", "position", "lens", "time", "coc", "motion"])
def test_samples_with_bad_maps_are_refused(name: str) -> None:
    given = getattr(SAMPLES, name)
    nan = given.clone(memory_format=torch.contiguous_format)
    nan.view(-1)[0] = torch.nan
    for bad in (None, [1.0], given.double().numpy(), given[0], given[..., :-1], given.int(), given.to("meta"), nan):
        with pytest.raises((TypeError, ValueError), match=r"samples\.\w+: expected"):
            tb.reconstruct(SAMPLES._replace(**{name: bad}))
