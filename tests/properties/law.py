"""What a law is, and how far two pictures are apart."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

from torch import Tensor

from .scenes import Scene

EXACT = ("exact",)
PROMISED = {"exact": 0.0, "high": 0.006, "balanced": 0.019, "fast": 0.033}
"""Relative L1 error that each quality promises at most."""

Bound = float | Callable[[Scene], float]


@dataclass(frozen=True)
class Law:
    """Something that holds for every scene that it suits.

    Attributes:
        name: one or two words.
        says: what holds, and what is measured.
        suit: the scene made such that the law concerns it; None where it cannot.
        measure: a number that the law keeps small; what is not finite breaks it.
        bound: of that number, the same for all scenes or by scene.
        most: how many times the bound no scene may pass. More than 1 for a promise, which may be broken rarely.
        tries: scenes of each run of the tests; fewer than usual where one takes long.
    """

    name: str
    says: str
    suit: Callable[[Scene], Scene | None]
    measure: Callable[[Scene], float]
    bound: Bound
    most: float = 1.0
    tries: int = 200


class Found(NamedTuple):
    """A law tried on a scene; ``share`` of the bound is infinite where the number is not finite."""

    scene: Scene
    value: float
    bound: float

    @property
    def share(self) -> float:
        """How much of its bound a number takes."""
        if not math.isfinite(self.value):
            return math.inf
        return self.value / self.bound if self.bound > 0 else math.inf if self.value > 0 else 0.0


def tried(law: Law, scene: Scene) -> Found | None:
    """Try a law; None where it does not concern the scene."""
    suited = law.suit(scene)
    if suited is None:
        return None
    bound = law.bound if isinstance(law.bound, float) else law.bound(suited)
    return Found(suited, law.measure(suited), bound)


def peak_error(found: Tensor, wanted: Tensor) -> float:
    """Largest difference over the largest value."""
    if found.shape != wanted.shape:
        return math.inf
    if not wanted.numel():
        return 0.0
    return float((found - wanted).abs().max().double() / wanted.abs().max().double().clamp_min(1e-38))


def light_error(found: Tensor, wanted: Tensor) -> float:
    """Relative L1 error: all differences over all light."""
    if found.shape != wanted.shape:
        return math.inf
    return float((found.double() - wanted.double()).abs().sum() / wanted.double().abs().sum().clamp_min(1e-38))


def same_bits(found: Tensor, wanted: Tensor) -> float:
    """0 where all numbers are the same, and how far they are apart where they are not."""
    apart = peak_error(found, wanted)
    return apart if apart or not bool((found != wanted).any()) else 1e-30


WILD = ("huge", "noise", "lognormal", "thresholds")
"""CoC that jumps from pixel to pixel, where merging promises nothing."""


def promised(scene: Scene) -> Scene:
    """What merges pixels is for CoC that varies little from one to the next."""
    merges = scene.quality != "exact" or scene.tolerance is not None
    return replace(scene, coc="ramp") if merges and scene.coc in WILD else scene


def without_lights(scene: Scene) -> Scene:
    """Nothing that stands out so far that it is rendered in another way than the rest."""
    size = tuple(max(n, 12) for n in scene.size)  # of a few pixels one may be as bright as all others together
    return replace(scene, size=size, image=scene.image if scene.image in ("noise", "uniform", "black") else "noise")


def anything(scene: Scene) -> Scene:
    """Every scene."""
    return scene


def still(scene: Scene) -> Scene:
    """Without motion of any kind."""
    return replace(scene, motion="none", approach=0.0) if scene.bank != "combined" else scene


def nothing_hides(scene: Scene) -> Scene:
    """One surface, behind the focus plane."""
    return replace(scene, side="behind", layers=0, background="none", coc=scene.coc)


def at_quality(scene: Scene, exact: float, merged: float, bank: float, views: float | None = None) -> float:
    """A bound by the way in which a scene is rendered."""
    if scene.renderer in ("AccumulationBuffer", "ChromaticAccumulation"):
        return exact if views is None else views
    if scene.bank != "none" or scene.renderer == "reconstruct" or scene.motion != "none" or scene.approach:
        return bank
    return exact if scene.quality == "exact" and scene.tolerance is None else merged
