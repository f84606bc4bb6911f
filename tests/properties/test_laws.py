"""Every law for scenes that are drawn at random; hypothesis finds the simplest one that breaks it.

A scene that once broke a law stays in `FOUND`. `examples/benchmarks/search.py` looks for more, without an end.
"""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings

from properties.law import Law, tried
from properties.laws import LAWS
from properties.scenes import LARGE, Scene, draw, scenes

BROKEN: dict[str, str] = {}
"""Laws that do not hold yet, and why."""

FOUND: list[tuple[str, Scene]] = [
    ("empty layer", Scene(size=(1, 32), radius=9.0, layers=1, alpha="opaque", tolerance=0.01)),
    ("empty layer", Scene(size=(2, 33), coc="ramp", layers=1, alpha="soft", motion="anywhere", speed=0.68)),
    (
        "empty layer",
        Scene(
            renderer="AccumulationBuffer",
            size=(13, 17),
            image="lights",
            coc="sharp",
            radius=0.56,
            batch=3,
            layers=1,
            motion="opposite",
            speed=0.37,
            seed=95723,
        ),
    ),
    (
        "half",
        Scene(
            size=(9, 2),
            image="lines",
            coc="lognormal",
            radius=0.77,
            tolerance=0.1,
            batch=2,
            layers=2,
            alpha="faint",
            speed=1.83,
            approach=0.8,
            seed=38717,
        ),
    ),
    ("half", Scene(renderer="KernelSplatting", size=(33, 33), image="dots", coc="edges", radius=33.94, seed=525677)),
    ("gradient", Scene(size=(9, 9), coc="ramp", side="behind", radius=6.0, aperture="polygon 3 1 0", seed=563088)),
    ("compiled", Scene(coc="constant", radius=10.0)),
    ("exported", Scene(renderer="KernelSplatting", coc="constant", radius=10.0)),
]
"""Scenes that broke a law once."""

TRIES = {law.name: law for law in LAWS}
FEW = settings(deadline=None, derandomize=True, suppress_health_check=list(HealthCheck), print_blob=False)


def laws() -> list[object]:
    """All laws as parameters, those that are broken marked."""
    marks = {name: [pytest.mark.xfail(reason=why, strict=False)] for name, why in BROKEN.items()}
    return [pytest.param(law, id=law.name, marks=marks.get(law.name, [])) for law in LAWS]


def quick(scene: Scene) -> Scene:
    """The same with less of what takes long: each of that is in one scene of eight, or of four."""
    some = scene.seed % 8
    scene = replace(scene, radius=min(scene.radius, 10.0), speed=min(scene.speed, 6.0))
    scene = replace(scene, size=(min(scene.size[0], 17), min(scene.size[1], 19)), subapertures=None if some > 5 else 1)
    scene = replace(scene, layers=min(scene.layers, 1 + (some == 2)), batch=min(scene.batch, 1 + (some == 4)))
    lens = scene.lens if scene.lens not in ("rgb", "continuous") else "rgb" if some == 3 else "none"
    if scene.bank != "none" and some > 1:
        scene = replace(scene, bank="none", motion="none")
    motion = scene.motion if some == 0 or scene.bank == "combined" else "none"
    return replace(scene, lens=lens, motion=motion, approach=min(scene.approach, 1.5) if some == 1 else 0.0)


def keeps(law: Law, scene: Scene) -> None:
    found = tried(law, scene)
    assert found is None or found.share <= law.most, f"{found.value:.3g}, bound {found.bound:.3g}: {found.scene!r}"


@pytest.mark.filterwarnings("ignore::DeprecationWarning:torch")
@pytest.mark.parametrize("law", laws())
def test_scenes_of_every_kind_keep_the_law(law: Law) -> None:
    phases = [Phase.generate] if law.name in BROKEN else [Phase.generate, Phase.shrink]

    @settings(FEW, max_examples=law.tries, phases=phases)
    @given(scenes())
    def keeps_it(scene: Scene) -> None:
        keeps(law, quick(scene))

    keeps_it()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning:torch")
@pytest.mark.parametrize("law", laws())
def test_scenes_of_all_sizes_keep_the_law(law: Law) -> None:
    """As many as there is time for where every change is tested; the search goes on from there."""
    rng = np.random.default_rng(7)
    for _ in range(law.tries // 4 + 1):
        keeps(law, draw(rng, LARGE))


@pytest.mark.parametrize(("name", "scene"), FOUND)
def test_what_broke_a_law_once_keeps_it(name: str, scene: Scene) -> None:
    keeps(TRIES[name], scene)


def test_a_scene_is_the_line_that_it_prints() -> None:
    rng = np.random.default_rng(1)
    for _ in range(50):
        scene = draw(rng)
        again = eval(repr(scene))
        assert again == scene
        assert all((a == b).all() for a, b in zip(again.inputs()[:3], scene.inputs()[:3], strict=True))


def test_what_is_broken_is_a_law() -> None:
    assert BROKEN.keys() <= TRIES.keys()
    assert len(TRIES) == len(LAWS)
