"""Where the samples of a space of PSFs stand: power remapping and the nested grid (LKS section 5.2).

A coordinate of a PSF model runs from 0 up to a bound, and small ones need more samples than large ones. Two things see
to that. The *power remapping* ``u = N (s / bound) ** (1 / beta)`` takes it to ``[0, N]``: with ``beta`` above 1, small
coordinates are spread. (LKS writes ``s ** beta``, which would crowd them; the text says they get the higher
resolution.) The *nested grid* then covers ``[0, N_1] x [0, N_2] x ...`` with boxes whose edges grow with the smallest
of the coordinates: level l = 0, 1, 2, ... begins where that reaches the triangular number ``l (l+1) / 2``, and its
boxes have edges of ``l + 1``, or what is left of them at the upper border. In one dimension that is one box per level.
"""

import math
from collections.abc import Sequence
from itertools import accumulate, count, product, takewhile

import torch
from torch import Tensor

LARGEST = 1 << 24
"""Units of a grid, at most: there is a table of them."""


class NestedGrid:
    """Boxes that cover a space of PSF coordinates, found in constant time.

    Args:
        bounds: upper bound of every coordinate; the lower one is 0.
        betas: exponents of the power remapping; above 1, small coordinates are sampled more finely.
        cells: ``N`` of every coordinate: how many boxes of level 0 lie side by side.

    Raises:
        ValueError: the numbers of entries differ, or an entry is not above 0.

    Example:
        >>> grid = NestedGrid((1.0, 1.0), (1.0, 1.0), (9, 9))
        >>> len(grid)
        28
        >>> grid.box(27)
        ((0.6666666666666666, 0.6666666666666666), (1.0, 1.0))
        >>> grid.index(torch.tensor([[0.5, 0.99], [0.0, 0.0]]))
        tensor([25,  0])
    """

    def __init__(self, bounds: Sequence[float], betas: Sequence[float], cells: Sequence[int]) -> None:
        for name, given in (("betas", betas), ("cells", cells)):
            if len(given) != len(bounds):
                raise ValueError(f"{name}: expected {len(bounds)} entries like bounds, got {len(given)}")
        for name, given in (("bounds", bounds), ("betas", betas), ("cells", cells)):
            if not given or not all(0 < value < math.inf for value in given):
                raise ValueError(f"{name}: expected finite numbers above 0, got {tuple(given)}")
        if any(n != int(n) for n in cells):
            raise ValueError(f"cells: expected whole numbers, got {tuple(cells)}")
        if math.prod(cells) > LARGEST:
            raise ValueError(f"cells: expected a product of at most {LARGEST}, got {math.prod(cells)}")
        self.bounds = tuple(float(b) for b in bounds)
        self.betas = tuple(float(b) for b in betas)
        self.cells = tuple(int(n) for n in cells)
        boxes = self.boxes()
        with torch.inference_mode(False):  # what is kept may be asked for gradients later
            self._corners = torch.tensor(boxes, dtype=torch.float64)
            self._table = torch.empty(self.cells, dtype=torch.int64)
            for number, corners in enumerate(boxes):
                self._table[tuple(map(slice, *corners))] = number

    def __len__(self) -> int:
        """The number of boxes."""
        return len(self._corners)

    def remap(self, coordinates: Tensor) -> Tensor:
        """Coordinates ``(..., n)`` to grid units ``[0, N]``; what lies outside the bounds goes to their border."""
        given = coordinates.to(torch.promote_types(coordinates.dtype, torch.float32))
        bounds, betas, cells = (given.new_tensor(values) for values in (self.bounds, self.betas, self.cells))
        share = (given / bounds).clamp(0, 1)
        above = share > 0  # at 0, where all sharp pixels are, the slope of a root is infinite
        return torch.where(above, torch.where(above, share, 1.0) ** betas.reciprocal(), 0.0) * cells

    def unmap(self, place: Tensor) -> Tensor:
        """The inverse of `remap`, within the bounds."""
        place = place.double()
        bounds, betas, cells = (place.new_tensor(values) for values in (self.bounds, self.betas, self.cells))
        return (place / cells) ** betas * bounds

    def index(self, coordinates: Tensor) -> Tensor:
        """The number ``(...)`` of the box that holds coordinates ``(..., n)``, int64: the forward mapping g of LKS."""
        if coordinates.shape[-1:] != (len(self.bounds),):
            raise ValueError(f"coordinates: expected shape (..., {len(self.bounds)}), got {tuple(coordinates.shape)}")
        return self._at(self.remap(coordinates))

    def _at(self, place: Tensor) -> Tensor:
        """The box that holds a place ``(..., n)`` in grid units: corners of boxes are whole, so that a table tells."""
        top = torch.tensor(self.cells, device=place.device) - 1
        inside = torch.minimum(place.clamp_min(0).long(), top)
        return self._table.to(place.device)[inside.unbind(-1)]

    def neighbours(self, coordinates: Tensor) -> list[tuple[Tensor, Tensor]]:
        """The ``2**n`` boxes that linear interpolation takes, with their shares.

        Along each axis, the other box is the one across the nearer face, and the share of both follows from the
        distance of their middles. Shares are differentiable to the coordinates, sum to 1, and within a level change
        without a jump; where boxes of different levels meet they need not.

        Args:
            coordinates: ``(..., n)``.

        Returns:
            Pairs of numbers ``(...)`` and shares ``(...)``, float64.
        """
        # The largest place that lies within the grid.
        edge = torch.tensor(self.cells, dtype=torch.float64, device=coordinates.device) * (1 - 2.0**-52)
        place = torch.minimum(self.remap(coordinates).double(), edge)
        own = self._at(place.detach())
        corners = self._corners.to(coordinates.device)
        low, high = corners[own].unbind(-2)
        middle, half = (low + high) / 2, (high - low) / 2
        inside = place.detach()
        forward = torch.where(inside >= middle, 1.0, -1.0)
        beyond = torch.where(forward > 0, high, low - 1e-9)
        there = (beyond >= 0) & (beyond <= edge)
        shares = []
        for axis in range(len(self.cells)):
            step = inside.clone()
            step[..., axis] = beyond[..., axis].clamp(min=0)
            other = corners[self._at(torch.minimum(step, edge))][..., axis]
            gap = half[..., axis] + (other[..., 1] - other[..., 0]) / 2
            far = (place[..., axis] - middle[..., axis]).abs() / gap
            shares.append(torch.where(there[..., axis], far, 0.0))
        across = torch.where(there, beyond, inside)
        found = []
        for picked in product((False, True), repeat=len(self.cells)):
            weight = torch.ones_like(place[..., 0])
            for taken, share in zip(picked, shares, strict=True):
                weight = weight * (share if taken else 1 - share)
            step = torch.where(torch.tensor(picked, device=place.device), across, inside)
            found.append((self._at(step), weight))
        return found

    def boxes(self) -> list[tuple[tuple[int, ...], tuple[int, ...]]]:
        """Lower and upper corner of every box in grid units, in order: the list that LKS stores."""
        found = []
        axes = range(len(self.cells))
        for level, start in enumerate(takewhile(lambda start: start < min(self.cells), accumulate(count()))):
            edge = level + 1
            counts = [-(-(n - start) // edge) for n in self.cells]
            # Boxes of a level have an index of 0 along some axis: first those that have it along axis 0, all others
            # being free; then those that have not, but along axis 1; and so on.
            for axis in axes:
                ranges = [range(other < axis, counts[other]) if other != axis else range(1) for other in axes]
                for place in product(*ranges):
                    low = tuple(start + edge * k for k in place)
                    high = tuple(min(a + edge, n) for a, n in zip(low, self.cells, strict=True))
                    found.append((low, high))
        return found

    def box(self, number: int) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Lower and upper corner of a box in coordinates: the backward mapping of LKS."""
        if not 0 <= number < len(self):
            raise ValueError(f"number: expected 0 to {len(self) - 1}, got {number}")
        low, high = self.unmap(self._corners[number]).tolist()
        return tuple(low), tuple(high)

    def centres(self) -> Tensor:
        """The middle ``(K, n)`` of every box, taken in grid units, as coordinates."""
        return self.unmap(self._corners.mean(1))
