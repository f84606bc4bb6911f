"""What both accumulations do before the first view: which views share work, and how finely each is rendered."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from torchbokeh.views.points import Views, detail_levels, largest_coc, shared_views, smallest_radius, subsample_offsets
from torchbokeh.views.prism import Prism


class ViewSettings(NamedTuple):
    """Techniques that save work, see `torchbokeh.AccumulationBuffer`; 0 turns each off."""

    level_of_detail: float = 0.0
    reuse: int = 0
    subsamples: int = 0


@dataclass(frozen=True, eq=False)
class Bounds:
    """Of every object in a view, how blurred and how fast it may be.

    Attributes:
        low: ``(K,)`` smallest signed CoC in px.
        high: ``(K,)`` largest one.
        motion: ``(K,)`` greatest speed, in px for the time that the shutter is open; ``inf`` where it has no bound.
        texel: ``(K,)`` area of a texel on the screen, in px²; 0 where it is not known.
        coarsest: ``(K,)`` the coarsest level of detail that there is.
    """

    low: Tensor
    high: Tensor
    motion: Tensor
    texel: Tensor
    coarsest: Tensor


class Schedule(NamedTuple):
    """How N views of K objects are rendered.

    Attributes:
        views: the views; with sub-samples, drawn in by as much as these spread.
        level: ``(N, K)`` level of detail.
        parents: ``(N, K)`` view that each object is taken from; None where each is its own.
        offsets: ``(S, 2)`` sub-samples around each lens point.
    """

    views: Views
    level: Tensor
    parents: Tensor | None
    offsets: Tensor


def scheduled(
    views: Views, bounds: Bounds, prism: Prism | None, settings: ViewSettings, *, by_wavelength: bool
) -> Schedule:
    """Which views share work, and how finely each object is rendered.

    Args:
        views: N of them.
        bounds: of K objects.
        prism: the wavelengths of the views, if these are told apart.
        settings: which techniques are on.
        by_wavelength: only views of one wavelength render an object alike.
    """
    points = views.lens if prism is None else views.lens.unique(dim=0)  # wavelengths share points
    offsets, scale = subsample_offsets(points, settings.subsamples)
    views = Views(views.lens * scale, views.time, views.shift)
    level = torch.zeros(len(views), len(bounds.low), dtype=torch.long)
    if settings.level_of_detail:
        below, above = (0.0, 0.0) if prism is None else prism.shifts()
        radius = smallest_radius(bounds.low + below, bounds.high + above)
        level = detail_levels(radius, bounds.texel, settings.level_of_detail, len(views), bounds.coarsest)
    parents = None
    if settings.reuse:
        kinds = level
        if prism is not None and by_wavelength:
            kinds = level + (level.max() + 1) * prism.kinds()[:, None]
        parents = shared_views(views, largest_coc(bounds.low, bounds.high), bounds.motion, settings.reuse, kinds)
    return Schedule(views, level, parents, offsets)
