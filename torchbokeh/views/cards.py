"""Many views of a scene: the accumulation buffer's way to see it."""

import math

import torch
from torch import Tensor

from torchbokeh.ops.planes import Plates, render_planes
from torchbokeh.ops.raycast import subsample_blur
from torchbokeh.scenes.camera import Camera
from torchbokeh.scenes.scene import Scene, inverse3, texel_area
from torchbokeh.views.points import Views
from torchbokeh.views.prism import Prism
from torchbokeh.views.setup import Bounds, ViewSettings, scheduled

CHUNK = 1 << 21
"""Pixels of frames held at a time while they wait for their sub-samples; only within these are renderings shared."""


@torch.no_grad()
def bounds(scene: Scene, plates: Plates, camera: Camera) -> Bounds:
    """Bounds from the corners of the cards, at times between which none of them turns by more than 45 degrees."""
    fastest = max((math.hypot(*s.angular_velocity) for s in scene.sprites), default=0.0)
    middle = 1 + min(math.ceil(fastest * camera.shutter / (math.pi / 4)), 64)
    times = torch.linspace(-0.5, 0.5, 2 * middle + 1, dtype=torch.float64)
    matrix = scene.homographies(camera, torch.zeros(len(times), 2), times, torch.zeros(len(times), 2))
    w, h = (torch.tensor([p[0].shape[n] for p in plates.levels], dtype=torch.float64) for n in (2, 1))
    zero, one = torch.zeros_like(w), torch.ones_like(w)
    corners = torch.stack(
        [torch.stack(c, -1) for c in ((zero, zero, one), (w, zero, one), (w, h, one), (zero, h, one))]
    )
    points = torch.einsum("vkij,ckj->vcki", matrix, corners)
    place, depth = points[..., :2] / points[..., 2:], points[..., 2]
    depth = torch.where(torch.tensor(plates.infinite), torch.inf, depth)
    # What reaches behind the lens has no bound: the blur goes to infinity there.
    inside = depth > 0
    coc = _coc(camera, torch.where(inside, depth, 1e-6))
    flat = coc.reshape(-1, len(plates.levels))
    motion = place.diff(dim=0).norm(dim=-1).amax((0, 1)) * (2 * middle)  # at the greatest speed of all
    motion = torch.where(inside.all(1).all(0), motion, torch.inf)
    still = torch.tensor(plates.mirror)  # the backdrop's corners may be anywhere, and it does not move
    texel = torch.stack([texel_area(matrix[middle, k], p[0]) for k, p in enumerate(plates.levels)])
    coarsest = torch.tensor([len(p) - 1 for p in plates.levels])
    return Bounds(flat.amin(0), flat.amax(0), torch.where(still, 0.0, motion), texel, coarsest)


def accumulate_scene(scene: Scene, camera: Camera, views: Views, prism: Prism | None, settings: ViewSettings) -> Tensor:
    """The mean of the views ``(1, 4, H, W)``, or their sum in the colours of a prism.

    See `torchbokeh.AccumulationBuffer` and `torchbokeh.ChromaticAccumulation`.
    """
    if len(scene) == 0:
        return torch.zeros(1, 4, *camera.size)
    plates = scene.plates() if settings.level_of_detail else scene.plates(levels=1)
    count, limits = len(views), bounds(scene, plates, camera)
    views, level, parents, offsets = scheduled(views, limits, prism, settings, by_wavelength=False)
    inverse = inverse3(scene.homographies(camera, views.lens, views.time, views.shift))
    if not settings.subsamples and prism is None:
        return render_planes(plates, inverse, level, camera.size, parents=parents)[0]
    sky = scene.backdrop is None or bool(plates.infinite[-1])
    texels = plates.levels[0][0]
    total = torch.zeros(1, 4, *camera.size, device=texels.device)
    limit = _coc(camera, torch.full((1, 1), torch.inf))
    chunk = max(1, CHUNK // (camera.size[0] * camera.size[1]))
    for start in range(0, count, chunk):
        part = slice(start, start + chunk)
        own, lod, shared = inverse[part], level[part], None
        if parents is not None:
            chosen = parents[part]
            own, lod = inverse.gather(0, chosen[..., None, None].expand_as(own)), level.gather(0, chosen)
            # Of the views of this part, the first with the same parent.
            shared = (chosen[:, None] == chosen).int().argmax(0)
        frames, nearest = render_planes(plates, own, lod, camera.size, parents=shared, frames=True)
        coc = _coc(camera, nearest.reciprocal())
        if prism is not None and not settings.subsamples:
            total = total + prism.moved(frames, coc.to(frames), views, start).sum(0, keepdim=True)
            continue
        background = None
        if sky:
            background = torch.zeros_like(frames)
            if scene.backdrop is not None:
                last = Plates(plates.levels[-1:], plates.mirror[-1:], plates.infinite[-1:])
                background = render_planes(last, inverse[part, -1:], level[part, -1:], camera.size, frames=True)[0]
        far = float(limit) - 1e-4 if sky else torch.inf  # 1e-4 px from the blur of infinity is infinity
        blurred = subsample_blur(frames, coc, offsets.to(frames.device), far=far, background=background)
        if prism is not None:
            blurred = prism.moved(blurred, coc.to(blurred), views, start)
        total = total + blurred.sum(0, keepdim=True)
    return (total if prism is not None else total / count).to(texels.dtype)


@torch.no_grad()
def _coc(camera: Camera, depth: Tensor) -> Tensor:
    """Signed CoC in px, where the depth is, wherever the lens is."""
    return camera.lens.coc(depth.to(camera.lens.focus_distance.device), camera.size[1]).to(depth.device)
