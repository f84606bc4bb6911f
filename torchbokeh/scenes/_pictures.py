"""Textures that are pictures of things: print, photographs, a town at night.

What they take, return and raise is as in `torchbokeh.scenes.textures`.
"""

import math
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from torchbokeh.ops.checks import check_kind, check_size
from torchbokeh.scenes._paint import draw_contrast
from torchbokeh.scenes._random import count_setting, rng, setting

if TYPE_CHECKING:
    from PIL.ImageFont import FreeTypeFont, ImageFont

PHOTOGRAPHS = (
    "astronaut",
    "brick",
    "camera",
    "chelsea",
    "coffee",
    "coins",
    "grass",
    "gravel",
    "hubble_deep_field",
    "immunohistochemistry",
    "rocket",
)
"""What :func:`photograph` knows: pictures in the wheel of scikit-image, public domain, CC0 or of no known copyright."""

_LAMPS = np.array(
    [
        [1.0, 0.62, 0.28],  # tungsten
        [1.0, 0.42, 0.08],  # sodium
        [1.0, 0.92, 0.80],  # warm white
        [0.75, 0.88, 1.0],  # daylight
        [1.0, 0.05, 0.03],  # red
        [0.05, 1.0, 0.35],  # green
        [0.15, 0.30, 1.0],  # blue
    ]
)
_SYLLABLES = ("ka", "lo", "ren", "mi", "tor", "ba", "sel", "un", "da", "ri", "fo", "ne", "ix", "gru", "est", "vi", "bo")


def text(size: tuple[int, int], seed: int, *, points: float | None = None, words: str | None = None) -> Tensor:
    """A printed page: lines of words, some of them large.

    Args:
        points: height of the small print over the longer side, 0.01 to 1.
        words: what to write over and over, at least one visible character.

    Example:
        >>> tuple(text((48, 64), seed=3, words="bokeh").shape)
        (3, 48, 64)
    """
    from PIL import Image, ImageDraw

    height, width = check_size(size)
    draw = rng(seed, "text")
    points = setting("points", points, draw.uniform(0.035, 0.08), 0.01, 1)
    check_kind("words", words, str, optional=True)
    if words is not None and not words.strip():
        raise ValueError(f"words: expected some text, got {words!r}")
    palette = draw_contrast(rng(seed, "text", "colours"), 3)
    masks = [Image.new("L", (width, height)) for _ in range(2)]
    pens = [ImageDraw.Draw(mask) for mask in masks]
    margin = draw.uniform(0, 0.08) * width
    y = draw.uniform(-0.5, 1) * points * max(size)
    while y < height:
        large = draw.uniform() < 0.12
        pixels = max(2.0, points * max(size) * (draw.uniform(1.6, 3.5) if large else 1.0))
        line = _words(draw, math.ceil(2.2 * width / pixels) + 1, words)
        pens[int(large or draw.uniform() < 0.1)].text((margin, y), line, 255, _font(round(pixels, 1)))
        y += (1.15 if large else draw.choice([1.2, 1.2, 1.2, 1.2, 2.0])) * pixels
    picture = palette[0][:, None, None].expand(3, height, width)
    for mask, ink in zip(masks, palette[1:], strict=True):
        picture = torch.lerp(picture, ink[:, None, None], torch.from_numpy(np.array(mask)).float() / 255)
    return picture


def photograph(size: tuple[int, int], seed: int, *, name: str | None = None) -> Tensor:
    """A random cut-out of a photograph that comes with scikit-image.

    Args:
        size: (H, W) in pixels. The cut-out has its proportions, and is averaged down in linear light; a picture
            that is too small is enlarged.
        seed: draws the picture where none is named, the cut-out, and whether it is mirrored.
        name: one of `PHOTOGRAPHS`.

    Example:
        >>> tuple(photograph((48, 64), seed=3, name="coffee").shape)
        (3, 48, 64)
    """
    height, width = check_size(size)
    draw = rng(seed, "photograph")
    drawn = PHOTOGRAPHS[draw.integers(len(PHOTOGRAPHS))]
    name = drawn if name is None else name
    if name not in PHOTOGRAPHS:
        raise ValueError(f"name: expected one of {', '.join(PHOTOGRAPHS)}, got {name!r}")
    pixels, decode = _photograph(name)
    # The largest cut-out that the picture has room for, or one down to half of that, and no smaller than asked.
    largest = min(pixels.shape[0] / height, pixels.shape[1] / width)
    zoom = min(largest, max(1.0, largest * draw.uniform(0.5, 1)))
    window = [max(1, min(n, round(zoom * m))) for n, m in zip(pixels.shape, size, strict=False)]
    y, x = (int(draw.integers(n - m + 1)) for n, m in zip(pixels.shape, window, strict=False))
    part = pixels[y : y + window[0], x : x + window[1]]
    if draw.integers(2):
        part = part[:, ::-1]
    linear = decode[torch.from_numpy(np.ascontiguousarray(part.transpose(2, 0, 1))).long()][None]
    if window[0] >= height and window[1] >= width:
        picture = F.interpolate(linear, (height, width), mode="area")
    else:
        picture = F.interpolate(linear, (height, width), mode="bicubic", align_corners=False).clamp(0, 1)
    return picture[0].expand(3, -1, -1).contiguous()


def lights(size: tuple[int, int], seed: int, *, count: int | None = None, peak: float | None = None) -> Tensor:
    """A town at night: lit windows and lamps far brighter than 1 on dark ground.

    Args:
        count: number of lamps, 1 to 10000; windows come on top.
        peak: the largest radiance, 1 to 1e6; None draws 10 to 100. Lamps range from a tenth of it upwards, windows
            up to a fifth.

    Returns:
        ``(3, H, W)`` in [0, peak], HDR.

    Example:
        >>> lights((48, 64), seed=3, peak=50.0).max().item()
        50.0
    """
    height, width = check_size(size)
    draw = rng(seed, "lights")
    count = count_setting("count", count, draw.integers(20, 80), 1, 10000)
    peak = setting("peak", peak, math.exp(draw.uniform(math.log(10), math.log(100))), 1, 1e6)
    unit = max(size)
    rows, columns = (np.arange(n, dtype=np.float32) + 0.5 for n in (height, width))
    # The sky: a dim glow that rises from the horizon.
    sky = np.array(draw.choice([[0.020, 0.018, 0.040], [0.045, 0.022, 0.012], [0.008, 0.015, 0.030]]), np.float32)
    picture = sky[:, None, None] * (0.15 + (rows / height)[:, None] ** 2) * np.ones((1, width), np.float32)
    x = -draw.uniform(0, 0.1) * unit
    while x < width:
        wide, top = draw.uniform(0.08, 0.2) * unit, draw.uniform(0.15, 0.8) * height
        pitch = max(3.0, draw.uniform(0.014, 0.028) * unit)
        _house(picture, draw, (top, x, wide), pitch, float(draw.uniform(0.05, 0.2) * peak))
        x += wide * draw.uniform(0.9, 1.6)
    # Lamps stand on pixel centres and the brightest is painted last, so that one pixel has the peak itself.
    at = np.floor(draw.uniform(0, 1, (count, 2)) ** [0.6, 1] * [height, width]) + 0.5
    radii = np.maximum(0.75, unit * draw.uniform(0.002, 0.006, count))
    radiance = np.sort(peak * 10 ** draw.uniform(-1, 0, count))
    radiance[-1] = peak
    tints = _LAMPS[draw.choice(len(_LAMPS), count, p=[0.35, 0.25, 0.15, 0.1, 0.05, 0.05, 0.05])]
    for (cy, cx), r, colour in zip(at, radii, (radiance[:, None] * tints).astype(np.float32), strict=True):
        y0, y1, x0, x1 = max(0, int(cy - r - 1)), int(cy + r + 2), max(0, int(cx - r - 1)), int(cx + r + 2)
        distance = np.hypot(rows[y0:y1, None] - np.float32(cy), columns[x0:x1] - np.float32(cx))
        patch = picture[:, y0:y1, x0:x1]
        cover = np.clip(np.float32(r + 0.5) - distance, 0, 1)
        patch[:] = (1 - cover) * patch + cover * colour[:, None, None]
    return torch.from_numpy(picture)


@lru_cache(maxsize=len(PHOTOGRAPHS))
def _photograph(name: str) -> tuple[np.ndarray, Tensor]:
    """A photograph's bytes ``(H, W, 1 or 3)`` and the table ``(256,)`` that decodes them to linear light."""
    import skimage.data
    from kornia.color import rgb_to_linear_rgb

    pixels = np.atleast_3d(getattr(skimage.data, name)())
    return pixels, rgb_to_linear_rgb(torch.arange(256).float().expand(3, 1, 256) / 255)[0, 0]


def _house(
    picture: np.ndarray, draw: np.random.Generator, place: tuple[float, float, float], pitch: float, radiance: float
) -> None:
    """A dark front with rows of windows, some of them lit, painted into ``(3, H, W)``."""
    top, left, wide = place
    height, width = picture.shape[1:]
    y0, x0, x1 = int(top), max(0, int(left)), min(width, int(left + wide))
    if x1 <= x0 or y0 >= height:
        return
    v, u = (np.arange(y0, height) + 0.5 - top) / (1.3 * pitch), (np.arange(x0, x1) + 0.5 - left) / pitch
    floors, flats = math.ceil(v[-1]) + 1, math.ceil(u[-1]) + 1
    lit = np.where(draw.uniform(size=(floors, flats)) < draw.uniform(0.1, 0.5), radiance, 0.003)
    tints = _LAMPS[draw.choice([0, 0, 2, 3], (floors, flats))] * (lit * draw.uniform(0.3, 1, lit.shape))[..., None]
    # Coverage of the window's opening, the middle 60 %, along each axis.
    open_v, open_u = (np.clip((0.3 - abs(t % 1 - 0.5)) * s + 0.5, 0, 1) for t, s in ((v, 1.3 * pitch), (u, pitch)))
    cover = (open_v[:, None] * open_u)[None]
    panes = tints[np.floor(v).astype(int)[:, None].clip(0), np.floor(u).astype(int).clip(0)].transpose(2, 0, 1)
    picture[:, y0:, x0:x1] = 0.004 + cover * (panes - 0.004)


def _words(draw: np.random.Generator, letters: int, words: str | None) -> str:
    """A line of about so many letters."""
    if words is not None:
        return " ".join([words] * (letters // (len(words) + 1) + 1))
    line = ""
    while len(line) < letters:
        kind = draw.uniform()
        word = "".join(_SYLLABLES[k] for k in draw.integers(len(_SYLLABLES), size=draw.integers(1, 4)))
        if kind < 0.1:
            word = str(draw.integers(10 ** int(draw.integers(1, 5))))
        elif kind < 0.3:
            word = word.capitalize()
        elif kind < 0.35:
            word = word.upper()
        line += word + draw.choice([" ", " ", " ", " ", ", ", ". "])
    return line


@lru_cache(maxsize=64)
def _font(pixels: float) -> "FreeTypeFont | ImageFont":
    """Pillow's own font; unpacking it costs more than writing a line."""
    from PIL.ImageFont import load_default

    return load_default(pixels)
