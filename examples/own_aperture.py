"""An aperture of one's own, in one file: a squircle, between a disc and a square.

Any convex shape will do: an aperture says its `profile`, the left and the right edge at every height, and what is to be
learned of it is a parameter like any other.
"""

import argparse
import math
from pathlib import Path

import torch
from torch import Tensor

import torchbokeh as tb
from torchbokeh.io.pictures import write_image
from torchbokeh.ops.spans import Profile
from torchbokeh.psfs import polygon_profile

CORNERS = 64


class Squircle(tb.Aperture):
    """The set ``|x|**p + |y|**p <= 1``, scaled into the unit circle: 2 is the disc, infinity the square.

    Args:
        power: p, at least 1.
    """

    power: Tensor

    def __init__(self, power: float | torch.nn.Parameter = 4.0) -> None:
        super().__init__()
        if isinstance(power, torch.nn.Parameter):
            self.power = power
        else:
            self.register_buffer("power", torch.tensor(float(power)))
        if not self.power.item() >= 1:
            raise ValueError(f"power: expected at least 1, got {self.power.item()}")

    def profile(self) -> Profile:
        """A polygon of `CORNERS` corners, differentiable to the power."""
        angle = (torch.arange(CORNERS, dtype=torch.float64, device=self.power.device) + 0.5) * (2 * math.pi / CORNERS)
        cos, sin = angle.cos(), angle.sin()
        power = self.power.double()
        radius = (cos.abs() ** power + sin.abs() ** power) ** (-1 / power)
        radius = radius / radius.max()  # the corners touch the unit circle
        return polygon_profile(torch.stack([radius * cos, radius * sin], 1))

    def extra_repr(self) -> str:
        """The settings, for ``print``."""
        return f"power={self.power.item():g}"


def lights(height: int, width: int) -> tuple[Tensor, Tensor]:
    """Lights before black, farther and farther behind the focus: image and signed CoC."""
    image = torch.full((1, 3, height, width), 0.01)
    radius = torch.linspace(1, 0.12 * height, width).expand(1, 1, height, width).contiguous()
    g = torch.Generator().manual_seed(0)
    places = torch.rand(24, 2, generator=g) * torch.tensor([height - 1.0, width - 1.0])
    for (y, x), colour in zip(places.long().tolist(), torch.rand(24, 3, generator=g), strict=True):
        image[0, :, y, x] = 40 + 400 * colour
    return image, radius


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/own_aperture.png"))
    parser.add_argument("--tiny", action="store_true", help="a few pixels, for tests")
    args = parser.parse_args()
    image, coc = lights(48, 72) if args.tiny else lights(400, 600)
    pictures = []
    for power in (2.0, 4.0, 30.0):
        blur = tb.LensBlur(aperture=Squircle(power))
        pictures.append(blur(image, coc=coc))
        print(blur.plan(image, coc=coc))
    args.out.parent.mkdir(parents=True, exist_ok=True)
    write_image(args.out, torch.cat(pictures, 2))
    print(f"{args.out}: powers 2, 4 and 30")


if __name__ == "__main__":
    main()
