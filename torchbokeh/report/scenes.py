"""The scenes of the report: pictures with signed CoC, at any size and blur radius."""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from torchbokeh import AccumulationBuffer, Dispersion, ThinLens
from torchbokeh.scenes import RECIPES, Camera, Scene

PHOTO = "photo"
NAMES = (PHOTO, *RECIPES)
"""Every scene of the report."""

IN_FRONT = -1.5
"""CoC in px below which a layer counts as foreground, where the true background is put together."""


@dataclass(frozen=True)
class Picture:
    """What a pinhole camera sees.

    Attributes:
        image: ``(1, 3, H, W)``, linear.
        coc: ``(1, 1, H, W)`` signed radius in px.
    """

    image: Tensor
    coc: Tensor


@dataclass(frozen=True)
class LayeredPicture(Picture):
    """A pinhole picture with all that it hides, and the truth.

    Attributes:
        layers: ``(1, L, 4, H, W)``, premultiplied, front to back.
        layer_coc: ``(1, L, 1, H, W)``.
        background: what the foreground hides, ``(1, 3, H, W)``.
        background_coc: ``(1, 1, H, W)``.
        halves: two independent pictures of the lens ``(1, 3, H, W)``; their mean is the truth.
    """

    layers: Tensor
    layer_coc: Tensor
    background: Tensor
    background_coc: Tensor
    halves: tuple[Tensor, Tensor]

    @property
    def truth(self) -> Tensor:
        """The picture of the lens."""
        return (self.halves[0] + self.halves[1]) / 2


def picture(name: str, size: int, radius: float) -> Picture:
    """A square scene.

    Args:
        name: one of `NAMES`.
        size: side in px.
        radius: of the largest blur in px.

    Raises:
        ValueError: an unknown name.

    Example:
        >>> picture("photo", 64, 5.0).coc.abs().max().item() <= 5.0
        True
    """
    if name == PHOTO:
        return photo(size, radius)
    scene, camera = still(name, size, radius)
    return _seen(scene, camera)[0]


def still(name: str, size: int, radius: float) -> tuple[Scene, Camera]:
    """A recipe with the shutter open for no time: blur is that of the lens alone.

    Raises:
        ValueError: an unknown name.
    """
    if name not in RECIPES:
        raise ValueError(f"scenes: expected some of {', '.join(NAMES)}, got {name!r}")
    scene, camera = RECIPES[name](0, size=(size, size), blur=radius)
    return scene, replace(camera, shutter=0.0)


def with_dispersion(camera: Camera, dispersion: Dispersion) -> Camera:
    """The same camera with a lens that disperses."""
    lens = camera.lens
    values = lens.focal_length, lens.f_number, lens.focus_distance, lens.sensor_width
    return replace(camera, lens=ThinLens(*values, dispersion=dispersion))


@lru_cache(maxsize=16)
def photo(size: int, radius: float, seed: int = 0) -> Picture:
    """A photograph with small bright highlights; its CoC is a ramp through focus, with discs of constant CoC on it.

    Args:
        size: side in px.
        radius: the CoC runs from minus this at the left to this at the right.
        seed: places of the highlights and of the discs.
    """
    import skimage

    draw = np.random.default_rng(seed)
    shown = skimage.transform.resize(skimage.data.astronaut(), (size, size), anti_aliasing=True)
    image = shown.astype(np.float32) ** 2.2
    for y, x in draw.integers(0, size, (120, 2)):
        image[y : y + 2, x : x + 2] = draw.uniform(20, 200)
    y, x = np.mgrid[0:size, 0:size].astype(np.float32) / size
    coc = (2 * x - 1) * np.float32(radius)
    for _ in range(12):
        v, u, reach = draw.uniform(0, 1), draw.uniform(0, 1), draw.uniform(0.04, 0.15)
        coc[(y - v) ** 2 + (x - u) ** 2 < reach**2] = draw.uniform(-radius, radius)
    return Picture(torch.from_numpy(image).permute(2, 0, 1)[None].contiguous(), torch.from_numpy(coc)[None, None])


def special(size: int, radius: float) -> dict[str, Picture]:
    """Scenes that need less than the whole, from the picture of `photo`; the last one needs everything.

    Args:
        size: side in px.
        radius: of the largest blur in px.
    """
    full = photo(size, radius)
    bright = full.image.amax(1, keepdim=True) > 1
    one = torch.ones_like(full.coc)
    rows = torch.linspace(-radius, radius, size)[:, None].expand(size, size)[None, None].contiguous()
    return {
        "all in focus": Picture(full.image, 0.3 * one),
        "one depth": Picture(full.image, radius * one),
        "no foreground": Picture(full.image, full.coc.abs()),
        "slight blur": Picture(full.image, full.coc * (2 / radius)),
        "nothing but highlights": Picture(full.image * bright, full.coc),
        "ramp": Picture(full.image, rows),
        "full": full,
    }


@lru_cache(maxsize=16)
def layered_picture(name: str, size: int, radius: float, views: int) -> LayeredPicture:
    """A recipe with its layers, its true background, and two halves of the truth.

    Args:
        name: of a recipe.
        size: side in px.
        radius: of the largest blur in px.
        views: of each half: points of the lens.

    Raises:
        ValueError: an unknown name.
    """
    scene, camera = still(name, size, radius)
    seen, layers, layer_coc = _seen(scene, camera)
    background, background_coc = _behind(layers, layer_coc)
    first, second = (AccumulationBuffer(views=views, seed=seed)(scene, camera)[:, :3] for seed in (1, 2))
    return LayeredPicture(
        seen.image, seen.coc, layers[None], layer_coc[None], background[None], background_coc[None], (first, second)
    )


def _seen(scene: Scene, camera: Camera) -> tuple[Picture, Tensor, Tensor]:
    """The pinhole picture, its layers ``(L, 4, H, W)`` and their CoC ``(L, 1, H, W)``."""
    seen = scene.render(camera)
    with torch.no_grad():
        coc = camera.lens.coc(seen["depth"][None], camera.size[1])
        layer_coc = camera.lens.coc(seen["layer_depth"], camera.size[1])
    # Where a layer holds nothing its depth says nothing, and may be anything.
    layer_coc = torch.where(seen["layers"][:, 3:] > 0, layer_coc, 0.0)
    return Picture(seen["image"][None], coc), seen["layers"], layer_coc


def _behind(layers: Tensor, coc: Tensor) -> tuple[Tensor, Tensor]:
    """What lies behind the foreground: colour ``(3, H, W)`` and CoC ``(1, H, W)`` of what is seen most of."""
    rest = (coc >= IN_FRONT).to(layers)
    colour, left = torch.zeros_like(layers[0, :3]), torch.ones_like(coc[0])
    most, found = torch.zeros_like(left), torch.zeros_like(left)
    for layer, radius, kept in zip(layers, coc, rest, strict=True):
        colour = colour + left * kept * layer[:3]
        visible = left * kept * layer[3:]
        found = torch.where(visible > most, radius, found)
        most = torch.maximum(most, visible)
        left = left * (1 - kept * layer[3:])
    return colour / (1 - left).clamp_min(1e-6), found
