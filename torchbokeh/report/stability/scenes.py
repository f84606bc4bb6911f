"""Scenes through the reference renderers, in float32 against double."""

from collections.abc import Iterator
from dataclasses import replace

import torch

from torchbokeh.lens import ThinLens
from torchbokeh.lens.dispersion import Dispersion
from torchbokeh.renderers.accumulation import AccumulationBuffer
from torchbokeh.renderers.chromatic import ChromaticAccumulation
from torchbokeh.report.stability.rows import Row, row
from torchbokeh.scenes import RECIPES, Camera, Scene

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
        renderers = {
            "AccumulationBuffer scene": (AccumulationBuffer(views=VIEWS), camera),
            "AccumulationBuffer scene, coarser and shared": (
                AccumulationBuffer(views=VIEWS, level_of_detail=1.0, reuse=1),
                camera,
            ),
            "AccumulationBuffer scene, sub-samples": (AccumulationBuffer(views=VIEWS, subsamples=4), camera),
            "ChromaticAccumulation scene, rgb": (ChromaticAccumulation(views=VIEWS), _dispersing(camera, "rgb")),
            "ChromaticAccumulation scene, continuous": (
                ChromaticAccumulation(views=VIEWS),
                _dispersing(camera, "continuous"),
            ),
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
            strange = int((~out.isfinite()).sum()) + (out.dtype != torch.float32)
            yield row(*here, "not finite, or of another dtype", strange, 0)
            yield row(*here, "error", float((out - want).abs().max()), limit)
            outside = torch.maximum(-out, out - top).clamp_min(0)
            yield row(*here, "outside of [0, max]", float(outside.max()), limit)


def _in_double(scene: Scene) -> Scene:
    assert scene.backdrop is not None
    sprites = tuple(replace(s, texture=s.texture.double()) for s in scene.sprites)
    return Scene(sprites, replace(scene.backdrop, texture=scene.backdrop.texture.double()))


def _dispersing(camera: Camera, spectrum: str) -> Camera:
    """The same camera with the glass of its lens."""
    dispersion = Dispersion("BK7", lateral=0.02, spectrum=spectrum)  # type: ignore[arg-type]
    return replace(camera, lens=ThinLens(*camera.lens.values().values(), dispersion=dispersion))
