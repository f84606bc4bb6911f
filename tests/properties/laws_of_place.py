"""Where a picture lies, and how it is turned, makes no difference to it."""

import math
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from .law import PROMISED, WILD, Law, light_error, peak_error, promised
from .renderers import aperture, module, picture, plan, planned
from .scenes import Inputs, Scene

TURNS = {
    "mirrored": (lambda t: t.flip(-1), lambda x, y: (-x, y), (0.0, True)),
    "upside down": (lambda t: t.flip(-2), lambda x, y: (x, -y), (math.pi, True)),
    "turned": (lambda t: t.rot90(1, (-2, -1)), lambda x, y: (y, -x), (math.pi / 2, False)),
    "transposed": (lambda t: t.mT, lambda x, y: (y, x), (math.pi / 2, True)),
}
"""What is done to maps, to displacements, and to the aperture: turned, after it is mirrored or not."""


def turned_inputs(inputs: Inputs, name: str) -> Inputs:
    maps, way, _ = TURNS[name]

    def change(t: Tensor) -> Tensor:
        return maps(t).contiguous()

    def vectors(t: Tensor) -> Tensor:
        return torch.stack(way(*change(t).unbind(-3)), -3)

    return inputs.mapped(change, vectors)


def symmetry(name: str) -> Callable[[Scene], float]:
    """How far the picture of a turned scene is from the turned picture."""
    maps, _, (angle, mirrored) = TURNS[name]

    def measure(scene: Scene) -> float:
        inputs = scene.inputs()
        wanted = maps(picture(scene, inputs))
        size = (wanted.shape[-2], wanted.shape[-1])
        iris = aperture(scene.aperture, angle, mirrored=mirrored)
        other = replace(scene, size=size)
        return light_error(picture(other, turned_inputs(inputs, name), module(other, iris)), wanted)

    return measure


def even(scene: Scene) -> Scene | None:
    """Those whose picture has no side: views lie anywhere, banks are of pixels, and so is what wavelengths meet."""
    views = scene.renderer in ("AccumulationBuffer", "ChromaticAccumulation")
    if views or scene.bank in ("physical-lens", "stylized", "volume") or scene.image == "range":
        return None
    return promised(scene)


def even_turned(scene: Scene) -> Scene | None:
    """A lens is cut along rows first: when it is turned, its pieces are others, but for quarters of a disc."""
    found = even(scene)
    if found is None:
        return None
    return replace(found, subapertures=min(found.subapertures or 2, 2) if found.aperture == "disc" else 1)


def symmetric(scene: Scene) -> float:
    """1e-3, and where pixels are merged in blocks that begin at a corner, twice what the quality promises."""
    bank = scene.bank != "none" or scene.renderer == "reconstruct" or scene.motion != "none" or scene.approach
    merged = PROMISED["fast" if scene.tolerance else scene.quality]
    return 1e-3 + 2 * merged + (0.02 if bank else 0.0)


def moved(scene: Scene) -> float:
    """Two windows of one scene, some px apart, where both see all that reaches a pixel."""
    dy, dx = 1 + scene.seed % 5, 1 + scene.seed // 5 % 5
    inputs, (height, width) = scene.inputs(), scene.size
    size = height - dy, width - dx
    window = replace(scene, size=size)
    first = inputs.mapped(lambda t: t[..., : size[0], : size[1]].contiguous())
    second = inputs.mapped(lambda t: t[..., dy:, dx:].contiguous())
    more = {"plan": plan(window, first)} if planned(scene) else {}
    edge = round(float(inputs.coc.abs().max()) + scene.speed * (scene.motion != "none")) * 2 + 3
    here = picture(window, first, **more)[..., edge + dy : -edge, edge + dx : -edge]
    there = picture(window, second, **more)[..., edge : -edge - dy, edge : -edge - dx]
    return light_error(there, here)


def movable(scene: Scene) -> Scene | None:
    """A blur that is small beside the picture, of one surface; it is not of highlights, which change what is usual."""
    if scene.renderer in ("AccumulationBuffer", "ChromaticAccumulation") or scene.lens in ("rgb", "continuous"):
        return None
    if scene.image in ("range", "spikes", "lognormal") or scene.bank in ("volume", "physical-lens"):
        return None  # the PSFs of a lens of glass depend on the place
    coc = "steps" if scene.coc in WILD else scene.coc
    one = replace(scene, layers=0, side="behind", coc=coc, radius=min(scene.radius, 5.0), speed=min(scene.speed, 5.0))
    one = replace(one, background="none", approach=0.0, motion="pan" if scene.motion != "none" else "none")
    return replace(one, size=(56 + scene.size[0] % 9, 56 + scene.size[1] % 9), batch=1)


def merged_or_bank(scene: Scene) -> float:
    if scene.bank != "none" or scene.renderer == "reconstruct" or scene.motion != "none":
        return 0.1 + PROMISED["fast" if scene.tolerance else scene.quality]
    return 1e-5 + 2 * PROMISED["fast" if scene.tolerance else scene.quality]


def at_the_border(scene: Scene) -> float:
    """By how much a light near the border is brighter than the same in the middle, where it is brightest."""
    out = []
    for place in (scene.size[0] // 2, 1 + scene.seed % 3):
        image = torch.full((1, 3, *scene.size), 1e-3)
        image[..., place, scene.size[1] // 2] = 1e3
        coc = torch.full((1, 1, *scene.size), scene.radius)
        out.append(float(picture(scene, Inputs(image, coc, coc)).max()))
    return max(out[1] / out[0] - 1, 0.0)


def bordering(scene: Scene) -> Scene | None:
    if scene.renderer not in ("LensBlur", "KernelSplatting") or scene.bank != "none":
        return None
    radius = min(max(scene.radius, 2.0), 12.0)
    side = 2 * math.ceil(2 * radius) + 7
    one = replace(scene, coc="constant", radius=radius, size=(side, side), lens="none", layers=0, image="spikes")
    return replace(one, motion="none", approach=0.0, background="none", batch=1, channels=3, side="behind")


def with_margin(scene: Scene) -> float:
    """A margin against the same picture cut by hand."""
    inputs, margin = scene.inputs(), 1 + scene.seed % 2
    whole = picture(scene, inputs)[..., margin:-margin, margin:-margin]
    return peak_error(picture(scene, inputs, module(scene, margin=margin)), whole)


def with_limit(scene: Scene) -> float:
    """``max_coc`` against radii cut by hand."""
    inputs, most = scene.inputs(), scene.radius / 2

    def cut(t: Tensor | None) -> Tensor | None:
        return None if t is None else t.clamp(-most, most)

    behind = None if inputs.behind is None else (inputs.behind[0], cut(inputs.behind[1]))
    less = inputs._replace(distance=inputs.distance.clamp(-most, most), ends=cut(inputs.ends), behind=behind)
    return peak_error(picture(scene, inputs, module(scene, max_coc=most)), picture(scene, less))


def blurred_by_coc(scene: Scene) -> Scene | None:
    one = replace(scene, lens="none", size=tuple(max(n, 5) for n in scene.size))
    return one if scene.renderer == "LensBlur" else None


def through_a_lens(scene: Scene) -> float:
    """Depth through a lens against the CoC that the lens says it has."""
    inputs, lens = scene.inputs(), scene.optics()
    assert lens is not None

    def radii(t: Tensor | None) -> Tensor | None:
        return None if t is None else lens.coc(t, scene.size[1])

    behind = None if inputs.behind is None else (inputs.behind[0], radii(inputs.behind[1]))
    given = inputs._replace(distance=lens.coc(inputs.distance, scene.size[1]), ends=radii(inputs.ends), behind=behind)
    return peak_error(picture(replace(scene, lens="none"), given), picture(scene, inputs))


def lensed(scene: Scene) -> Scene | None:
    if scene.renderer not in ("LensBlur", "AccumulationBuffer"):
        return None
    lens = "disparity" if scene.seed % 2 and scene.renderer == "LensBlur" else "thin"
    return replace(scene, lens=lens, coc="ramp" if scene.coc == "huge" else scene.coc)


def of_either_sign(scene: Scene) -> float:
    """What is evenly blurred before the focus against the same behind it."""
    inputs = scene.inputs()
    other = inputs._replace(distance=-inputs.distance, coc=-inputs.coc)
    return light_error(picture(scene, other), picture(scene, inputs))


def evenly_blurred(scene: Scene) -> Scene | None:
    if scene.renderer not in ("LensBlur", "KernelSplatting", "reconstruct") or scene.bank not in ("none", "combined"):
        return None
    one = replace(scene, coc="constant", aperture="disc", layers=0, background="none", lens="none", approach=0.0)
    return replace(one, side="behind")


def padded(scene: Scene) -> float:
    """Layers, and the same with one more that is not there."""
    inputs, at = scene.inputs(), scene.seed % (scene.layers + 1)

    def more(t: Tensor) -> Tensor:
        empty = torch.zeros_like(t[:, :1]) if t is inputs.image else t[:, :1] * 0 + 3.0
        return torch.cat([t[:, :at], empty, t[:, at:]], 1)

    image = inputs.image
    image[:, -1, 3:] = 1  # so that it is known in any case whether anything is hidden
    return peak_error(picture(replace(scene, layers=scene.layers + 1), inputs.mapped(more)), picture(scene, inputs))


def layered(scene: Scene) -> Scene | None:
    if scene.renderer not in ("LensBlur", "AccumulationBuffer") or scene.lens in ("rgb", "continuous"):
        return None
    return replace(scene, layers=min(max(scene.layers, 1), 2), lens="none", approach=0.0)


LAWS = (
    *(
        Law(
            name,
            f"A scene {name} makes the picture {name}, the aperture with it; relative L1.",
            even_turned if TURNS[name][2][0] == math.pi / 2 else even,
            symmetry(name),
            symmetric,
        )
        for name in TURNS
    ),
    Law(
        "moved",
        "A scene some px aside is the picture aside, away from borders; relative L1.",
        movable,
        moved,
        merged_or_bank,
    ),
    Law("border", "A light near the border is no brighter than one in the middle.", bordering, at_the_border, 0.1),
    Law("margin", "A margin is what cutting the picture is.", blurred_by_coc, with_margin, 1e-6),
    Law("max_coc", "A largest radius is what cutting the radii is.", blurred_by_coc, with_limit, 1e-6),
    Law("lens", "A lens is the CoC that it says.", lensed, through_a_lens, 1e-6),
    Law(
        "sign",
        "Evenly blurred, before or behind the focus is the same; relative L1.",
        evenly_blurred,
        of_either_sign,
        1e-4,
    ),
    Law("empty layer", "A layer that is not there changes nothing.", layered, padded, 1e-6),
)
