"""Scenes as small records of numbers and words: one line of code makes the same tensors everywhere, at any time.

`draw` takes them from a generator of random numbers, `scenes` is the same as a strategy of hypothesis.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import numpy as np
import torch
from hypothesis import strategies as st
from torch import Tensor

import torchbokeh as tb

textures = tb.scenes.textures
Maps = Callable[[Tensor], Tensor]

OPTIONS: dict[str, tuple[Any, ...]] = {
    "image": (
        *("noise", "uniform", "black", "spikes", "range", "lognormal", "checkers", "dots", "lines", "text"),
        *("lights", "photograph"),
    ),
    "coc": ("constant", "ramp", "planes", "steps", "noise", "lognormal", "edges", "thresholds", "sharp", "huge"),
    "side": ("both", "both", "behind", "front"),
    "quality": ("exact", "high", "balanced", "fast"),
    "tolerance": (None, None, None, 0.003, 0.01, 0.03, 0.1),
    "aperture": ("disc", "disc", "disc", "polygon 6 0 0", "polygon 5 0.3 0.5", "polygon 3 1 0", "ellipse 2 0.4"),
    "lens": (*("none",) * 6, "thin", "disparity", "rgb", "continuous"),
    "batch": (1, 1, 1, 1, 2, 3),
    "channels": (3, 3, 1, 2, 4, 5),
    "layers": (0, 0, 0, 0, 0, 1, 2, 3, 4),
    "alpha": ("any", "opaque", "cut", "soft", "faint"),
    "motion": (*("none",) * 8, "pan", "anywhere", "opposite", "curve"),
    "approach": (*(0.0,) * 12, 0.3, 0.8, 3.0, 9.0, 30.0),
    "background": ("none", "none", "none", "image", "both"),
    "shutter": ("centre", "centre", "start"),
}
"""What each word or number of a scene is drawn from; what stands there twice comes twice as often."""

SIDES = (1, 2, 3, 4, 5, 7, 8, 9, 11, 13, 16, 17, 19, 23, 31, 32, 33)
LARGE = (*SIDES, 37, 48, 61, 64, 65, 67, 96, 97, 127, 128, 130)
"""Heights and widths: odd, prime, powers of two and their neighbours."""

THRESHOLDS = (0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 8.0, 16.0)
"""Radii in px at which a plan changes, or a level begins."""


class Inputs(NamedTuple):
    """Tensors of a scene: `Scene.inputs`.

    Attributes:
        image: ``(B, C, H, W)`` or layers ``(B, L, 4, H, W)``.
        distance: what the lens takes for depth, or the CoC where there is none; with one channel for C.
        coc: signed CoC in px that is meant.
        motion: displacements, in order.
        ends: ``shutter_depth`` in the unit of ``distance``, or None.
        behind: ``background``: an image, and its ``distance`` or None; or None.
    """

    image: Tensor
    distance: Tensor
    coc: Tensor
    motion: tuple[Tensor, ...] = ()
    ends: Tensor | None = None
    behind: tuple[Tensor, Tensor | None] | None = None

    def mapped(self, change: Maps, vectors: Maps | None = None) -> "Inputs":
        """The same with all maps changed, and displacements by a rule of their own."""

        def of(t: Tensor | None) -> Tensor | None:
            return None if t is None else change(t)

        behind = None if self.behind is None else (change(self.behind[0]), of(self.behind[1]))
        motion = tuple((vectors or change)(t) for t in self.motion)
        return Inputs(change(self.image), change(self.distance), change(self.coc), motion, of(self.ends), behind)


@dataclass(frozen=True)
class Scene:
    """A picture, its maps, and the renderer that it is for: words and numbers that `inputs` makes tensors of.

    Lengths are in px: ``radius`` is about the largest of the CoC, ``speed`` that of the motion, ``approach`` the change
    of the CoC while the shutter is open.
    """

    renderer: str = "LensBlur"
    size: tuple[int, int] = (16, 16)
    image: str = "noise"
    coc: str = "constant"
    side: str = "both"
    radius: float = 4.0
    quality: str = "exact"
    tolerance: float | None = None
    aperture: str = "disc"
    bank: str = "none"
    lens: str = "none"
    batch: int = 1
    channels: int = 3
    layers: int = 0
    alpha: str = "any"
    motion: str = "none"
    speed: float = 6.0
    approach: float = 0.0
    background: str = "none"
    shutter: str = "centre"
    subapertures: int | None = None
    seed: int = 0

    def __repr__(self) -> str:
        """The line of code that makes it, without what is as usual."""
        told = [f"{f.name}={getattr(self, f.name)!r}" for f in fields(self) if getattr(self, f.name) != f.default]
        return f"Scene({', '.join(told)})"

    def rng(self, what: str) -> np.random.Generator:
        """Random numbers for one part of it: another part may change without them."""
        return np.random.default_rng([self.seed, *what.encode()])

    def inputs(self, dtype: torch.dtype = torch.float32) -> Inputs:
        """All tensors."""
        count = max(self.layers, 1)
        shape = (self.batch, count)
        coc = torch.stack([self._signed(f"coc {n}") for n in range(self.batch * count)]).view(*shape, 1, *self.size)
        if self.layers:
            colour = torch.stack([self._pixels(f"image {n}") for n in range(self.batch * count)])
            alpha = torch.stack([self._alpha(f"alpha {n}") for n in range(self.batch * count)])
            image = torch.cat([colour * alpha, alpha], 1).view(*shape, 4, *self.size)
        else:
            image, coc = torch.stack([self._pixels(f"image {n}") for n in range(self.batch)]), coc[:, 0]
        motion = tuple(torch.stack([t.squeeze(0) for t in way]) for way in self._ways(self.batch * count))
        motion = tuple(t.view(*shape, 2, *self.size) if self.layers else t for t in motion)
        ends = behind = None
        if self.approach:
            half = self.approach / 2 * torch.from_numpy(self.rng("ends").choice([-1.0, 1.0, 0.5], coc.shape[:-3]))
            half = half.view(*half.shape, 1, 1, 1)
            ends = self.distance(torch.cat([coc - half, coc + half], -3))
        if self.background != "none" and not self.layers:
            pixels = torch.stack([self._pixels(f"behind {n}") for n in range(self.batch)])
            far = torch.stack([self._signed(f"behind coc {n}") for n in range(self.batch)]).abs()
            behind = pixels, self.distance(far) if self.background == "both" else None
        return Inputs(image, self.distance(coc), coc, motion, ends, behind).mapped(lambda t: t.to(dtype))

    def optics(self) -> tb.Lens | None:
        """The lens, which can blur by half as much again as ``radius``; its pixels have the same pitch in any size."""
        if self.lens == "none":
            return None
        if self.lens == "disparity":
            return tb.DisparityLens(max(self.radius, 1.0), 0.5)
        limit, pitch = 1.5 * max(self.radius, 1.0), 1e-4
        dispersion = None if self.lens == "thin" else tb.Dispersion("BK7", 1.0, 0.01, spectrum=self.lens)  # type: ignore
        f_number = 0.05**2 / (2 * limit * pitch * (2.0 - 0.05))
        return tb.ThinLens(0.05, f_number, 2.0, pitch * self.size[1], dispersion=dispersion)

    def distance(self, coc: Tensor) -> Tensor:
        """What the lens takes for a CoC, as near as it comes to that."""
        lens = self.optics()
        if lens is None:
            return coc
        if self.lens != "disparity":
            coc = coc.clamp(max=1.49 * max(self.radius, 1.0))
        return lens.depth(coc, self.size[1])

    def _pixels(self, part: str) -> Tensor:
        """A picture ``(C, H, W)`` in double."""
        rng, channels = self.rng(part), 3 if self.layers else self.channels
        shape = channels, *self.size
        tint = torch.from_numpy(rng.uniform(0.2, 1, (channels, 1, 1)))
        plain = _PLAIN.get(self.image)
        if plain is not None:
            return torch.from_numpy(np.broadcast_to(plain(rng, shape), shape).copy()) * tint
        found = getattr(textures, "line_art" if self.image == "lines" else self.image)(
            self.size, int(rng.integers(1e6))
        )
        return found.double()[[c % 3 for c in range(channels)]]

    def _signed(self, part: str) -> Tensor:
        """Signed CoC ``(1, H, W)`` in double."""
        rng = self.rng(part)
        coc = self.radius * torch.from_numpy(np.broadcast_to(_COC[self.coc](rng, self.size), self.size).copy())[None]
        if self.coc == "thresholds":
            coc = torch.from_numpy(_near_thresholds(rng, self.size))[None]
        return coc if self.side == "both" else coc.abs() if self.side == "behind" else -coc.abs()

    def _alpha(self, part: str) -> Tensor:
        """Coverage ``(1, H, W)``; the last layer of all is opaque but for those of "any"."""
        rng = self.rng(part)
        kind = rng.choice(["opaque", "cut", "soft", "faint", "empty"]) if self.alpha == "any" else self.alpha
        noise = rng.uniform(0, 1, (1, *self.size))
        cut = _discs(rng, self.size)[None]
        alphas = {"opaque": np.ones_like(noise), "cut": cut, "soft": noise, "faint": 1e-4 * noise, "empty": 0 * noise}
        return torch.from_numpy(alphas[str(kind)].astype(np.float64))

    def _ways(self, count: int) -> list[list[Tensor]]:
        """Displacements ``(1, 2, H, W)`` of each picture or layer, for each part of the exposure."""
        if self.motion == "none":
            return []
        parts = []
        for part in range(3 if self.motion == "curve" else 1):
            rng = self.rng(f"motion {part}")
            angle = 2 * math.pi * rng.uniform(size=(count, 1, 1, 1))
            length = self.speed * np.ones((count, 1, *self.size))
            if self.motion == "anywhere":
                angle, length = 2 * math.pi * rng.uniform(size=length.shape), length * rng.uniform(size=length.shape)
            if self.motion == "opposite":
                length = length * np.sign(rng.uniform(-1, 1, length.shape))
            way = np.concatenate([length * np.cos(angle), length * np.sin(angle)], 1)
            parts.append(list(torch.from_numpy(way).split(1)))
        return parts


def _discs(rng: np.random.Generator, size: tuple[int, int]) -> np.ndarray:
    """1 in a few discs, else 0."""
    y, x = np.mgrid[: size[0], : size[1]]
    found = np.zeros(size)
    for _ in range(3):
        cy, cx, r = rng.uniform(0, size[0]), rng.uniform(0, size[1]), rng.uniform(0.1, 0.4) * max(size)
        found[(y - cy) ** 2 + (x - cx) ** 2 <= r * r] = 1
    return found


def _slope(rng: np.random.Generator, size: tuple[int, int]) -> np.ndarray:
    """A plane of numbers from -1 to 1."""
    y, x = np.mgrid[: size[0], : size[1]]
    a = rng.uniform(0, 2 * math.pi)
    plane = (x - size[1] / 2) * math.cos(a) + (y - size[0] / 2) * math.sin(a)
    return plane / max(float(np.abs(plane).max()), 1e-9)


def _stripes(rng: np.random.Generator, size: tuple[int, int]) -> np.ndarray:
    """A plane of numbers from -1 to 1 in a few steps."""
    steps = int(rng.integers(1, 5))
    return np.round(_slope(rng, size) * steps) / steps


def _near_thresholds(rng: np.random.Generator, size: tuple[int, int]) -> np.ndarray:
    """Radii in px at thresholds of plans, and just beside them; a few of them, in discs."""
    few = rng.choice(THRESHOLDS, 3) * rng.choice([-1, 1], 3) + rng.choice([0, 1e-6, -1e-6, 1e-3, -1e-3, 0.01], 3)
    return np.where(_discs(rng, size) > 0, few[0], np.where(_discs(rng, size) > 0, few[1], few[2]))


def _checkers(rng: np.random.Generator, size: tuple[int, int]) -> np.ndarray:
    cell = int(rng.integers(1, 6))
    y, x = np.mgrid[: size[0], : size[1]]
    return ((y // cell + x // cell) % 2).astype(float)


Part = Callable[[np.random.Generator, tuple[int, ...]], Any]
_PLAIN: dict[str, Part] = {
    "noise": lambda rng, shape: rng.uniform(0, 1, shape),
    "uniform": lambda rng, shape: 1.0,
    "black": lambda rng, shape: 0.0,
    "spikes": lambda rng, shape: 0.1 + 1e4 * (rng.uniform(0, 1, shape[1:]) < 2 / math.prod(shape[1:])),
    "range": lambda rng, shape: 10 ** rng.uniform(-30, 30, shape),
    "lognormal": lambda rng, shape: np.exp(rng.normal(0, 2, shape)),
    "checkers": lambda rng, shape: _checkers(rng, shape[1:]),
    "dots": lambda rng, shape: (rng.uniform(0, 1, shape[1:]) < 0.02).astype(float),
}
_COC: dict[str, Part] = {
    "constant": lambda rng, size: rng.choice([-1.0, 1.0]),
    "ramp": _slope,
    "planes": lambda rng, size: np.where(_slope(rng, size) > 0.2, _slope(rng, size), -rng.uniform()),
    "steps": _stripes,
    "noise": lambda rng, size: rng.uniform(-1, 1, size),
    "lognormal": lambda rng, size: rng.choice([-1, 1], size) * np.exp(rng.normal(-1, 1, size)),
    "edges": lambda rng, size: np.where(_discs(rng, size) > 0, -rng.uniform(0.3, 1), rng.uniform(0, 1)),
    "thresholds": lambda rng, size: 0.0,
    "sharp": lambda rng, size: 0.0,
    "huge": lambda rng, size: rng.choice([-1, 1]) * 10 ** rng.uniform(0, 4, size),
}

BANKS = ("simple-lens", "combined", "physical-lens", "volume", "stylized")
RENDERERS = (
    *(("LensBlur",) * 6 + ("KernelSplatting",) * 3),
    *("AccumulationBuffer", "ChromaticAccumulation", "reconstruct", "KernelSplatting bank"),
)
"""What a scene is drawn for; the quick ones come more often."""


def fitting(renderer: str, **told: Any) -> Scene:
    """A scene of what was drawn, without what its renderer does not take."""
    bank = told.pop("bank")
    if renderer == "KernelSplatting bank":
        renderer, told["aperture"] = "KernelSplatting", "disc"
        if bank in ("combined",) and told["motion"] in ("none", "curve"):
            told["motion"] = "pan"
        if bank != "combined":
            told["motion"] = "none"
        if bank in ("volume", "physical-lens", "stylized"):
            told["channels"] = 3
        told |= {"bank": bank, "radius": min(told["radius"], 20.0)}
        told["coc"] = "ramp" if told["coc"] == "huge" else told["coc"]
    elif renderer != "LensBlur":
        told["motion"] = "none" if renderer == "KernelSplatting" or told["motion"] == "curve" else told["motion"]
    if renderer != "LensBlur":
        told |= {"approach": 0.0, "background": "none", "shutter": "centre"}
    if renderer in ("KernelSplatting", "reconstruct"):
        told |= {"lens": "none", "layers": 0}
    if renderer in ("AccumulationBuffer", "ChromaticAccumulation", "reconstruct"):
        told |= {"quality": "exact", "tolerance": None}
    if renderer in ("AccumulationBuffer", "ChromaticAccumulation"):
        told["layers"] = max(told["layers"], 1)
        told["lens"] = (
            "thin" if renderer == "AccumulationBuffer" and told["lens"] not in ("none", "thin") else told["lens"]
        )
    if renderer == "reconstruct":
        told |= {"channels": 3, "aperture": "disc"}
    if told["lens"] in ("rgb", "continuous"):  # every light is a picture of its own
        told |= {"channels": 3, "layers": min(told["layers"], 2), "approach": 0.0, "batch": 1}
        told["motion"] = told["motion"] if told["lens"] == "rgb" and told["motion"] != "curve" else "none"
    if renderer == "LensBlur" and (told["motion"] != "none" or told["approach"]):
        told["aperture"] = "disc"
    if told["layers"]:
        told |= {"background": "none", "channels": 3}
    if told["lens"] != "none" and told["coc"] == "huge":
        told["coc"] = "ramp"
    return Scene(renderer=renderer, **told)


def draw(rng: np.random.Generator, sides: tuple[int, ...] = LARGE) -> Scene:
    """A scene at random."""
    told = {name: options[rng.integers(len(options))] for name, options in OPTIONS.items()}
    size = tuple(sides[rng.integers(len(sides))] for _ in range(2))
    # Wide blurs are rarer, as many of each power of ten as of another.
    radius, speed = (round(float(10 ** rng.uniform(-0.5, high)), 2) for high in (1.6, 1.4))
    renderer, bank = RENDERERS[rng.integers(len(RENDERERS))], BANKS[rng.integers(len(BANKS))]
    seed = int(rng.integers(1 << 20))
    return fitting(renderer, **told, size=size, radius=radius, speed=speed, bank=bank, seed=seed)


def scenes(sides: tuple[int, ...] = SIDES) -> st.SearchStrategy[Scene]:
    """The same for hypothesis, which finds the simplest scene that breaks a law: what stands first is simplest."""
    told = {name: st.sampled_from(options) for name, options in OPTIONS.items()}
    side, number = st.sampled_from(sides), st.integers(0, 1 << 20)
    length = st.floats(0.3, 40).map(lambda r: round(r, 2))
    names = {"renderer": st.sampled_from(RENDERERS), "bank": st.sampled_from(BANKS)}
    return st.builds(fitting, **names, **told, size=st.tuples(side, side), radius=length, speed=length, seed=number)
