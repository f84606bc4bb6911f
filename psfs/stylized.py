"""`Stylized`: any picture as the shape of defocus, with coloured fringes (LKS table 1)."""

import base64
import io
import math
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from torchbokeh.ops.checks import check_number
from torchbokeh.ops.spans import MIN_RADIUS
from torchbokeh.psfs.arrays import Array
from torchbokeh.psfs.model import Axis
from torchbokeh.psfs.simple_lens import RadiusModel
from torchbokeh.psfs.tracing import cropped

Mask = NDArray[np.uint8]

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Shares of linear red, green and blue (ITU-R BT.709)."""

LARGEST = 1024
"""Height and width of a mask, at most."""


def star(size: int = 129) -> Mask:
    """A five-pointed star, yellow at the top and magenta at the bottom: ``(size, size, 4)``."""
    fine = 4  # points per pixel along each axis
    y, x = (np.mgrid[: size * fine, : size * fine] + 0.5) * 2 / (size * fine) - 1
    # In each fifth, folded along its middle, the star is what lies on one side of the line from a tip to a notch.
    fifth = 2 * math.pi / 5
    angle = np.abs((np.arctan2(x, -y) + fifth / 2) % fifth - fifth / 2)
    along = np.hypot(x, y) * np.cos(angle), np.hypot(x, y) * np.sin(angle)
    inside = along[0] * math.sin(math.pi / 10) + along[1] * math.cos(math.pi / 10) <= math.sin(math.pi / 10)
    alpha = inside.reshape(size, fine, size, fine).mean((1, 3))
    down = np.linspace(0, 1, size)[:, None, None]
    colour = (1 - down) * np.array([255.0, 220.0, 90.0]) + down * np.array([240.0, 70.0, 200.0])
    return (
        np.concatenate([np.broadcast_to(colour, (size, size, 3)), 255 * alpha[..., None]], 2).round().astype(np.uint8)
    )


def encoded(mask: Mask) -> str:
    """A mask as a PNG file in base64."""
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(mask).save(file, "PNG")
    return base64.b64encode(file.getvalue()).decode("ascii")


def decoded(text: str) -> Mask:
    """The mask that `encoded` wrote.

    Raises:
        ValueError: the text is something else.
    """
    from PIL import Image

    try:
        with Image.open(io.BytesIO(base64.b64decode(text, validate=True)), formats=["PNG"]) as image:
            if max(image.size) > LARGEST:
                raise ValueError(f"mask: expected at most {LARGEST} px along each side, got {image.size}")
            return np.array(image.convert("RGBA"))
    except Exception as error:  # decoders raise whatever they like on a broken file
        raise ValueError(f"mask: expected a PNG file in base64, got {text[:20]!r}... ({error})") from error


def light_of(mask: Mask) -> Array:
    """Linear light ``(3, H, W)`` of a mask: its colours times alpha, with a luminance that sums to 1."""
    from kornia.color import rgb_to_linear_rgb

    values = torch.from_numpy(np.moveaxis(mask, 2, 0) / 255)
    light = (rgb_to_linear_rgb(values[:3]) * values[3:]).numpy()
    total = LUMINANCE @ light.sum((1, 2))
    if total == 0:
        raise ValueError("mask: expected a pixel that is neither black nor transparent, got none")
    return light / total


def overlaps(count: int, length: float, radius: float) -> Array:
    """How ``count`` equal pieces of a segment lie on whole pixels: shares ``(pixels, count)``, columns sum to 1.

    Args:
        count: of the pieces.
        length: of the segment in px, > 0. It is centred on the middle pixel.
        radius: in px, how far the pixels reach at least on both sides; half of the length or more.
    """
    reach = math.ceil(radius - 0.5)
    edges = (np.arange(count + 1) / count - 0.5) * length
    borders = (np.arange(-reach, reach + 1) - 0.5)[:, None]
    low, high = np.maximum(edges[:-1], borders), np.minimum(edges[1:], borders + 1)
    return np.maximum(high - low, 0.0) * (count / length)


class Stylized(RadiusModel):
    """A logo, or any other mask, that grows with the defocus.

    The coordinate is the CoC radius beyond half a pixel, in px; the radius is half of the mask's longer side. Up to
    half a pixel all light stays on its pixel, and from there on red grows faster and blue slower. Larger masks are
    scaled from the largest.

    Light is alpha times the colour. Its luminance sums to 1, and the colours stay: a mask that is not grey tints the
    picture, what is in focus as well.

    Args:
        mask: ``(H, W, 4)`` uint8, sRGB and straight alpha, at most `LARGEST` px along each side; or such a PNG file in
            base64. Default: `star`.
        shift: by which share red grows faster and blue slower than green, in [0, 0.5].
        radius: largest radius that is sampled, in px, above 0.5 and at most 128.

    Raises:
        TypeError: ``mask`` is neither of these, or another argument not a number.
        ValueError: an argument is out of range.

    Example:
        >>> model = Stylized(shift=0.1)
        >>> model.dense((20.0,)).shape, model.dense((0.0,)).shape
        ((3, 45, 43), (3, 1, 1))
    """

    name = "stylized"
    channels = 3
    similarity = 0.99
    tints = True

    def __init__(self, mask: Mask | str | None = None, shift: float = 0.04, radius: float = 64.0) -> None:
        shift, radius = check_number("shift", shift, 0, 0.5), check_number("radius", radius)
        if not MIN_RADIUS < radius <= 128:
            raise ValueError(f"radius: expected a number of px above {MIN_RADIUS} and at most 128, got {radius}")
        self.mask = star() if mask is None else decoded(mask) if isinstance(mask, str) else _checked(mask)
        self._light = light_of(self.mask)
        self.shift = shift
        self._drawn = mask is None
        self.axes = (Axis("radius", "px", radius - MIN_RADIUS, 1.5, 100 * 101 // 2),)

    def settings(self) -> dict[str, float | int | str]:
        """All arguments; the mask as a PNG file in base64, unless it is the default."""
        rest: dict[str, float | int | str] = {"shift": self.shift, "radius": self.axes[0].bound + MIN_RADIUS}
        return rest if self._drawn else {"mask": encoded(self.mask), **rest}

    def dense(self, coordinates: Sequence[float]) -> Array:
        """The mask in the size of each channel, the light of every pixel exact."""
        radii = [MIN_RADIUS + coordinates[0] * (1 + k * self.shift) for k in (1, 0, -1)]
        side, light = max(self._light.shape), []
        for channel, radius in zip(self._light, radii, strict=True):
            rows, columns = (overlaps(n, 2 * radius * n / side, radii[0]) for n in channel.shape)
            light.append(rows @ channel @ columns.T)
        return cropped(np.stack(light))


def _checked(mask: Mask) -> Mask:
    if not isinstance(mask, np.ndarray) or mask.dtype != np.uint8:
        kind = f"an array of {mask.dtype}" if isinstance(mask, np.ndarray) else type(mask).__name__
        raise TypeError(f"mask: expected an array of uint8 or a str, got {kind}")
    if mask.ndim != 3 or mask.shape[2] != 4 or min(mask.shape) == 0 or max(mask.shape) > LARGEST:
        raise ValueError(f"mask: expected shape (H, W, 4) of at most {LARGEST} px per side, got {mask.shape}")
    return mask.copy()
