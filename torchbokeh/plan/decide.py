"""From a look at a scene to a plan: what `LensBlur` finds out once, and what it decides by that."""

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchbokeh.compose.surfaces import FOREGROUND, bin_centres
from torchbokeh.ops.merge import highest_level
from torchbokeh.ops.spans import MIN_RADIUS
from torchbokeh.plan.plan import Hidden, Plan, Seen
from torchbokeh.plan.quality import QUALITIES, choose, merged_shares
from torchbokeh.psfs.combined import STILL

Moves = tuple[float, tuple[float, float] | None, float]
"""What `torchbokeh.picture.motion.look_at_motion` returns."""


class Wishes(NamedTuple):
    """Settings that a plan keeps to, see `torchbokeh.LensBlur`; None stands for ``"auto"``.

    The last says whether what the foreground hides is known.
    """

    quality: str
    tolerance: float | None
    layers: int | None
    subapertures: int | None
    aperture: str
    background: bool


class Look(NamedTuple):
    """What a look at a scene finds, as numbers.

    Attributes:
        size: ``(H, W)``.
        low: smallest signed CoC in px, of the picture or of each layer that holds anything.
        high: largest, likewise.
        clamped: share of the pixels whose radius was cut.
        shares: those of `torchbokeh.plan.quality.merged_shares`.
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


CUT = (3.0, 4.0)
"""Largest radius in px between which the picture passes from that of the whole lens to that of sub-apertures."""

HIDE = (1.0, 2.0)
"""Extent of the CoC in px between which what is in front begins to hide what is behind."""

MOVE = (STILL[0], 2 * STILL[0])
"""Longest motion in px between which a picture begins to move: then, the lens is not cut."""


def decide(look: Look, moves: Moves, wishes: Wishes) -> Plan:
    """What a scene needs.

    Where one more part begins to be needed, the pictures with and without it are mixed, so that no picture jumps as a
    scene changes: the plan of the one has that of the other among its ``fading``.

    Args:
        look: at the scene.
        moves: and at its motion.
        wishes: the settings.
    """
    low, high = min(look.low, default=0.0), max(look.high, default=0.0)
    motion, _, approach = moves
    hide = 1.0 if look.layer_count and len(look.low) > 1 else passed(high - low, HIDE)
    split = hide * passed(high, FOREGROUND)
    if wishes.subapertures is None:
        cut = passed(max(-low, high), CUT)
        known = float(look.layer_count > 0)
        if wishes.background:
            known = passed(-low, (-FOREGROUND[1], -FOREGROUND[0]))
        for_guessed, for_known = choose(wishes.quality, wishes.tolerance, look.shares)[0].subapertures
        cuts = [(1 - cut, 1), (cut * (1 - known), for_guessed), (cut * known, for_known)]
    else:
        cuts = [(1.0, wishes.subapertures)]
    # What hides nothing needs no cut; what is in front of the focus only hides the rest where there is some.
    ways = [(1 - hide, False, [(1.0, wishes.subapertures or 1)]), (hide - split, False, cuts), (split, True, cuts)]
    move = passed(max(motion, approach), MOVE)
    still: Moves = (0.0, None, 0.0)
    mixed: dict[Plan, float] = {}
    for share_moving, way in ((1 - move, still), (move, moves)):
        for share_split, splits, pieces_of in ways:
            for share_cut, pieces in pieces_of:
                share = share_moving * share_split * share_cut
                if share > 0:
                    plan = _plan(look, way, wishes, pieces, splits=splits)
                    mixed[plan] = mixed.pop(plan, 0.0) + share
    *others, plan = mixed
    return replace(plan, fading=tuple((other, mixed[other]) for other in others))


def passed(value: float, ends: tuple[float, float]) -> float:
    """How much of the way from one end to the other a value has come."""
    start, stop = ends
    return min(max((value - start) / (stop - start), 0.0), 1.0)


def _plan(look: Look, moves: Moves, wishes: Wishes, pieces: int, *, splits: bool) -> Plan:
    """A plan by itself.

    Args:
        look: at the scene.
        moves: and at its motion.
        wishes: the settings.
        pieces: each way, into which the lens is cut if nothing moves.
        splits: whether a foreground is put over the rest of a plain image, if there are both.
    """
    quality, error = choose(wishes.quality, wishes.tolerance, look.shares)
    most = wishes.layers or quality.bins
    low, high = min(look.low, default=0.0), max(look.high, default=0.0)
    hidden: Hidden = "nothing"
    bins: tuple[tuple[float, ...], ...]
    start, stop = FOREGROUND
    if look.layer_count:
        hidden, bins = "layers", tuple(bin_centres(*ends, most) for ends in zip(look.low, look.high, strict=True))
    elif low < stop and high > start and splits:
        ahead = wishes.layers or (1 if quality.coarse else quality.bins)
        hidden = "given" if wishes.background else "filled"
        bins = bin_centres(low, min(stop, high), ahead), bin_centres(max(start, low), high, most)
    else:
        bins = (bin_centres(low, high, most),)
    seen = Seen(look.size, (low, high), look.clamped, *moves, look.layer_count, look.layers, look.opaque)
    largest = max(abs(low), abs(high))
    merging = quality.merging
    return Plan(
        **vars(seen),
        sharp=largest <= MIN_RADIUS and hidden != "layers" and not seen.moves,
        hidden=hidden,
        bins=bins,
        subapertures=1 if seen.moves else pieces,
        aperture=wishes.aperture,
        quality=quality,
        highest=0 if merging is None else highest_level(largest, seen.size, merging),
        predicted_error=error,
    )
