"""A picture blurred light by light: each wavelength with its own radius and magnification, from one pinhole picture."""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from torchbokeh.compose.surfaces import continued
from torchbokeh.lens import Lens
from torchbokeh.lens.dispersion import SEEN
from torchbokeh.lens.field_map import Field
from torchbokeh.ops.dispatch import compute_dtype
from torchbokeh.picture.motion import Motion, ways
from torchbokeh.plan.decide import Look, Moves, Wishes, decide, passed
from torchbokeh.plan.plan import Colour, Plan

STEPS = 4
"""Steps to the place that comes to lie on a pixel; each leaves an error smaller by the slope of the magnification."""


class Given(NamedTuple):
    """What a picture is blurred by, see `torchbokeh.LensBlur.forward`.

    Attributes:
        image: ``(B, C, H, W)`` or layers ``(B, L, 4, H, W)``; with fewer channels of colour where that is of one light.
        signed: its signed CoC in px.
        motion: of it.
        ends: signed CoC when the shutter opens and closes.
        behind: what the foreground hides, as colour and signed CoC.
    """

    image: Tensor
    signed: Tensor
    motion: Motion
    ends: Tensor | None
    behind: tuple[Tensor, Tensor | None] | None


@torch.no_grad()
def plan_colours(
    plan: Plan, look: Look, moves: Moves, wishes: Wishes, lens: Lens, like: Tensor, *, margin: int, limit: float | None
) -> Plan:
    """The same plan, with one for each light that the lens splits a picture into."""
    dispersion = lens.dispersion
    if dispersion is None:
        return plan
    like = like[..., :1].to(compute_dtype(like))
    field, width = Field.pixels(look.size, margin, like), look.size[1] - 2 * margin
    first, last = dispersion.wavelengths()
    shifts = lens.coc_shift(first, width, field) - lens.coc_shift(last, width, field)
    scale = dispersion.enlargement(first, field) - dispersion.enlargement(last, field)
    away = (scale * torch.hypot(field.x, field.y)).abs().max()
    spread, sideways = torch.stack([shifts.abs().max().to(away), away]).tolist()
    learned = dispersion.axial.requires_grad or dispersion.lateral.requires_grad
    seen = max(spread + sideways, 1.0 if learned else 0.0)
    light = dispersion.light(seen)
    if not light:
        return plan
    enlarged = sideways > 0 or dispersion.lateral.requires_grad
    found = [torch.stack(lens.coc_shift(one.wavelength, width, field).aminmax()) for one in light]

    def cut(values: tuple[float, ...], by: float) -> tuple[float, ...]:
        moved = (v + by for v in values)
        return tuple(moved) if limit is None else tuple(min(max(v, -limit), limit) for v in moved)

    colours = []
    for one, (low, high) in zip(light, torch.stack(found).tolist(), strict=True):
        own = look._replace(low=cut(look.low, low), high=cut(look.high, high))
        colours.append(Colour(one, enlarged, decide(own, moves, wishes)))
    plain = 1 - passed(seen, (SEEN, 2 * SEEN))
    fading = ((plan, plain),) if plain > 0 else ()
    return replace(plan, colours=tuple(colours), spread=spread + sideways, fading=fading)


def blur_colours(
    given: Given, plan: Plan, lens: Lens, blur: Callable[[Given, Plan], Tensor], *, margin: int, limit: float | None
) -> Tensor:
    """The sum of the pictures that the lens makes of every light.

    Args:
        given: the picture and its maps.
        plan: with its colours.
        lens: with a dispersion.
        blur: makes the picture of one light, ``(B, C, H, W)``, or ``(B, C + 1, H, W)`` of layers.
        margin: px on each side that lie beyond the sensor.
        limit: largest radius in px.
    """
    given = _working(given)
    layered = given.image.dim() == 5
    field = Field.pixels(plan.size, margin, given.signed)
    out = [torch.zeros_like(given.signed if not layered else given.signed[:, 0])] * (4 if layered else 3)
    for light, enlarged, own in plan.colours:
        channels = [c for c in range(3) if light.rgb[c] > 0]
        part = blur(_of_light(given, light.wavelength, channels, lens, field, margin, limit, enlarged), own)
        for k, c in enumerate(channels):
            out[c] = out[c] + light.rgb[c] * part[:, k : k + 1]
        if layered:
            out[3] = out[3] + sum(light.rgb) / 3 * part[:, -1:]
    return torch.cat(out, 1)


def _working(given: Given) -> Given:
    """The same in at least float32: half precision can tell neither radii nor the columns of a wide picture apart."""
    image, signed, motion, ends, behind = given
    dtype = compute_dtype(image, signed)

    def of(t: Tensor | None) -> Tensor | None:
        return None if t is None else t.to(dtype)

    if behind is not None:
        behind = behind[0].to(dtype), of(behind[1])
    moved = None if motion is None else [way.to(dtype) for way in ways(motion)]
    return Given(image.to(dtype), signed.to(dtype), moved, of(ends), behind)


def _of_light(
    given: Given,
    wavelength: float,
    channels: list[int],
    lens: Lens,
    field: Field,
    margin: int,
    limit: float | None,
    enlarged: bool,
) -> Given:
    """The channels of a picture, with the radii and in the size that they have in light of one wavelength."""
    shift = lens.coc_shift(wavelength, field.x.shape[1] - 2 * margin, field)

    def shifted(coc: Tensor) -> Tensor:
        moved = coc + (shift[:, None] if coc.dim() == 5 and shift.dim() == 4 else shift).to(coc.dtype)
        return moved if limit is None else moved.clamp(-limit, limit)

    image = given.image.index_select(-3, torch.tensor(channels, device=given.image.device))
    if given.image.dim() == 5:
        image = torch.cat([image, given.image[:, :, 3:]], 2)
    behind = None
    if given.behind is not None:
        colour, coc = given.behind
        behind = colour[:, channels], None if coc is None else shifted(coc)
    ends = None if given.ends is None else shifted(given.ends)
    one = Given(image, shifted(given.signed), given.motion, ends, behind)
    return _enlarged(one, wavelength, lens, field, margin) if enlarged else one


def _enlarged(given: Given, wavelength: float, lens: Lens, field: Field, margin: int) -> Given:
    assert lens.dispersion is not None
    height, width = field.x.shape
    sensor = height - 2 * margin, width - 2 * margin
    here = field
    for _ in range(STEPS):
        scale = 1 + lens.dispersion.enlargement(wavelength, here)
        here = Field.of(field.x / scale, field.y / scale, sensor)
    grid = torch.stack([2 * here.x / width, 2 * here.y / height], -1)
    batch = len(given.image)
    grid = grid.reshape(-1, height, width, 2).expand(batch, -1, -1, -1)

    alpha = given.image[:, :, -1:].flatten(0, 1) if given.image.dim() == 5 else None

    def at(t: Tensor, mode: str = "nearest") -> Tensor:
        if alpha is not None and mode == "nearest":  # the rim of a layer takes its maps along
            t = continued(t.flatten(0, 1), alpha).view_as(t)
        flat = t.flatten(1, -3)
        return F.grid_sample(flat, grid.to(t.dtype), mode=mode, padding_mode="border", align_corners=False).view_as(t)

    ends = None if given.ends is None else at(given.ends)
    behind = None
    if given.behind is not None:
        colour, coc = given.behind
        behind = at(colour, "bilinear"), None if coc is None else at(coc)
    moved = [at(way) for way in ways(given.motion)]
    return Given(at(given.image, "bilinear"), at(given.signed), moved or None, ends, behind)
