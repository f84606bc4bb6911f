"""The form in which a scene is given, kept or run makes no difference to its picture."""

import copy
import pickle
from dataclasses import replace

import torch
from torch import Tensor, nn

from .law import Law, anything, at_quality, light_error, nothing_hides, peak_error, same_bits, still
from .renderers import module, picture, plan, planned
from .scenes import Inputs, Scene


def one_by_one(scene: Scene) -> float:
    inputs = scene.inputs()
    together = picture(scene, inputs)
    alone = [picture(scene, inputs.mapped(lambda t, n=n: t[n : n + 1])) for n in range(scene.batch)]
    return peak_error(torch.cat(alone), together)


def batched(scene: Scene) -> Scene | None:
    if scene.renderer == "reconstruct":
        return None  # its bins are those of the whole batch
    return replace(scene, batch=max(scene.batch, 2)) if scene.lens not in ("rgb", "continuous") else scene


def given_plan(scene: Scene) -> float:
    inputs = scene.inputs()
    return same_bits(picture(scene, inputs, plan=plan(scene, inputs)), picture(scene, inputs))


def one_planned(scene: Scene) -> Scene | None:
    return replace(scene, batch=1) if planned(scene) else None


def over(scene: Scene) -> float:
    """Layers in focus against plain alpha blending."""
    inputs = scene.inputs()
    coc = inputs.coc * 0
    if scene.renderer == "LensBlur":
        coc = coc + 0.98 * (torch.rand(coc.shape, generator=torch.Generator().manual_seed(scene.seed)) - 0.5)
    wanted = torch.zeros_like(inputs.image[:, 0])
    for k in reversed(range(scene.layers)):
        wanted = inputs.image[:, k] + (1 - inputs.image[:, k, 3:]) * wanted
    return peak_error(picture(scene, inputs._replace(distance=coc, coc=coc)), wanted)


def in_focus(scene: Scene) -> Scene | None:
    if scene.renderer not in ("LensBlur", "AccumulationBuffer"):
        return None
    return replace(still(scene), layers=max(scene.layers, 1), lens="none")


def one_layer(scene: Scene) -> float:
    """A picture against one opaque layer of it."""
    inputs = scene.inputs()
    image = torch.cat([inputs.image, torch.ones_like(inputs.coc)], 1)
    layer = Inputs(image, inputs.distance, inputs.coc, inputs.motion, inputs.ends).mapped(lambda t: t[:, None])
    return light_error(picture(scene, layer)[:, :3], picture(scene, inputs))


def one_surface(scene: Scene) -> Scene | None:
    if scene.renderer != "LensBlur":
        return None
    return replace(nothing_hides(scene), channels=3, subapertures=1)


def with_background(scene: Scene) -> float:
    inputs = scene.inputs()
    return same_bits(picture(scene, inputs), picture(scene, inputs._replace(behind=None)))


def behind_all(scene: Scene) -> Scene | None:
    """Of one colour: with dispersion, what is behind the focus plane in one lies before it in another."""
    if scene.renderer != "LensBlur" or scene.lens in ("rgb", "continuous"):
        return None
    return replace(nothing_hides(scene), background="both" if scene.seed % 2 else "image")


def unchanged(scene: Scene) -> float:
    inputs = scene.inputs()
    return peak_error(picture(scene, inputs), inputs.image[:, 0] if scene.layers else inputs.image)


def without_blur(scene: Scene) -> Scene | None:
    if scene.bank not in ("none", "simple-lens") or scene.lens != "none":
        return None
    return replace(still(scene), coc="sharp", background="none", layers=min(scene.layers, 1), alpha="opaque")


def by_threads(scene: Scene) -> float:
    inputs, before = scene.inputs(), torch.get_num_threads()
    found = []
    try:
        for count in (1, 2, 3):
            torch.set_num_threads(count)
            found.append(picture(scene, inputs))
    finally:
        torch.set_num_threads(before)
    return max(same_bits(other, found[0]) for other in found[1:])


def in_double(scene: Scene) -> float:
    single = scene.inputs()
    return light_error(picture(scene, single), picture(scene, single.mapped(lambda t: t.double())))


def without_jumps(scene: Scene) -> Scene | None:
    """Radii and ways that rounding does not take from one sample or step to the next."""
    if scene.lens != "none" or scene.image == "range":
        return None
    return replace(scene, coc="ramp") if scene.coc in ("huge", "thresholds") else scene


def in_half(scene: Scene) -> float:
    """Half precision against float32 of the same numbers, rounded: not a bit may differ."""
    dtype = torch.bfloat16 if scene.seed % 2 else torch.float16
    inputs = scene.inputs(dtype)
    wanted = picture(scene, inputs.mapped(lambda t: t.float())).to(dtype)
    found = picture(scene, inputs)
    return same_bits(found.float(), wanted.float()) if found.dtype == dtype else float("inf")


def halved(scene: Scene) -> Scene | None:
    if scene.lens != "none" or scene.bank == "volume" or scene.renderer == "reconstruct":
        return None  # half precision has no room for positions in a picture, and depths are made of radii here
    coc = "ramp" if scene.coc == "huge" else scene.coc  # infinite in half precision
    return replace(scene, coc=coc, image="noise" if scene.image in ("range", "spikes", "lognormal") else scene.image)


def kept(scene: Scene) -> float:
    """Pickled, copied, and with its state taken over by another module."""
    inputs, one = scene.inputs(), module(scene)
    another = module(replace(scene, radius=scene.radius + 5, size=scene.size))
    another.load_state_dict(one.state_dict())
    wanted = picture(scene, inputs, one)
    others: list[nn.Module] = [pickle.loads(pickle.dumps(one)), copy.deepcopy(one), another]
    return max(same_bits(picture(scene, inputs, other), wanted) for other in others)


def untouched(scene: Scene) -> float:
    """The same call again, and with other strides: the same bits, and inputs as they were."""
    inputs = scene.inputs()
    before = inputs.mapped(lambda t: t.clone())
    first = picture(scene, inputs)
    strided = inputs.mapped(lambda t: t.mT.contiguous().mT)
    apart = max(same_bits(picture(scene, inputs), first), same_bits(picture(scene, strided), first))
    for mine, was in zip(_tensors(inputs), _tensors(before), strict=True):
        apart = max(apart, same_bits(mine, was))
    return apart


def _tensors(inputs: Inputs) -> list[Tensor]:
    more = [*inputs.motion, *([] if inputs.ends is None else [inputs.ends])]
    behind = [] if inputs.behind is None else [t for t in inputs.behind if t is not None]
    return [inputs.image, inputs.distance, inputs.coc, *more, *behind]


def forward_mode(scene: Scene) -> float:
    """A derivative in forward mode is that of a difference, or refused by name: 0; what is wrong in silence is not."""
    inputs = scene.inputs(torch.float64)
    way = torch.from_numpy(scene.rng("way").normal(size=inputs.image.shape))
    more = {"plan": plan(scene, inputs)} if planned(scene) else {}

    def of(image: Tensor) -> Tensor:
        return picture(scene, inputs._replace(image=image), **more)

    try:
        _, found = torch.func.jvp(of, (inputs.image,), (way,))
    except RuntimeError as error:
        return 0.0 if "forward" in str(error) else float("inf")  # ours say "forward mode", torch's own "forward AD"
    step = 1e-6
    wanted = (of(inputs.image + step * way) - of(inputs.image - step * way)) / (2 * step)
    return light_error(found, wanted)


def of_light_alone(scene: Scene) -> Scene | None:
    if scene.renderer in ("AccumulationBuffer", "ChromaticAccumulation"):
        return replace(scene, image="noise", alpha="opaque")
    return replace(scene, image="noise", layers=0, background="none", side="behind")


LAWS = (
    Law("one by one", "A picture of a batch is what it is alone.", batched, one_by_one, 1e-6),
    Law("given plan", "A plan made before makes the same bits.", one_planned, given_plan, 0.0),
    Law("over", "Layers in focus are plainly over one another.", in_focus, over, 1e-5),
    Law(
        "one layer",
        "One opaque layer is the image of it, through the whole lens; relative L1.",
        one_surface,
        one_layer,
        lambda s: at_quality(s, 1e-5, 1e-2, 1e-1),
    ),
    Law("background", "A background is not seen where nothing hides it: same bits.", behind_all, with_background, 0.0),
    Law(
        "sharp",
        "Without blur, the picture is the input.",
        without_blur,
        unchanged,
        lambda s: at_quality(s, 1e-6, 1e-6, 1e-5, 1e-5),
    ),
    Law("threads", "The number of threads changes no bit.", anything, by_threads, 0.0, tries=15),
    Law(
        "double",
        "Single precision is double precision but for rounding; relative L1.",
        without_jumps,
        in_double,
        lambda s: at_quality(s, 1e-4, 1e-2, 2e-2),
    ),
    Law("half", "Half precision is single precision rounded: same bits.", halved, in_half, 0.0),
    Law(
        "kept",
        "Pickled, copied, or with its state taken over, a module makes the same bits.",
        anything,
        kept,
        0.0,
        tries=100,
    ),
    Law("untouched", "Calls leave their inputs alone, and depend on no strides: same bits.", anything, untouched, 0.0),
    Law("forward mode", "Forward mode is right, or refused by name.", of_light_alone, forward_mode, 1e-5, tries=60),
)
