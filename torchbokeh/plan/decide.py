"""From a look at a scene to a plan: what is needed, and how what begins to be needed fades in."""

import math
from dataclasses import replace

from torchbokeh.ops.merge import highest_level
from torchbokeh.ops.spans import MIN_RADIUS
from torchbokeh.plan.bins import FOREGROUND, bin_centres
from torchbokeh.plan.lights import BRIGHTER
from torchbokeh.plan.look import Look, PlanSettings
from torchbokeh.plan.plan import Hidden, Plan
from torchbokeh.plan.quality import choose
from torchbokeh.psfs.combined import STILL

CUT = (3.0, 4.0)
"""Largest radius in px between which the picture passes from that of the whole lens to that of sub-apertures."""

HIDE = (1.0, 2.0)
"""Extent of the CoC in px between which what is in front begins to hide what is behind."""

STEP = 2.0
"""Change of a radius in px over one part of the exposure."""

MOST_PARTS = 12
"""Parts of the exposure, at most: of larger radii a larger step is not seen."""

MORE = 0.25
"""Part of a `STEP` on which one more part of the exposure comes in."""

MOVE = (STILL[0], 2 * STILL[0])
"""Longest motion in px between which a picture begins to move: then, the lens is not cut."""


def decide(look: Look, settings: PlanSettings) -> Plan:
    """What a scene needs.

    Where one more part begins to be needed, the pictures with and without it are mixed, so that no picture jumps as a
    scene changes: the plan with the part has that without it among its ``fading``.

    Args:
        look: at the scene.
        settings: what to keep to.
    """
    low, high = look.coc_range
    hide = 1.0 if look.layer_count and len(look.low) > 1 else passed(high - low, HIDE)
    split = hide * passed(high, FOREGROUND)
    if settings.subapertures is None:
        cut = passed(max(-low, high), CUT)
        known = float(look.layer_count > 0)
        if look.background:
            known = passed(-low, (-FOREGROUND[1], -FOREGROUND[0]))
        for_guessed, for_known = choose(settings.quality, settings.tolerance, look.errors, 0.0)[0].subapertures
        cuts = [(1 - cut, 1), (cut * (1 - known), for_guessed), (cut * known, for_known)]
    else:
        cuts = [(1.0, settings.subapertures)]
    # What hides nothing needs no cut; what is in front of the focus only hides the rest where there is some.
    ways = [
        (1 - hide, False, [(1.0, settings.subapertures or 1)]),
        (hide - split, False, cuts),
        (split, True, cuts),
    ]
    move = passed(max(look.motion, look.approach), MOVE)
    parts = _exposure_parts(look)
    still = replace(look, motion=0.0, pan=None, approach=0.0)
    seen_lights = passed(look.lights, BRIGHTER)
    around = min(math.ceil(max(-low, high) + look.motion + look.approach), min(look.size) // 2)
    candidates = [
        (
            share_lit * share_moving * share_split * share_cut,
            replace(_plan(seen, settings, pieces, count, splits=splits), surrounded=px),
        )
        for share_lit, px in ((1 - seen_lights, 0), (seen_lights, around))
        for share_moving, seen, count in ((1 - move, still, 1), *((move * share, look, n) for share, n in parts))
        for share_split, splits, pieces_of in ways
        for share_cut, pieces in pieces_of
        if share_lit * share_moving * share_split * share_cut > 0
    ]
    main = candidates[-1][1]  # they are ordered: each has all that those before it have
    shares: dict[Plan, float] = {}
    for share, plan in candidates:
        shares[plan] = shares.get(plan, 0.0) + share
    return replace(main, fading=tuple((plan, share) for plan, share in shares.items() if plan != main))


def passed(value: float, ends: tuple[float, float]) -> float:
    """How much of the way from one end to the other a value has come."""
    start, stop = ends
    return min(max((value - start) / (stop - start), 0.0), 1.0)


def _exposure_parts(look: Look) -> list[tuple[float, int]]:
    """Into how many parts of constant radius the exposure is cut, and how much that counts for."""
    if not look.approaches:
        return [(1.0, 1)]
    steps = min(max(look.approach / STEP, 2 - 2 * MORE), MOST_PARTS)
    count = math.ceil(steps)
    more = passed(steps, (count - MORE, count)) if count < MOST_PARTS else 0.0
    return [(1 - more, count), (more, count + 1)]


def _plan(look: Look, settings: PlanSettings, pieces: int, parts: int, *, splits: bool) -> Plan:
    """A plan by itself.

    Args:
        look: at the scene.
        settings: what to keep to.
        pieces: each way, into which the lens is cut if nothing moves.
        parts: into which the exposure is cut.
        splits: whether a foreground is put over the rest of a plain image, if there are both.
    """
    low, high = look.coc_range
    largest = max(abs(low), abs(high))
    quality, error = choose(settings.quality, settings.tolerance, look.errors, largest)
    most = settings.layers or quality.bins
    hidden: Hidden = "nothing"
    bins: tuple[tuple[float, ...], ...]
    start, stop = FOREGROUND
    if look.layer_count:
        hidden, bins = "layers", tuple(bin_centres(*ends, most) for ends in zip(look.low, look.high, strict=True))
    elif low < stop and high > start and splits:
        ahead = settings.layers or (1 if quality.coarse else quality.bins)
        hidden = "given" if look.background else "filled"
        bins = bin_centres(low, min(stop, high), ahead), bin_centres(max(start, low), high, most)
    else:
        bins = (bin_centres(low, high, most),)
    return Plan(
        **vars(look),
        sharp=largest <= MIN_RADIUS and hidden != "layers" and not look.moves,
        hidden=hidden,
        bins=bins,
        subapertures=1 if look.moves else pieces,
        parts=parts,
        surrounded=0,
        aperture=settings.aperture,
        quality=quality,
        highest=0 if quality.merging is None else highest_level(largest, look.size, quality.merging),
        predicted_error=error,
    )
