"""Scenes of textured cards, and the pinhole picture that a renderer starts from."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchbokeh.ops.checks import check_kind, check_whole
from torchbokeh.ops.dispatch import compute_dtype
from torchbokeh.ops.planes import Plates, pixel_centres, render_planes
from torchbokeh.scenes.camera import Camera
from torchbokeh.scenes.layering import Fragments, stack_layers
from torchbokeh.scenes.sprite import Backdrop, Sprite, place

MOST_SAMPLES = 256
"""Points of each pixel and direction that a card is averaged over, at most."""

LEVELS = 16
"""Most levels of a texture: more than any texture has."""


@dataclass(frozen=True, eq=False)
class Scene:
    """Cards in space before a backdrop: a world with an exact picture through any lens.

    Args:
        sprites: the cards, in any order; they may be tilted and may cut through each other.
        backdrop: what is behind them; without one the picture is transparent there.

    Raises:
        TypeError: not sprites, or not a backdrop.

    Example:
        >>> from torchbokeh import ThinLens
        >>> from torchbokeh.scenes import Backdrop, Camera, Scene, Sprite
        >>> card = Sprite(torch.ones(4, 8, 8), position=(0.0, 0.0, 2.0), size=(0.5, 0.5))
        >>> scene = Scene((card,), Backdrop(torch.full((3, 4, 4), 0.5), distance=8.0))
        >>> camera = Camera(ThinLens(0.05, 1.8, 2.0, sensor_width=0.036), size=(48, 64))
        >>> {name: tuple(t.shape) for name, t in scene.render(camera).items()}["layers"]
        (2, 4, 48, 64)
    """

    sprites: tuple[Sprite, ...]
    backdrop: Backdrop | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.sprites, Sequence):
            raise TypeError(f"sprites: expected a sequence of Sprites, got {type(self.sprites).__name__}")
        object.__setattr__(self, "sprites", tuple(self.sprites))
        for sprite in self.sprites:
            if not isinstance(sprite, Sprite):
                raise TypeError(f"sprites: expected Sprites, got {type(sprite).__name__}")
        check_kind("backdrop", self.backdrop, Backdrop, optional=True)

    def __len__(self) -> int:
        """How many planes there are, the backdrop included."""
        return len(self.sprites) + (self.backdrop is not None)

    def to(self, device: torch.device | str) -> "Scene":
        """The same scene with its textures on another device."""
        sprites = tuple(replace(s, texture=s.texture.to(device)) for s in self.sprites)
        backdrop = self.backdrop and replace(self.backdrop, texture=self.backdrop.texture.to(device))
        return Scene(sprites, backdrop)

    def plates(self, levels: int = LEVELS) -> Plates:
        """The textures as `torchbokeh.ops.planes.render_planes` takes them, the backdrop last."""
        every = [s.texture for s in self.sprites] + ([] if self.backdrop is None else [self.backdrop.texture])
        dtype = compute_dtype(*every)
        textures = [s.texture.to(dtype) for s in self.sprites]
        textures = [
            t if s.emission == 1 else torch.cat([t[:3] * s.emission, t[3:]])
            for s, t in zip(self.sprites, textures, strict=True)
        ]
        mirror, infinite = [False] * len(textures), [False] * len(textures)
        if self.backdrop is not None:
            picture = self.backdrop.texture.to(dtype)
            textures.append(torch.cat([picture, torch.ones_like(picture[:1])]))
            mirror.append(True)
            infinite.append(self.backdrop.distance == torch.inf)
        return Plates.build(textures, mirror, infinite, levels)

    def homographies(self, camera: Camera, lens: Tensor, times: Tensor, shift: Tensor) -> Tensor:
        """Homographies ``(V, K, 3, 3)`` from texture coordinates ``(s, t, 1)`` to ``z * (x, y, 1)``, one per view.

        Args:
            camera: the camera.
            lens: ``(V, 2)`` points (x, y) of the lens, in units of the aperture radius.
            times: ``(V,)`` in units of the shutter time: -0.5 is when it opens, 0.5 when it closes.
            shift: ``(V, 2)`` by which the picture moves, in px.
        """
        return camera.projection(lens, shift)[:, None] @ place(self.sprites, self.backdrop, times * camera.shutter)

    def render(self, camera: Camera, *, samples: int = 8, layers: int | None = None) -> dict[str, Tensor]:
        """The pinhole picture at half time, and all that a renderer wants to know beside it.

        Every card is averaged over ``samples x samples`` points of each pixel, on its own. Cards that overlap in the
        picture come to lie in different layers, those that do not may share one, and every card lies in one layer
        whole; only cards that cut through each other change places where they do. Put over one another, the layers
        are the image: two cards that share a pixel are taken to cover it independently of each other.

        Depth and motion do not blend. In a layer they are those of the card, at the centre of the pixel; in the
        picture those of the card that is seen most of.

        Args:
            camera: the camera.
            samples: points per pixel and direction.
            layers: the most layers; what lies behind is flattened into the last of them. ``None``: as many as
                it takes.

        Returns:
            ``image (3, H, W)`` premultiplied by ``alpha (1, H, W)``; ``depth (1, H, W)`` in metres, ``inf`` for the
            sky and where nothing is; ``motion (2, H, W)``, the way (dx, dy) in px from the opening to the closing of
            the shutter; ``shutter_depth (2, H, W)``, the depth of what the pixel shows at these two moments; and front
            to back, hidden surfaces included, ``layers (L, 4, H, W)`` of premultiplied RGBA,
            ``layer_depth (L, 1, H, W)``, ``layer_motion (L, 2, H, W)`` and ``layer_shutter_depth (L, 2, H, W)``. All
            float32.

        Raises:
            TypeError: ``camera`` is no `Camera`, or a number is no int.
            ValueError: ``samples`` or ``layers`` is not positive, or ``samples`` above `MOST_SAMPLES`.
        """
        check_kind("camera", camera, Camera)
        check_whole("samples", samples, 1, MOST_SAMPLES)
        if layers is not None:
            check_whole("layers", layers, 1)
        return stack_layers(self._fragments(camera, samples), layers, camera.size)

    def _fragments(self, camera: Camera, samples: int) -> list[Fragments]:
        """What each card alone shows, for the cards that are in the picture."""
        offsets = (torch.arange(samples, dtype=torch.float64) + 0.5) / samples - 0.5
        grid = torch.cartesian_prod(offsets, offsets).reshape(-1, 2)
        plates = self.plates()
        times = torch.tensor([0.0, -0.5, 0.5], dtype=torch.float64)
        matrices = self.homographies(camera, torch.zeros(3, 2), times, torch.zeros(3, 2))
        found = []
        for k in range(len(self)):
            one = Plates(plates.levels[k : k + 1], plates.mirror[k : k + 1], plates.infinite[k : k + 1])
            top, left, bottom, right = _box(matrices[0, k], one, camera.size)
            if top >= bottom or left >= right:
                continue
            three = shifted(matrices[:, k], torch.tensor([[-left, -top]], dtype=torch.float64))
            several = shifted(three[:1], grid)
            lod = min(_minified(three[0], one, samples), len(one.levels[0]) - 1)
            level = torch.full((len(grid), 1), lod)
            rgba, _ = render_planes(one, inverse3(several)[:, None], level, (bottom - top, right - left))
            if bool((rgba[0, 3] > 0).any()):
                depth, motion = _geometry(three, rgba, one)
                found.append(Fragments(top, left, rgba[0], depth, motion))
        return found


def shifted(homography: Tensor, shift: Tensor) -> Tensor:
    """Homographies whose pictures are moved by ``(N, 2)`` px."""
    out = homography.expand(max(len(shift), len(homography)), 3, 3).clone()
    out[:, :2] += shift[:, :, None] * homography[:, 2:]
    return out


def _box(homography: Tensor, plate: Plates, size: tuple[int, int]) -> tuple[int, int, int, int]:
    """Rows and columns of the picture that may show a card: top, left, bottom, right; all of it where in doubt."""
    texel = 2.0 ** (len(plate.levels[0]) - 1)
    h, w = (n * texel for n in plate.levels[0][-1].shape[1:])  # a level of odd size may end beyond level 0
    corners = _corners(h, w, 0.5 * texel)
    points = corners @ homography.mT
    if plate.mirror[0] or not bool((points[:, 2] > 1e-6).all()):
        return 0, 0, *size
    x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]

    def clipped(value: Tensor, most: int) -> int:
        return int(value.clamp(0, most))

    top, bottom = clipped((y.min() - 1).floor(), size[0]), clipped((y.max() + 1).ceil(), size[0])
    return top, clipped((x.min() - 1).floor(), size[1]), bottom, clipped((x.max() + 1).ceil(), size[1])


def _corners(height: float, width: float, rim: float = 0.0) -> Tensor:
    """Corners ``(4, 3)`` of a card of so many texels, and of ``rim`` more around it, as ``(s, t, 1)`` in order."""
    x0, x1, y0, y1 = -rim, width + rim, -rim, height + rim
    return torch.tensor([[x0, y0, 1], [x1, y0, 1], [x1, y1, 1], [x0, y1, 1]], dtype=torch.float64)


def _geometry(matrices: Tensor, rgba: Tensor, plate: Plates) -> tuple[Tensor, Tensor]:
    """Depth and motion of a card at the centres of the pixels, from its homographies half way, before and after."""
    h, w = rgba.shape[2:]
    if plate.infinite[0]:
        return rgba.new_full((1, h, w), torch.inf), rgba.new_zeros(4, h, w)
    middle, opening, closing = matrices
    x, y = pixel_centres((h, w), middle)
    s, t, inverse_depth = torch.einsum("ij,jyx->iyx", inverse3(middle), torch.stack([x, y, torch.ones_like(x)]))
    # The centre of a pixel that holds some of a card may look past the card, even past its horizon.
    corners = _corners(*plate.levels[0][0].shape[1:]) @ middle[2]
    near, far = float(corners.min()), float(corners.max())
    inverse_depth = inverse_depth.clamp(1 / far if far > 0 else 1e-9, 1 / near if near > 0 else torch.inf)
    depth = inverse_depth.reciprocal()[None]
    if torch.equal(opening, closing):
        return depth.to(rgba), rgba.new_zeros(4, h, w)
    texel = torch.stack([s / inverse_depth, t / inverse_depth, torch.ones_like(s)])
    start, stop = (torch.einsum("ij,jyx->iyx", m, texel) for m in (opening, closing))
    ends = torch.stack([start, stop])
    places, nearness = ends[:, :2] / ends[:, 2:].clamp_min(1e-6), ends[:, 2].clamp_min(1e-6).reciprocal()
    return depth.to(rgba), torch.cat([places[1] - places[0], nearness - inverse_depth]).to(rgba)


def _minified(homography: Tensor, plate: Plates, samples: int) -> int:
    """The level whose texels are about as far apart as the points of a pixel: finer ones would only be missed."""
    area = float(texel_area(homography, plate.levels[0][0]))
    return max(0, int(-math.log2(samples * math.sqrt(area)))) if area > 0 else 0


def texel_area(homography: Tensor, texture: Tensor) -> Tensor:
    """Area in px² that a texel covers on the screen, on the average over the card; 0 where that can't be said."""
    x, y, z = (_corners(*texture.shape[1:]) @ homography.mT).unbind(-1)
    x, y = x / z, y / z
    area = 0.5 * (x * y.roll(-1, -1) - y * x.roll(-1, -1)).sum(-1).abs()
    return torch.where((z > 0).all(-1), area, 0.0) / texture[0].numel()


def inverse3(matrix: Tensor) -> Tensor:
    """Inverse of 3 x 3 matrices; zero for a card that is seen edge-on and so not at all."""
    a, b, c = matrix.unbind(-2)
    cofactors = torch.stack([torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)], -1)
    determinant = (a * cofactors[..., 0]).sum(-1)[..., None, None]
    # A shift of the picture, as far as it may be, adds multiples of the last row to the others: it does not count.
    unit = c / c.norm(dim=-1, keepdim=True).clamp_min(1e-300)
    across = [(row - (row * unit).sum(-1, keepdim=True) * unit).norm(dim=-1) for row in (a, b)]
    scale = (across[0] * across[1] * c.norm(dim=-1))[..., None, None]
    flat = determinant.abs() <= 1e-12 * scale
    return torch.where(flat, 0.0, cofactors / torch.where(flat, 1.0, determinant))
