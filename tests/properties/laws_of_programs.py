"""Compiled, exported, or run without torch: the same picture. Each scene takes seconds, so few of them are tried."""

import tempfile
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

import torchbokeh as tb

from .law import Law, peak_error, still
from .renderers import module, picture, plan, planned
from .scenes import Scene


def quietly(measure: Callable[[Scene], float]) -> Callable[[Scene], float]:
    """Without the warnings of torch's compilers about themselves, and without what they keep from scene to scene."""

    def run(scene: Scene) -> float:
        torch._dynamo.reset()
        with warnings.catch_warnings(), torch.no_grad():
            warnings.simplefilter("ignore")
            found = measure(scene)
        torch._dynamo.reset()
        return found

    return run


@quietly
def compiled(scene: Scene) -> float:
    """`torch.compile` as one graph, with a plan."""
    inputs, one = scene.inputs(), module(scene)
    decided = plan(scene, inputs, one)
    whole = torch.compile(one, fullgraph=True, backend="aot_eager")
    return peak_error(picture(scene, inputs, whole, plan=decided), picture(scene, inputs, one, plan=decided))


class Positional(nn.Module):
    """A module that is called with an image and its CoC or depth, as exporters like it."""

    def __init__(self, renderer: nn.Module, name: str | None) -> None:
        super().__init__()
        self.renderer, self.name = renderer, name

    def forward(self, image: Tensor, distance: Tensor) -> Tensor:
        return self.renderer(image, distance) if self.name is None else self.renderer(image, **{self.name: distance})


@quietly
def exported(scene: Scene) -> float:
    """`torch.export` of a planned renderer."""
    inputs, one = scene.inputs(), module(scene)
    name = None if scene.renderer == "KernelSplatting" else "coc" if scene.lens == "none" else "depth"
    whole = Positional(one.planned(plan(scene, inputs, one)), name)  # type: ignore[operator]
    given = inputs.image, inputs.distance
    return peak_error(torch.export.export(whole, given).module()(*given), whole(*given))


@quietly
def without_torch(scene: Scene) -> float:
    """The ONNX file of a renderer in onnxruntime."""
    import onnxruntime

    inputs, one = scene.inputs(), module(scene)
    decided = plan(scene, inputs, one)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "blur.onnx"
        tb.export_onnx(one, path, inputs.image, inputs.distance, plan=decided)
        loaded = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    given = zip(loaded.get_inputs(), (inputs.image, inputs.distance), strict=True)
    (found,) = loaded.run(None, {at.name: np.asarray(t, np.float32) for at, t in given})
    return peak_error(torch.from_numpy(found), picture(scene, inputs, one, plan=decided))


def simple(scene: Scene) -> Scene | None:
    """One picture with a plan, which stands still."""
    if not planned(scene) or scene.bank != "none" or scene.lens in ("rgb", "continuous"):
        return None
    few = replace(still(scene), batch=1, background="none", layers=min(scene.layers, 2), tolerance=None)
    size = tuple(min(max(n, 8), 24) for n in few.size)
    return replace(few, size=size, image="noise" if few.image == "range" else few.image)


def for_other_runtimes(scene: Scene) -> Scene | None:
    one = simple(scene)
    # More sub-apertures are as many copies of one graph.
    if one is None:
        return None
    coc = "ramp" if one.coc in ("constant", "sharp") else one.coc  # where nothing varies there is nothing to export
    return replace(one, lens="none", subapertures=1, coc=coc, radius=max(one.radius, 1.0))


LAWS = (
    Law("compiled", "Compiled is eager; largest difference over the largest value.", simple, compiled, 1e-5, tries=2),
    Law("exported", "A program of `torch.export` is eager.", simple, exported, 1e-5, tries=2),
    Law("ONNX", "An ONNX file in onnxruntime is eager.", for_other_runtimes, without_torch, 1e-4, tries=1),
)
