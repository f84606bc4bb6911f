"""The demo: a photograph with measured depth, refocused on three of the things in it."""

import time
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

import torchbokeh
from torchbokeh.io.pictures import check_writable, encode_srgb, sample_map, write_image
from torchbokeh.lens import ThinLens
from torchbokeh.ops.system.files import make_folder, replacing

# Calibration of the Middlebury 2014 "Motorcycle" scene at the size that scikit-image carries.
_WIDTH, _FOCAL_PX, _BASELINE, _OFFSET_PX = 741, 994.978, 0.193001, 31.086
_SENSOR_WIDTH = 0.036
_FOCAL_LENGTH = _FOCAL_PX / _WIDTH * _SENSOR_WIDTH
_F_NUMBER = 0.22
_TARGETS = {"front": ("headlight", 542, 155), "middle": ("rear wheel", 150, 300), "back": ("wall", 80, 50)}
_FRONT_SRGB, _BEHIND_SRGB = (0.10, 0.35, 0.80), (0.95, 0.50, 0.05)


def motorcycle(scale: float = 1.0) -> tuple[Tensor, Tensor]:
    """The demo's scene: a photograph and its measured depth, which come with scikit-image.

    ``depth = baseline * focal length / (disparity + offset of the principal points)``. Disparity is missing
    mostly on background that one of the two cameras could not see past an edge. There a pixel takes the
    farther of its nearest known neighbours left and right, then the median over 9 rows, against streaks.

    Args:
        scale: 1 is 741 x 500 pixels. Colour is averaged in linear light, depth is sampled, so that no depth
            appears between two surfaces.

    Returns:
        The picture ``(1, 3, H, W)``, linear, and the depth ``(1, 1, H, W)`` in metres, 2.1 to 5.0.

    Raises:
        ValueError: ``scale`` is not in (0, 1].

    Source: D. Scharstein et al., High-resolution stereo datasets with subpixel-accurate ground truth, 2014.

    Example:
        >>> image, depth = motorcycle(scale=0.1)
        >>> tuple(image.shape), tuple(depth.shape)
        ((1, 3, 50, 74), (1, 1, 50, 74))
    """
    if not 0 < scale <= 1:
        raise ValueError(f"scale: expected above 0 and at most 1, got {scale}")
    from kornia.color import rgb_to_linear_rgb
    from skimage.data import stereo_motorcycle

    photograph, _, disparity = stereo_motorcycle()
    image = rgb_to_linear_rgb(torch.from_numpy(photograph.copy()).permute(2, 0, 1)[None] / 255)
    depth = torch.from_numpy(_BASELINE * _FOCAL_PX / (_fill(disparity) + _OFFSET_PX)).float()[None, None]
    size = [max(1, round(n * scale)) for n in image.shape[2:]]
    return F.interpolate(image, size, mode="area"), F.interpolate(depth, size, mode="nearest-exact")


def motorcycle_lens(focus_distance: float) -> ThinLens:
    """The scene's own field of view on a 36 mm sensor, with an aperture far beyond any real lens.

    The scene begins two metres away, so f/0.22, an opening 22 cm wide, is what blurs it by up to 29 pixels.

    Args:
        focus_distance: in metres.

    Returns:
        A :class:`~torchbokeh.ThinLens` that is right at every ``scale`` of :func:`motorcycle`.

    Example:
        >>> round(motorcycle_lens(2.0).focal_length.item(), 4)
        0.0483
    """
    return ThinLens(_FOCAL_LENGTH, _F_NUMBER, focus_distance, _SENSOR_WIDTH)


def run_demo(out: str | Path, scale: float = 1.0, show_progress: bool = True) -> list[Path]:
    """Refocus the photograph and write the pictures.

    Args:
        out: folder, created where it is missing. ``pinhole.png`` is the photograph, ``coc.png`` the blur
            radius of ``middle.png`` (blue before the focus, white in focus, orange behind), ``front.png``,
            ``middle.png`` and ``back.png`` are the three focus distances, ``sheet.png`` is all with captions.
        scale: size of the pictures; 1 is 741 x 500.
        show_progress: show a progress bar where there is a terminal.

    Returns:
        The files written.

    Raises:
        ValueError: ``scale`` is not in (0, 1], or the folder cannot be created or written.

    Example:
        >>> run_demo("out/demo")  # doctest: +SKIP
    """
    from tqdm import tqdm

    out = Path(out)
    image, depth = motorcycle(scale)
    make_folder(out)
    check_writable(out / "sheet.png")
    focal = _FOCAL_LENGTH * 1000
    camera = f"{focal:.1f} mm at f/{_F_NUMBER}, which no real lens reaches"
    print(f"{camera}; the first time below includes loading the kernels")
    tiles = [("the photograph, sharp everywhere", image)]
    frames = []
    for name, (thing, x, y) in tqdm(_TARGETS.items(), disable=None if show_progress else True):
        focus = sample_map(depth, int(x * scale), int(y * scale))
        blur = torchbokeh.LensBlur(motorcycle_lens(focus))
        start = time.perf_counter()
        plan = blur.plan(image, depth)
        frame = blur(image, depth, plan=plan)
        caption = f"{name}: focus on the {thing} at {focus:.2f} m"
        tqdm.write(f"{caption}, {time.perf_counter() - start:.2f} s\n{plan}")
        frames.append((caption, frame))
        if name == "middle":
            coc = motorcycle_lens(focus).coc(depth, image.shape[3])
            tiles.append((f"blur radius of middle: {coc.min():+.1f} to {coc.max():+.1f} px", colour_coc(coc)))
    tiles += frames
    written = [out / f"{name}.png" for name in ("pinhole", "coc", *_TARGETS)]
    for path, (_, picture) in zip(written, tiles, strict=True):
        write_image(path, picture)
    sheet = out / "sheet.png"
    _write_sheet(sheet, tiles, f"{camera}\n\nblue: before the focus\nwhite: in focus\norange: behind it")
    return [*written, sheet]


def colour_coc(coc: Tensor) -> Tensor:
    """Colours for a map of signed radii: blue before the focus, white in focus, orange behind it.

    Args:
        coc: ``(1, 1, H, W)`` signed radius in pixels; the largest magnitude gets the full colour.

    Returns:
        ``(1, 3, H, W)``, linear, for :func:`~torchbokeh.io.pictures.write_image`.

    Example:
        >>> colour_coc(torch.zeros(1, 1, 1, 1)).flatten().tolist()
        [1.0, 1.0, 1.0]
    """
    from kornia.color import rgb_to_linear_rgb

    strength = coc.abs() / coc.abs().max().clamp(min=1e-6)
    front, behind = (torch.tensor(rgb).view(1, 3, 1, 1).to(coc) for rgb in (_FRONT_SRGB, _BEHIND_SRGB))
    srgb = torch.lerp(torch.ones_like(front), torch.where(coc < 0, front, behind), strength)
    return rgb_to_linear_rgb(srgb)


def _fill(disparity: np.ndarray) -> np.ndarray:
    """Fill what was not measured, as :func:`motorcycle` describes."""
    from skimage.filters import median

    known = np.isfinite(disparity) & (disparity > 0)
    columns = np.arange(disparity.shape[1])
    left = np.maximum.accumulate(np.where(known, columns, 0), axis=1)
    right = np.minimum.accumulate(np.where(known, columns, columns[-1])[:, ::-1], axis=1)[:, ::-1]
    sides = [np.take_along_axis(np.where(known, disparity, np.inf), side, axis=1) for side in (left, right)]
    rows = np.minimum(*sides)
    return np.where(known, disparity, median(rows, np.ones((9, 1)), mode="nearest"))


def _write_sheet(path: Path, tiles: list[tuple[str, Tensor]], legend: str) -> None:
    """The five pictures and the legend, three in a row, captions below."""
    from PIL import Image, ImageDraw, ImageFont

    height, width = tiles[0][1].shape[2:]
    size = max(8, width // 36)
    font = ImageFont.load_default(size)
    sheet = Image.new("RGB", (3 * width, 2 * (height + 2 * size)), "white")
    draw = ImageDraw.Draw(sheet)
    cells = [(x * width, y * (height + 2 * size)) for y in range(2) for x in range(3)]
    legend_at = cells.pop(2)
    for (x, y), (caption, picture) in zip(cells, tiles, strict=True):
        sheet.paste(Image.fromarray(encode_srgb(picture, 8)), (x, y))
        draw.text((x + size // 2, y + height + size // 3), caption, "black", font)
    draw.multiline_text((legend_at[0] + size, legend_at[1] + size), legend, "black", font, spacing=size // 2)
    with replacing(path) as temporary:
        sheet.save(temporary)
