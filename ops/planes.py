"""Views of textured rectangles in space: the accumulation buffer's rasteriser.

A pinhole view of a plane is a homography of its texture, and a thin lens is a bundle of pinholes. So a view needs no
mesh: each pixel looks up the texture of every plane it meets, sorts what it found by depth, and puts it together
front to back. Sorting is per pixel: planes may be tilted and may cut through each other.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from torchbokeh.ops.checks import check_flag, check_image, check_kind, check_size, check_whole
from torchbokeh.ops.dispatch import compute_dtype, has_kernel
from torchbokeh.ops.spans import working_dtype

SOLID = 1e-6
"""Once less light than this share passes, what lies behind is not looked at."""


@dataclass(frozen=True, eq=False)
class Plates:
    """Textures of K rectangles, each with its coarser levels.

    Texture coordinates ``(s, t)`` run over ``[0, w] x [0, h]`` of level 0; texel (i, j) is the square from (i, j) to
    (i + 1, j + 1). A look-up interpolates bilinearly between the centres of texels. A texel of level l is the mean
    of ``2^l x 2^l`` texels.

    Attributes:
        levels: for each rectangle its levels, ``(4, h, w)`` of premultiplied RGBA, level 0 first.
        mirror: for each rectangle, whether its texture goes on without end, mirrored at its edges. Otherwise it is
            transparent outside.
        infinite: for each rectangle, whether it lies beyond everything, as the sky does.
    """

    levels: tuple[tuple[Tensor, ...], ...]
    mirror: tuple[bool, ...]
    infinite: tuple[bool, ...]

    @classmethod
    def build(
        cls, textures: Sequence[Tensor], mirror: Sequence[bool], infinite: Sequence[bool], count: int
    ) -> "Plates":
        """Make ``count`` levels of every texture, or as many as it takes to come down to one texel."""
        for name, given in (("textures", textures), ("mirror", mirror), ("infinite", infinite)):
            if not isinstance(given, Sequence) or isinstance(given, str):
                raise TypeError(f"{name}: expected a sequence, got {type(given).__name__}")
        check_whole("count", count, 1, sys.maxsize)
        for name, flags in (("mirror", mirror), ("infinite", infinite)):
            if len(flags) != len(textures):
                raise ValueError(f"{name}: expected one for each of {len(textures)} textures, got {len(flags)}")
        levels = []
        made: dict[tuple[int, bool], tuple[Tensor, ...]] = {}  # cards that share a texture share its levels
        for texture, endless in zip(textures, mirror, strict=True):
            check_image("textures", texture, (4, "h", "w"))
            if texture.numel() == 0:
                raise ValueError(f"textures: expected at least one texel, got shape {tuple(texture.shape)}")
            key = id(texture), bool(endless)
            if key not in made:
                pyramid = [texture]
                while len(pyramid) < count and max(pyramid[-1].shape[1:]) > 1:
                    pyramid.append(_halved(pyramid[-1], endless))
                made[key] = tuple(pyramid)
            levels.append(made[key])
        return cls(tuple(levels), tuple(mirror), tuple(infinite))


def _halved(texture: Tensor, endless: bool) -> Tensor:
    """Means over 2 x 2 texels. What is missing to an even size is transparent, or as the texel beside it."""
    odd = (0, texture.shape[2] % 2, 0, texture.shape[1] % 2)
    padded = F.pad(texture[None], odd, mode="replicate" if endless else "constant")
    return F.avg_pool2d(padded, 2)[0]


def render_planes(
    plates: Plates,
    inverse: Tensor,
    level: Tensor,
    size: tuple[int, int],
    *,
    parents: Tensor | None = None,
    frames: bool = False,
) -> tuple[Tensor, Tensor]:
    """Render V views of K rectangles and return their mean, or every one of them.

    Args:
        plates: the textures.
        inverse: ``(V, K, 3, 3)`` double. ``inverse @ (x, y, 1)``, with (x, y) a point of the picture in px, whose
            first pixel is the square from (0, 0) to (1, 1), is ``(s, t, 1) / z``: texture coordinates and depth. A
            rectangle is not seen where ``z <= 0``. Pixels are looked at in their centres.
        level: ``(V, K)`` int64, the level of its texture that each view looks at.
        size: ``(H, W)`` of the picture.
        parents: ``(V, K)`` int64, the view whose ``inverse`` and ``level`` stand for those of this view. A rectangle
            with the same parent in several views is rendered once, and copied with a depth test. ``None``: every view
            is its own parent.
        frames: return every view.

    Returns:
        The mean of all views ``(1, 4, H, W)``, premultiplied RGBA, and an empty tensor. With ``frames`` every view
        ``(V, 4, H, W)``, and ``1 / z`` of what is seen most of in each pixel ``(V, 1, H, W)``: 0 where that is a
        rectangle at infinity, or nothing. Both in the dtype of the textures; differentiable to these and to
        ``inverse``.

    Raises:
        TypeError: ``inverse`` is not a floating-point tensor or ``level`` not an integer one.
        ValueError: shapes do not fit, or a level that is not there.

    Source: Haeberli and Akeley, "The accumulation buffer" (1990); thin lens as in chapter 3 of the defocus and bokeh
    dissertation.

    Example:
        >>> import torch
        >>> from torchbokeh.ops.planes import Plates, render_planes
        >>> grey = Plates.build([torch.full((4, 2, 2), 0.5)], [True], [True], count=1)
        >>> view = torch.eye(3, dtype=torch.float64).expand(1, 1, 3, 3)
        >>> render_planes(grey, view, torch.zeros(1, 1, dtype=torch.long), (3, 5))[0].shape
        torch.Size([1, 4, 3, 5])
    """
    check_kind("plates", plates, Plates)
    check_size(size)
    check_flag("frames", frames)
    count = len(plates.levels)
    check_image("inverse", inverse, ("V", count, 3, 3))
    if len(inverse) == 0:
        raise ValueError("inverse: expected at least one view, got none")
    check_image("level", level, (len(inverse), count), like=inverse, integer=True)
    if parents is not None:
        check_image("parents", parents, tuple(level.shape), like=inverse, integer=True)
        if parents.numel() and not 0 <= int(parents.min()) <= int(parents.max()) < len(level):
            raise ValueError(f"parents: expected indices of {len(level)} views, got {parents.min()} to {parents.max()}")
        inverse = inverse.gather(0, parents[..., None, None].expand_as(inverse))
        level = level.gather(0, parents)
    for k, pyramid in enumerate(plates.levels):
        if not 0 <= int(level[:, k].min()) <= int(level[:, k].max()) < len(pyramid):
            raise ValueError(f"level: expected 0 to {len(pyramid) - 1} for rectangle {k}, got {level[:, k].tolist()}")
    texels = plates.levels[0][0] if count else torch.zeros(0)
    leaves = (inverse, *(texture for pyramid in plates.levels for texture in pyramid))
    grads = torch.is_grad_enabled() and any(t.requires_grad for t in leaves)
    if count and has_kernel(texels) and not grads:
        from torchbokeh.ops.kernels import planes as kernels

        return kernels.render_planes(plates, inverse, level, size, parents, frames)
    return _render_planes_torch(plates, inverse, level, size, parents, frames)


def _render_planes_torch(
    plates: Plates, inverse: Tensor, level: Tensor, size: tuple[int, int], parents: Tensor | None, frames: bool
) -> tuple[Tensor, Tensor]:
    texels = plates.levels[0][0] if plates.levels else torch.zeros(0)
    work = working_dtype(texels.device)
    total = torch.zeros(1, 4, *size, dtype=work, device=texels.device)
    views, depths = [], []
    homographies, chosen = inverse.to(texels.device, work), level.tolist()
    copies: dict[tuple[int, int], tuple[Tensor, Tensor]] = {}
    last = {} if parents is None else {(k, p): v for v, row in enumerate(parents.tolist()) for k, p in enumerate(row)}
    for v in range(len(level)):
        seen = []
        for k in range(len(plates.levels)):
            key = (k, v if parents is None else int(parents[v, k]))
            picture = copies.pop(key, None) or _look_up(plates, k, chosen[v][k], homographies[v, k], size)
            if last.get(key, v) > v:
                copies[key] = picture
            seen.append(picture)
        view, depth = _put_together(seen) if seen else (total[0], total[0, :1])
        if frames:
            views.append(view)
            depths.append(depth)
        else:
            total = total + view
    if frames:
        return torch.stack(views).to(texels.dtype), torch.stack(depths).to(texels.dtype)
    return (total / len(inverse)).to(texels.dtype), texels.new_zeros(0)


def pixel_centres(size: tuple[int, int], like: Tensor) -> tuple[Tensor, Tensor]:
    """Coordinates x and y ``(H, W)`` of the centres of all pixels, of the dtype and on the device of ``like``."""
    y, x = (torch.arange(n, dtype=like.dtype, device=like.device) + 0.5 for n in size)
    return x.expand(size), y[:, None].expand(size)


def _look_up(plates: Plates, k: int, lod: int, homography: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """What every pixel sees of one rectangle: RGBA ``(4, H, W)`` and ``1 / z`` ``(1, H, W)``."""
    h, w = plates.levels[k][0].shape[1:]
    texture = plates.levels[k][lod]
    texture = texture.to(compute_dtype(texture))  # half precision could not say where
    x, y = pixel_centres(size, homography)
    s, t, inverse_depth = torch.einsum("ij,jyx->iyx", homography, torch.stack([x, y, torch.ones_like(x)]))
    there = inverse_depth > 0
    safe = torch.where(there, inverse_depth, 1.0)
    s, t = s / safe, t / safe
    if plates.mirror[k]:
        s, t = (n - (c.remainder(2 * n) - n).abs() for c, n in ((s, w), (t, h)))
    extent = homography.new_tensor([texture.shape[2], texture.shape[1]]) * 2.0**lod
    # Far outside is outside: float32 could not hold where.
    grid = (2 * torch.stack([s, t], -1) / extent - 1).clamp(-9, 9).to(texture.dtype)
    padding = "border" if plates.mirror[k] else "zeros"
    rgba = F.grid_sample(texture[None], grid[None], padding_mode=padding, align_corners=False)[0]
    rgba = torch.where(there, rgba, 0.0).to(homography.dtype)
    depth = torch.zeros_like(inverse_depth) if plates.infinite[k] else inverse_depth
    return rgba, torch.where(there, depth, -torch.inf)[None]


def _put_together(seen: list[tuple[Tensor, Tensor]]) -> tuple[Tensor, Tensor]:
    """Sort ``(4, H, W)`` by ``1 / z`` ``(1, H, W)``, nearest first, and put one over the other."""
    rgba, inverse_depth = (torch.stack(planes) for planes in zip(*seen, strict=True))
    inverse_depth, order = inverse_depth.sort(dim=0, descending=True, stable=True)
    rgba = rgba.gather(0, order.expand_as(rgba))
    left = (1 - rgba[:, 3:]).cumprod(0)
    visible = torch.cat([torch.ones_like(left[:1]), left[:-1]])
    share, first = (visible * rgba[:, 3:]).max(0)
    depth = torch.where(share > left[-1], inverse_depth.gather(0, first[None])[0], 0.0)
    return (visible * rgba).sum(0), depth
