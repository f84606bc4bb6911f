"""Composition against the truth: a small scene with an exact picture, thousands of rays through the lens per pixel.

A floor that runs through the focus plane to a far wall, a sharp subject on it, a strongly defocused ring in front,
and highlights on the floor, the wall and the ring. `Tracer` follows rays from points of the lens through the point of
sharp focus behind each pixel; the pinhole picture and its layers come from the same rays with the lens closed.

Prints a Markdown table for each of three focus distances: SSIM and PSNR on ``clip(x, 0, 1) ** (1/2.2)``, without a
border as wide as the largest radius, and median seconds of every way to blur the picture.

    python examples/benchmarks/composition.py [--power 13] [--repeat 3] [--out FOLDER]
"""

import argparse
import math
import platform
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from scipy.stats import qmc
from skimage import data
from skimage.metrics import peak_signal_noise_ratio, structural_similarity
from torch import Tensor

import torchbokeh as tb
from torchbokeh.io.pictures import write_image

FLOOR, WALL = 0.6, 9.0  # metres below and behind the camera
SUBJECT = (2.6, -0.15, 0.15, 0.62)  # depth, x, y, radius
RING = (1.0, 0.14, 0.02, 0.17, 0.27)  # depth, x, y, inner and outer radius

FOCUS = {"ring": RING[0], "subject": SUBJECT[0], "wall": WALL}


@dataclass(frozen=True)
class Scene:
    """Size in pixels and the thin lens; the sensor is as wide as the picture."""

    width: int = 480
    height: int = 360
    focus_distance: float = 2.6
    focal_length: float = 0.050
    f_number: float = 0.3
    sensor_width: float = 0.050

    @property
    def lens(self) -> tb.ThinLens:
        """The lens of the scene."""
        return tb.ThinLens(self.focal_length, self.f_number, self.focus_distance, self.sensor_width)


def _photo(name: str) -> Tensor:
    picture = torch.from_numpy(getattr(data, name)()[..., :3]).permute(2, 0, 1).float() / 255
    return picture**2.2


def _look_up(picture: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Bilinear, mirrored beyond the border: ``u, v`` in pictures' widths, any shape; returns ``(3, *shape)``."""
    grid = torch.stack([2 * u - 1, 2 * v - 1], -1).reshape(1, 1, -1, 2).to(picture.dtype)
    out = torch.nn.functional.grid_sample(picture[None], grid, padding_mode="reflection", align_corners=False)
    return out.reshape(3, *u.shape)


def _dots(u: Tensor, v: Tensor, pitch: float, radius: float, share: float) -> Tensor:
    """1 within round dots that sit in some of the cells of a square grid, 0 elsewhere."""
    i, j = (u / pitch).floor(), (v / pitch).floor()
    noise = ((i * 127.1 + j * 311.7).sin() * 43758.5453).remainder(1)
    centre_u = (i + 0.35 + 0.3 * (noise * 7.3).remainder(1)) * pitch
    centre_v = (j + 0.35 + 0.3 * (noise * 13.7).remainder(1)) * pitch
    near = (u - centre_u) ** 2 + (v - centre_v) ** 2 < radius**2
    return (near & (noise < share)).to(u.dtype)


class Tracer:
    """Colour, depth and coverage of the three surfaces along any rays."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.wall, self.floor, self.face, self.metal = map(_photo, ("coffee", "astronaut", "chelsea", "rocket"))

    def surfaces(self, px: Tensor, py: Tensor, ux: float, uy: float) -> list[tuple[Tensor, Tensor, Tensor]]:
        """Rays through lens point ``u`` (metres) and pixel ``p``: (colour, alpha, depth) front to back."""
        s = self.scene
        # Slope per pixel of the rays through the middle of the lens: the sensor stands where the focus is sharp.
        pixel = s.sensor_width / s.width * (1 / s.focal_length - 1 / s.focus_distance)
        fx = (px - s.width / 2) * pixel * s.focus_distance
        fy = (py - s.height / 2) * pixel * s.focus_distance
        gx, gy = (fx - ux) / s.focus_distance, (fy - uy) / s.focus_distance  # direction per metre of depth

        def at(z: Tensor | float) -> tuple[Tensor, Tensor]:
            return ux + gx * z, uy + gy * z

        z, x0, y0, inner, outer = RING
        x, y = at(z)
        radius = torch.hypot(x - x0, y - y0)
        ring = ((radius > inner) & (radius < outer)).float()
        colour = _look_up(self.metal, x / 0.6, y / 0.6) * 0.7 + 0.05
        colour = colour + 6 * _dots(x, y, 0.05, 0.004, 0.35) * torch.tensor([1.0, 0.8, 0.5])[:, None]
        out = [(colour, ring, torch.full_like(x, z))]

        z, x0, y0, outer = SUBJECT
        x, y = at(z)
        angle = torch.atan2(y - y0, x - x0)
        inside = (torch.hypot(x - x0, y - y0) < outer * (1 + 0.12 * (7 * angle).cos())).float()
        out.append((_look_up(self.face, (x - x0) / 1.6 + 0.5, (y - y0) / 1.4 + 0.5), inside, torch.full_like(x, z)))

        z = torch.where(gy > 1e-6, (FLOOR - uy) / gy.clamp_min(1e-6), math.inf).clamp(max=WALL)
        x, y = at(z)
        on_wall = z >= WALL
        wall = _look_up(self.wall, x / 7 + 0.5, y / 5 + 0.5)
        wall = wall + 10 * _dots(x, y, 0.5, 0.06, 0.3) * torch.tensor([0.6, 0.8, 1.0])[:, None]
        floor = _look_up(self.floor, x / 2.5, z / 2.5)
        floor = floor + 10 * _dots(x, z, 0.45, 0.03, 0.25) * torch.tensor([1.0, 0.9, 0.7])[:, None]
        out.append((torch.where(on_wall, wall, floor), torch.ones_like(x), z))
        return out

    def _grid(self, dx: float, dy: float) -> tuple[Tensor, Tensor]:
        y, x = torch.meshgrid(
            torch.arange(self.scene.height),
            torch.arange(self.scene.width),
            indexing="ij",
        )
        return (x + dx).reshape(-1), (y + dy).reshape(-1)

    def truth(self, power: int, seed: int = 0) -> Tensor:
        """The picture through the open lens ``(1, 3, H, W)``: ``2**power`` pairs of lens point and pixel offset."""
        s = self.scene
        radius = s.focal_length / (2 * s.f_number)
        total = torch.zeros(3, s.height * s.width)
        for a, b, c, d in qmc.Sobol(4, seed=seed).random_base2(power):
            r, phi = radius * math.sqrt(a), 2 * math.pi * b
            colour = torch.zeros_like(total)
            for layer, alpha, _ in reversed(self.surfaces(*self._grid(c, d), r * math.cos(phi), r * math.sin(phi))):
                colour = torch.where(alpha > 0, layer, colour)
            total += colour
        return (total / 2**power).reshape(1, 3, s.height, s.width).float()

    def pinhole(self, side: int = 8) -> dict[str, Tensor]:
        """The picture with the lens closed, ``side**2`` rays per pixel, and its layers front to back.

        A pixel's depth is that of the surface that covers most of it: depth does not blend.
        """
        s = self.scene
        offsets = (np.arange(side) + 0.5) / side
        layers: list[list[Tensor]] = []
        for dy in offsets:
            for dx in offsets:
                for k, (colour, alpha, depth) in enumerate(self.surfaces(*self._grid(dx, dy), 0.0, 0.0)):
                    if len(layers) == k:
                        layers.append([torch.zeros(4, colour.shape[1]), torch.zeros_like(depth)])
                    layers[k][0] += torch.cat([colour * alpha, alpha[None]])
                    layers[k][1] += depth
        size = (s.height, s.width)
        rgba = torch.stack([c.reshape(4, *size) / side**2 for c, _ in layers]).float()
        depth = torch.stack([d.reshape(1, *size) / side**2 for _, d in layers]).float()
        image, front, left = torch.zeros(3, *size), torch.zeros(1, *size), torch.ones(1, *size)
        seen = torch.zeros(1, *size)
        for layer, z in zip(rgba, depth, strict=True):
            image += left * layer[:3]
            visible = left * layer[3:]
            front = torch.where(visible > seen, z, front)
            seen = torch.maximum(seen, visible)
            left = left * (1 - layer[3:])
        return {"image": image[None], "depth": front[None], "layers": rgba[None], "layer_depth": depth[None]}


def score(picture: Tensor, truth: Tensor, border: int) -> tuple[float, float]:
    """SSIM and PSNR of the displayed pictures, without the border that light from outside the picture reaches."""
    inside = (0, slice(3), slice(border, -border), slice(border, -border))
    shown, wanted = ((t[inside].clamp(0, 1) ** (1 / 2.2)).permute(1, 2, 0).numpy() for t in (picture, truth))
    return (
        float(structural_similarity(shown, wanted, channel_axis=-1, data_range=1)),
        float(peak_signal_noise_ratio(wanted, shown, data_range=1)),
    )


def methods(scene: Scene, seen: dict[str, Tensor]) -> dict[str, Callable[[], Tensor]]:
    """Every way to blur the scene, by name."""
    image, depth, layers, layer_depth = (seen[k] for k in ("image", "depth", "layers", "layer_depth"))
    lens = scene.lens
    subject = layers[:, 1, 3:]
    behind = layers[:, 1, :3] + (1 - subject) * layers[:, 2, :3]
    behind_depth = torch.where(subject > 0.5, layer_depth[:, 1], layer_depth[:, 2])
    coc = lens.coc(depth, scene.width)

    def plain() -> Tensor:
        splat = tb.ops.splat.splat_spans(
            torch.cat([image, torch.ones_like(coc)], 1), coc, tb.Disc().profile(), integrate=True
        )
        return splat[:, :3] / splat[:, 3:]

    out: dict[str, Callable[[], Tensor]] = {"no blur at all": lambda: image, "plain splat, normalised": plain}
    inputs: dict[str, Callable[[tb.LensBlur], Tensor]] = {
        "one RGB-D image": lambda blur: blur(image, depth),
        "true background given": lambda blur: blur(image, depth, background=(behind, behind_depth)),
        "true layers given": lambda blur: blur(layers, layer_depth),
    }
    for name, call in inputs.items():
        for pieces in (1, 2, 3):
            blur = tb.LensBlur(lens, subapertures=pieces)
            out[f"LensBlur, {name}, {pieces} x {pieces} sub-apertures"] = partial(call, blur)
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--power", type=int, default=13, help="the truth takes 2**power rays per pixel")
    parser.add_argument("--repeat", type=int, default=3, help="timed runs of each method")
    parser.add_argument("--out", type=Path, help="write every picture there")
    parser.add_argument("--tiny", action="store_true", help="a few seconds, for the tests")
    args = parser.parse_args()
    power, repeat, size = (6, 1, (96, 72)) if args.tiny else (args.power, args.repeat, (480, 360))
    print(f"{platform.processor() or platform.machine()}, torch {torch.__version__}, {torch.get_num_threads()} threads")
    for focus, distance in FOCUS.items():
        scene = Scene(*size, focus_distance=distance)
        tracer = Tracer(scene)
        halves = [tracer.truth(power - 1, seed) for seed in (0, 1)]
        truth = (halves[0] + halves[1]) / 2
        seen = tracer.pinhole()
        coc = scene.lens.coc(seen["depth"], scene.width)
        border = math.ceil(coc.abs().max().item())
        print(f"\nFocus on the {focus}: {size[0]} x {size[1]}, CoC {coc.min():.1f} to {coc.max():.1f} px.")
        print(
            "Two halves of the truth, {} rays per pixel: SSIM {:.4f}, PSNR {:.1f}.".format(
                2**power, *score(*halves, border)
            )
        )
        print("\n| method | SSIM | PSNR | seconds |\n| --- | --- | --- | --- |", flush=True)
        pictures = {"truth": truth}
        for name, method in methods(scene, seen).items():
            pictures[name] = method()
            seconds = []
            for _ in range(repeat):
                start = time.perf_counter()
                method()
                seconds.append(time.perf_counter() - start)
            row = (*score(pictures[name], truth, border), statistics.median(seconds))
            print("| {} | {:.4f} | {:.1f} | {:.3f} |".format(name, *row), flush=True)
        if args.out:
            args.out.mkdir(parents=True, exist_ok=True)
            for name, picture in pictures.items():
                write_image(args.out / f"{focus}, {name}.png", picture[:, :3])


if __name__ == "__main__":
    main()
