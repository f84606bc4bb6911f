"""A lens of one's own, in one file: its focal plane is tilted, as a view camera's is when its lens is.

The plane in focus is ``1 / d = 1 / focus_distance + slope * y``, with y the place in the picture: a plane in space, for
the reciprocal of the depth of any plane changes linearly over the picture. So a photograph of the ground may be sharp
from the feet to the horizon, and blurred above and below that plane.
"""

import argparse
from pathlib import Path

import torch
from torch import Tensor

import torchbokeh as tb
from torchbokeh.io.pictures import write_image
from torchbokeh.lens import Field
from torchbokeh.lens.parameters import check_parameter
from torchbokeh.picture import Sensor


class TiltedLens(tb.Lens):
    """A thin lens whose plane of focus runs through the picture at a slope.

    Args:
        focal_length: in metres.
        f_number: the aperture is ``focal_length / f_number`` wide.
        focus_distance: in metres, in the middle of the picture.
        sensor_width: in metres.
        slope: how many dioptres (1 / m) nearer the focus is at half a sensor width below the middle.
    """

    slope: Tensor

    def __init__(
        self,
        focal_length: float | Tensor,
        f_number: float | Tensor,
        focus_distance: float | Tensor,
        sensor_width: float | Tensor,
        slope: float | Tensor,
    ) -> None:
        super().__init__()
        self.keep(
            focal_length=focal_length,
            f_number=f_number,
            focus_distance=focus_distance,
            sensor_width=sensor_width,
            slope=slope,
        )
        for name, value in self.values().items():
            good = value.isfinite() if name == "slope" else value > 0
            check_parameter(name, value, good, "a finite slope" if name == "slope" else "a positive number")

    def coc(self, depth: Tensor, width: int, *, field: Field | None = None) -> Tensor:
        """Signed CoC radius in px; without a field, that in the middle of the picture."""
        d, focal, f_number, focus, sensor, slope = self.aligned("depth", depth, width)
        nearness = focus.reciprocal()
        if field is not None:
            nearness = nearness + slope * field.y.to(d.dtype) * (2 / width)
        gain = focal.square() / (2 * f_number) / (1 - focal / focus) * width / sensor
        return gain * (nearness - d.reciprocal())


def ground(height: int, width: int, eye: float = 1.6) -> tuple[Tensor, Tensor]:
    """A chequered ground under a sky, with posts on it, seen from ``eye`` metres above: image and depth."""
    y = (torch.arange(height) - height / 2 + 0.5) * (2 / width)
    x = (torch.arange(width) - width / 2 + 0.5) * (2 / width)
    nearness = (0.7 / eye * (y + 0.25)).clamp_min(0.0)[:, None].expand(height, width)
    depth = nearness.reciprocal()
    tiles = torch.where(nearness > 0, ((depth * x * 1.4).floor() + (depth * 1.5).floor()) % 2, 0.6)
    image = torch.stack([0.1 + 0.5 * tiles, 0.15 + 0.4 * tiles, 0.1 + 0.25 * tiles + 0.5 * (nearness == 0)])
    for k, distance in enumerate((3.0, 4.5, 7.0)):
        left = int(width * (0.2 + 0.25 * k))
        foot, top = (int(height / 2 + width / 2 * (eye - up) / distance / 0.7 - width / 8) for up in (0.0, 1.8))
        part = slice(max(top, 0), min(foot, height)), slice(left, left + max(int(width * 0.09 / distance), 2))
        depth[part] = distance
        image[:, part[0], part[1]] = torch.tensor([1.0, 0.3 * k, 0.1])[:, None, None]
    return image[None], depth[None, None]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/own_lens.png"))
    parser.add_argument("--tiny", action="store_true", help="a few pixels, for tests")
    args = parser.parse_args()
    image, depth = ground(48, 72) if args.tiny else ground(480, 720)
    pictures = []
    for slope in (0.0, 0.42):
        lens = TiltedLens(0.050, 1.4, focus_distance=9.0, sensor_width=0.012, slope=slope)
        blur = tb.LensBlur(lens, quality="balanced")
        radius = lens.coc(depth, depth.shape[-1], field=Sensor((depth.shape[2], depth.shape[3])).field(depth)).abs()
        print(f"slope {slope:g}: {100 * float((radius < 1).float().mean()):.0f} % of the pixels are sharp to a pixel")
        pictures.append(blur(image, depth))
    args.out.parent.mkdir(parents=True, exist_ok=True)
    write_image(args.out, torch.cat([image, *pictures], 3))
    print(f"{args.out}: pinhole, thin lens, tilted lens")


if __name__ == "__main__":
    main()
