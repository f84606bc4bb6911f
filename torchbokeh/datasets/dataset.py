"""Training data without end: pictures, depth, motion and layers with the exact picture a camera would take."""

import operator
from collections.abc import Sequence
from typing import Any

import torch
from torch.nn.functional import pad
from torch.utils.data import Dataset

from torchbokeh.ops.checks import check_size, check_whole, is_number
from torchbokeh.renderers.accumulation import AccumulationBuffer
from torchbokeh.scenes._random import rng
from torchbokeh.scenes.recipes import RECIPES

MOST_LAYERS = 1024


class ProceduralDataset(Dataset[dict[str, Any]]):
    """Samples of the recipes: sample i is a function of ``(seed, i)`` and the settings alone.

    It is the same to the bit in every process and worker; on machines with other versions of torch, numpy and Pillow,
    or without numba, to rounding.

    A sample is a dict of float32 tensors: ``image (3, H, W)``, the pinhole picture, linear; ``depth (1, H, W)`` in
    metres, ``inf`` is sky; ``motion (2, H, W)`` in px over the open shutter; ``coc (1, H, W)`` signed radius in px;
    ``target (3, H, W)``, the mean of ``views`` views through the lens; front to back ``layers (L, 4, H, W)`` of
    premultiplied RGBA with ``layer_depth (L, 1, H, W)`` and ``layer_motion (L, 2, H, W)``, empty ones at the back;
    ``lens``, a dict of the four parameters of `torchbokeh.ThinLens` as 0-d tensors; ``recipe``, its name; ``index``.

    Args:
        seed: of the whole set, >= 0.
        resolution: ``(H, W)`` of the pictures.
        length: number of samples; there is no end to them, but a shuffling sampler lists them all.
        recipes: names from `torchbokeh.scenes.RECIPES`, each as likely; ``None`` for all of them.
        blur: smallest and largest blur of a sample in px, where the blur of a sample is the largest CoC radius of
            anything in it; ``None`` for 1 % to 8 % of the width.
        views: of the target. Highlights want thousands, other things hundreds.
        layers: L, at most `MOST_LAYERS`; what lies deeper is flattened into the last one.
        level_of_detail: as for `torchbokeh.AccumulationBuffer`; ``"auto"`` takes the grain from pictures of few views.
        reuse: as for `torchbokeh.AccumulationBuffer`.

    Raises:
        TypeError: an argument of the wrong kind.
        ValueError: a value out of its range, or an unknown recipe.

    Example:
        >>> from torchbokeh.scenes import ProceduralDataset
        >>> sample = ProceduralDataset(resolution=(24, 32), recipes=("sky",), views=4)[7]
        >>> sample["target"].shape
        torch.Size([3, 24, 32])
    """

    def __init__(
        self,
        seed: int = 0,
        resolution: tuple[int, int] = (256, 256),
        *,
        length: int = 1 << 20,
        recipes: Sequence[str] | str | None = None,
        blur: tuple[float, float] | None = None,
        views: int = 256,
        layers: int = 6,
        level_of_detail: float | str = "auto",
        reuse: int = 0,
    ) -> None:
        rng(seed)
        self.seed = int(seed)
        self.resolution = check_size(resolution, "resolution")
        self.length = check_whole("length", length, 0)
        names = tuple(RECIPES) if recipes is None else recipes
        if not isinstance(names, Sequence):
            raise TypeError(f"recipes: expected names or None, got {recipes!r}")
        self.recipes = (names,) if isinstance(names, str) else tuple(names)
        for name in self.recipes:
            if name not in RECIPES:
                raise ValueError(f"recipes: expected some of {', '.join(RECIPES)}, got {name!r}")
        if not self.recipes:
            raise ValueError("recipes: expected at least one, got none")
        width = self.resolution[1]
        pair = (0.01 * width, 0.08 * width) if blur is None else blur
        if not isinstance(pair, Sequence) or len(pair) != 2 or not all(is_number(r) for r in pair):
            raise TypeError(f"blur: expected (smallest, largest) radius in px, got {blur!r}")
        self.blur = float(pair[0]), float(pair[1])
        if not 0 <= self.blur[0] <= self.blur[1] < float("inf"):
            raise ValueError(f"blur: expected (smallest, largest) radius in px, 0 or more, got {blur}")
        self.layers = check_whole("layers", layers, 1, MOST_LAYERS)
        buffer = AccumulationBuffer(views=views, level_of_detail=level_of_detail, reuse=reuse)
        self.target = {name: getattr(buffer, name) for name in ("views", "level_of_detail", "reuse")}

    def settings(self) -> dict[str, Any]:
        """All that the samples depend on, for a file beside them."""
        return {
            **{"seed": self.seed, "resolution": list(self.resolution), "recipes": list(self.recipes)},
            **{"blur": list(self.blur), "layers": self.layers},
            **self.target,
        }

    def __len__(self) -> int:
        return self.length

    def __repr__(self) -> str:
        return f"ProceduralDataset({', '.join(f'{k}={v!r}' for k, v in self.settings().items())}, length={self.length})"

    def __getitem__(self, index: int) -> dict[str, Any]:
        try:
            index = operator.index(index)
        except TypeError:
            raise TypeError(f"index: expected an int, got {index!r}") from None
        if not -self.length <= index < self.length:
            raise IndexError(f"index: expected below {self.length}, got {index}")
        index %= self.length
        draw = rng(self.seed, "sample", index)
        name = self.recipes[draw.integers(len(self.recipes))]
        low, high = self.blur
        # Small blurs are as likely as large ones, whatever the range.
        blur = low * (high / low) ** draw.uniform() if low > 0 else draw.uniform(low, high)
        scene, camera = RECIPES[name](int(draw.integers(1 << 31)), self.resolution, float(blur))
        with torch.no_grad():
            seen = scene.render(camera, samples=4, layers=self.layers)
            # Views of its own for each sample: the same ones in all would be a pattern to learn.
            buffer = AccumulationBuffer(**self.target, seed=int(draw.integers(1 << 31)))
            target = buffer(scene, camera)[0, :3]
        for key, empty in (("layers", 0.0), ("layer_depth", torch.inf), ("layer_motion", 0.0)):
            missing = self.layers - len(seen[key])  # all samples share a number of layers
            seen[key] = pad(seen[key], (0, 0, 0, 0, 0, 0, 0, missing), value=empty)
        for key in ("alpha", "shutter_depth", "layer_shutter_depth"):
            del seen[key]
        lens = {key: value.clone() for key, value in camera.lens.values().items()}
        coc = camera.lens.coc(seen["depth"], self.resolution[1])
        return {**seen, "coc": coc, "target": target, "lens": lens, "recipe": name, "index": index}
