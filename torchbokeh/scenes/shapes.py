"""Shapes: how much of each texel of a card is covered.

Every shape takes the size (H, W) of the card in texels, a seed, and settings that are drawn from the seed where they
are None. It returns the coverage ``(1, H, W)``, float32 in [0, 1]. It raises a TypeError for an argument of the wrong
kind, and a ValueError for one out of its range. The outermost texels are empty, so that a card sampled bilinearly ends
in nothing. Outlines are polygons with exact area coverage; round ones have 512 corners, off by less than 1/100 texel on
cards of up to 1000 texels.
"""

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from torchbokeh.ops.checks import check_flag, check_image, check_kind, check_size
from torchbokeh.scenes._random import count_setting, rng, setting
from torchbokeh.scenes._raster import fill

if TYPE_CHECKING:
    from PIL.Image import Image


def disc(size: tuple[int, int], seed: int = 0) -> Tensor:
    """A disc in the middle of the card; its radius is ``min(H, W) / 2 - 1`` texels.

    Args:
        seed: not used, there is only one disc.

    Example:
        >>> round(disc((4, 4)).sum().item(), 2)
        3.14
    """
    rng(seed)
    return fill(size, *_place(size, _circle()))


def ring(size: tuple[int, int], seed: int = 0, *, inner: float | None = None) -> Tensor:
    """A disc with a round hole.

    Args:
        size: (H, W) in texels; the outer radius is ``min(H, W) / 2 - 1``.
        inner: radius of the hole over the outer radius, 0 to 1.

    Example:
        >>> ring((9, 9), inner=0.5)[0, 4, 4].item()
        0.0
    """
    inner = setting("inner", inner, rng(seed, "ring").uniform(0.45, 0.85), 0, 1)
    return fill(size, *_place(size, _circle(), inner * _circle()[::-1]))


def polygon(
    size: tuple[int, int],
    seed: int = 0,
    *,
    corners: int | None = None,
    rotation: float | None = None,
    depth: float | None = None,
) -> Tensor:
    """A regular polygon or a star.

    Args:
        size: (H, W) in texels; the corners lie on a circle of radius ``min(H, W) / 2 - 1``.
        seed: draws what is None; about every second one is a star.
        corners: 3 to 64.
        rotation: radians, counter-clockwise as seen in the image; 0 puts a corner on top.
        depth: 0 is the convex polygon; the notches of a star reach from its edges this share of the way to
            the centre, below 1.

    Example:
        >>> polygon((34, 34), corners=4, rotation=0.0, depth=0.0).sum().item()  # 2 r²
        512.0
    """
    draw = rng(seed, "polygon")
    corners = count_setting("corners", corners, draw.integers(3, 9), 3, 64)
    rotation = setting("rotation", rotation, draw.uniform(-math.pi, math.pi), -1e3, 1e3)
    depth = setting("depth", depth, draw.uniform(0.2, 0.6) * draw.integers(2), 0, 0.99)
    angle = np.arange(2 * corners) * (math.pi / corners) + rotation
    radius = np.where(np.arange(2 * corners) % 2, (1 - depth) * math.cos(math.pi / corners), 1.0)
    return fill(size, *_place(size, np.stack([-radius * np.sin(angle), -radius * np.cos(angle)], 1)))


def leaf(size: tuple[int, int], seed: int = 0, *, lobes: int | None = None, slenderness: float | None = None) -> Tensor:
    """A leaf with a stem, bent and turned at random.

    Args:
        size: (H, W) in texels; the leaf is as large as fits in the middle.
        seed: draws what is None, and the bend, the teeth along the edge and the rotation.
        lobes: lobes on each side, 0 (entire) to 8, as an oak's.
        slenderness: length over width, 1 to 8.

    Example:
        >>> tuple(leaf((64, 48), seed=3).shape)
        (1, 64, 48)
    """
    draw = rng(seed, "leaf")
    lobes = count_setting("lobes", lobes, draw.choice([0, 0, 0, 3, 4]), 0, 8)
    slenderness = setting("slenderness", slenderness, draw.uniform(1.2, 2.6), 1, 8)
    widest, bend, angle, stem = draw.uniform([0.9, -0.5, -math.pi, 0.1], [1.6, 0.5, math.pi, 0.35])
    teeth, toothed = draw.integers(12, 24), draw.integers(2)
    t = np.linspace(0, 1, 241)
    # Half-widths of a superellipse-like blade: round at the stem, pointed at the tip.
    half = t ** (0.6 * widest) * (1 - t) ** 0.9
    half *= 0.5 / (slenderness * half.max())
    if lobes:
        half *= 0.62 + 0.38 * np.sin(math.pi * (2 * lobes * t**0.9 - 0.5)) * np.minimum(1, 4 * (1 - t))
    elif toothed:
        half *= 1 - 0.12 * (teeth * t % 1)  # a saw, steep towards the tip
    half[-1] = 0
    x = np.concatenate([[-stem], t])
    stalk = np.concatenate([[0.02], np.maximum(half, 0.012 * (1 - t))])
    upper, lower = np.stack([x, -stalk], 1), np.stack([x, stalk], 1)[::-1]
    outline = np.concatenate([upper, lower[1:]])
    turn = bend * (outline[:, 0] - 0.5)
    outline[:, 1] += bend * (outline[:, 0] - 0.5) ** 2
    outline[:, 0] += np.sin(turn) * (0.25 * bend - outline[:, 1])
    return fill(size, _fit(size, _turn(outline, angle)))


def gear(size: tuple[int, int], seed: int = 0, *, teeth: int | None = None, hole: float | None = None) -> Tensor:
    """A gear wheel with a round hole, and spokes where there is room for them.

    Args:
        size: (H, W) in texels; the outer radius is ``min(H, W) / 2 - 1``.
        seed: draws what is None, the number of spokes (0, or 3 to 6) and the rotation.
        teeth: 4 to 64.
        hole: radius of the hole over the outer radius, 0 to 0.6.

    Example:
        >>> gear((33, 33), teeth=12, hole=0.2)[0, 16, 16].item()
        0.0
    """
    draw = rng(seed, "gear")
    teeth = count_setting("teeth", teeth, draw.integers(8, 25), 4, 64)
    hole = setting("hole", hole, draw.uniform(0.1, 0.3), 0, 0.6)
    spokes, turn = draw.choice([0, 3, 4, 5, 6]), draw.uniform(0, 2 * math.pi)
    root = 1 - min(0.22, 2.6 / teeth)
    angle = (np.arange(teeth)[:, None] + [-0.28, -0.15, 0.15, 0.28]) * (2 * math.pi / teeth) + turn
    tooth = np.stack([np.cos(angle), np.sin(angle)], 2) * np.array([root, 1, 1, root])[:, None]
    cuts = [hole * _circle()[::-1]]
    inner, outer = hole + 0.12, root - 0.12
    if spokes and outer - inner > 0.15:
        for k in range(spokes):
            # Windows between spokes of constant width.
            half = math.pi / spokes - 0.06 / np.array([inner, outer])
            middle = turn + 2 * math.pi * k / spokes
            if half[0] > 0.1:
                arcs = [np.linspace(middle - h, middle + h, 48) for h in half]
                arc = [r * np.stack([np.cos(a), np.sin(a)], 1) for r, a in zip((inner, outer), arcs, strict=True)]
                cuts.append(np.concatenate([arc[0], arc[1][::-1]]))
    return fill(size, *_place(size, tooth.reshape(-1, 2), *cuts))


def grid(
    size: tuple[int, int],
    seed: int = 0,
    *,
    pitch: float | None = None,
    bar: float | None = None,
    diagonal: bool | None = None,
) -> Tensor:
    """A lattice over the whole card: bars, or a diagonal wire fence.

    Args:
        seed: draws what is None, and the phase.
        pitch: distance between bars over the shorter side of the card, 0.02 to 1.
        bar: width of a bar over the pitch, 0.01 to 0.9.
        diagonal: False for upright and level bars, True for the diamonds of a chain-link fence.

    Example:
        >>> 0.3 < grid((128, 128), pitch=0.25, bar=0.25, diagonal=False).mean() < 0.5
        tensor(True)
    """
    height, width = check_size(size)
    draw = rng(seed, "grid")
    pitch = setting("pitch", pitch, draw.uniform(0.1, 0.25), 0.02, 1)
    bar = setting("bar", bar, draw.uniform(0.12, 0.3), 0.01, 0.9)
    drawn = bool(draw.integers(2))
    diagonal = drawn if diagonal is None else check_flag("diagonal", diagonal)
    phases = draw.uniform(0, 1, 2)
    step = pitch * min(height, width)
    reach = 0.5 * math.hypot(height, width)
    angles = (0.25 * math.pi + 0.12, -0.25 * math.pi - 0.12) if diagonal else (0.0, 0.5 * math.pi)
    clear = torch.ones(1, height, width)
    for angle, phase in zip(angles, phases, strict=True):
        at = (np.arange(-math.ceil(reach / step) - 1, math.ceil(reach / step) + 1) + phase) * step
        half = 0.5 * bar * step
        bars = [np.array([[-reach, y - half], [reach, y - half], [reach, y + half], [-reach, y + half]]) for y in at]
        clear *= 1 - fill(size, *(_turn(b, angle) + np.array([0.5 * width, 0.5 * height]) for b in bars))
    return (1 - clear) * rectangle(size)


def glyph(size: tuple[int, int], seed: int = 0, *, characters: str | None = None) -> Tensor:
    """Letters, as large as fit into the card.

    Args:
        seed: draws a single character where none is given.
        characters: what to write, on one line, in Pillow's own font.

    Example:
        >>> tuple(glyph((48, 64), characters="Hi").shape)
        (1, 48, 64)
    """
    from PIL import Image

    height, width = check_size(size)
    drawn = "ABCDEFGHJKMNPQRSTUVWXYZabdefghkmnqrstwxyz2345678&@#?%"[rng(seed, "glyph").integers(53)]
    characters = drawn if characters is None else characters
    check_kind("characters", characters, str)
    ink = _ink(characters, 256.0) if characters and "\n" not in characters else None
    if ink is None:
        raise ValueError(f"characters: expected something visible on one line, got {characters!r}")
    canvas = Image.new("L", (width, height))
    points = 256 * min((width - 2) / ink.width, (height - 2) / ink.height)
    # Hinting moves edges to whole pixels, so that the first guess may be a pixel too large.
    while points >= 1 and (ink := _ink(characters, points)) is not None:
        if ink.width <= width - 2 and ink.height <= height - 2:
            canvas.paste(ink, ((width - ink.width) // 2, (height - ink.height) // 2))
            break
        points -= max(0.5, 0.005 * points)
    return torch.from_numpy(np.array(canvas))[None].float() / 255 * rectangle(size)


def rectangle(size: tuple[int, int], seed: int = 0) -> Tensor:
    """The whole card but its outermost texels.

    Args:
        seed: not used, there is only one rectangle.

    Example:
        >>> rectangle((3, 4)).tolist()
        [[[0.0, 0.0, 0.0, 0.0], [0.0, 1.0, 1.0, 0.0], [0.0, 0.0, 0.0, 0.0]]]
    """
    rng(seed)
    cover = torch.zeros(1, *check_size(size))
    cover[:, 1:-1, 1:-1] = 1
    return cover


SHAPES: dict[str, Callable[[tuple[int, int], int], Tensor]] = {
    f.__name__: f for f in (disc, ring, polygon, leaf, gear, grid, glyph, rectangle)
}
"""All shapes by name; each takes (size, seed) and draws its settings from the seed."""


def card(texture: Tensor, coverage: Tensor) -> Tensor:
    """A picture cut out by a shape: premultiplied RGBA.

    Args:
        texture: ``(3, H, W)``, linear radiance, non-negative.
        coverage: ``(1, H, W)`` in [0, 1].

    Returns:
        ``(4, H, W)``: ``texture * coverage`` and ``coverage``.

    Raises:
        TypeError: not floating-point tensors.
        ValueError: a wrong shape, sizes or devices that differ, or values out of range.

    Example:
        >>> card(torch.ones(3, 1, 1), torch.full((1, 1, 1), 0.5)).flatten().tolist()
        [0.5, 0.5, 0.5, 0.5]
    """
    check_image("texture", texture, (3, "H", "W"))
    check_image("coverage", coverage, (1, *texture.shape[1:]), like=texture)
    for name, values, high in (("texture", texture, torch.finfo(texture.dtype).max), ("coverage", coverage, 1.0)):
        if values.numel() and not ((values >= 0) & (values <= high)).all():
            raise ValueError(f"{name}: expected finite values from 0 to {high:g}, got some outside")
    return torch.cat([texture * coverage, coverage.to(texture.dtype)])


def _ink(characters: str, points: float) -> "Image | None":
    """Letters of some size in pixels, cropped to what is not empty; None where all is."""
    from PIL import Image, ImageDraw, ImageFont

    font = ImageFont.load_default(points)
    left, top, right, bottom = font.getbbox(characters)
    if right <= left or bottom <= top:
        return None
    picture = Image.new("L", (math.ceil(right - left), math.ceil(bottom - top)))
    ImageDraw.Draw(picture).text((-left, -top), characters, 255, font)
    box = picture.getbbox()
    return picture.crop(box) if box else None


def _circle() -> np.ndarray:
    """The unit circle."""
    angle = np.arange(512) * (2 * math.pi / 512)
    return np.stack([np.cos(angle), np.sin(angle)], 1)


def _turn(points: np.ndarray, angle: float) -> np.ndarray:
    """Points turned about the origin."""
    cos, sin = math.cos(angle), math.sin(angle)
    return points @ np.array([[cos, sin], [-sin, cos]])


def _place(size: Sequence[int], *outlines: np.ndarray) -> list[np.ndarray]:
    """Outlines within the unit circle, put into the middle of the card; a card too small keeps nothing."""
    height, width = check_size(size)
    radius = max(0.0, 0.5 * min(height, width) - 1)
    return [radius * outline + [0.5 * width, 0.5 * height] for outline in outlines]


def _fit(size: Sequence[int], outline: np.ndarray) -> np.ndarray:
    """An outline scaled and moved so that it touches the card's border, less one texel."""
    height, width = check_size(size)
    low, high = outline.min(0), outline.max(0)
    scale = max(0.0, (([width - 2, height - 2]) / (high - low)).min())
    return scale * (outline - 0.5 * (low + high)) + [0.5 * width, 0.5 * height]
