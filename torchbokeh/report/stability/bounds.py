"""What rounding and approximation may do: bounds that every stiff case is held to.

Those of rounding are derived from the arithmetic. `TIES`, `GRAZING`, `far_leak` and the errors of qualities
are stated, not derived: they say what they were taken from, and rows held to one are marked.

``u`` is the unit round-off of the dtype in which pictures are held while they are worked on, ``u64`` that of double.
Weights, ends of rows and running sums are double in float32 as well, so errors of the sums count with ``u64``.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torchbokeh.ops.composite import TINY
from torchbokeh.ops.dense import dense_spans
from torchbokeh.ops.merge import EVEN, STEPS
from torchbokeh.psfs.aperture import Disc
from torchbokeh.report.internals import BRIGHT, FOREGROUND, QUALITIES, STEPS_OF_VIEWS
from torchbokeh.report.stability.cases import Case
from torchbokeh.report.stability.renderers import Renderer

U64 = torch.finfo(torch.float64).eps / 2

STORED = 4
"""Roundings between the sums in double and the result: of the sum, of the coverage, of their quotient and of what is
multiplied by it."""

ARC = 1e-11
"""Of a pixel's light: what the polynomial of the semicircle in the float32 kernels is off (6e-12 of pi / 2)."""

DENORMAL = 8
"""Steps of the smallest number that a result may be off where it is not a normal number any more: one for each of the
`STORED` roundings, divided by a coverage of at least 1/2."""

OPERATIONS = 64
"""Roundings that the weight of a surface goes through in a composition: hats of bins (2), their coverage (2), filling
(3), density and share (4), votes (4) and their sums over 3 x 3 sub-apertures (18), the quotient and the mean (3): 36;
filled colours come from as many as log2 of the size levels of two operations each."""

GREEN = 1.3
"""Largest value of the lattice's Green's function over buffers of up to 2000 px: (log r + 1.616) / (2 pi)."""

POINTS = 8.0
"""Largest sum of magnitudes of the points of a sparse PSF: the Laplacian of a single pixel, 4 + 4 * 1."""

GRAZING = 1 / 20
"""Of the contrast of a picture, where sub-samples cast rays through the depth of a view. Stated, not derived.

A surface ends half a pixel from the middle of its last one. A ray that just grazes that end may meet it or not, and
then sees something else: one of the four rays of a pixel and itself, in a quarter of the views.
"""

STEP = EVEN / STEPS
"""The largest step from one rounded radius to the next, in proportion to the radius."""

TIES = 8 * STEP
"""Of the contrast of a picture, where radii are averaged and then rounded to steps. Stated, not derived.

A radius that lies on the border of a step may be rounded to the other side in another precision. That moves ``4 STEP``
of the light of its pixel; of what another pixel receives, several such pixels together could do as much again.
"""


@dataclass(frozen=True)
class Precision:
    """A dtype as users meet it.

    Attributes:
        name: for tables.
        dtype: of all inputs.
        autocast: dtype of ``torch.autocast`` around the call; None for none.
    """

    name: str
    dtype: torch.dtype
    autocast: torch.dtype | None = None

    @property
    def work(self) -> float:
        """Unit round-off while working: half precision is computed in float32."""
        return U64 if self.dtype == torch.float64 else torch.finfo(torch.float32).eps / 2

    @property
    def store(self) -> float:
        """Of the result: half a unit in the last place of the input's dtype, where that is less than float32."""
        return torch.finfo(self.dtype).eps / 2 if self.dtype.itemsize < 4 else 0.0

    @property
    def least(self) -> float:
        """The smallest number above 0 that the result may hold."""
        info = torch.finfo(self.dtype)
        return info.smallest_normal * info.eps


PRECISIONS = (
    Precision("float64", torch.float64),
    Precision("float32", torch.float32),
    Precision("bfloat16", torch.bfloat16),
    Precision("float16", torch.float16),
    Precision("float32, autocast to bfloat16", torch.float32, torch.bfloat16),
    Precision("float32, autocast to float16", torch.float32, torch.float16),
)


def rounding(renderer: Renderer, case: Case, want: Tensor, image: Tensor, coc: Tensor, precision: Precision) -> Tensor:
    """Largest error of each pixel against the renderer itself in double, of the shape of ``want``.

    Args:
        renderer: of the picture.
        case: what it was asked.
        want: its result in double, for the rounded inputs.
        image: the inputs, rounded to the precision, in double.
        coc: likewise.
        precision: in which they were given.
    """
    # Whether the radii are the least or the largest: one has the largest weights, the other the least coverage.
    absolute = torch.stack([_absolute(renderer, case, image, radii, precision) for radii in renderer.widths(coc)])
    rounded = (STORED * precision.work + precision.store) * want.abs()
    contrast = image.amax((1, 2, 3), True) - image.amin((1, 2, 3), True)
    if renderer.kind == "rays":
        rounded = rounded + GRAZING * contrast
    if renderer.layered:
        # The layers of a case are made in its precision: alpha, colour times alpha, and what is behind are rounded.
        rounded = rounded + 3 * precision.store * image.abs().amax((1, 2, 3), keepdim=True)
    if renderer.merges:
        rounded = rounded + TIES * contrast
    return (rounded + absolute.amax(0) + DENORMAL * precision.least).expand_as(want)


def _absolute(renderer: Renderer, case: Case, image: Tensor, coc: Tensor, precision: Precision) -> Tensor:
    """What does not shrink with the result, by the kind of a renderer.

    A composition is a mean of colours whose weights are off by `OPERATIONS` roundings. What hides something leaves
    ``1 - stopped`` of it, whose error is absolute: so the error is that of the brightest light behind, and not of the
    result. Votes are counted from a density of 1/4 on.
    """
    splat = _splat(image, coc, precision)
    if renderer.kind in ("splat", "merged"):
        return splat
    composed = 4 * OPERATIONS * precision.work + _places(renderer, case, coc, precision)
    absolute = composed * image.abs().amax((1, 2, 3), keepdim=True) + splat.amax()
    return absolute + _laplacian(image, coc, precision) if renderer.kind == "bank" else absolute


def _splat(image: Tensor, coc: Tensor, precision: Precision) -> Tensor:
    """Absolute error of a normalised splat ``(B, 1, H, W)``.

    A row of the picture receives at most two ends, each shared by two columns, of every source pixel:
    ``n = 4 H W`` additions of at most ``|v| w`` each, with w the largest weight of a row, ``1 / (pi r)`` per px of its
    height or 1 for a radius below 1/2. The running sum takes as many again, and the FFT of a uniform blur, whose error
    is ``log2(n) u64 |v|_2 |w|_2``, stays below that. Divided by the coverage.
    """
    height, width = image.shape[2:]
    weight = float((1 / (math.pi * coc.abs())).clamp(max=1.0).max())
    brightest = image.abs().amax((1, 2, 3), keepdim=True)
    summed = 8 * height * width * U64 * weight * brightest
    arc = 0.0 if precision.dtype == torch.float64 else ARC * brightest
    covered = coverage(coc)
    return (summed + arc * covered.clamp_min(1)) / covered.clamp_min(TINY)


def coverage(coc: Tensor) -> Tensor:
    """What all discs together cover of each pixel, ``(B, 1, H, W)`` float64."""
    return dense_spans(torch.ones_like(coc), coc, Disc().profile())


def _places(renderer: Renderer, case: Case, coc: Tensor, precision: Precision) -> float:
    """Error of what is looked up at places in px, as a share of the brightest light.

    A place is held to ``u`` times the size of the picture and of what moves it. That of a view is the fourth iterate of
    one that comes to lie on a pixel (`torchbokeh.views.layers.STEPS`): each step multiplies what it is off by the slope
    of the CoC and of the motion, of which a view sees half at most. Beyond a pixel, anything may be looked up.
    """
    side = max(coc.shape[2:])
    if renderer.kind == "colours":  # light is shared by two pixels each way
        return 4 * 8 * precision.work * side
    if renderer.kind not in ("views", "rays"):
        return 0.0
    motion = renderer.motion(case)
    way = torch.zeros_like(coc) if motion is None else motion / 2
    slope = _steepest(coc) + _steepest(way)
    size = max(side, float((coc.abs() + way.abs().amax(1, keepdim=True)).max()))
    return 2 * min(8 * precision.work * size * (1 + slope) ** STEPS_OF_VIEWS, 1.0)


def _steepest(maps: Tensor) -> float:
    """Largest difference of two neighbouring pixels."""
    return max((float(maps.diff(dim=d).abs().max()) for d in (2, 3) if maps.shape[d] > 1), default=0.0)


def _laplacian(image: Tensor, coc: Tensor, precision: Precision) -> Tensor:
    """Absolute error of splats in the Laplacian domain: the rounding of their buffer, times the Green's function.

    The buffer holds `POINTS` times the light of all pixels that are no highlights, and is stored in the working
    precision; its error is at most ``u |b|_1 max g``, whatever its sign. Highlights are drawn in the direct domain.
    """
    value = image.abs().amax(1, keepdim=True)
    usual = value.flatten(1).median(1).values[:, None, None, None]
    area = math.pi * coc.square().clamp_min(1.0) + 2 * coc.abs() * 10
    ordinary = torch.minimum(value, 4 * usual * (BRIGHT * area).clamp_min(4.0))
    stored = 2 * precision.work * GREEN * POINTS * ordinary.sum((1, 2, 3), keepdim=True)
    # Numbers of the buffer that are not normal are off by a step each.
    least = torch.finfo(torch.float32).smallest_normal * torch.finfo(torch.float32).eps
    return stored + 4 * GREEN * least * image[0, 0].numel()


def far_leak(case: Case) -> float:
    """What a highlight may add where its PSF does not reach, over an even background of 1 or none: a promise."""
    return min(1e-6 * case.peak, 1e-3 * max(case.even, 1.0))


def approximation(renderer: Renderer, coc: Tensor) -> float:
    """Relative L1 error of a renderer that merges, against its exact quality.

    Splats of a quality have the error that it promises, and radii that are rounded: a disc of radius r differs from one
    of r + d by ``4 d / r`` of its light, and d is at most half a step. Over one another,
    surfaces F and R with the share s of light that F stops are ``s F + (1 - s) R``, whose error is at most
    ``s dF + (1 - s) dR + ds |F - R|``: once more that of a splat for a surface that hides something.
    """
    quality = next(q for q in QUALITIES if q.name == renderer.quality)
    splat = quality.error + 2 * STEP
    hides = renderer.kind == "layers" or (renderer.kind != "merged" and float(coc.min()) < FOREGROUND[1])
    return 2 * splat if hides else splat


def lipschitz(contrast: float, radius: float, covered: float) -> float:
    """Largest change of a normalised splat per px that all radii change by.

    Discs of radius r and r + d differ in ``4 d / r`` of their light: as much is lost inside as is won outside. Rows are
    rectangles of the mean of their ends, which move up to twice as fast as the rim. A mean whose weights change by
    that, relative to the coverage, changes by no more than that times the contrast, the largest minus the smallest
    value.
    """
    return 8 / max(radius, 0.5) * contrast / covered
