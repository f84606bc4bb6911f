"""Every public renderer as one function from a scene to its picture."""

from functools import cache
from typing import Any

import torch
from torch import Tensor, nn

import torchbokeh as tb

from .scenes import Inputs, Scene

VIEWS = 12
"""Of the accumulation buffers: these have laws at any number of views."""


@cache
def bank(name: str) -> tb.PsfBank:
    """A bank that comes with the package, loaded once."""
    return tb.PsfBank.load(name)


def aperture(words: str, turned: float = 0.0, *, mirrored: bool = False) -> tb.Aperture:
    """An aperture from its kind and numbers, mirrored left to right or not, and then turned counter-clockwise."""
    kind, *numbers = words.split()
    if kind == "disc":
        return tb.Disc()
    first, rotation, *rest = map(float, numbers)
    rotation = (-rotation if mirrored else rotation) + turned
    return tb.Ellipse(first, rotation) if kind == "ellipse" else tb.Polygon(int(first), rotation, *rest)


class Reconstruction(nn.Module):
    """`torchbokeh.reconstruct` as a module."""

    def forward(self, samples: tb.Samples) -> Tensor:
        return tb.reconstruct(samples, layers=3)


def module(scene: Scene, iris: tb.Aperture | None = None, **settings: Any) -> nn.Module:
    """The renderer that a scene names, as its user builds it."""
    iris = aperture(scene.aperture) if iris is None else iris
    if scene.renderer == "LensBlur":
        settings = {"subapertures": scene.subapertures or "auto", "shutter": scene.shutter} | settings
        return tb.LensBlur(scene.optics(), iris, quality=scene.quality, tolerance=scene.tolerance, **settings)
    if scene.renderer == "KernelSplatting":
        settings |= {"aperture": iris} if scene.bank == "none" else {"bank": bank(scene.bank)}
        return tb.KernelSplatting(quality=scene.quality, tolerance=scene.tolerance, **settings)
    if scene.renderer == "reconstruct":
        return Reconstruction()
    kind = {"AccumulationBuffer": tb.AccumulationBuffer, "ChromaticAccumulation": tb.ChromaticAccumulation}
    return kind[scene.renderer](scene.optics(), iris, VIEWS, **settings)


def arguments(scene: Scene, inputs: Inputs) -> tuple[tuple[Any, ...], dict[str, Any]]:
    """What the module of a scene is called with."""
    image, distance = inputs.image, inputs.distance
    if scene.renderer == "reconstruct":
        return (_samples(inputs),), {}
    if scene.renderer == "KernelSplatting":
        if scene.bank == "volume":
            return (image,), {"depth": inputs.coc.abs() + 0.1}
        return (image, distance), {"motion": inputs.motion[0]} if scene.bank == "combined" else {}
    given: dict[str, Any] = {"depth" if scene.lens != "none" else "coc": distance}
    if inputs.motion:
        given["motion"] = inputs.motion if len(inputs.motion) > 1 else inputs.motion[0]
    if inputs.ends is not None:
        given["shutter_depth"] = inputs.ends
    if inputs.behind is not None:
        given["background"] = inputs.behind[0] if inputs.behind[1] is None else inputs.behind
    return (image,), given


def picture(scene: Scene, inputs: Inputs | None = None, renderer: nn.Module | None = None, **more: Any) -> Tensor:
    """The picture of a scene: by its own inputs and module, or by these.

    Args:
        scene: of which renderer, and with what.
        inputs: in the place of those of the scene.
        renderer: likewise.
        more: arguments of the module, such as ``plan``.
    """
    positional, named = arguments(scene, scene.inputs() if inputs is None else inputs)
    return (module(scene) if renderer is None else renderer)(*positional, **named, **more)


def plan(scene: Scene, inputs: Inputs, renderer: nn.Module | None = None) -> Any:
    """What the module of a scene plans."""
    positional, named = arguments(scene, inputs)
    return (module(scene) if renderer is None else renderer).plan(*positional, **named)  # type: ignore[operator]


def planned(scene: Scene) -> bool:
    """Whether the renderer decides on plans."""
    return scene.renderer in ("LensBlur", "KernelSplatting")


def _samples(inputs: Inputs) -> tb.Samples:
    """A plain picture as one sample in the middle of each pixel, of the lens and of the exposure."""
    image, coc = inputs.image, inputs.coc
    height, width = image.shape[2:]
    dtype = image.dtype if image.dtype == torch.float64 else torch.float32
    y, x = torch.meshgrid(torch.arange(height, dtype=dtype), torch.arange(width, dtype=dtype), indexing="ij")
    position = torch.stack([x, y]).expand(len(image), 2, height, width)
    zero = torch.zeros_like(position)
    motion = inputs.motion[0] if inputs.motion else zero
    present = torch.ones_like(coc, dtype=torch.bool)
    maps = (image, position, zero, zero[:, :1], coc, motion, present)
    return tb.Samples(*(t[:, None] for t in maps))
