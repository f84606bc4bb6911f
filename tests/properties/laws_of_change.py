"""What a picture does when a scene changes, and how near the qualities are to the exact picture."""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise

import torch
from torch import Tensor

from .law import PROMISED, Law, light_error, nothing_hides, promised, still
from .renderers import module, picture, plan, planned
from .scenes import Inputs, Scene


def exactly(scene: Scene, inputs: Inputs) -> Tensor:
    return picture(replace(scene, quality="exact", tolerance=None), inputs)


def off_splats(scene: Scene) -> float:
    """The relative L1 error of one surface in one bin: promises are those of splats, not of what they compose."""
    inputs, settings = scene.inputs(), {"layers": 1} if scene.renderer == "LensBlur" else {}
    exact = replace(scene, quality="exact", tolerance=None)
    wanted = picture(exact, inputs, module(exact, **settings))
    return light_error(picture(scene, inputs, module(scene, **settings)), wanted)


def of_promise(scene: Scene) -> float:
    """The error of a quality as a share of what its plan predicts."""
    predicted = plan(scene, scene.inputs()).predicted_error
    return off_splats(scene) / (predicted or 1e-6)


def of_tolerance(scene: Scene) -> float:
    """The error as a share of the tolerance."""
    assert scene.tolerance is not None
    return off_splats(scene) / scene.tolerance


def by_splats(scene: Scene) -> Scene | None:
    """One surface, of the kind that a promise is made for."""
    if not planned(scene) or scene.bank != "none" or scene.lens in ("rgb", "continuous"):
        return None
    one = promised(still(nothing_hides(scene)))
    size = tuple(max(n, 16) for n in one.size)
    return replace(one, size=size, image="noise" if one.image == "range" else one.image, subapertures=1)


def by_quality(scene: Scene) -> Scene | None:
    quality = ("high", "balanced", "fast")[scene.seed % 3]
    return by_splats(replace(scene, tolerance=None, quality=quality))


def by_tolerance(scene: Scene) -> Scene | None:
    return by_splats(replace(scene, tolerance=scene.tolerance or 0.02))


def composed(scene: Scene) -> float:
    """The relative L1 error of a quality where something hides something, and something opaque is behind it."""
    inputs = scene.inputs()
    if scene.layers:
        inputs.image[:, -1, 3:] = 1
    return light_error(picture(scene, inputs), exactly(scene, inputs))


def by_composition(scene: Scene) -> Scene | None:
    if scene.renderer != "LensBlur":
        return None
    scene = replace(scene, tolerance=None, quality=("high", "balanced", "fast")[scene.seed % 3], lens="none")
    size = tuple(max(n, 16) for n in scene.size)
    return replace(promised(still(scene)), size=size, image="photograph" if scene.seed % 2 else "noise")


def _scaled(scene: Scene) -> dict[str, Callable[[Inputs, float], Inputs]]:
    """Ways in which one number changes a scene, by what changes; the number goes from 0 to 1."""

    def radii(inputs: Inputs, s: float) -> Inputs:
        return inputs._replace(distance=inputs.distance * s, coc=inputs.coc * s)

    def shifted(inputs: Inputs, s: float) -> Inputs:
        by = 2 * scene.radius * (s - 0.5)
        return inputs._replace(distance=inputs.distance + by, coc=inputs.coc + by)

    ways: dict[str, Callable[[Inputs, float], Inputs]] = {"radius": radii, "focus": shifted}
    if scene.motion != "none":
        ways["motion"] = lambda i, s: i._replace(motion=tuple(t * s for t in i.motion))
    if scene.approach:

        def approach(inputs: Inputs, s: float) -> Inputs:
            assert inputs.ends is not None
            middle = inputs.ends.mean(-3, keepdim=True)
            return inputs._replace(ends=middle + s * (inputs.ends - middle))

        ways["approach"] = approach
    if scene.background == "both":
        ways["background"] = lambda i, s: i._replace(behind=(i.behind[0], i.behind[1] * s))  # type: ignore[index,operator]
    if scene.layers:
        # Not from nothing: changes are measured against what is there.
        ways["alpha"] = lambda i, s: i._replace(image=i.image * (0.1 + 0.9 * s))
    if scene.renderer == "LensBlur" and scene.radius > 1:
        ways["max_coc"] = lambda i, s: i
    return ways


def jump(scene: Scene, times: int = 14) -> float:
    """The largest change of a picture on the way of one number, after the interval where it is was halved again."""
    ways, inputs = _scaled(scene), scene.inputs(torch.float64)
    name = sorted(ways)[scene.seed % len(ways)]

    def at(s: float) -> Tensor:
        limit = {"max_coc": scene.radius * (0.05 + s)} if name == "max_coc" else {}
        return picture(scene, ways[name](inputs, s), module(scene, **limit))

    ends = [n / 4 + 0.011 * (0 < n < 4) for n in range(5)]
    shown = [at(s) for s in ends]
    changes = [light_error(b, a) for a, b in pairwise(shown)]
    k = changes.index(max(changes))
    (low, high), (first, last) = ends[k : k + 2], shown[k : k + 2]
    for _ in range(times):
        middle = 0.5 * (low + high)
        new = at(middle)
        if light_error(new, first) > light_error(last, new):
            high, last = middle, new
        else:
            low, first = middle, new
    return light_error(last, first)


def changing(scene: Scene) -> Scene | None:
    """Without what is documented as a step: samples of banks, and which quality keeps a tolerance."""
    if scene.bank != "none" or scene.lens != "none" or scene.renderer not in ("LensBlur", "KernelSplatting"):
        return None
    scene = replace(scene, tolerance=None, batch=1, layers=min(scene.layers, 2), radius=min(scene.radius, 16.0))
    size = tuple(min(max(n, 9), 24) for n in scene.size)
    coc = "ramp" if scene.coc in ("huge", "thresholds", "sharp") else scene.coc
    image = "noise" if scene.image in ("range", "black") else scene.image
    return replace(scene, size=size, coc=coc, image=image, motion="none" if scene.motion == "curve" else scene.motion)


def smallest_step(scene: Scene) -> float:
    """Of a picture: none at "exact"; a radius that is rounded to 1/64 of a cell moves as much of its light."""
    if scene.motion != "none" or scene.approach:
        return 2e-2  # the samples of the bank of motion are steps
    return 1e-3 if scene.quality == "exact" else 2e-2


def slope_error(scene: Scene) -> float:
    """The derivative along one direction of image and CoC against differences; 0 at a kink, whose sides differ."""
    inputs = scene.inputs(torch.float64)
    more = {"plan": plan(scene, inputs)} if planned(scene) else {}
    # The least and the largest CoC are centres of bins, where shares have kinks.
    inputs = inputs._replace(distance=0.97 * inputs.distance + 0.01)
    rng = scene.rng("direction")
    middle = picture(scene, inputs, **more)
    weights = torch.from_numpy(rng.normal(size=middle.shape))
    worst, step = 0.0, 1e-5
    for name in ("image", "distance"):
        base: Tensor = getattr(inputs, name)
        way = torch.from_numpy(rng.normal(size=base.shape))

        def loss(t: Tensor, name: str = name) -> Tensor:
            return (weights * picture(scene, inputs._replace(**{name: t}), **more)).sum()

        leaf = base.clone().requires_grad_()
        here = loss(leaf)
        (gradient,) = torch.autograd.grad(here, leaf)
        with torch.no_grad():
            ahead, back = loss(base + step * way) - here, here - loss(base - step * way)
        found, size = float((gradient * way).sum()), float((gradient * way).abs().sum()) + 1e-9
        if float((ahead - back).abs()) / step < 1e-3 * size:
            worst = max(worst, abs(found - float(ahead + back) / (2 * step)) / size)
    return worst


def smooth(scene: Scene) -> Scene | None:
    """Exact, and small; without choices: samples of banks, layers that are just there, and bins of even blur, which are
    full to rounding: one pixel of more or of less blur is then a kink."""
    if scene.bank != "none" or scene.renderer == "reconstruct" or scene.lens in ("rgb", "continuous"):
        return None
    one = replace(still(scene), quality="exact", tolerance=None, batch=1, layers=min(scene.layers, 2))
    size = tuple(min(max(n, 3), 9) for n in one.size)
    coc = one.coc if one.coc in ("ramp", "noise", "lognormal") else "ramp"
    return replace(one, size=size, coc=coc, radius=min(max(one.radius, 1.0), 6.0), image="noise", alpha="soft")


LAWS = (
    Law(
        "promise",
        "A quality is as near to the exact splat as its plan predicts; share of that.",
        by_quality,
        of_promise,
        1.0,
        most=1.5,
    ),
    Law("tolerance", "A tolerance is kept; share of it.", by_tolerance, of_tolerance, 1.0, most=1.5),
    Law(
        "composition",
        "Where something hides something, a quality is near the exact picture; relative L1.",
        by_composition,
        composed,
        lambda s: 0.1 + 2 * PROMISED[s.quality],
        most=1.5,
    ),
    Law(
        "no jump",
        "A picture changes steadily with every number: its largest change over 1/65536 of the way; relative L1.",
        changing,
        jump,
        smallest_step,
        tries=8,
    ),
    Law(
        "gradient",
        "Gradients to image and CoC are those of differences, but at kinks.",
        smooth,
        slope_error,
        1e-5,
        tries=8,
    ),
)
