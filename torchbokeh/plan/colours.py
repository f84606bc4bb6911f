"""Which lights a lens with dispersion splits a picture into, and what each of them needs."""

from dataclasses import replace

import torch

from torchbokeh.lens.base import Lens
from torchbokeh.lens.dispersion import SEEN, Dispersion
from torchbokeh.lens.field_map import Field
from torchbokeh.ops.dispatch import compute_dtype
from torchbokeh.picture.request import Request
from torchbokeh.plan.decide import decide, passed
from torchbokeh.plan.look import Look, PlanSettings
from torchbokeh.plan.plan import Colour, Plan


@torch.no_grad()
def plan_colours(plan: Plan, look: Look, settings: PlanSettings, request: Request) -> Plan:
    """The same plan, with one for each light that the lens splits the picture into.

    Args:
        plan: of the picture without dispersion.
        look: at it.
        settings: what to keep to.
        request: the picture, and the lens.
    """
    lens, limit = request.optics.lens, request.optics.max_coc
    if lens is None or lens.dispersion is None:
        return plan
    like, width = request.coc[..., :1].to(compute_dtype(request.coc)), request.sensor.width
    field = request.sensor.field(like)
    axial, lateral = _spread(lens, lens.dispersion, width, field)
    learned = lens.dispersion.axial.requires_grad or lens.dispersion.lateral.requires_grad
    seen = max(axial + lateral, 1.0 if learned else 0.0)
    light = lens.dispersion.light(seen)
    if not light:
        return plan
    enlarged = lateral > 0 or lens.dispersion.lateral.requires_grad
    shifts = [torch.stack(lens.coc_shift(one.wavelength, width, field).aminmax()) for one in light]

    def shifted(radii: tuple[float, ...], by: float) -> tuple[float, ...]:
        moved = tuple(r + by for r in radii)
        return moved if limit is None else tuple(min(max(r, -limit), limit) for r in moved)

    colours = []
    for one, (low, high) in zip(light, torch.stack(shifts).tolist(), strict=True):
        own = replace(look, low=shifted(look.low, low), high=shifted(look.high, high))
        colours.append(Colour(one, enlarged, decide(own, settings)))
    plain = 1 - passed(seen, (SEEN, 2 * SEEN))
    fading = ((plan, plain),) if plain > 0 else ()
    return replace(plan, colours=tuple(colours), spread=axial + lateral, fading=fading)


def _spread(lens: Lens, dispersion: Dispersion, width: int, field: Field) -> tuple[float, float]:
    """How far in px the lens spreads colours in radius, and how far in place."""
    first, last = dispersion.wavelengths()
    shift = lens.coc_shift(first, width, field) - lens.coc_shift(last, width, field)
    larger = dispersion.enlargement(first, field) - dispersion.enlargement(last, field)
    away = (larger * torch.hypot(field.x, field.y)).abs().max()
    axial, lateral = torch.stack([shift.abs().max().to(away), away]).tolist()
    return axial, lateral
