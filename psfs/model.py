"""What a model of point-spread functions is: a space of coordinates, a dense PSF for each, and its symmetry."""

import math
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import ClassVar, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchbokeh.psfs.grid import NestedGrid

Symmetry = Literal["none", "mirror", "quadrants", "octants"]
"""Which reflections leave every PSF of a model as it is: none; y; x and y; x, y and the diagonal."""

FRAME = 513
"""Side of the picture in px that every dense PSF fits into, its centre being the middle pixel. LKS: 512."""

PREFILTER_NODES = 3
"""Nodes of the quadrature over a cell, along each coordinate."""


@dataclass(frozen=True)
class Axis:
    """One coordinate of a model.

    Attributes:
        name: such as ``"radius"``.
        unit: such as ``"px"``.
        bound: its largest value; the smallest is 0.
        beta: exponent of the power remapping, see `NestedGrid`.
        cells: how finely it is sampled, see `NestedGrid`.
    """

    name: str
    unit: str
    bound: float
    beta: float
    cells: int


class Labels(NamedTuple):
    """What a renderer knows of each pixel. Maps that it does not have are None.

    Attributes:
        coc: ``(B, 1, H, W)`` signed CoC radius in px.
        depth: ``(B, 1, H, W)`` metres along the optical axis.
        motion: ``(B, 2, H, W)`` displacement (dx, dy) in px over the open shutter.
        offset: ``(B, 2, H, W)`` of the centre of the PSF from the pixel, (dx, dy) in px. Models do not look at it.
        field: ``(B, 2, H, W)``, see `field_of`; None where the maps are those of the whole picture.
    """

    coc: Tensor | None = None
    depth: Tensor | None = None
    motion: Tensor | None = None
    offset: Tensor | None = None
    field: Tensor | None = None

    def required_coc(self) -> Tensor:
        """The CoC of labels that must have one.

        Raises:
            ValueError: they have none.
        """
        if self.coc is None:
            raise ValueError("labels.coc: expected one, since pixels are merged by it, got none")
        return self.coc


def field_of(like: Tensor) -> Tensor:
    """Where in a picture ``(B, ..., H, W)`` its pixels are: x and y from its middle over half its longer side."""
    height, width = like.shape[-2:]
    x, y = (torch.arange(n, dtype=like.dtype, device=like.device) - (n - 1) / 2 for n in (width, height))
    place = torch.stack(torch.broadcast_tensors(x, y[:, None])) * (2 / max(height, width))
    return place.expand(len(like), -1, -1, -1)


class Place(NamedTuple):
    """Which PSF of a model each pixel takes, and where it goes.

    Attributes:
        coordinates: ``(B, n, H, W)``.
        frame: ``(B, 2, 2, H, W)``: the matrix that takes offsets of the PSF to offsets in the picture, a rotation
            times a scale; None where that is the identity everywhere.
        scale: ``(B, 1, H, W)`` of ``frame``; None where it is 1 everywhere.
        offset: ``(B, 2, H, W)`` of the centre of the PSF from the pixel, (dx, dy) in px; None where it is 0 everywhere.
        share: ``(B, 1, H, W)`` of the pixel's light that this PSF gets; None where it is all of it.
    """

    coordinates: Tensor
    frame: Tensor | None = None
    scale: Tensor | None = None
    offset: Tensor | None = None
    share: Tensor | None = None


class PsfModel(ABC):
    """Base class of PSF models: to add one, write `dense` and `place`, and what describes it.

    Attributes:
        name: of the model, in files and tables.
        axes: its coordinates.
        channels: 1, or 3 where the PSF is coloured.
        symmetry: of every dense PSF.
        turns: whether a renderer turns the PSF, so that only rotation-invariant domains will do.
        merges: whether the PSF is smooth over a part of the CoC radius, so that pixels may be merged by that radius.
        fields: whether the PSF depends on the place in the picture.
        tints: whether channels of the PSF do not sum to 1 and are meant not to: white then comes out coloured.
        similarity: what a bank of it is built to, see `torchbokeh.psfs.represent.Target`.
    """

    name: ClassVar[str]
    axes: tuple[Axis, ...]
    channels: ClassVar[Literal[1, 3]] = 1
    symmetry: ClassVar[Symmetry] = "none"
    turns: ClassVar[bool] = False
    merges: ClassVar[bool] = True
    fields: ClassVar[bool] = False
    tints: ClassVar[bool] = False
    similarity: ClassVar[float] = 0.97

    @cached_property
    def grid(self) -> NestedGrid:
        """Where the samples stand."""
        return NestedGrid([a.bound for a in self.axes], [a.beta for a in self.axes], [a.cells for a in self.axes])

    @abstractmethod
    def dense(self, coordinates: Sequence[float]) -> NDArray[np.float64]:
        """The PSF at a coordinate: ``(channels, h, w)``, odd sizes of at most `FRAME`, centred, >= 0.

        The light of each pixel, so that a channel sums to what arrives of it: 1 where nothing is lost.
        """

    @abstractmethod
    def place(self, labels: Labels) -> Place:
        """Which PSF each pixel of a picture takes. Differentiable to the labels.

        Raises:
            ValueError: a map that the model needs is None.
        """

    def places(self, labels: Labels, size: int = 1) -> list[Place]:
        """The PSFs of each pixel of a picture whose pixels are blocks of ``size`` px; their sum is what it spreads.

        The labels are in px. In blocks, the PSF is the same seen from farther away; models whose coordinates are
        lengths take another sample instead.
        """
        place = self.place(labels)
        return [place if size == 1 else scaled(place, 1 / size)]

    def still(self, labels: Labels) -> Tensor | None:
        """Share ``(B, 1, H, W)`` of each pixel's light that spreads over a plain disc; None where that is none of it.

        Discs are splatted by rows, in closed form; the samples of the bank get the rest.
        """
        return None

    def extent(self, coordinates: Tensor) -> Tensor | None:
        """How large the PSFs at coordinates ``(..., n)`` are, ``(...)`` > 0, where the nearest sample is to be scaled.

        A sample that stands for another coordinate is then drawn larger or smaller by the ratio of their extents, so
        that only its shape is the nearest there is. None: samples are drawn as they are.
        """
        return None

    def area(self, parts: Sequence[Labels], reach: Tensor) -> Tensor:
        """About how many pixels ``(B, 1, H, W)`` the light of each is spread over, the mean of parts of an exposure.

        ``reach (K,)`` is that of the samples in px, see `torchbokeh.psfs.bank.PsfBank.reach`.
        """
        found = [(place, self._reach(place, reach)) for part in parts for place in self.places(part)]
        return torch.stack([(r * (1.0 if p.scale is None else p.scale)).square() for p, r in found]).mean(0)

    def support(self, labels: Labels, reach: Tensor, pixels: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
        """Discs that hold the PSFs of the ``pixels (B, 1, H, W)`` that are True; for ``reach`` see `area`.

        Each is the offset ``(B, 2, H, W)`` of its centre from the pixel and its radius ``(B, 1, H, W)``, in px.
        """
        for place in self.places(labels):
            radius = math.sqrt(2) * self._reach(place, reach) * (1.0 if place.scale is None else place.scale)
            shift = 0.0 if place.offset is None else place.offset.square().sum(1, keepdim=True).sqrt()
            yield torch.zeros_like(radius).expand(-1, 2, -1, -1), radius + shift + 1

    def _reach(self, place: Place, reach: Tensor) -> Tensor:
        return reach[self.grid.index(place.coordinates.movedim(1, -1))][:, None]

    def splat_exactly(self, values: Tensor, labels: Labels, pixels: Tensor) -> Tensor | None:
        """What a few bright pixels spread, ``(B, C, H, W)``, in closed form; None: their samples are drawn densely.

        ``pixels (N,)`` are flat indices into ``(B, H, W)``.
        """
        return None

    def needs_clipping(self, parts: Sequence[Labels], size: tuple[int, int]) -> bool:
        """Whether PSFs are so much larger than a picture of ``(H, W)`` px that they are to be `clipped`."""
        return False

    def clipped(self, values: Tensor, labels: Labels, size: int) -> tuple[Tensor, Labels]:
        """The same picture ``(B, C, h, w)``, in blocks of ``size`` px, by PSFs no larger than it asks for."""
        return values, labels

    def settings(self) -> dict[str, float | int | str]:
        """What `torchbokeh.psfs.models.model_from` needs to build the model again; it stands in the file of a bank."""
        return {}

    def prefiltered(self, low: Sequence[float], high: Sequence[float]) -> NDArray[np.float64]:
        """The mean of `dense` over a box of coordinates (LKS section 5.4), with a Gaussian as its weight.

        The Gaussian has a standard deviation of a quarter of the box.
        """
        rules = [gaussian(a, b, PREFILTER_NODES) for a, b in zip(low, high, strict=True)]
        chosen = list(product(*rules))
        pictures = [self.dense([x for x, _ in place]) for place in chosen]
        return mean_picture(pictures, [math.prod(share for _, share in place) for place in chosen])


def gaussian(low: float, high: float, count: int) -> list[tuple[float, float]]:
    """Nodes and weights of the mean over an interval, weighted by a Gaussian of a quarter of its width."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    weights = weights * np.exp(-2 * nodes**2)
    return list(zip((low + high) / 2 + (high - low) / 2 * nodes, weights / weights.sum(), strict=True))


def scaled(place: Place, factor: float | Tensor) -> Place:
    """The same PSFs, larger by a factor, a number or ``(B, 1, H, W)``."""
    scale = torch.ones_like(place.coordinates[:, :1]) if place.scale is None else place.scale
    frame = place.frame
    if frame is None:
        one = torch.eye(2, dtype=scale.dtype, device=scale.device)[None, :, :, None, None]
        frame = one.expand(len(scale), 2, 2, *scale.shape[2:])
    wide = factor[:, None] if isinstance(factor, Tensor) else factor
    offset = None if place.offset is None else place.offset * factor
    return Place(place.coordinates, frame * wide, scale * factor, offset, place.share)


def mean_picture(pictures: Sequence[NDArray[np.float64]], shares: Sequence[float]) -> NDArray[np.float64]:
    """Weighted sum of centred pictures ``(C, h, w)`` of different odd sizes."""
    height, width = (max(p.shape[axis] for p in pictures) for axis in (1, 2))
    out = np.zeros((pictures[0].shape[0], height, width))
    for picture, share in zip(pictures, shares, strict=True):
        y, x = (height - picture.shape[1]) // 2, (width - picture.shape[2]) // 2
        out[:, y : y + picture.shape[1], x : x + picture.shape[2]] += share * picture
    return out


def turned(motion: Tensor) -> Tensor:
    """Rotations ``(B, 2, 2, H, W)`` that take the x axis to the direction of ``motion (B, 2, H, W)``, if it has one."""
    length = motion.square().sum(1, keepdim=True).clamp_min(1e-12).sqrt()
    still = length < 1e-5
    ahead = motion.new_tensor([1.0, 0.0])[:, None, None]
    x, y = torch.where(still, ahead, motion / length).unbind(1)
    return torch.stack([torch.stack([x, -y], 1), torch.stack([y, x], 1)], 1)
