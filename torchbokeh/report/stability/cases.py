"""Stiff and extreme pictures: dynamic range, radii, motions, sizes."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

HALF_MAX = 65504.0
"""Largest value that float16 holds."""

MEAN = 1.0
"""Of the textured scene."""


@dataclass(frozen=True, eq=False)
class Case:
    """A picture to blur, in float64.

    Attributes:
        group: ``"dynamic range"``, ``"radius"``, ``"motion"``, ``"size"`` or ``"highlight"``.
        name: of it.
        image: ``(B, C, H, W)``.
        coc: ``(B, 1, H, W)`` signed radius in px.
        motion: ``(B, 2, H, W)`` in px; ``None`` where renderers of motion take their own.
        bright: place (y, x) of the highlight on an even background, whose leak is measured.
        across: side in px of the square of such highlights that begins there.
        even: brightness of that background.
        promised: whether the picture is of the kind for which a quality promises its error: the radius varies little
            from pixel to pixel.
    """

    group: str
    name: str
    image: Tensor
    coc: Tensor
    motion: Tensor | None = None
    bright: tuple[int, int] | None = None
    across: int = 1
    even: float = MEAN
    promised: bool = True

    @property
    def peak(self) -> float:
        """The largest magnitude of the picture; 0 of an empty one."""
        return float(self.image.abs().max()) if self.image.numel() else 0.0


def texture(height: int, width: int, seed: int = 0, channels: int = 3) -> Tensor:
    """A scene with a mean of about `MEAN` and a contrast of about 1: waves and noise, positive."""
    draw = torch.Generator().manual_seed(seed)
    y, x = torch.arange(height, dtype=torch.float64)[:, None], torch.arange(width, dtype=torch.float64)
    waves = torch.stack([1 + 0.5 * torch.sin(0.3 * (k + 1) * x + 0.2 * y + k) for k in range(channels)])
    noise = torch.rand(channels, height, width, dtype=torch.float64, generator=draw)
    return (MEAN * waves * (0.5 + noise))[None]


def slope(height: int, width: int, low: float, high: float) -> Tensor:
    """CoC that runs from one value to another along the columns, ``(1, 1, H, W)``."""
    return torch.linspace(low, high, width, dtype=torch.float64).expand(1, 1, height, width).contiguous()


def even(height: int, width: int, radius: float) -> Tensor:
    """The same CoC everywhere."""
    return torch.full((1, 1, height, width), radius, dtype=torch.float64)


def cases(side: int) -> Iterator[Case]:
    """All pictures for renderers, of about ``side`` px each way."""
    yield from dynamic_range(side)
    yield from radii(side)
    yield from motions(side)
    yield from sizes(side)


def dynamic_range(side: int) -> Iterator[Case]:
    """One pixel of 1e2 to 1e8 beside black, grey and texture; a field of highlights; the least and largest numbers."""
    group, at = "dynamic range", (side // 4, side // 3)
    radius = side / 8
    wide = slope(side, side, 0.9 * radius, radius)
    for value in (1e2, 1e4, 1e6, 1e8):
        for ground in (0.0, MEAN):
            image = torch.full((1, 3, side, side), ground, dtype=torch.float64)
            image[..., at[0], at[1]] = value
            beside = "grey" if ground else "black"
            yield Case(group, f"{value:.0e} beside {beside}", image, wide, bright=at, even=ground)
        image = texture(side, side)
        image[..., at[0], at[1]] = value
        yield Case(group, f"{value:.0e} beside texture", image, wide)
    image = texture(side, side)
    image[..., ::3, ::3] = 1e4
    yield Case(group, "a field of 1e4", image, wide)
    image = torch.full((1, 3, side, side), MEAN, dtype=torch.float64)
    image[..., at[0], at[1]] = HALF_MAX
    yield Case(group, "65504 beside grey", image, wide, bright=at)
    yield Case(group, "all 65504", torch.full((1, 3, side, side), HALF_MAX, dtype=torch.float64), wide)
    yield Case(group, "denormal (1e-40)", texture(side, side) * 1e-40, wide)
    yield Case(group, "all black", torch.zeros(1, 3, side, side, dtype=torch.float64), wide)


def radii(side: int) -> Iterator[Case]:
    """Even radii at the ends of ranges, and CoC that jumps at every pixel."""
    group, image = "radius", texture(side, side)
    for radius in (0.0, 1e-6, 0.49, 0.5, 0.51, 1 - 1e-4, 1 + 1e-4, 7 - 1e-4, 7 + 1e-4, 8.0, 1.5 * side, 1e4):
        yield Case(group, f"even, {radius:.10g} px", image, even(side, side, radius))
    yield Case(group, "even, -7.3 px", image, even(side, side, -7.3))
    yield Case(group, "slope -9 to 9 px", image, slope(side, side, -9.0, 9.0))
    chess = (torch.arange(side)[:, None] + torch.arange(side)) % 2 * torch.ones(1, 1, 1, 1, dtype=torch.float64)
    yield Case(group, "-60 and 60 px by turns", image, 120 * chess - 60, promised=False)
    yield Case(group, "0 and 40 px by turns", image, 40 * chess, promised=False)
    draw = torch.Generator().manual_seed(1)
    noise = torch.rand(1, 1, side, side, dtype=torch.float64, generator=draw)
    yield Case(group, "noise up to 1e4 px", image, 1e4 * noise**8, promised=False)


def motions(side: int) -> Iterator[Case]:
    """No motion, hardly any, far more than the picture is wide; along axes and diagonals, in opposite ways, in any."""
    group, image, coc = "motion", texture(side, side), even(side, side, side / 16)
    ways = {
        "none": (0.0, 0.0),
        "1e-6 px": (1e-6, 0.0),
        "1.5 px": (1.5, 0.0),
        "2000 px": (1600.0, 1200.0),
        "along x": (side / 4, 0.0),
        "along y": (0.0, -side / 4),
        "diagonal": (side / 5, side / 5),
    }
    for name, way in ways.items():
        motion = torch.tensor(way, dtype=torch.float64).view(1, 2, 1, 1).expand(1, 2, side, side).contiguous()
        yield Case(group, name, image, coc, motion)
    signs = torch.where((torch.arange(side) // 4) % 2 == 0, 1.0, -1.0).double()
    opposite = torch.stack([signs * side / 4, 0 * signs])[:, None, :].expand(2, side, side)[None].contiguous()
    yield Case(group, "opposite, side by side", image, slope(side, side, 0.5, side / 16), opposite)
    draw = torch.Generator().manual_seed(2)
    angle, length = (torch.rand(1, 1, side, side, dtype=torch.float64, generator=draw) for _ in range(2))
    anywhere = 2000 * length * torch.cat([torch.cos(2 * math.pi * angle), torch.sin(2 * math.pi * angle)], 1)
    yield Case(group, "up to 2000 px, anywhere", image, coc, anywhere)


def sizes(side: int) -> Iterator[Case]:
    """Pictures of one pixel, one row, one column, primes; none at all; one channel."""
    group = "size"
    for height, width in ((1, 1), (1, side), (side, 1), (2, 2), (3, 5), (31, 37)):
        yield Case(group, f"{height} x {width}", texture(height, width), slope(height, width, -3.0, 5.0))
    yield Case(group, f"5 x {8 * side}", texture(5, 8 * side), slope(5, 8 * side, 1.0, 30.0))
    yield Case(group, "batch of 0", texture(5, 6)[:0], even(5, 6, 3.0)[:0])
    yield Case(group, "one channel", texture(side, side, channels=1), slope(side, side, -3.0, 6.0))
    pair = torch.cat([texture(side, side), 1e6 * texture(side, side, seed=1)])
    coc = torch.cat([slope(side, side, 1.0, 5.0), slope(side, side, -5.0, 1.0)])
    yield Case(group, "dark beside bright in a batch", pair, coc)


def highlights(side: int, edge: int) -> Iterator[Case]:
    """A pixel of 1e6 over an even ground of 1, at two radii; and a square of such pixels, ``edge`` px wide."""
    (one,) = [case for case in dynamic_range(side) if case.name == "1e+06 beside grey"]
    for radius in (side / 64, side / 24):
        name = f"1e6 over 1, radius {radius:.1f} px"
        yield replace(one, group="highlight", name=name, coc=slope(side, side, 0.95 * radius, radius))
    side = edge + 140
    image = torch.ones(1, 3, side, side, dtype=torch.float64)
    image[..., :edge, :edge] = 1e6
    coc = slope(side, side, 4.5, 5.0)
    yield Case("highlight", f"{edge} x {edge} of 1e6 over 1", image, coc, bright=(0, 0), across=edge)


def beyond(case: Case, reach: float, *, mirrored: bool) -> Tensor:
    """Pixels ``(H, W)`` that are farther than ``reach`` px from the highlights of a case (and their mirror image)."""
    assert case.bright is not None
    away = [_away(n, start, case.across) for n, start in zip(case.image.shape[2:], case.bright, strict=True)]
    far = torch.hypot(away[0][:, None], away[1]) > reach
    return far & far.flip(1) if mirrored else far


def _away(size: int, start: int, across: int) -> Tensor:
    """How far each pixel of a line lies from those of a stretch of it."""
    at = torch.arange(size, dtype=torch.float64)
    return torch.maximum(start - at, at - (start + across - 1)).clamp_min(0)


def reach_of(coc: Tensor, motion: Tensor | None, ahead: float = 0.5) -> float:
    """How far in px PSFs reach; 3 px more than the disc or capsule of any pixel.

    Args:
        coc: their radii.
        motion: of them.
        ahead: how far they go along that, as a share of its length.
    """
    way = 0.0 if motion is None or not motion.numel() else float(motion.square().sum(1).sqrt().max())
    return float(coc.abs().max()) + ahead * way + 3.0 if coc.numel() else math.inf
