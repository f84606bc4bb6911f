"""Procedural scenes with exact pictures: textured cards in space, seen through a thin lens over an open shutter."""

from importlib import import_module
from typing import TYPE_CHECKING

from torchbokeh.scenes import shapes, textures
from torchbokeh.scenes.camera import Camera
from torchbokeh.scenes.ray_samples import samples
from torchbokeh.scenes.recipes import RECIPES, coins, fence, gears, rain, ramp, sky, stack, whirl
from torchbokeh.scenes.scene import Scene
from torchbokeh.scenes.sprite import Backdrop, Sprite

if TYPE_CHECKING:
    from torchbokeh.datasets import ProceduralDataset, read_shards, write_shards

__all__ = [
    "RECIPES",
    "Backdrop",
    "Camera",
    "ProceduralDataset",
    "Scene",
    "Sprite",
    "coins",
    "fence",
    "gears",
    "rain",
    "ramp",
    "read_shards",
    "samples",
    "shapes",
    "sky",
    "stack",
    "textures",
    "whirl",
    "write_shards",
]


def __getattr__(name: str) -> object:
    """Forward data sets, which are made with renderers and so stand above the scenes, at their first use."""
    if name not in ("ProceduralDataset", "read_shards", "write_shards"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module("torchbokeh.datasets"), name)


def __dir__() -> list[str]:
    """The public names, those of the data sets among them."""
    return sorted({*globals(), *__all__})
