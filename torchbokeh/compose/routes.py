"""The ways in which a plan may have a picture made, by the name of its route."""

from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor

from torchbokeh.compose.composition import blur_one_layer, compose
from torchbokeh.compose.exposure import Exposure, exposed
from torchbokeh.compose.foreground import foreground_over_rest
from torchbokeh.compose.surfaces import COARSE, Surface, split_foreground
from torchbokeh.ops.convolve import blur_uniform, blur_with
from torchbokeh.ops.dispatch import has_kernel
from torchbokeh.ops.spans import Profile
from torchbokeh.picture.motion import ADVANCE
from torchbokeh.picture.request import Request
from torchbokeh.plan.plan import Plan, Route
from torchbokeh.psfs.combined import turned_capsule

Pieces = Mapping[int, Sequence[Profile]]
"""The sub-apertures, by how many there are each way; of 1, the whole lens."""


def sharp(request: Request, plan: Plan, pieces: Pieces) -> Tensor:
    """The picture as it is."""
    return request.image.clone()


def uniform(request: Request, plan: Plan, pieces: Pieces) -> Tensor:
    """One convolution for all pixels; where a gradient asks for radii or ways, each pixel has its own.

    So it has for a compiler, which cannot say how large a PSF is.
    """
    image, (lens,), radius = request.image, pieces[1], plan.coc_range[0]
    if torch.compiler.is_compiling() or any(t.requires_grad for t in (request.coc, *request.motion.maps)):
        return surface(request, plan, pieces)
    if not plan.moves or plan.pan is None:
        return blur_uniform(image, radius, lens)
    # What lies farther away than the picture is large need not be drawn.
    height, width = image.shape[-2:]
    advance = ADVANCE[request.motion.shutter]
    psf = torch.from_numpy(turned_capsule(abs(radius), plan.pan, advance, (width - 1, height - 1)))
    return blur_with(image, psf[None, None].to(image))


def surface(request: Request, plan: Plan, pieces: Pieces) -> Tensor:
    """One surface, which hides nothing of itself but by its bins."""
    whole = len(plan.bins[0]) == 1 and plan.subapertures == 1
    if whole and not plan.moves:
        return blur_one_layer(request.image, request.coc, pieces[1][0], plan.detail)
    one = Surface(request.image, None, request.coc, plan.bins[0], _exposure(request, plan))
    return compose([one], pieces[plan.subapertures], plan.detail)[0]


def foreground(request: Request, plan: Plan, pieces: Pieces) -> Tensor:
    """What stands in front of the focus plane over the rest, of which a part is hidden."""
    image, coc, behind, lens = request.image, request.coc, request.background, pieces[1][0]
    coarse, exposure = plan.detail.coarse, _exposure(request, plan)
    asked = torch.is_grad_enabled() and any(t.requires_grad for t in (image, coc, *lens))
    simple = behind is None and exposure is None and plan.subapertures == 1 and image.shape[1] <= 3 and not asked
    if plan.detail.merging is not None and coarse and simple and has_kernel(image):
        return foreground_over_rest(image.detach(), coc.detach(), plan.bins, lens, plan.detail)
    surfaces = split_foreground(image, coc, behind, plan.bins, COARSE if coarse else 1, exposure)
    return compose(surfaces, pieces[plan.subapertures], plan.detail)[0]


def layers(request: Request, plan: Plan, pieces: Pieces) -> Tensor:
    """Layers of the caller's over one another, those that hold anything."""
    image, coc = request.image, request.coc
    opaque = () if image.requires_grad else plan.opaque
    surfaces = [
        Surface(
            image[:, k, :-1], None if k in opaque else image[:, k, -1:], coc[:, k], bins, _exposure(request, plan, k)
        )
        for k, bins in zip(plan.layers, plan.bins, strict=True)
    ]
    surfaces = [s.continued(COARSE if plan.detail.coarse else 1) for s in surfaces]
    if not surfaces:
        return torch.zeros_like(image[:, 0])
    return torch.cat(compose(surfaces, pieces[plan.subapertures], plan.detail), 1)


def _exposure(request: Request, plan: Plan, layer: int | None = None) -> Exposure | None:
    """What the picture, or one of its layers, does while the shutter is open, as far as the plan says it is seen."""
    if not plan.moves:
        return None
    motion = request.motion if plan.approaches else request.motion._replace(shutter_coc=None)
    return exposed(motion if layer is None else motion.mapped(lambda t: t[:, layer]), plan.parts)


ROUTES: dict[Route, Callable[[Request, Plan, Pieces], Tensor]] = {
    "sharp": sharp,
    "uniform": uniform,
    "layers": layers,
    "foreground": foreground,
    "surface": surface,
}
