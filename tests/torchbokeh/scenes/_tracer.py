"""A ray tracer for scenes of cards, to check renderers against: one ray, one lens point, one time at a time.

It knows nothing of homographies, views or levels of detail. A ray leaves a point of the lens, goes through the point
of the focus plane that the place on the sensor is sharp for, meets every card where that stands at that time, and
puts together what it met. Only numpy, in double.
"""

from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from torchbokeh import ThinLens
from torchbokeh.scenes import Backdrop, Camera, Scene, Sprite


class Rays(NamedTuple):
    """``(N, 2)`` places in the picture in px, ``(N, 2)`` points of the unit lens, ``(N,)`` times from -0.5 to 0.5."""

    pixel: np.ndarray
    lens: np.ndarray
    time: np.ndarray


def random_disc(generator: np.random.Generator, count: int) -> np.ndarray:
    """Points evenly distributed over the unit disc: those of a square that are within it."""
    found = generator.uniform(-1, 1, (2 * count + 64, 2))
    found = found[(found**2).sum(1) <= 1]
    return found[:count] if len(found) >= count else np.concatenate([found, random_disc(generator, count - len(found))])


def trace(scene: Scene, camera: Camera, rays: Rays) -> np.ndarray:
    """What the rays see, ``(N, 4)``."""
    height, width = camera.size
    focal, focus = float(camera.lens.focal_length), float(camera.lens.focus_distance)
    pitch = float(camera.lens.sensor_width) / width  # of a pixel on the sensor, in metres
    image_distance = focal if np.isinf(focus) else focal * focus / (focus - focal)
    origin = np.zeros((len(rays.time), 3))
    origin[:, :2] = rays.lens * focal / (2 * float(camera.lens.f_number))
    # The sensor upside down in front of the lens.
    sensor = np.empty_like(origin)
    sensor[:, :2] = (rays.pixel - [width / 2, height / 2]) * pitch
    sensor[:, 2] = image_distance
    focused = sensor if np.isinf(focus) else sensor * (focus / image_distance)  # where the ray through the middle goes
    direction = sensor / image_distance if np.isinf(focus) else (focused - origin) / focus
    # Now `direction` has a z of 1, and the way along a ray is the depth.
    times = rays.time * camera.shutter
    hits = [_meet_card(sprite, origin, direction, times) for sprite in scene.sprites]
    if scene.backdrop is not None:
        far = scene.backdrop.distance
        at = direction[:, :2] if np.isinf(far) else (origin[:, :2] + far * direction[:, :2]) / far
        texture = scene.backdrop.texture.double().numpy()
        place = at / scene.backdrop.width * texture.shape[2] + [texture.shape[2] / 2, texture.shape[1] / 2]
        opaque = np.concatenate([texture, np.ones_like(texture[:1])])
        hits.append((np.full(len(times), far), _bilinear(opaque, place, mirrored=True)))
    return _over(hits, len(times))


def _meet_card(
    sprite: Sprite, origin: np.ndarray, direction: np.ndarray, times: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Depth and colour of a card along every ray."""
    centre = np.array(sprite.position) + times[:, None] * np.array(sprite.velocity)
    turn = Rotation.from_rotvec(times[:, None] * np.array(sprite.angular_velocity)) * Rotation.from_rotvec(
        sprite.rotation
    )
    axes = turn.as_matrix()
    normal = axes[:, :, 2]
    along = (normal * direction).sum(1)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = (normal * (centre - origin)).sum(1) / along
    seen = np.isfinite(depth) & (depth > 0)
    depth = np.where(seen, depth, np.inf)
    hit = origin + np.where(seen, depth, 0.0)[:, None] * direction
    local = np.einsum("nij,ni->nj", axes, hit - centre)[:, :2]
    texture = sprite.texture.double().numpy()
    place = (local / np.array(sprite.size) + 0.5) * [texture.shape[2], texture.shape[1]]
    colour = _bilinear(texture, place, mirrored=False) * [*[sprite.emission] * 3, 1.0]
    return depth, np.where(seen[:, None], colour, 0.0)


def _bilinear(texture: np.ndarray, place: np.ndarray, mirrored: bool) -> np.ndarray:
    """Texture ``(C, h, w)`` at ``(N, 2)`` places (s, t): the centre of texel i is at i + 0.5."""
    _, h, w = texture.shape
    low = np.floor(place - 0.5)
    share = place - 0.5 - low
    out = np.zeros((len(place), texture.shape[0]))
    for dy in (0, 1):
        for dx in (0, 1):
            weight = (share[:, 0] if dx else 1 - share[:, 0]) * (share[:, 1] if dy else 1 - share[:, 1])
            i, j = low[:, 0] + dx, low[:, 1] + dy
            if mirrored:
                i, j = np.mod(i, 2 * w), np.mod(j, 2 * h)
                i, j = np.where(i >= w, 2 * w - 1 - i, i), np.where(j >= h, 2 * h - 1 - j, j)
            else:
                weight = weight * ((i >= 0) & (i < w) & (j >= 0) & (j < h))
            i, j = np.clip(i, 0, w - 1).astype(int), np.clip(j, 0, h - 1).astype(int)
            out += weight[:, None] * texture[:, j, i].T
    return out


def _over(hits: list[tuple[np.ndarray, np.ndarray]], count: int) -> np.ndarray:
    """Put what each ray met over one another, nearest first."""
    if not hits:
        return np.zeros((count, 4))
    depth, colour = np.stack([h[0] for h in hits]), np.stack([h[1] for h in hits])
    order = depth.argsort(0, kind="stable")
    colour = np.take_along_axis(colour, order[..., None], 0)
    out, left = np.zeros((count, 4)), np.ones((count, 1))
    for layer in colour:
        out += left * layer
        left = left * (1 - layer[:, 3:])
    return out


def trace_views(
    scene: Scene, camera: Camera, lens: np.ndarray, time: np.ndarray, shift: np.ndarray, pixels: np.ndarray
) -> np.ndarray:
    """Mean over given views, ``(P, 4)``, at pixels ``(P, 2)`` of integer (x, y), through their shifted centres."""
    total = np.zeros((len(pixels), 4))
    for point, when, moved in zip(lens, time, shift, strict=True):
        n = len(pixels)
        rays = Rays(pixels + 0.5 - moved, np.broadcast_to(point, (n, 2)), np.full(n, when))
        total += trace(scene, camera, rays)
    return total / len(time)


def trace_picture(scene: Scene, camera: Camera, samples: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean ``(4, H, W)`` of random rays over pixel, lens and shutter, and the variance of that mean."""
    generator = np.random.default_rng(seed)
    height, width = camera.size
    y, x = np.mgrid[:height, :width]
    corner = np.stack([x.ravel(), y.ravel()], 1).astype(float)
    total, squares = np.zeros((2, len(corner), 4))
    at_once = max(1, 4096 // len(corner))
    for start in range(0, samples, at_once):
        rounds = min(at_once, samples - start)
        pixel = np.tile(corner, (rounds, 1))
        n = len(pixel)
        lens = random_disc(generator, n)
        rays = Rays(pixel + generator.uniform(0, 1, (n, 2)), lens, generator.uniform(-0.5, 0.5, n))
        seen = trace(scene, camera, rays).reshape(rounds, -1, 4)
        total += seen.sum(0)
        squares += (seen**2).sum(0)
    mean = total / samples
    variance = (squares / samples - mean**2).clip(0) / (samples - 1)
    return mean.T.reshape(4, height, width), variance.T.reshape(4, height, width)


def random_scene(seed: int, dtype: torch.dtype = torch.float32) -> tuple[Scene, Camera]:
    """Up to six cards at any angle, which cut through each other and the plane of the lens, before any backdrop."""
    draw = np.random.default_rng(seed)

    def vector(scale: float) -> tuple[float, float, float]:
        return tuple(draw.normal(0, scale, 3).tolist())

    def texture(channels: int, largest: int) -> torch.Tensor:
        return torch.from_numpy(draw.random((channels, *draw.integers(1, largest, 2)))).float()

    sprites = []
    for _ in range(draw.integers(1, 7)):
        rgba = texture(4, 20)
        if draw.random() < 0.5:
            rgba[3] = 1.0
        rgba[:3] *= rgba[3]
        z = draw.uniform(-0.3, 8)
        sprites.append(
            Sprite(
                rgba.to(dtype),
                position=(z * draw.uniform(-0.4, 0.4), z * draw.uniform(-0.3, 0.3), z),
                size=tuple(draw.uniform(0.2, 4, 2).tolist()),
                rotation=vector(1.5),
                velocity=vector(10.0),
                angular_velocity=vector(20.0),
                emission=float(draw.choice([1.0, 5.0])),
            )
        )
    distance = [None, np.inf, draw.uniform(3, 12)][draw.integers(3)]
    behind = None if distance is None else Backdrop(texture(3, 12).to(dtype), float(distance), draw.uniform(0.2, 1))
    parameters = 0.05, draw.uniform(0.7, 8), draw.choice([0.5, 1.0, 2.0, 5.0, np.inf]), 0.036
    lens = ThinLens(*(torch.tensor(v, dtype=dtype) for v in parameters))
    return Scene(tuple(sprites), behind), Camera(lens, tuple(draw.integers(5, 30, 2).tolist()), shutter=1 / 50)
