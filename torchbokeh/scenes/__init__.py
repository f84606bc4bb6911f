"""Procedural scenes with exact pictures: textured cards in space, seen through a thin lens over an open shutter."""

from torchbokeh.datasets.dataset import ProceduralDataset
from torchbokeh.datasets.shards import read_shards, write_shards
from torchbokeh.scenes import shapes, textures
from torchbokeh.scenes.camera import Camera
from torchbokeh.scenes.ray_samples import samples
from torchbokeh.scenes.recipes import RECIPES, coins, fence, gears, rain, ramp, sky, stack, whirl
from torchbokeh.scenes.scene import Scene
from torchbokeh.scenes.sprite import Backdrop, Sprite

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
