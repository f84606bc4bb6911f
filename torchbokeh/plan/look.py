"""A look at a scene: the numbers that a plan is decided by."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from torchbokeh.ops.spans import working_dtype
from torchbokeh.picture.motion import Motion
from torchbokeh.picture.request import Request
from torchbokeh.plan.lights import lights_at_border
from torchbokeh.plan.quality import predict_errors
from torchbokeh.psfs.combined import STILL


class PlanSettings(NamedTuple):
    """Settings that a plan keeps to, see `torchbokeh.LensBlur`; None stands for ``"auto"``."""

    quality: str
    tolerance: float | None
    layers: int | None
    subapertures: int | None
    aperture: str


@dataclass(frozen=True)
class Look:
    """What a look at a scene finds, as numbers.

    Attributes:
        size: ``(H, W)`` of the image.
        low: smallest signed CoC in px after ``max_coc``, of the picture or of each layer that holds anything.
        high: largest, likewise.
        clamped: share of the pixels whose radius ``max_coc`` cut.
        errors: those of `torchbokeh.plan.quality.predict_errors`, where there is a tolerance to keep to.
        layer_count: number of input layers; 0 for a plain image.
        layers: indices of those that hold anything.
        opaque: indices of those that cover everything: their coverage needs no looking at.
        background: whether what the foreground hides is known.
        motion: longest displacement in px over the open shutter.
        pan: the displacement (dx, dy) that all pixels share; None where they do not.
        approach: largest change of a signed radius in px while the shutter is open.
        lights: how bright lights near the border are, see `torchbokeh.plan.lights.lights_at_border`.
    """

    size: tuple[int, int]
    low: tuple[float, ...]
    high: tuple[float, ...]
    clamped: float
    errors: tuple[float, ...]
    layer_count: int = 0
    layers: tuple[int, ...] = ()
    opaque: tuple[int, ...] = ()
    background: bool = False
    motion: float = 0.0
    pan: tuple[float, float] | None = None
    approach: float = 0.0
    lights: float = 0.0

    @property
    def coc_range(self) -> tuple[float, float]:
        """Smallest and largest signed CoC of all, in px."""
        return min(self.low, default=0.0), max(self.high, default=0.0)

    @property
    def approaches(self) -> bool:
        """Whether motion toward the camera, or away, is to be seen."""
        return self.approach > STILL[0]

    @property
    def moves(self) -> bool:
        """Whether motion is to be seen."""
        return self.motion > STILL[0] or self.approaches


@torch.no_grad()
def look_at(request: Request, settings: PlanSettings) -> Look:
    """Look at a picture, or at layers, with a small copy from the device for its maps, its motion and its lights."""
    image, coc = request.image, request.coc
    if image.numel() == 0:
        raise ValueError(f"image: expected at least one pixel to plan for, got shape {tuple(image.shape)}")
    size, background = (image.shape[-2], image.shape[-1]), request.background is not None
    if not request.layered:
        motion, pan, approach = _look_at_motion(image, request.motion)
        clamped = coc.new_zeros(()) if request.clamped is None else request.clamped.to(coc.dtype).mean()
        expected = [] if settings.tolerance is None else predict_errors(image, coc)
        found = [t.to(coc.dtype) for t in (*coc.aminmax(), clamped, *expected)]
        low, high, share, *errors = torch.stack(found).tolist()
        lights = lights_at_border(image, coc, max(-low, high), motion + approach)
        return Look(size, (low,), (high,), share, tuple(errors), 0, (), (), background, motion, pan, approach, lights)
    there = image[:, :, 3:] > 0
    # A product: what is not finite is refused, wherever it is.
    motion, pan, approach = _look_at_motion(image, request.motion.mapped(lambda t: t * there))
    lows = torch.where(there, coc, torch.inf).movedim(1, 0).flatten(1).amin(1)
    highs = torch.where(there, coc, -torch.inf).movedim(1, 0).flatten(1).amax(1)
    cut = request.clamped
    clamped = lows.new_zeros(()) if cut is None else (cut & there).sum() / there.sum().clamp_min(1)
    expected = [] if settings.tolerance is None else predict_errors(image, torch.where(there, coc, torch.nan))
    least = image[:, :, 3:].movedim(1, 0).flatten(1).amin(1).to(lows.dtype)
    rest = torch.stack([t.to(lows.dtype) for t in (clamped, *expected)])
    count, numbers = image.shape[1], torch.cat([lows, highs, least, rest]).tolist()
    bounds, (share, *errors) = numbers[: 3 * count], numbers[3 * count :]
    kept = tuple(k for k in range(count) if bounds[k] <= bounds[count + k])
    opaque = tuple(k for k in range(count) if bounds[2 * count + k] >= 1)
    ends = tuple(bounds[k] for k in kept), tuple(bounds[count + k] for k in kept)
    largest = max((*map(abs, ends[0]), *map(abs, ends[1])), default=0.0)
    lights = lights_at_border(image, torch.where(there, coc, 0.0), largest, motion + approach)
    return Look(size, *ends, share, tuple(errors), count, kept, opaque, background, motion, pan, approach, lights)


def _look_at_motion(image: Tensor, motion: Motion) -> tuple[float, tuple[float, float] | None, float]:
    """`Look.motion`, `Look.pan` and `Look.approach`.

    Raises:
        ValueError: the motion is not finite.
    """
    if not motion:
        return 0.0, None, 0.0
    found, ends = motion.displacements, motion.shutter_coc
    # In half precision the square of 300 px is infinite already, and differences are rounded.
    work = working_dtype(image.device)
    numbers = [image.new_zeros(1) if ends is None else ends.to(work).diff(dim=-3).abs().max()[None]]
    if found:
        length = torch.stack([d.to(work).square().sum(-3) for d in found]).sqrt().sum(0).max()
        numbers += [length[None], *found[0].movedim(-3, 0).flatten(1).aminmax(dim=1)]
    approach, *rest = torch.cat([t.to(image.device, work) for t in numbers]).tolist()
    if not rest:
        return 0.0, None, approach
    longest, *limits = rest
    if not math.isfinite(longest):
        bad = sum(int((~d.isfinite()).sum()) for d in found)
        raise ValueError(f"motion: expected finite values, got {bad} that are not")
    same = len(found) == 1 and limits[:2] == limits[2:]
    return longest, (limits[0], limits[1]) if same else None, approach
