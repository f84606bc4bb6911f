"""Textures: pictures of any size, made from a seed.

Every texture takes the size (H, W) in pixels, a seed, and settings that are drawn from the seed where they are None. It
returns ``(3, H, W)`` float32 linear radiance, non-negative, in [0, 1] but for :func:`lights`. It raises a TypeError for
an argument of the wrong kind, and a ValueError for one out of its range. Lengths are relative to the longer side, so
that a larger picture shows the same things larger; edges are anti-aliased.
"""

import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from torchbokeh.ops.checks import check_size
from torchbokeh.scenes._paint import draw_contrast, draw_palette, fractal, lattice, linear_hsv, ramp
from torchbokeh.scenes._pictures import lights, photograph, text
from torchbokeh.scenes._random import count_setting, rng, setting
from torchbokeh.scenes._raster import fill, stroke


def noise(
    size: tuple[int, int],
    seed: int,
    *,
    octaves: int | None = None,
    cells: float | None = None,
    roughness: float | None = None,
    warp: float | None = None,
    colours: int | None = None,
) -> Tensor:
    """Clouds, marble, rust: octaves of smooth value noise through a ramp of colours.

    Args:
        octaves: 1 to 10, each twice as fine; those finer than two pixels are left out.
        cells: features of the coarsest octave along the longer side, 0.5 to 64.
        roughness: weight of an octave over that of the one before, 0 to 1.
        warp: how far coarse noise displaces the fine, in cells, 0 to 4.
        colours: colours of the ramp, 2 to 16.

    Example:
        >>> tuple(noise((48, 64), seed=3, octaves=4).shape)
        (3, 48, 64)
    """
    draw = rng(seed, "noise")
    octaves = count_setting("octaves", octaves, draw.integers(4, 9), 1, 10)
    cells = setting("cells", cells, draw.uniform(2, 7), 0.5, 64)
    roughness = setting("roughness", roughness, draw.uniform(0.45, 0.7), 0, 1)
    warp = setting("warp", warp, max(0.0, draw.uniform(-1, 1.5)), 0, 4)
    colours = count_setting("colours", colours, draw.integers(3, 7), 2, 16)
    shift = None
    if warp:
        shift = torch.stack([fractal(size, rng(seed, "noise", "warp", k), 2, cells, 0.5) for k in range(2)])
        shift = (shift - 0.5) * (2 * warp)
    values = fractal(size, rng(seed, "noise", "octaves"), octaves, cells, roughness, shift)
    palette = draw_palette(rng(seed, "noise", "colours"), colours)
    # From dark to light, as most surfaces go, with two neighbours swapped now and then.
    palette = palette[palette.sum(1).argsort()]
    swap = int(draw.integers(2 * colours))
    if swap + 1 < colours:
        palette[[swap, swap + 1]] = palette[[swap + 1, swap]]
    return ramp(values, palette)


def voronoi(
    size: tuple[int, int],
    seed: int,
    *,
    cells: float | None = None,
    border: float | None = None,
    shading: float | None = None,
) -> Tensor:
    """Cells of random colours, as of pebbles, cracked mud or stained glass.

    Args:
        cells: cells along the longer side, 1 to 200.
        border: width of the border over the size of a cell, 0 (none) to 0.5.
        shading: how much darker a cell is at its border, 0 to 1.

    Example:
        >>> tuple(voronoi((48, 64), seed=3, cells=5).shape)
        (3, 48, 64)
    """
    draw = rng(seed, "voronoi")
    cells = setting("cells", cells, math.exp(draw.uniform(math.log(5), math.log(24))), 1, 200)
    border = setting("border", border, max(0.0, draw.uniform(-0.12, 0.16)), 0, 0.5)
    shading = setting("shading", shading, max(0.0, draw.uniform(-0.5, 0.8)), 0, 1)
    pixels = max(check_size(size)) / cells
    (u, v), extent = lattice(size, pixels, draw.uniform(0, math.pi))
    # One site per lattice cell, jittered so little that all that matter are in the 3 x 3 cells around a pixel.
    jitter = torch.from_numpy(draw.uniform(0.1, 0.9, (2, extent * extent)).astype(np.float32))
    site_u = jitter[0] + torch.arange(extent).repeat(extent)
    site_v = jitter[1] + torch.arange(extent).repeat_interleave(extent)
    home = (v.floor() * extent + u.floor()).long()
    near, best = home, torch.full(u.shape, math.inf)
    around = []
    for index in (home + (dv * extent + du) for dv in (-1, 0, 1) for du in (-1, 0, 1)):
        at_u, at_v = site_u[index], site_v[index]
        distance = (at_u - u) ** 2 + (at_v - v) ** 2
        around.append((index, at_u, at_v, distance))
        near = torch.where(distance < best, index, near)
        best = torch.minimum(distance, best)
    # The border is the nearest of the bisectors between the nearest site and the others; lengths are in cells.
    near_u, near_v = site_u[near], site_v[near]
    beyond, edge = near, torch.full(u.shape, math.inf)
    for index, at_u, at_v, distance in around:
        apart = ((at_u - near_u) ** 2 + (at_v - near_v) ** 2).sqrt()
        bisector = torch.where(index == near, math.inf, (distance - best) / (2 * apart).clamp(min=1e-6))
        beyond = torch.where(bisector < edge, index, beyond)
        edge = torch.minimum(bisector, edge)
    palette = draw_palette(rng(seed, "voronoi", "colours"), 6)
    table = palette[torch.from_numpy(draw.integers(5, size=extent * extent))]
    table = table * torch.from_numpy(draw.uniform(0.6, 1.15, (extent * extent, 1)).astype(np.float32))
    mix = (0.5 - edge * pixels).clamp(min=0)
    picture = torch.lerp(table.T[:, near], table.T[:, beyond], mix)
    picture *= 1 - shading * (1 - 3 * edge).clamp(min=0) ** 2
    if border:
        dark = 0.25 * palette[5]
        line = ((0.5 * border - edge) * pixels + 0.5).clamp(0, 1) * min(1.0, border * pixels)
        picture = torch.lerp(picture, dark[:, None, None], line)
    return picture.clamp(0, 1)


def brick(
    size: tuple[int, int],
    seed: int,
    *,
    rows: float | None = None,
    mortar: float | None = None,
    variation: float | None = None,
) -> Tensor:
    """A wall of bricks with mortar between them.

    Args:
        rows: rows of bricks along the longer side, 1 to 200.
        mortar: width of the joints over the height of a row, 0 to 0.5.
        variation: how much bricks differ from one another, 0 to 1.

    Example:
        >>> tuple(brick((48, 64), seed=3, rows=6).shape)
        (3, 48, 64)
    """
    draw = rng(seed, "brick")
    rows = setting("rows", rows, draw.uniform(6, 16), 1, 200)
    mortar = setting("mortar", mortar, draw.uniform(0.08, 0.2), 0, 0.5)
    variation = setting("variation", variation, draw.uniform(0.3, 1), 0, 1)
    pixels = max(check_size(size)) / rows
    aspect = draw.choice([1.0, 2.0, 2.4, 3.0])
    (u, v), extent = lattice(size, pixels, 0.0)
    u, v = u + draw.uniform(), v + draw.uniform()
    row = v.floor()
    u = u / aspect + (0.5 if aspect > 1 else 0.0) * (row % 2)
    column = u.floor()
    left, top = u - column, v - row
    edge = torch.minimum(torch.minimum(left, 1 - left) * aspect, torch.minimum(top, 1 - top))
    grain = fractal(size, rng(seed, "brick", "grain"), 6, 0.5 * rows, 0.7)
    edge = edge + 0.12 * mortar * (grain - 0.5)  # bricks are chipped
    colours = _brick_colours(rng(seed, "brick", "colours"))
    index = (row * extent + column).long()
    mix = variation * torch.from_numpy(draw.uniform(-0.5, 0.5, (3, extent * extent)).astype(np.float32))[:, index]
    picture = torch.lerp(colours[0][:, None, None], colours[1][:, None, None], 0.5 + mix[0])
    picture = picture * (1 + 0.7 * mix[1]) * (1 + 0.9 * (grain - 0.5))
    # Lit from above: the lower edge of a brick lies in shade.
    picture *= 1 - 0.35 * (1 - (1 - top) / 0.25).clamp(min=0)
    joint = ((0.5 * mortar - edge) * pixels + 0.5).clamp(0, 1) * min(1.0, mortar * pixels)
    ground = colours[2][:, None, None] * (0.7 + 0.6 * grain)
    return torch.lerp(picture, ground, joint).clamp(0, 1)


def checker(size: tuple[int, int], seed: int, *, cells: float | None = None, rotation: float | None = None) -> Tensor:
    """A chessboard of two colours.

    Args:
        seed: draws what is None, and the phase.
        cells: squares along the longer side, 1 to 200.
        rotation: radians, counter-clockwise as seen in the image.

    Example:
        >>> tuple(checker((48, 64), seed=3, cells=8, rotation=0.0).shape)
        (3, 48, 64)
    """
    draw = rng(seed, "checker")
    cells = setting("cells", cells, math.exp(draw.uniform(math.log(4), math.log(20))), 1, 200)
    rotation = setting("rotation", rotation, draw.choice([0.0, draw.uniform(-0.8, 0.8)]), -1e3, 1e3)
    pixels = max(check_size(size)) / cells
    uv, _ = lattice(size, pixels, rotation)
    side = torch.ones(size)
    for t, phase in zip(uv, draw.uniform(0, 2, 2), strict=True):
        # Signed distance to the next line: positive in every second stripe.
        distance = 0.5 - ((t + phase) % 2 - 1).abs()
        side *= (2 * distance * pixels).clamp(-1, 1)
    palette = draw_contrast(rng(seed, "checker", "colours"), 2)
    return torch.lerp(palette[0][:, None, None], palette[1][:, None, None], 0.5 + 0.5 * side)


def dead_leaves(
    size: tuple[int, int],
    seed: int,
    *,
    count: int | None = None,
    smallest: float | None = None,
    exponent: float = 3.0,
) -> Tensor:
    """Discs that fall on one another, with the edge statistics of natural pictures.

    Args:
        count: number of discs, 1 to 10000; the first fall on noise.
        smallest: least radius over the longer side, 0.002 to 0.2; the greatest is 0.3.
        exponent: the density of a radius falls with this power of it, 1.5 to 5; 3 makes the picture look the
            same at every scale.

    Source: A. Lee, D. Mumford, J. Huang, Occlusion models for natural images, 2001.

    Example:
        >>> tuple(dead_leaves((48, 64), seed=3, count=50).shape)
        (3, 48, 64)
    """
    height, width = check_size(size)
    draw = rng(seed, "dead_leaves")
    count = count_setting("count", count, draw.integers(400, 800), 1, 10000)
    smallest = setting("smallest", smallest, draw.uniform(0.012, 0.03), 0.002, 0.2)
    exponent = setting("exponent", exponent, 3.0, 1.5, 5)
    picture = noise(size, seed, octaves=5, cells=4.0, warp=0.0, colours=3).numpy()
    # Inverse of the distribution function of r^-exponent between the two radii.
    power = 1 - exponent
    low, high = smallest**power, 0.3**power
    radii = max(size) * (low + (high - low) * draw.uniform(size=count)) ** (1 / power)
    centres = draw.uniform(-0.1, 1.1, (count, 2)) * [height, width]
    palette = draw_palette(rng(seed, "dead_leaves", "colours"), 24).numpy()
    colours = palette[draw.integers(24, size=count)] * draw.uniform(0.6, 1.1, (count, 1))
    slopes = draw.normal(0, 0.25, (count, 2)) / radii[:, None]
    rows, columns = (np.arange(n, dtype=np.float32) + 0.5 for n in (height, width))
    for (cy, cx), r, colour, slope in zip(centres, radii, colours.astype(np.float32), slopes, strict=True):
        y0, y1, x0, x1 = max(0, int(cy - r - 1)), int(cy + r + 2), max(0, int(cx - r - 1)), int(cx + r + 2)
        dy, dx = rows[y0:y1, None] - np.float32(cy), columns[x0:x1] - np.float32(cx)
        if dy.size and dx.size:
            cover = np.minimum(np.maximum(np.float32(r + 0.5) - np.sqrt(dy * dy + dx * dx), 0), 1)
            shade = np.float32(slope[0]) * dy + np.float32(slope[1]) * dx + 1
            patch = picture[:, y0:y1, x0:x1]
            patch += cover * (colour[:, None, None] * shade - patch)
    return torch.from_numpy(picture.clip(0, 1))


def line_art(size: tuple[int, int], seed: int, *, strokes: int | None = None, width: float | None = None) -> Tensor:
    """A drawing in ink: curves, circles and hatched patches.

    Args:
        strokes: number of things drawn, 1 to 500.
        width: width of the pen over the longer side, 0.001 to 0.1.

    Example:
        >>> tuple(line_art((48, 64), seed=3, strokes=10).shape)
        (3, 48, 64)
    """
    extent = np.array(check_size(size)[::-1])
    draw = rng(seed, "line_art")
    strokes = count_setting("strokes", strokes, draw.integers(16, 40), 1, 500)
    width = setting("width", width, draw.uniform(0.004, 0.012), 0.001, 0.1)
    palette = draw_contrast(rng(seed, "line_art", "colours"), 3)
    inks: list[list[np.ndarray]] = [[], []]
    t = np.linspace(0, 1, 64)[:, None]
    for _ in range(strokes):
        kind, ink = draw.integers(4), inks[int(draw.uniform() < 0.3)]
        centre, reach, angle = draw.uniform(0, 1, 2) * extent, draw.uniform(0.05, 0.3) * max(size), draw.uniform(0, 7)
        pen = width * max(size) * draw.uniform(0.6, 1.6)
        turned = np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
        if kind == 0:  # parallel lines in a disc
            for at in np.arange(-0.95, 0.95, max(0.06, 3 * pen / reach)):
                half = math.sqrt(1 - at * at)
                ink.append(stroke(np.array([[-half, at], [half, at]]) @ turned * reach + centre, 0.7 * pen))
        elif kind == 1:  # concentric circles
            for radius in np.arange(reach, 2 * pen, -max(0.25 * reach, 3 * pen)):
                whole = np.concatenate([np.cos(6.4 * t), np.sin(6.4 * t)], 1)
                ink.append(stroke(radius * whole + centre, pen))
        else:  # a curve that swings, drawn with a pen that swells
            waves = draw.normal(0, 0.25, (3, 2)) / np.array([[1], [1.5], [2.5]])
            swing = sum(w * np.sin(math.pi * (k + 1) * t + draw.uniform(0, 6)) for k, w in enumerate(waves))
            line = (np.concatenate([2 * t - 1, 0 * t], 1) + swing) @ turned * (2 * reach) + centre
            ink.append(stroke(line, pen * (0.3 + 1.4 * np.sin(math.pi * t[:, 0]))))
    picture = palette[0][:, None, None].expand(3, *size)
    for outlines, colour in zip(inks, palette[1:], strict=True):
        picture = torch.lerp(picture, colour[:, None, None], fill(size, *outlines))
    return picture.contiguous()


TEXTURES: dict[str, Callable[[tuple[int, int], int], Tensor]] = {
    f.__name__: f for f in (noise, voronoi, brick, checker, dead_leaves, text, line_art, photograph, lights)
}
"""All textures by name; each takes (size, seed) and draws its settings from the seed. `lights` alone is HDR."""


def _brick_colours(draw: np.random.Generator) -> Tensor:
    """Two colours of brick and one of mortar ``(3, 3)``, linear: mostly reds, now and then sandstone or grey."""
    hue, saturation = draw.choice([[0.02, 0.6], [0.03, 0.5], [0.05, 0.55], [0.1, 0.35], [0.6, 0.08]])
    hues = hue + draw.uniform(-0.015, 0.03, 2)
    low, high = draw.uniform(0.3, 0.5), draw.uniform(0.6, 0.8)
    bricks = [[hues[0] % 1, saturation * 1.1, low], [hues[1] % 1, saturation * 0.85, high]]
    return linear_hsv(np.array([*bricks, [0.1, 0.1, draw.choice([0.35, 0.7, 0.8])]]))
