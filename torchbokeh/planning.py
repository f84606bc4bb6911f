"""From a look at a scene to a plan: what `LensBlur` finds out once, and what it decides by that."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchbokeh.layers import FOREGROUND, bin_centres
from torchbokeh.ops.merge import highest_level
from torchbokeh.ops.spans import MIN_RADIUS
from torchbokeh.plan import Hidden, Plan, Seen
from torchbokeh.quality import QUALITIES, choose, merged_shares

Moves = tuple[float, tuple[float, float] | None, float]
"""What `torchbokeh._motion.look_at_motion` returns."""


class Wishes(NamedTuple):
    """Settings that a plan keeps to, see `torchbokeh.LensBlur`; None stands for ``"auto"``."""

    quality: str
    tolerance: float | None
    layers: int | None
    subapertures: int | None
    aperture: str


class Look(NamedTuple):
    """What a look at a scene finds, as numbers.

    Attributes:
        size: ``(H, W)``.
        low: smallest signed CoC in px, of the picture or of each layer that holds anything.
        high: largest, likewise.
        clamped: share of the pixels whose radius was cut.
        shares: those of `torchbokeh.quality.merged_shares`.
        layer_count: number of input layers; 0 for a plain image.
        layers: indices of those that hold anything.
        opaque: indices of those that cover everything.
    """

    size: tuple[int, int]
    low: tuple[float, ...]
    high: tuple[float, ...]
    clamped: float
    shares: tuple[float, ...]
    layer_count: int = 0
    layers: tuple[int, ...] = ()
    opaque: tuple[int, ...] = ()


@torch.no_grad()
def look_at(image: Tensor, signed: Tensor, cut: Tensor | None, wishes: Wishes) -> Look:
    """Look at a picture, or at layers, with one copy from the device.

    Args:
        image: see `torchbokeh.LensBlur.forward`.
        signed: its signed CoC in px.
        cut: where a limit cut that.
        wishes: what to look for.
    """
    if image.numel() == 0:
        raise ValueError(f"image: expected at least one pixel to plan for, got shape {tuple(image.shape)}")
    size = (image.shape[-2], image.shape[-1])
    if image.dim() == 4:
        share = signed.new_zeros(()) if cut is None else cut.to(signed.dtype).mean()
        found = [*signed.aminmax(), share, *merged_shares(signed, wishes.quality, wishes.tolerance)]
        low, high, clamped, *shares = torch.stack(found).tolist()
        return Look(size, (low,), (high,), clamped, tuple(shares))
    held = image[:, :, 3:] > 0
    lows = torch.where(held, signed, torch.inf).movedim(1, 0).flatten(1).amin(1)
    highs = torch.where(held, signed, -torch.inf).movedim(1, 0).flatten(1).amax(1)
    share = lows.new_zeros(()) if cut is None else (cut & held).sum() / held.sum().clamp_min(1)
    merging = merged_shares(torch.where(held, signed, 0.0), wishes.quality, wishes.tolerance)
    least = image[:, :, 3:].movedim(1, 0).flatten(1).amin(1).to(lows.dtype)
    numbers = torch.cat([lows, highs, least, torch.stack([share.to(lows.dtype), *merging])]).tolist()
    bounds, (clamped, *shares) = numbers[: -len(QUALITIES) - 1], numbers[-len(QUALITIES) - 1 :]
    count = image.shape[1]
    kept = tuple(k for k in range(count) if bounds[k] <= bounds[count + k])
    opaque = tuple(k for k in range(count) if bounds[2 * count + k] >= 1)
    ends = tuple(bounds[k] for k in kept), tuple(bounds[count + k] for k in kept)
    return Look(size, *ends, clamped, tuple(shares), count, kept, opaque)


def decide(look: Look, moves: Moves, wishes: Wishes, *, background: bool) -> Plan:
    """What a scene needs.

    Args:
        look: at the scene.
        moves: and at its motion.
        wishes: the settings.
        background: whether what the foreground hides is known.
    """
    quality, error = choose(wishes.quality, wishes.tolerance, look.shares)
    most = wishes.layers or quality.bins
    low, high = min(look.low, default=0.0), max(look.high, default=0.0)
    hidden: Hidden = "nothing"
    bins: tuple[tuple[float, ...], ...]
    start, stop = FOREGROUND
    if look.layer_count:
        hidden, bins = "layers", tuple(bin_centres(*ends, most) for ends in zip(look.low, look.high, strict=True))
    elif low < stop and high > start and high - low > 1:
        ahead = wishes.layers or (1 if quality.coarse else quality.bins)
        hidden = "given" if background else "filled"
        bins = bin_centres(low, stop, ahead), bin_centres(start, high, most)
    else:
        bins = (bin_centres(low, high, most),)
    occludes = len(bins) > 1 or any(len(b) > 1 for b in bins)
    seen = Seen(look.size, (low, high), look.clamped, *moves, look.layer_count, look.layers, look.opaque)
    largest = max(abs(low), abs(high))
    if seen.moves:
        pieces = 1
    elif wishes.subapertures is not None:
        pieces = wishes.subapertures
    elif not occludes or largest < 3:
        pieces = 1
    else:
        pieces = quality.subapertures[hidden in ("given", "layers")]
    merging = quality.merging
    return Plan(
        **vars(seen),
        sharp=largest <= MIN_RADIUS and hidden != "layers" and not seen.moves,
        hidden=hidden,
        bins=bins,
        subapertures=pieces,
        aperture=wishes.aperture,
        quality=quality,
        highest=0 if merging is None else highest_level(largest, seen.size, merging),
        predicted_error=error,
    )
