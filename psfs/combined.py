"""`Combined`: a disc in linear motion, in closed form (LKS table 1)."""

import math
from collections.abc import Iterator, Sequence
from itertools import product

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchbokeh.ops.capsules import splat_capsules
from torchbokeh.ops.checks import check_number
from torchbokeh.ops.composite import TINY
from torchbokeh.ops.spans import MIN_RADIUS
from torchbokeh.psfs.model import FRAME, Axis, Labels, Place, PsfModel, gaussian, mean_picture, scaled, turned

NODES = 5
"""Radii, and lengths, whose mean stands for a box of the grid."""

CELLS = 160
"""Boxes of the finest level along each axis."""

FINE = (3, 15)
"""Least and most samples along each side of a pixel of `turned_capsule`, odd."""

SHARING = 2 / 3
"""What sharing turned points among four pixels adds to the square of a radius: 4 times its mean variance, 1/6."""

STILL = (0.5, 1.5)
"""Lengths of a motion in px between which a disc passes into a sample of the bank."""

ROWS = (8, 32)
"""Least and most rows of the quadrature across a pixel; small discs need more."""

ALONG = 64
"""Discs that the support of a moving one is made up of, at most."""


def capsule(radius: float, length: float) -> NDArray[np.float64]:
    """A disc, spread along a segment of the x axis: the light of every pixel, ``(1, h, w)``, with a sum of 1.

    At height y the disc has a chord of half-width ``h = sqrt(r**2 - y**2)``. What reaches x is the overlap of that
    chord with the interval ``[x - l/2, x + l/2]``: a trapezoid, whose integral over the pixel is closed; the rows of a
    pixel are summed by Gauss quadrature between the ends of the disc.

    Args:
        radius: of the disc in px, >= 0. At 0 it is a line of no width.
        length: of the segment in px, >= 0.
    """
    half = length / 2
    # A disc below this radius lies within its pixel, and a line of no width would have no rows to sum.
    radius = max(radius, 1e-3)
    height, width = math.ceil(radius - 0.5), math.ceil(radius + half - 0.5)
    nodes, weights = np.polynomial.legendre.leggauss(int(np.clip(256 / radius, *ROWS)))
    rows = np.arange(height + 1)
    # In the angle of a point of the rim the chord is smooth up to the ends of the disc.
    low, high = (np.arcsin(np.clip(y / radius, -1.0, 1.0)) for y in (rows - 0.5, rows + 0.5))
    angle = (low + high)[:, None] / 2 + (high - low)[:, None] / 2 * nodes
    chord = np.asarray(radius * np.cos(angle), np.float64)
    share = (high - low)[:, None] / 2 * weights * chord
    edges = np.linspace(-0.5, width + 0.5, width + 2)
    sums = _running(edges[None, None], chord[..., None], half)
    quarter = np.maximum((share[:, None] @ np.diff(sums, axis=2))[:, 0], 0.0)
    half_plane = np.concatenate([quarter[:, :0:-1], quarter], 1)
    whole = np.concatenate([half_plane[:0:-1], half_plane])[None]
    whole[whole < 1e-12 * whole.max()] = 0.0  # what rounding left outside
    return whole / whole.sum()  # pi r**2, but for 1e-7 of the quadrature


def turned_capsule(
    radius: float, motion: tuple[float, float], advance: float = 0.0, limit: tuple[int, int] | None = None
) -> NDArray[np.float64]:
    """A disc, spread along a displacement in any direction, by samples in each pixel: ``(h, w)``, with a sum of 1.

    Args:
        radius: of the disc in px, >= 0; below half a pixel it is half a pixel.
        motion: (dx, dy) in px.
        advance: by which part of the motion its middle lies ahead of the middle of the picture.
        limit: how far along x and y it is drawn at most; the sum is that of what is drawn.
    """
    radius = max(radius, MIN_RADIUS)
    half = math.hypot(*motion) / 2
    cos, sin = (motion[0] / (2 * half), motion[1] / (2 * half)) if half > 0 else (1.0, 0.0)
    reach = [math.ceil(radius + (0.5 + abs(advance)) * abs(d)) + 1 for d in motion]
    if limit is not None:
        reach = [min(r, most) for r, most in zip(reach, limit, strict=True)]
    fine = int(np.clip(24 / radius, *FINE)) | 1
    steps = (np.arange(fine) - fine // 2) / fine
    pixels = np.zeros((2 * reach[1] + 1, 2 * reach[0] + 1))
    for row, line in enumerate(pixels):
        v = row - reach[1] - advance * motion[1]
        # A long way crosses few pixels of a row.
        width = (radius + 1) / max(abs(sin), 1e-9)
        middle = advance * motion[0] + v * cos / (sin or 1e-9) + reach[0]
        first, last = (int(np.clip(end, 0, len(line))) for end in (middle - width - 1, middle + width + 2))
        x = (np.arange(first, last)[:, None] + steps).ravel() - reach[0] - advance * motion[0]
        y = v + steps[:, None]
        along, across = x * cos + y * sin, y * cos - x * sin
        chord = np.sqrt(np.maximum(radius**2 - across**2, 0.0))
        if half < 1e-3:
            light = ((np.abs(along) <= chord) & (chord > 0)).astype(np.float64)
        else:
            light = np.maximum(np.minimum(along + half, chord) - np.maximum(along - half, -chord), 0.0)
        line[first:last] = light.reshape(fine, -1, fine).sum((0, 2))
    return pixels / max(pixels.sum(), np.finfo(np.float64).tiny)


def _running(x: NDArray[np.float64], chord: NDArray[np.float64], half: float) -> NDArray[np.float64]:
    """Integral over x, from the centre on, of the overlap of a chord with a segment about x, per length of it."""
    if half < 1e-3:  # the ramps would cancel; what is left out is of the order of half squared
        return np.clip(x, -chord, chord)
    # The overlap is a second difference of ramps: |x + a| with a = +-(chord + half), +-(chord - half).
    outer, inner = chord + half, chord - half

    def ramp(u: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.abs(u) * u / 2

    return (ramp(x + outer) + ramp(x - outer) - ramp(x + inner) - ramp(x - inner)) / (4 * half)


class Combined(PsfModel):
    """Defocus and linear motion in one PSF: a disc along a segment, turned to the motion of its pixel.

    Coordinates are the CoC radius beyond half a pixel, below which a disc lies within its pixel, and the length of the
    motion over the open shutter, both in px. The PSF is that of a shutter whose middle is the moment of the picture.
    Longer motion is put together from segments, and larger discs are scaled from the largest.

    Args:
        radius: largest radius that is sampled.
        length: longest motion that is sampled. Both are at least 1, and the PSF of both fits into `FRAME`.

    Raises:
        TypeError: not a number.
        ValueError: out of its range.

    Example:
        >>> model = Combined()
        >>> psf = model.dense((4.5, 20.0))
        >>> psf.shape, psf.sum().round(6).item()
        ((1, 11, 31), 1.0)
    """

    name = "combined"
    symmetry = "quadrants"
    turns = True

    def __init__(self, radius: float = 100.0, length: float = 256.0) -> None:
        radius = check_number("radius", radius, 1, FRAME / 2 - 1)
        length = check_number("length", length, 1, FRAME - 2 * radius)
        self.axes = (
            Axis("radius", "px", radius - MIN_RADIUS, 2.0, CELLS),
            Axis("motion length", "px", length, 1.0, CELLS),
        )

    def settings(self) -> dict[str, float | int | str]:
        """The largest radius and length."""
        return {"radius": self.axes[0].bound + MIN_RADIUS, "length": self.axes[1].bound}

    def dense(self, coordinates: Sequence[float]) -> NDArray[np.float64]:
        """`capsule` of a radius and a length."""
        radius, length = coordinates
        return capsule(radius + MIN_RADIUS, length)

    def extent(self, coordinates: Tensor) -> Tensor:
        """Four times the standard deviation of the PSF along the motion: without motion, twice the radius."""
        radius, length = (coordinates[..., 0] + MIN_RADIUS), coordinates[..., 1]
        return (4 * radius.square() + 4 / 3 * length.square()).sqrt()

    def prefiltered(self, low: Sequence[float], high: Sequence[float]) -> NDArray[np.float64]:
        """The mean over a box, of PSFs that are scaled to the extent of its middle: as renderers scale the sample."""
        corners = torch.tensor([low, high], dtype=torch.float64)
        middle = float(self.extent(self.grid.unmap(self.grid.remap(corners).mean(0))))
        pictures, shares = [], []
        for (radius, a), (length, b) in product(*(gaussian(x, y, NODES) for x, y in zip(low, high, strict=True))):
            factor = middle / float(self.extent(torch.tensor([radius, length], dtype=torch.float64)))
            pictures.append(capsule((radius + MIN_RADIUS) * factor, length * factor))
            shares.append(a * b)
        return mean_picture(pictures, shares)

    def place(self, labels: Labels) -> Place:
        """Radius (less `SHARING`), length and rotation of every pixel; needs ``coc`` and ``motion``."""
        if labels.coc is None or labels.motion is None:
            raise ValueError(
                f"{self.name}: expected coc and motion, got no " + ("coc" if labels.coc is None else "motion")
            )
        length = labels.motion.square().sum(1, keepdim=True).clamp_min(1e-12).sqrt()
        oblique = labels.motion.abs().amin(1, keepdim=True).clamp(max=1)  # along an axis, rows fall on rows
        radius = (labels.coc.square() - SHARING * oblique).clamp_min(MIN_RADIUS**2).sqrt()
        return of_radius(self, radius, length, frame=turned(labels.motion))

    def still(self, labels: Labels) -> Tensor | None:
        """What does not move is a disc; between the lengths of `STILL`, it is partly one."""
        if labels.coc is None or labels.motion is None:
            return None
        start, stop = STILL
        share = torch.ones_like(labels.motion[:, :1])
        for way in (labels.motion, labels.offset):  # the discs have no offset
            if way is not None:
                length = way.square().sum(1, keepdim=True).clamp_min(1e-12).sqrt()
                share = share * ((stop - length) / (stop - start)).clamp(0, 1)
        return share

    def places(self, labels: Labels, size: int = 1) -> list[Place]:
        """One PSF, or several in a row where the motion is longer than what is sampled."""
        if labels.coc is None or labels.motion is None:
            return [self.place(labels)]
        coc, motion = labels.coc / size, labels.motion / size
        length = _length(motion.detach())
        longest = self.axes[1].bound * (coc.detach().abs() / (self.axes[0].bound + MIN_RADIUS)).clamp_min(1.0)
        count = (length / longest).ceil().clamp_min(1.0)
        most = int(count.max()) if count.numel() else 1
        piece = self.place(Labels(coc=coc, motion=motion / count))
        if most == 1:
            return [piece]
        found = []
        for number in range(most):
            step = (number + 0.5) / count - 0.5
            found.append(piece._replace(offset=step * motion, share=(number < count) / count))
        return found

    def area(self, parts: Sequence[Labels], reach: Tensor) -> Tensor:
        """That of a capsule of the mean radius and length."""
        radius = torch.stack([part.required_coc().abs().clamp_min(MIN_RADIUS) for part in parts]).mean(0)
        length = torch.stack([_length(_path(part)[0]) for part in parts]).sum(0)
        return radius * (math.pi * radius + 2 * length) / len(parts)

    def support(self, labels: Labels, reach: Tensor, pixels: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
        """Discs along the motion, about as far apart as they are wide."""
        radius = labels.required_coc().abs().float()
        motion, offset = (t.float() for t in _path(labels))
        length = _length(motion)
        count = min(1 + math.ceil(float((length / radius.clamp_min(1.0))[pixels].max())), ALONG)
        step = length / max(count - 1, 1)
        cover = (radius.square() + step.square() / 4).sqrt() + 1
        for k in range(count):
            yield offset + (k / max(count - 1, 1) - 0.5) * motion, cover

    def splat_exactly(self, values: Tensor, labels: Labels, pixels: Tensor) -> Tensor:
        """Each capsule in closed form."""
        maps = (labels.required_coc(), *_path(labels))
        coc, motion, offset = (t.movedim(1, -1).flatten(0, 2)[pixels] for t in maps)
        return splat_capsules(values, pixels, coc[:, 0].abs(), motion, offset)

    def needs_clipping(self, parts: Sequence[Labels], size: tuple[int, int]) -> bool:
        """Where a motion or a disc is longer than the diagonal, so that its buffer would be as large as it."""
        maps = [t for part in parts for t in (part.required_coc(), part.motion, part.offset) if t is not None]
        return bool(torch.stack([t.detach().square().sum(1).max() for t in maps]).amax().sqrt() > math.hypot(*size))

    def clipped(self, values: Tensor, labels: Labels, size: int) -> tuple[Tensor, Labels]:
        """Motions and discs that are no larger than the picture asks for.

        A disc that moves evenly is a mean of discs over time. Those that do not reach the picture add nothing: what is
        left is a shorter motion, with as much less light. A disc that covers all of the picture all the time has the
        same density everywhere, the reciprocal of its area: a smaller one that stands still stands for it, with as much
        less light.
        """
        coc, (motion, offset) = labels.required_coc(), _path(labels)
        height, width = (n * size for n in values.shape[2:])
        rows, columns = ((torch.arange(n, device=coc.device) + 0.5) * size - 0.5 for n in values.shape[2:])
        radius, length = coc.abs(), _length(motion.detach())
        diagonal = math.hypot(height, width) + size
        wide = radius > diagonal + length / 2 + _length(offset.detach())
        # Samples of the bank fade towards their ends, so these are to lie well beyond the picture.
        room = radius + max(height, width) / 4 + 2 * size
        first, last = torch.full_like(radius, -0.5), torch.full_like(radius, 0.5)
        for axis, (place, extent) in enumerate(((columns, width), (rows[:, None], height))):
            start, speed = place + offset[:, axis : axis + 1], motion[:, axis : axis + 1]
            speed = torch.where(speed.abs() < TINY, TINY, speed)
            ends = (-0.5 - room - start) / speed, (extent - 0.5 + room - start) / speed
            first, last = first.maximum(torch.minimum(*ends)), last.minimum(torch.maximum(*ends))
        share, middle = (last - first).clamp_min(0), (first + last) / 2
        uncut = (length <= diagonal + 2 * room) & (share > 0)
        share, middle = torch.where(uncut, 1.0, share), torch.where(uncut, 0.0, middle)
        there = (share > 0) & ~wide
        light = torch.where(wide, (diagonal / radius.clamp_min(1.0)).square(), share)
        motion, offset = (torch.where(there, t, 0.0) for t in (share * motion, offset + middle * motion))
        coc = torch.where(there, coc, torch.where(wide, diagonal, 0.0))
        return values * light, labels._replace(coc=coc, motion=motion, offset=offset)


def _path(labels: Labels) -> tuple[Tensor, Tensor]:
    """Motion and offset of labels, ``(B, 2, H, W)``: 0 where they have none."""
    still = torch.zeros_like(labels.required_coc()).expand(-1, 2, -1, -1)
    return still if labels.motion is None else labels.motion, still if labels.offset is None else labels.offset


def _length(way: Tensor) -> Tensor:
    """``(B, 2, H, W) -> (B, 1, H, W)``."""
    return way.square().sum(1, keepdim=True).sqrt()


def of_radius(model: PsfModel, radius: Tensor, *lengths: Tensor, frame: Tensor | None = None) -> Place:
    """The place of a radius and other lengths, in px; a radius beyond the largest is reached by scaling the PSF."""
    scale = (radius.detach() / (model.axes[0].bound + MIN_RADIUS)).clamp_min(1.0)
    first = (radius / scale - MIN_RADIUS).clamp_min(0.0)
    place = Place(torch.cat([first, *(t / scale for t in lengths)], 1), frame)
    return scaled(place, scale) if bool((scale > 1).any()) else place
