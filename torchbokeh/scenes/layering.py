"""From cards to layers: as few as there are cards that overlap, each card in one of them."""

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Fragments:
    """What one card alone shows, in the part of the picture that it takes.

    Attributes:
        top: first row of that part.
        left: first column.
        rgba: ``(4, h, w)`` premultiplied.
        depth: ``(1, h, w)`` metres, also beyond the card.
        motion: ``(4, h, w)`` from the opening to the closing of the shutter: the displacement (dx, dy) in px, and what
            is to be added to one over the depth at both moments.
    """

    top: int
    left: int
    rgba: Tensor
    depth: Tensor
    motion: Tensor

    @property
    def place(self) -> tuple[slice, slice, slice]:
        """Where in the picture it is."""
        _, h, w = self.rgba.shape
        return slice(None), slice(self.top, self.top + h), slice(self.left, self.left + w)


def stack_layers(cards: list[Fragments], most: int | None, size: tuple[int, int]) -> dict[str, Tensor]:
    """Layers, and the picture they make; see `torchbokeh.scenes.Scene.render`."""
    device = cards[0].rgba.device if cards else None
    chosen, cross = assign_layers(cards)
    count = max(chosen, default=-1) + 1
    rgba = torch.zeros(count, 4, *size, device=device)
    depth = torch.full((count, 1, *size), torch.inf, device=device)
    motion = torch.zeros(count, 4, *size, device=device)
    for card, k in zip(cards, chosen, strict=True):
        there = card.rgba[3:] > 0
        for whole, part in ((rgba[k], card.rgba), (depth[k], card.depth), (motion[k], card.motion)):
            inside = whole[card.place]
            inside.copy_(torch.where(there, part, inside))
    if cross:
        _sort_pixels(rgba, depth, motion)
    if most is not None and count > most:
        flat = [t[None] for t in flatten(rgba[most - 1 :], depth[most - 1 :], motion[most - 1 :])]
        rgba, depth, motion = (torch.cat([t[: most - 1], f]) for t, f in zip((rgba, depth, motion), flat, strict=True))
    picture, front, moved = flatten(rgba, depth, motion)
    return {
        **{"image": picture[:3], "alpha": picture[3:], "depth": front, "motion": moved[:2]},
        **{"shutter_depth": _ends(front, moved), "layers": rgba, "layer_depth": depth, "layer_motion": motion[:, :2]},
        "layer_shutter_depth": _ends(depth, motion),
    }


def _ends(depth: Tensor, motion: Tensor) -> Tensor:
    """Depth ``(..., 2, H, W)`` when the shutter opens and when it closes."""
    return (depth.reciprocal() + motion[..., 2:, :, :]).clamp_min(0).reciprocal()


def flatten(rgba: Tensor, depth: Tensor, motion: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Put layers over one another, front to back; depth and motion are those of what is seen most of.

    Args:
        rgba: ``(L, 4, H, W)`` premultiplied.
        depth: ``(L, 1, H, W)``.
        motion: ``(L, E, H, W)``.

    Returns:
        ``(4, H, W)``, ``(1, H, W)`` and ``(E, H, W)``; where nothing is seen, depth ``inf`` and no motion.
    """
    size = rgba.shape[2:]
    left, most = rgba.new_ones(1, *size), rgba.new_zeros(1, *size)
    picture, front = rgba.new_zeros(4, *size), rgba.new_full((1, *size), torch.inf)
    moved = motion.new_zeros(motion.shape[1:])
    for colour, z, moves in zip(rgba, depth, motion, strict=True):
        visible = left * colour[3:]
        nearer = visible > most
        front, moved = torch.where(nearer, z, front), torch.where(nearer, moves, moved)
        most = torch.maximum(most, visible)
        picture = picture + left * colour
        left = left * (1 - colour[3:])
    return picture, front, moved


def assign_layers(cards: list[Fragments]) -> tuple[list[int], bool]:
    """The layer of every card, and whether some cards cannot be ordered as wholes.

    A card comes to lie one layer behind the last of those that cover it somewhere.
    """
    after: list[set[int]] = [set() for _ in cards]
    before: list[set[int]] = [set() for _ in cards]
    for a in range(len(cards)):
        for b in range(a + 1, len(cards)):
            for front, back in _order(cards, a, b):
                after[front].add(back)
                before[back].add(front)
    nearest = [float(c.depth[c.rgba[3:] > 0].amin()) for c in cards]
    layers: dict[int, int] = {}
    cross = False
    while len(layers) < len(cards):
        waiting = [k for k in range(len(cards)) if k not in layers]
        free = [k for k in waiting if before[k] <= layers.keys()]
        if not free:
            # They cover each other in a ring or cut through each other: begin with the nearest and sort pixels later.
            cross = True
            free = [min(waiting, key=lambda k: (nearest[k], k))]
        for k in free:
            layers[k] = 1 + max((layers[j] for j in before[k] | after[k] if j in layers), default=-1)
    return [layers[k] for k in range(len(cards))], cross


def _order(cards: list[Fragments], a: int, b: int) -> list[tuple[int, int]]:
    """Which of two cards is before the other where both are: neither, one, or each somewhere."""
    one, other = cards[a], cards[b]
    top, left = max(one.top, other.top), max(one.left, other.left)
    bottom = min(c.top + c.rgba.shape[1] for c in (one, other))
    right = min(c.left + c.rgba.shape[2] for c in (one, other))
    if top >= bottom or left >= right:
        return []
    first, second = (
        (c.rgba[3, y, x], c.depth[0, y, x])
        for c in (one, other)
        for y, x in [(slice(top - c.top, bottom - c.top), slice(left - c.left, right - c.left))]
    )
    both = (first[0] > 0) & (second[0] > 0)
    found, behind = torch.stack([both.any(), (both & (first[1] > second[1])).any()]).tolist()
    if not found:
        return []
    if not behind:
        return [(a, b)]
    return [(a, b), (b, a)] if bool((both & (first[1] <= second[1])).any()) else [(b, a)]


def _sort_pixels(rgba: Tensor, depth: Tensor, motion: Tensor) -> None:
    """Bring the layers of every pixel into the order of their depth, in place; empty ones stay where they are."""
    for i in range(len(rgba)):
        for j in range(i + 1, len(rgba)):
            swap = (rgba[i, 3:] > 0) & (rgba[j, 3:] > 0) & (depth[i] > depth[j])
            if bool(swap.any()):
                for t in (rgba, depth, motion):
                    t[i], t[j] = torch.where(swap, t[j], t[i]), torch.where(swap, t[i], t[j])
