"""The views of an accumulation buffer: where each looks through the lens, when, and which of them share work."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchbokeh.ops.sampling import aperture_points, halton, stratified
from torchbokeh.ops.spans import Profile


@dataclass(frozen=True, eq=False)
class Views:
    """N views.

    Attributes:
        lens: ``(N, 2)`` points (x, y) of the lens, in units of the aperture radius.
        time: ``(N,)`` in units of the shutter time, from -0.5, when it opens, to 0.5.
        shift: ``(N, 2)`` by which each view's picture is moved, within half a pixel, so that their mean is
            anti-aliased.
    """

    lens: Tensor
    time: Tensor
    shift: Tensor

    @classmethod
    def spread(cls, count: int, profile: Profile, *, first: int = 0, seed: int | None = None) -> "Views":
        """Halton points: bases 2 and 7 over the lens, 3 over time, where they are stratified, 5 and 11 in the pixel."""
        points = halton(count, first=first, seed=seed)
        lens = aperture_points(profile, points[:, [0, 3]]).cpu()  # the aperture may be on another device
        return cls(lens, stratified(points[:, 1]) - 0.5, points[:, [2, 4]] - 0.5)

    def __len__(self) -> int:
        return len(self.time)


def smallest_radius(low: Tensor, high: Tensor) -> Tensor:
    """The smallest ``|coc|`` within each range: 0 where it spans the focus."""
    return torch.where(low * high <= 0, 0.0, torch.minimum(low.abs(), high.abs()))


def largest_coc(low: Tensor, high: Tensor) -> Tensor:
    """The signed CoC that is largest in size within each range."""
    return torch.where(high.abs() >= low.abs(), high, low)


def detail_levels(radius: Tensor, texel: Tensor, share: float, count: int, most: Tensor) -> Tensor:
    """The level of detail of every object in every view (section 3.2 of the defocus and bokeh dissertation).

    ``L = max(log_s(share * C / A), 0)``, with C the area of the smallest CoC of the object, A that of one of its
    texels on the screen, and s = 4: a level has a quarter of the texels of the one before. The two levels beside L
    share the views: of ``L = 2.3`` the first 70 % look at level 2 and the rest at level 3, and as any run of Halton
    points is spread evenly, nothing pops while L changes.

    Args:
        radius: ``(K,)`` smallest CoC radius in px.
        texel: ``(K,)`` area of a texel in px²; 0 where it is not known, which gives level 0.
        share: of the CoC's area that a texel may cover: 1 as in the text, less is finer.
        count: number of views N.
        most: ``(K,)`` the coarsest level there is.

    Returns:
        ``(N, K)`` int64.
    """
    ratio = torch.where(texel > 0, share * torch.pi * radius**2 / texel.clamp_min(1e-30), 1.0)
    level = (ratio.clamp_min(1).log2() / 2).clamp(max=most.to(ratio.dtype))
    fine = level.floor()
    views = torch.arange(count, dtype=level.dtype)[:, None]
    coarser = views >= ((1 - (level - fine)) * count).round()
    return (fine + coarser.to(fine.dtype)).long()


@torch.no_grad()
def shared_views(views: Views, coc: Tensor, motion: Tensor, grid: int, level: Tensor) -> Tensor:
    """Which view each object is taken from in each view (section 3.3 of the dissertation).

    Views in which an object comes to lie on the same raster cell share one rendering of it: that of the parent, the
    one nearest to the middle of the cell. The place of an object is its largest CoC times the lens point, and the
    sub-pixel shift of the view; its motion is a third dimension. Levels of detail are kept apart. The CoC is signed,
    for what is in front of the focus goes against the lens point.

    Args:
        views: N of them.
        coc: ``(K,)`` signed CoC in px, where it is largest.
        motion: ``(K,)`` the greatest speed of the object, in px for the time that the shutter is open.
        grid: cells per pixel and direction: 1 as in the text, 2 its finer grid.
        level: ``(N, K)``.

    Returns:
        ``(N, K)`` int64: the index of the parent, which is its own parent.
    """
    parents = torch.empty_like(level)
    for k in range(level.shape[1]):
        if not (coc[k].isfinite() and motion[k].isfinite()):  # it may be anywhere: nothing is shared
            parents[:, k] = torch.arange(len(level))
            continue
        lens = coc[k] * views.lens + views.shift
        place = grid * torch.cat([lens, (motion[k] * views.time)[:, None]], 1)
        cell = place.round()
        _, member = torch.cat([cell, level[:, k : k + 1]], 1).unique(dim=0, return_inverse=True)
        off = (place - cell).square().sum(1)
        order = off.argsort(stable=True)
        order = order[member[order].argsort(stable=True)]  # cell by cell, the nearest to its middle first
        cells = member[order]
        leads = torch.cat([cells.new_ones(1, dtype=torch.bool), cells[1:] != cells[:-1]])
        parents[:, k] = order[leads][member]
    return parents


@torch.no_grad()
def subsample_offsets(lens: Tensor, count: int) -> tuple[Tensor, float]:
    """Sub-samples around every view's lens point (section 3.4 of the dissertation).

    They fill a disc, whatever the aperture, whose radius is the mean distance of a lens point from its nearest
    neighbour (the text's mean over all pairs would be most of the lens); the whole lens where there is but one point.
    Other than in the text, the lens points are to be drawn in by the returned factor, so that the blur keeps its
    spread.

    Args:
        lens: ``(N, 2)`` lens points.
        count: S, number of sub-samples.

    Returns:
        ``(S, 2)`` offsets from the lens point, with mean zero, and the factor.
    """
    if count == 0:
        return lens.new_zeros(0, 2), 1.0
    reach = 1.0
    if len(lens) > 1:
        from scipy.spatial import cKDTree

        reach = float(cKDTree(lens.numpy()).query(lens.numpy(), k=2)[0][:, 1].mean())
    k = torch.arange(count, dtype=torch.float64)
    angle = k * (torch.pi * (3 - 5**0.5))  # a sunflower: even for any number
    offsets = reach * ((k + 0.5) / count).sqrt()[:, None] * torch.stack([angle.cos(), angle.sin()], 1)
    offsets = offsets - offsets.mean(0)
    if len(lens) == 1:
        return offsets, 0.0
    spread = float(offsets.square().sum()) / (count + 1)
    return offsets, max(0.0, 1 - spread / max(float(lens.square().sum(1).mean()), 1e-12)) ** 0.5
