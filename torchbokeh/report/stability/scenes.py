"""Scenes through the reference renderers, in float32 against double."""

from collections.abc import Iterator
from dataclasses import replace

import torch

from torchbokeh import AccumulationBuffer, ChromaticAccumulation, Dispersion
from torchbokeh.report.rows import Row
from torchbokeh.report.scenes import with_dispersion
from torchbokeh.report.stability.rows import STRANGE, outside, row, strange
from torchbokeh.scenes import RECIPES, Scene

CHOSEN = ("coins", "whirl", "sky")
"""Recipes: highlights at many depths, fast rotation, and a backdrop at infinity."""

VIEWS = 16


def scene_rows(side: int) -> Iterator[Row]:
    """Recipes through `AccumulationBuffer` with each of its techniques, and `ChromaticAccumulation`.

    Homographies are double, textures and what is looked up in them float32. Of a picture of K planes a view is a sum
    with weights that sum to 1; each plane is a mean of four texels (8 roundings) and hides the next ones (3 roundings).
    A place in a texture, or in a frame that dispersion moves, is held to ``u`` times its size in texels (px), and lies
    between two of them each way. So the error is ``(3 K + 8 + 4 extent) u`` of the brightest texel.
    """
    for recipe in CHOSEN:
        scene, camera = RECIPES[recipe](0, (side, side * 3 // 2))
        assert scene.backdrop is not None
        rgb, continuous = (
            with_dispersion(camera, Dispersion("BK7", lateral=0.02, spectrum=spectrum))
            for spectrum in ("rgb", "continuous")
        )
        shared = AccumulationBuffer(views=VIEWS, level_of_detail=1.0, reuse=1)
        renderers = {
            "AccumulationBuffer scene": (AccumulationBuffer(views=VIEWS), camera),
            "AccumulationBuffer scene, coarser and shared": (shared, camera),
            "AccumulationBuffer scene, sub-samples": (AccumulationBuffer(views=VIEWS, subsamples=4), camera),
            "ChromaticAccumulation scene, rgb": (ChromaticAccumulation(views=VIEWS), rgb),
            "ChromaticAccumulation scene, continuous": (ChromaticAccumulation(views=VIEWS), continuous),
        }
        textures = [*(s.texture[:3] * s.emission for s in scene.sprites), scene.backdrop.texture]
        top = max(float(t.max()) for t in textures)
        extent = max(*camera.size, *(n for t in textures for n in t.shape[1:]))
        unit = torch.finfo(torch.float32).eps / 2
        limit = (3 * len(scene) + 8 + 4 * extent) * unit * top
        for name, (renderer, seen_by) in renderers.items():
            out = renderer(scene, seen_by)
            want = renderer(_in_double(scene), seen_by)
            here = (name, f"scene: {recipe}", "float32")
            yield row(*here, STRANGE, strange(out, torch.float32), 0)
            yield row(*here, "error", float((out - want).abs().max()), limit)
            yield row(*here, "outside of [0, max]", float(outside(out, 0.0, torch.tensor(top)).max()), limit)


def _in_double(scene: Scene) -> Scene:
    assert scene.backdrop is not None
    sprites = tuple(replace(s, texture=s.texture.double()) for s in scene.sprites)
    return Scene(sprites, replace(scene.backdrop, texture=scene.backdrop.texture.double()))
