"""What becomes of light: none is made, none is lost."""

import math
from dataclasses import replace

import torch
from torch import Tensor

from .law import PROMISED, Law, anything, at_quality, light_error, peak_error, promised, without_lights
from .renderers import picture, plan, planned
from .scenes import Inputs, Scene

COLOURED = ("volume", "physical-lens", "stylized")
"""Banks whose PSFs have colours of their own."""


def coloured(scene: Scene, inputs: Inputs) -> tuple[Inputs, Tensor]:
    """The same with one colour everywhere, and that colour ``(C, 1, 1)``."""
    channels = 3 if scene.layers else inputs.image.shape[1]
    colour = torch.from_numpy(scene.rng("colour").uniform(0.1, 2, (channels, 1, 1))).to(inputs.image.dtype)
    if scene.layers:
        alpha = inputs.image[:, :, 3:]
        return inputs._replace(image=torch.cat([colour * alpha, alpha], 2)), colour
    behind = None if inputs.behind is None else (colour.expand_as(inputs.image), inputs.behind[1])
    return inputs._replace(image=colour.expand_as(inputs.image).contiguous(), behind=behind), colour


def one_colour(scene: Scene) -> Scene | None:
    """Without what colours a picture: coloured PSFs, and rims of layers through a lens with dispersion."""
    if scene.bank in COLOURED:
        return None
    return replace(scene, alpha="opaque") if scene.lens in ("rgb", "continuous") else scene


def off_colour(scene: Scene, out: Tensor, colour: Tensor) -> float:
    """How far a picture of one colour is from it; where layers leave something open, as much less of it."""
    wanted = colour * out[:, 3:] if scene.layers else colour.expand_as(out)
    return float((out[:, : len(colour)] - wanted).abs().max() / colour.max())


def constant(scene: Scene) -> float:
    inputs, colour = coloured(scene, scene.inputs())
    return off_colour(scene, picture(scene, inputs), colour)


def constant_by_another_plan(scene: Scene) -> float:
    other = replace(scene, coc=("ramp", "sharp", "planes", "huge", "constant")[scene.seed % 5], seed=scene.seed + 1)
    inputs, colour = coloured(scene, scene.inputs())
    return off_colour(scene, picture(scene, inputs, plan=plan(other, other.inputs())), colour)


def another_plan(scene: Scene) -> Scene | None:
    if not planned(scene) or scene.lens != "none" or scene.bank in COLOURED:
        return None
    if scene.motion != "none" or scene.approach:
        return None  # a plan with motion is for pictures that move
    return replace(scene, layers=0)


def opaque(scene: Scene) -> float:
    """How much is missing of the coverage of layers of which the last is opaque."""
    inputs = scene.inputs()
    inputs.image[:, -1, 3:] = 1
    return float((1 - picture(scene, inputs)[:, 3:]).abs().max())


def layered_blur(scene: Scene) -> Scene | None:
    return replace(scene, layers=max(scene.layers, 1)) if scene.renderer == "LensBlur" else None


def reach(scene: Scene) -> int:
    """How far light of a scene with one radius goes, in px."""
    moved = 0.0 if scene.motion == "none" else scene.speed * (1 if scene.shutter == "start" else 0.5)
    return math.ceil(scene.radius + moved) + 1


def within(scene: Scene) -> Scene | None:
    """One radius and one motion, and a picture that is black where light could leave it."""
    if scene.bank not in ("none", "combined", "simple-lens"):
        return None  # their PSFs end where they like
    motion = "none" if scene.motion == "none" else "pan"
    layers = min(scene.layers, 1)
    one = replace(scene, coc="constant", motion=motion, approach=0.0, lens="none", background="none", alpha="opaque")
    one = replace(one, radius=min(scene.radius, 6.0), speed=min(scene.speed, 8.0), layers=layers)
    side = 4 * reach(one) + 3
    return replace(one, size=(side + scene.size[0] % 7, side + scene.size[1] % 7))


def energy(scene: Scene) -> float:
    inputs, edge = scene.inputs(), 2 * reach(scene)
    inside = torch.zeros(scene.size)
    inside[edge:-edge, edge:-edge] = 1
    image = inputs.image * inside
    if scene.layers:
        image = torch.cat([image[:, :, :3], inputs.image[:, :, 3:]], 2)
    colours = image[:, 0, :3] if scene.layers else image
    before = colours.double().sum((-2, -1))
    after = picture(scene, inputs._replace(image=image))[:, : colours.shape[1]].double().sum((-2, -1))
    return float(((after - before).abs() / before.abs().clamp_min(1e-30)).where(before > 0, after).max())


def negative(scene: Scene) -> float:
    inputs = scene.inputs()
    return float(-picture(scene, inputs).min().clamp(max=0) / inputs.image.max().clamp_min(1e-30))


def brighter(scene: Scene) -> float:
    inputs = scene.inputs()
    out = picture(scene, inputs)
    image = inputs.image.flatten(0, 1) if scene.layers else inputs.image
    if scene.layers:  # of a premultiplied colour, as bright as it is where it covers all
        plain = image[:, :3] / image[:, 3:].clamp_min(1e-30)
        brightest, alpha = plain.amax(), out[:, 3:].clamp_min(0)
        return float(((out[:, :3] - brightest * alpha).amax() / brightest.clamp_min(1e-30)).clamp_min(0))
    brightest = image.amax()
    if inputs.behind is not None:
        brightest = torch.maximum(brightest, inputs.behind[0].amax())
    return float(((out.amax() - brightest) / brightest.clamp_min(1e-30)).clamp_min(0))


def homogeneous(scene: Scene) -> float:
    inputs = scene.inputs()
    behind = None if inputs.behind is None else (128 * inputs.behind[0], inputs.behind[1])
    image = 128 * inputs.image
    if scene.layers:
        image = torch.cat([image[:, :, :3], inputs.image[:, :, 3:]], 2)
    out, times = picture(scene, inputs), picture(scene, inputs._replace(image=image, behind=behind))
    if scene.layers:
        out, times = out[:, :3], times[:, :3]
    return peak_error(times / 128, out)


def linear(scene: Scene) -> float:
    """One picture and another, blurred and added, against their sum blurred."""
    first = scene.inputs()
    second = replace(scene, image="noise", alpha="opaque", seed=scene.seed + 1).inputs()
    both = first.image + second.image
    mine, yours = first, first._replace(image=second.image)
    if scene.layers:
        alpha = first.image[:, :, 3:]
        plain = torch.cat([second.image[:, :, :3] * alpha, alpha], 2)
        both, yours = torch.cat([(first.image + plain)[:, :, :3], alpha], 2), first._replace(image=plain)
    behind = None
    if first.behind is not None and second.behind is not None:
        yours = yours._replace(behind=(second.behind[0], first.behind[1]))
        behind = first.behind[0] + second.behind[0], first.behind[1]
    more = {"plan": plan(scene, first)} if planned(scene) else {}
    out = picture(scene, first._replace(image=both, behind=behind), **more)
    channels = 3 if scene.layers else out.shape[1]
    apart = picture(scene, mine, **more) + picture(scene, yours, **more)
    return light_error(apart[:, :channels], out[:, :channels])


def where_linear(scene: Scene) -> Scene:
    """What is filled in, and goes on beyond the border, leaves highlights out, which is not linear; so do banks."""
    if scene.layers == 0 and scene.background == "none":
        scene = replace(scene, side="behind")
    return without_lights(scene)


def channels_alone(scene: Scene) -> float:
    inputs = scene.inputs()
    together = picture(scene, inputs)
    alone = []
    for c in range(inputs.image.shape[1]):
        behind = None if inputs.behind is None else (inputs.behind[0][:, c : c + 1], inputs.behind[1])
        alone.append(picture(scene, inputs._replace(image=inputs.image[:, c : c + 1], behind=behind)))
    return peak_error(torch.cat(alone, 1), together)


def of_channels(scene: Scene) -> Scene | None:
    if scene.lens in ("rgb", "continuous") or scene.bank in COLOURED or not planned(scene):
        return None
    return replace(promised(without_lights(scene)), layers=0)


def merging(scene: Scene) -> float:
    """What merging may be off by: the promise of the quality; or, with a tolerance, that of the worst."""
    return PROMISED["fast" if scene.tolerance else scene.quality]


LAWS = (
    Law(
        "constant",
        "One colour in is that colour out, in every renderer; largest difference over the colour.",
        one_colour,
        constant,
        lambda s: at_quality(s, 1e-5, 1e-4, 1e-3),
    ),
    Law(
        "constant by any plan",
        "One colour stays one by the plan of any other scene of the size.",
        another_plan,
        constant_by_another_plan,
        lambda s: at_quality(s, 1e-5, 1e-4, 1e-3),
    ),
    Law("opaque", "What is opaque at the back covers all; largest lack.", layered_blur, opaque, 1e-4),
    Law(
        "energy",
        "All light is there again where one radius spreads it and none leaves; relative difference of sums.",
        within,
        energy,
        lambda s: at_quality(s, 1e-5, max(merging(s), 1e-3), 5e-2, 2e-2),
    ),
    Law(
        "non-negative",
        "No light is taken away; depth of the darkest over the brightest pixel.",
        anything,
        negative,
        lambda s: at_quality(s, 1e-6, 1e-6, 1e-4),
    ),
    Law(
        "no brighter",
        "A picture is a mean: nothing is brighter than the brightest.",
        one_colour,
        brighter,
        lambda s: at_quality(s, 1e-4, 1e-4, 1e-2),
    ),
    Law("homogeneous", "128 times the light is 128 times the picture.", anything, homogeneous, 1e-5),
    Law(
        "linear",
        "At a fixed plan, and where nothing is guessed, the picture of a sum is the sum of the pictures.",
        where_linear,
        linear,
        lambda s: at_quality(s, 1e-5, 1e-3, 5e-2),
    ),
    Law(
        "channels alone",
        "A channel is what it is alone.",
        of_channels,
        channels_alone,
        lambda s: at_quality(s, 1e-5, merging(s), 1e-1),
    ),
)
