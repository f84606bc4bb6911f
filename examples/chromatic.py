"""Expressive dispersion: maps over the picture, equalisers of the spectrum and its two modes, on white rings."""

import argparse
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

import torchbokeh as tb
from torchbokeh.ops.spectrum import HIGH, LOW, linear_rgb
from torchbokeh.report.sheets import write_sheet
from torchbokeh.scenes import Camera, Scene, Sprite
from torchbokeh.scenes.shapes import ring

LENS = {"focal_length": 0.050, "focus_distance": 1.6, "sensor_width": 0.036}
MAPS = (  # map, axial strength, lateral strength: maps that grow steeply take less
    (tb.FieldMap("identity"), 1.0, 0.25),
    (tb.FieldMap("square"), 1.0, 0.25),
    (tb.FieldMap("cube"), 1.0, 0.30),
    (tb.FieldMap("exp"), 0.6, 0.08),
    (tb.FieldMap("inversion"), 1.0, 0.35),
    (tb.FieldMap("inversion", "reciprocal"), 0.20, 0.03),
    (tb.FieldMap("cosine"), 0.5, 0.20),
    (tb.FieldMap("angular"), 0.6, 0.25),
)
PAIRS = (  # axial map, lateral map and their strengths
    (tb.FieldMap("identity"), tb.FieldMap("identity"), 0.8, 0.25),
    (tb.FieldMap("inversion"), tb.FieldMap("inversion", "exp"), 0.6, 0.08),
    (tb.FieldMap("exp"), tb.FieldMap("angular"), 0.4, 0.20),
    (tb.FieldMap("inversion", "reciprocal"), tb.FieldMap("inversion", "reciprocal"), 0.20, 0.03),
)


def peak(centre: float, width: float = 15.0) -> Callable[[Tensor], Tensor]:
    """A bell about a wavelength in nanometres, over a little of everything."""
    return lambda wavelength: 0.02 + (-0.5 * ((wavelength - centre) / width) ** 2).exp()


EQUALISERS: dict[str, Callable[[Tensor], Tensor]] = {
    "flat": torch.ones_like,
    "peak at 480 nm": peak(480),
    "peak at 600 nm": peak(600),
    "notch at 540 nm": lambda wavelength: (1.02 - peak(540, 40)(wavelength)).clamp_min(0),
    "peaks at 460 and 610 nm": lambda wavelength: peak(460)(wavelength) + peak(610)(wavelength),
    "seven peaks": lambda wavelength: 0.5 - 0.5 * (wavelength * (torch.pi / 30)).cos(),
}


def rings(size: tuple[int, int], rows: int = 5, columns: int = 7) -> dict[str, Tensor]:
    """White rings with a lamp in the middle of each, none over another, at depths before and behind the focus."""
    draw = torch.Generator().manual_seed(5)
    share = 0.55 / columns
    texels = max(8, round(share * size[1]))
    rgba = ring((texels, texels), inner=0.84).repeat(4, 1, 1)
    middle = slice(texels // 2 - max(texels // 16, 1), texels // 2 + max(texels // 16, 1))
    rgba[:3, middle, middle], rgba[3, middle, middle] = 12.0, 1.0
    sprites = []
    for row in range(rows):
        for column in range(columns):
            x, y, nearness = torch.rand(3, generator=draw).tolist()
            z = 1 / (0.35 + 0.65 * nearness)  # 1 m to 2.9 m
            unit = z * LENS["sensor_width"] * (1 / LENS["focal_length"] - 1 / LENS["focus_distance"])
            place = (column + 0.5 + 0.3 * (x - 0.5)) / columns - 0.5, (row + 0.5 + 0.3 * (y - 0.5)) / rows - 0.5
            position = unit * place[0], unit * place[1] * size[0] / size[1], z
            sprites.append(Sprite(rgba, position, (share * unit, share * unit)))
    return Scene(tuple(sprites)).render(Camera(tb.ThinLens(**LENS, f_number=1.0), size))


def blurred(seen: dict[str, Tensor], dispersion: tb.Dispersion | None) -> Tensor:
    """The picture ``(1, 3, H, W)`` before black."""
    lens = tb.ThinLens(**LENS, f_number=0.8, dispersion=dispersion)
    layers, depth = seen["layers"][None], seen["layer_depth"][None]
    return tb.LensBlur(lens, quality="balanced")(layers, depth)[:, :3]


def formula(field_map: tb.FieldMap) -> str:
    """What is between the brackets of its ``repr``."""
    return repr(field_map).removeprefix("FieldMap(").removesuffix(")")


def maps(seen: dict[str, Tensor]) -> list[tuple[str, Tensor]]:
    """One part of the dispersion at a time under each map, then both."""
    each = [(f"A = {formula(m)}", axial, 0.0, m, None) for m, axial, _ in MAPS]
    each += [(f"L = {formula(m)}", 0.0, lateral, None, m) for m, _, lateral in MAPS]
    each += [(f"A = {formula(a)}, L = {formula(m)}", axial, lateral, a, m) for a, m, axial, lateral in PAIRS]
    return [
        (name, blurred(seen, tb.Dispersion("BK7", *s, axial_map=a, lateral_map=m, spectrum="continuous")))
        for name, *s, a, m in each
    ]


def strip(weight: Callable[[Tensor], Tensor], height: int, width: int) -> Tensor:
    """The weight as a graph, and the weighted colours of the spectrum below it: ``(1, 3, height, width)``."""
    wavelength = torch.linspace(LOW, HIGH, width)
    share = weight(wavelength) / weight(wavelength).max()
    upper = torch.arange(height // 2, 0, -1)[:, None] <= share * (height // 2)
    colours = linear_rgb(wavelength).mT * share / 2
    return torch.cat([upper.float().expand(3, -1, -1) * 0.5, colours[:, None].expand(-1, height - len(upper), -1)], 1)[
        None
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/chromatic"), help="folder for the three pictures")
    parser.add_argument("--tiny", action="store_true", help="small, for tests")
    args = parser.parse_args()
    size = (24, 32) if args.tiny else (192, 256)
    args.out.mkdir(parents=True, exist_ok=True)

    seen = rings(size if args.tiny else (288, 384))
    modes = [("no dispersion", blurred(seen, None))]
    for mode in ("rgb", "continuous"):
        modes.append((f'spectrum="{mode}"', blurred(seen, tb.Dispersion("BK7", 0.6, 0.3, spectrum=mode))))
    write_sheet(args.out / "modes.png", modes, columns=3)
    print(args.out / "modes.png")

    seen = rings(size)
    equalised = []
    for name, weight in EQUALISERS.items():
        lens = tb.Dispersion("BK7", 0.8, 0.4, spectrum="continuous", equaliser=weight)
        equalised.append((name, torch.cat([blurred(seen, lens), strip(weight, size[0] // 6, size[1])], 2)))
    write_sheet(args.out / "equaliser.png", equalised, columns=3)
    print(args.out / "equaliser.png")

    write_sheet(args.out / "maps.png", maps(seen), columns=4)
    print(args.out / "maps.png")


if __name__ == "__main__":
    main()
