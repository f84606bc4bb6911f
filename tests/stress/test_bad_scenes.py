"""Bad arguments to scenes and PSF models: each is named in a ValueError or TypeError, whatever is wrong with it."""

import math
import re
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

import torchbokeh as tb
from torchbokeh import psfs, scenes
from torchbokeh.scenes import shapes, textures

H, W = 6, 8


def image(*shape: int) -> Tensor:
    return torch.linspace(0.1, 1.0, math.prod(shape)).reshape(shape)


RGB, DEPTH, LAYERS = image(2, 3, H, W), image(2, 1, H, W), image(2, 2, 4, H, W)
LENS = tb.ThinLens(0.05, 2.0, 2.0, 0.036)
SCENE, CAMERA = scenes.ramp(seed=0, size=(H, W))


def good(function: Callable[..., object], *fine: str, **arguments: Any) -> Any:
    """See `one_by_one`."""
    return function, arguments, fine


def sizes(name: str, *axes: int) -> tuple[str, ...]:
    """Sizes of an argument that nothing else is bound to."""
    return tuple(f"{name}: size {axis}" for axis in axes)


def optional(*names: str) -> tuple[str, ...]:
    return tuple(f"{name}: none" for name in names)


TEXTURES = {
    "noise": {"octaves": 3, "cells": 3.0, "roughness": 0.5, "warp": 0.5, "colours": 3},
    "voronoi": {"cells": 5.0, "border": 0.1, "shading": 0.5},
    "brick": {"rows": 4.0, "mortar": 0.1, "variation": 0.1},
    "checker": {"cells": 4.0, "rotation": 0.5},
    "dead_leaves": {"count": 20, "smallest": 0.05, "exponent": 3.0},
    "text": {"points": 0.2, "words": "words"},
    "line_art": {"strokes": 5, "width": 0.01},
    "photograph": {"name": "chelsea"},
    "lights": {"count": 5, "peak": 10.0},
}
SHAPES = {
    "polygon": {"corners": 5, "rotation": 0.5, "depth": 0.2},
    "ring": {"inner": 0.5},
    "leaf": {"lobes": 3, "slenderness": 2.0},
    "gear": {"teeth": 8, "hole": 0.3},
    "grid": {"pitch": 0.5, "bar": 0.2, "diagonal": True},
    "glyph": {"characters": "a"},
}
DRAWN = ("seed: 0", "seed: huge")
ZEROS = (
    *(f"{name}: 0" for name in ("roughness", "warp", "border", "shading", "mortar", "variation", "inner", "hole")),
    *("depth: 0", "lobes: 0", "rotation: 0", "rotation: -1", "words: unknown", "characters: unknown"),
)


CALLS = {
    # ------------------------------------------------------------------------------------------------------- scenes
    "Backdrop": good(
        scenes.Backdrop,
        *sizes("texture", 1, 2),
        "distance: inf",
        "distance: 1e30",
        "width: 1e30",
        texture=RGB[0],
        distance=8.0,
        width=1.2,
    ),
    "Camera": good(scenes.Camera, "shutter: 0", "shutter: 1e30", lens=LENS, size=(H, W), shutter=0.02),
    "ProceduralDataset": good(
        scenes.ProceduralDataset,
        *optional("recipes", "blur"),
        *DRAWN,
        *(
            "length: 0",
            "length: huge",
            "level_of_detail: 0",
            "reuse: 0",
            "reuse: huge",
            "blur: huge",
            "blur: 0",
            "blur: reals",
        ),
        seed=1,
        resolution=(H, W),
        length=5,
        recipes="sky",
        blur=(1.0, 2.0),
        views=4,
        layers=3,
        level_of_detail=0.5,
        reuse=1,
    ),
    "ProceduralDataset.__getitem__": good(
        scenes.ProceduralDataset(resolution=(H, W), length=1 << 50, views=2).__getitem__,
        *(f"index: {what}" for what in ("0", "-1", "bool", "huge")),
        index=3,
    ),
    "Scene": good(
        scenes.Scene,
        *optional("backdrop"),
        "sprites: list",
        "sprites: module",
        sprites=SCENE.sprites,
        backdrop=SCENE.backdrop,
    ),
    "Scene.render": good(SCENE.render, *optional("layers"), "layers: huge", camera=CAMERA, samples=2, layers=2),
    "Sprite": good(
        scenes.Sprite,
        *sizes("texture", 1, 2),
        "emission: 0",
        "emission: 1e30",
        "size: reals",
        "size: huge",
        *(f"{name}: three" for name in ("position", "rotation", "velocity", "angular_velocity")),
        texture=LAYERS[0, 0],
        position=(0.0, 0.0, 2.0),
        size=(0.5, 0.5),
        rotation=(0.0, 0.1, 0.0),
        velocity=(1.0, 0.0, 0.0),
        angular_velocity=(0.0, 0.0, 1.0),
        emission=2.0,
    ),
    "samples": good(scenes.samples, *DRAWN, scene=SCENE, camera=CAMERA, per_pixel=2, seed=1),
    **{
        name: good(
            recipe,
            *optional("blur"),
            *DRAWN,
            "blur: 0",
            "blur: 1e30",
            seed=1,
            size=(H, W),
            blur=2.0,
            **({"count": 5} if name == "stack" else {}),
        )
        for name, recipe in scenes.RECIPES.items()
    },
    **{
        f"textures.{name}": good(textures.TEXTURES[name], *optional(*rest), *DRAWN, *ZEROS, size=(H, W), seed=1, **rest)
        for name, rest in TEXTURES.items()
    },
    **{
        f"shapes.{name}": good(
            shape, *optional(*SHAPES.get(name, ())), *DRAWN, *ZEROS, size=(H, W), seed=1, **SHAPES.get(name, {})
        )
        for name, shape in shapes.SHAPES.items()
    },
    "shapes.card": good(shapes.card, texture=RGB[0], coverage=DEPTH[0]),
    # --------------------------------------------------------------------------------------------------------- psfs
    "parse_aperture": good(psfs.parse_aperture, aperture="6-gon"),
    "polygon_profile": good(
        psfs.polygon_profile,
        "vertices: size 0",
        "vertices: -1",
        vertices=torch.tensor([[0.0, -1.0], [1.0, 0.0], [0.0, 1.0], [-1.0, 0.0]]),
    ),
    "SimpleLens": good(psfs.SimpleLens, radius=5.0),
    "Combined": good(psfs.Combined, radius=5.0, length=5.0),
    "Volume": good(psfs.Volume, "density: 1e30", "focal: 1e30", density=0.5, distance=2.0, focal=1024.0),
    "Stylized": good(psfs.Stylized, *optional("mask"), "shift: 0", mask=psfs.stylized.star(9), shift=0.1, radius=5.0),
    "PhysicalLens": good(
        psfs.PhysicalLens,
        "f_number: 1e30",
        "focus_distance: 1e30",
        "width: real",
        side="front",
        focal_length=0.1,
        f_number=4.0,
        focus_distance=0.7,
        sensor_width=0.036,
        width=1024,
    ),
}

WITHOUT_ARGUMENTS_TO_CHECK = {
    **dict.fromkeys(("Aperture", "PsfModel"), "abstract"),
    **dict.fromkeys(("Axis", "Labels", "Place"), "a record"),
    **dict.fromkeys(("Disc", "Ellipse", "Polygon", "PsfBank"), "in test_bad_input.py"),
    **dict.fromkeys(("shapes", "textures"), "a module"),
    "RECIPES": "a dict of functions that are in the table one by one",
    "build": "takes minutes; psfs/test_bank.py calls it",
    "read_shards": "reads files: test_hostile_claims.py",
    "write_shards": "writes files: datasets/test_writing.py",
}


@pytest.mark.parametrize("name", CALLS)
def test_each_bad_argument_is_named(name: str, one_by_one: Callable[[Any], list[str]]) -> None:
    wrong = one_by_one(CALLS[name])
    assert not wrong, "\n".join(wrong)


def test_the_table_is_complete() -> None:
    public = {*scenes.__all__, *psfs.__all__}
    public |= {f"textures.{name}" for name in textures.TEXTURES} | {f"shapes.{name}" for name in shapes.SHAPES}
    seen = {re.sub(r"(?<=[a-z])\.(render|__getitem__)$", "", name) for name in CALLS}
    assert public - seen == {*WITHOUT_ARGUMENTS_TO_CHECK}
