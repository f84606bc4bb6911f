"""Samples of a scene, as a stochastic renderer takes them: rays through random points of pixel, lens and shutter."""

import torch
from torch import Tensor
from torch.nn import functional as F

from torchbokeh.ops.checks import MOST_PIXELS, check_kind, check_whole
from torchbokeh.ops.composite import TINY
from torchbokeh.ops.planes import Plates, pixel_centres
from torchbokeh.ops.sampling import aperture_points
from torchbokeh.picture.samples import Samples
from torchbokeh.psfs.aperture import Disc
from torchbokeh.scenes._random import rng
from torchbokeh.scenes.camera import Camera
from torchbokeh.scenes.scene import Scene, inverse3

CHUNK = 1 << 18
"""Rays times cards that are looked at together."""

MOST = 1 << 16
"""Most rays of a pixel; of a picture, no more than `torchbokeh.ops.checks.MOST_PIXELS`."""


def samples(scene: Scene, camera: Camera, per_pixel: int = 1, seed: int = 0) -> Samples:
    """Cast rays: through each pixel ``per_pixel`` of them, each at its own time and through its own point of the lens.

    The points are Sobol's, turned at random for each pixel (Cranley and Patterson, 1976). A card of which a ray meets
    a translucent place stops it with the probability of its coverage there, so that every sample is of one surface,
    and the mean of the samples of a pixel tends to the picture of `torchbokeh.AccumulationBuffer`.

    Args:
        scene: what to look at.
        camera: from where; its aperture is a disc.
        per_pixel: S, how many rays each pixel gets.
        seed: of the random numbers; the same on every machine, whatever the number of threads.

    Returns:
        The samples on the CPU, float32, with ``B = 1``. CoC is that of the point that is met, where it was then;
        motion is the way of that point from the opening to the closing of the shutter, seen from the middle of the
        lens. What meets nothing is not ``present``.

    Raises:
        TypeError: ``scene`` or ``camera`` is of another kind, or a number is no int.
        ValueError: ``per_pixel`` or ``seed`` is out of its range, or the scene is empty.

    Source: Cook et al., "Distributed ray tracing" (1984).

    Example:
        >>> from torchbokeh import scenes
        >>> from torchbokeh.scenes import samples
        >>> samples(*scenes.coins(size=(24, 32)), per_pixel=4).colour.shape
        torch.Size([1, 4, 3, 24, 32])
    """
    check_kind("scene", scene, Scene)
    check_kind("camera", camera, Camera)
    if len(scene) == 0:
        raise ValueError("scene: expected at least one card or a backdrop, got none")
    height, width = camera.size
    per_pixel = check_whole("per_pixel", per_pixel, 1, max(1, min(MOST, MOST_PIXELS // (height * width))))
    scene = scene.to("cpu")
    plates, rays = scene.plates(levels=1), _rays(camera.size, per_pixel, seed)
    hits = [_hits(scene, plates, camera, part) for part in rays.split(max(1, CHUNK // len(scene)))]
    maps = torch.cat(hits).T.reshape(-1, per_pixel, *camera.size).movedim(0, 1)[None].float()
    present, colour, coc, motion = maps.split([1, 3, 1, 2], 2)
    position, lens, time, _ = (
        rays.T.reshape(-1, per_pixel, *camera.size).movedim(0, 1)[None].float().split([2, 2, 1, 1], 2)
    )
    return Samples(colour, position - 0.5, lens, time, coc, motion, present > 0)


def _rays(size: tuple[int, int], per_pixel: int, seed: int) -> Tensor:
    """For rays ``(S * H * W, 6)``: x and y in the picture, in px from its corner; x and y in the lens; time; a number.

    The number, in [0, 1), says which of the surfaces that a ray may meet it meets.
    """
    from scipy.stats import qmc

    points = qmc.Sobol(6, scramble=False).random_base2((per_pixel - 1).bit_length())[:per_pixel]
    turned = torch.from_numpy((points[:, :, None, None] + rng(seed, "samples").random((6, *size))) % 1)
    unit = turned.movedim(1, -1)
    lens = aperture_points(Disc().profile(), unit[..., :2].reshape(-1, 2)).double()
    inside = torch.stack(pixel_centres(size, unit), -1) - 0.5 + unit[..., 2:4]
    return torch.cat([inside.reshape(-1, 2), lens, unit[..., 4:].reshape(-1, 2) - torch.tensor([0.5, 0.0])], 1)


def _hits(scene: Scene, plates: Plates, camera: Camera, rays: Tensor) -> Tensor:
    """What each ray meets, ``(N, 7)``: whether anything, its colour, CoC and motion."""
    place, lens, time, number = rays.split([2, 2, 1, 1], 1)
    inverse = inverse3(scene.homographies(camera, lens, time[:, 0], torch.zeros_like(lens)))
    s, t, nearness = (inverse @ torch.cat([place, torch.ones_like(time)], 1)[:, None, :, None])[..., 0].unbind(-1)
    there = nearness > 0
    safe = torch.where(there, nearness, 1.0)
    texel = torch.stack([s / safe, t / safe, torch.ones_like(s)], -1)
    rgba = torch.stack([_look_up(plates, k, texel[:, k, :2]) for k in range(len(scene))], 1).double() * there[..., None]
    depth = torch.where(there & ~torch.tensor(plates.infinite), safe.reciprocal(), torch.inf)
    card, hit = _first(rgba[..., 3], depth, number)

    def chosen(values: Tensor) -> Tensor:
        return values.take_along_dim(card[..., None], 1)[:, 0]

    found = chosen(rgba)
    coc = camera.lens.coc(chosen(depth[..., None]).to(camera.lens.focus_distance), camera.size[1]).to(found)
    motion = _motion(scene, camera, card[:, 0], chosen(texel))
    return torch.cat([hit.double(), found[:, :3] / found[:, 3:].clamp_min(TINY), coc, motion], 1)


def _look_up(plates: Plates, k: int, texel: Tensor) -> Tensor:
    """RGBA ``(N, 4)`` of a card at places ``(N, 2)`` of its texture, interpolated bilinearly."""
    texture, mirror = plates.levels[k][0], plates.mirror[k]
    extent = texel.new_tensor([texture.shape[2], texture.shape[1]])
    if mirror:
        texel = extent - (texel.remainder(2 * extent) - extent).abs()
    # Far outside is outside: float32 could not hold where.
    grid = (2 * texel / extent - 1).clamp(-9, 9).to(texture.dtype)
    padding = "border" if mirror else "zeros"
    return F.grid_sample(texture[None], grid[None, None], padding_mode=padding, align_corners=False)[0, :, 0].T


def _first(alpha: Tensor, depth: Tensor, number: Tensor) -> tuple[Tensor, Tensor]:
    """Which card stops each ray, and whether one does, ``(N, 1)`` each, from ``(N, K)`` of all cards."""
    order = depth.argsort(dim=1, stable=True)
    stopped = (1 - alpha.gather(1, order)).cumprod(1) <= number
    return order.gather(1, stopped.int().argmax(1, keepdim=True)), stopped.any(1, keepdim=True)


def _motion(scene: Scene, camera: Camera, card: Tensor, texel: Tensor) -> Tensor:
    """The way ``(N, 2)`` in px of texels ``(N, 3)`` of their cards ``(N,)`` while the shutter is open."""
    middle = torch.zeros(2, 2, dtype=torch.float64)
    matrices = scene.homographies(camera, middle, torch.tensor([-0.5, 0.5], dtype=torch.float64), middle)
    start, stop = (matrices[:, card] @ texel[:, :, None])[..., 0]
    return stop[:, :2] / stop[:, 2:].clamp_min(1e-6) - start[:, :2] / start[:, 2:].clamp_min(1e-6)
