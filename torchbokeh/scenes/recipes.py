"""Recipes: scenes with a camera, drawn from a seed. Each puts one thing to the test that blur gets wrong."""

import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from torchbokeh.lens import ThinLens
from torchbokeh.ops.checks import check_finite, check_size, check_whole
from torchbokeh.scenes import shapes, textures
from torchbokeh.scenes._random import rng
from torchbokeh.scenes.camera import Camera
from torchbokeh.scenes.scene import Scene
from torchbokeh.scenes.sprite import Backdrop, Sprite, place

FOCAL_LENGTH, SENSOR_WIDTH = 0.050, 0.036
SHUTTER = 1 / 50
MOST_CARDS = 100_000
BLUR = 0.04
"""Largest CoC radius, as a share of the picture's width, where a recipe is not told another."""


class Studio:
    """What recipes share: a view to put cards into, and a lens that blurs them as much as wanted.

    Places are given as a camera sees them: ``x`` and ``y`` from -1 to 1 over the picture, whatever the depth, and
    sizes and speeds as shares of the picture's width.
    """

    def __init__(self, name: str, seed: int, size: tuple[int, int], focus: float, blur: float | None) -> None:
        if blur is not None:
            check_finite("blur", blur, 0)
        self.draw = rng(seed, name)
        self.size = check_size(size)
        self.focus = focus
        self.blur = BLUR * self.size[1] if blur is None else blur
        self.sprites: list[Sprite] = []

    def width(self, z: float) -> float:
        """How wide the picture is at depth ``z``, in metres."""
        return z * SENSOR_WIDTH * (1 / FOCAL_LENGTH - 1 / self.focus)

    def texels(self, share: float, aspect: float = 1.0) -> tuple[int, int]:
        """(h, w) of a texture for a card that is ``share`` of the picture wide: about one texel per pixel."""
        w = min(max(share * self.size[1], 8), 1024)
        return max(4, round(w * aspect)), max(4, round(w))

    def add(
        self,
        rgba: Tensor,
        x: float,
        y: float,
        z: float,
        share: float,
        *,
        turn: tuple[float, float, float] = (0.0, 0.0, 0.0),
        move: tuple[float, float] = (0.0, 0.0),
        spin: float = 0.0,
        emission: float = 1.0,
    ) -> None:
        """Put up a card.

        Args:
            rgba: its texture.
            x: of its centre.
            y: of its centre.
            z: its depth in metres.
            share: its width, as a share of the picture's.
            turn: rotation vector.
            move: its way (x, y) while the shutter is open, as shares of the picture's width.
            spin: how far it turns about its own axis while the shutter is open, in radians.
            emission: factor on its radiance.
        """
        width, tall = self.width(z), self.size[0] / self.size[1]
        h, w = rgba.shape[1:]
        self.sprites.append(
            Sprite(
                rgba,
                position=(0.5 * x * width, 0.5 * y * tall * width, z),
                size=(share * width, share * width * h / w),
                rotation=turn,
                velocity=(move[0] * width / SHUTTER, move[1] * width / SHUTTER, 0.0),
                angular_velocity=(0.0, 0.0, spin / SHUTTER),
                emission=emission,
            )
        )

    def card(self, share: float, shape: str | None = None, texture: str | None = None, aspect: float = 1.0) -> Tensor:
        """The texture of a card, of a drawn shape and picture where none is named."""
        size = self.texels(share, aspect)
        shape = shape or str(self.draw.choice(sorted(shapes.SHAPES)))
        texture = texture or str(self.draw.choice(sorted(textures.TEXTURES)))
        picture = textures.TEXTURES[texture](size, self.seed())
        return shapes.card(picture, shapes.SHAPES[shape](size, self.seed()))

    def seed(self) -> int:
        """A seed for something that draws by itself."""
        return int(self.draw.integers(1 << 31))

    def uniform(self, low: float, high: float) -> float:
        """A number, evenly distributed."""
        return float(self.draw.uniform(low, high))

    def backdrop(self, texture: str, distance: float = math.inf) -> Backdrop:
        """A picture behind everything, a little larger than the view."""
        size = self.size[0] * 5 // 4 + 1, self.size[1] * 5 // 4 + 1
        return Backdrop(textures.TEXTURES[texture](size, self.seed()), distance, 1.25 * self.width(1.0))

    def finish(self, backdrop: Backdrop) -> tuple[Scene, Camera]:
        """The scene, and the camera whose largest CoC of anything in it is as wanted."""
        lens = ThinLens(FOCAL_LENGTH, 1.0, self.focus, SENSOR_WIDTH)
        # Depth is linear over a card: its corners are its nearest and farthest points.
        rows = place(self.sprites, None, torch.zeros(1))[0, :, 2]
        sizes = torch.tensor([s.texture.shape[:0:-1] for s in self.sprites], dtype=torch.float64)
        corners = [
            rows[:, 2] + rows[:, 0] * i * sizes[:, 0] + rows[:, 1] * j * sizes[:, 1] for i in (0, 1) for j in (0, 1)
        ]
        depths = torch.cat([*corners, torch.tensor([backdrop.distance], dtype=torch.float64)])[None]
        coc = lens.coc(depths.clamp_min(1e-3), self.size[1])
        largest = float(coc.abs().max())
        f_number = largest / max(self.blur, 1e-6 * largest, 1e-12)
        lens = ThinLens(FOCAL_LENGTH, max(f_number, 1e-6), self.focus, SENSOR_WIDTH)
        return Scene(tuple(self.sprites), backdrop), Camera(lens, self.size, SHUTTER)


def coins(seed: int = 0, size: tuple[int, int] = (256, 256), blur: float | None = None) -> tuple[Scene, Camera]:
    """Coins with sparkling edges before a wall of lights: many small HDR highlights, near and far."""
    s = Studio("coins", seed, size, 1.6, blur)
    for k, z in enumerate(np.geomspace(0.9, 4.0, 8)):
        share = s.uniform(0.18, 0.32)
        rgba = s.card(share, "disc", str(s.draw.choice(["noise", "voronoi"])))
        rgba = _with_sparkles(rgba, s.draw, count=10, peak=40.0)
        turn = (s.uniform(-0.7, 0.7), s.uniform(-0.7, 0.7), 0.0)
        s.add(rgba, s.uniform(-0.8, 0.8), s.uniform(-0.8, 0.8), s.focus if k == 3 else float(z), share, turn=turn)
    return s.finish(s.backdrop("lights", 9.0))


def whirl(seed: int = 0, size: tuple[int, int] = (256, 256), blur: float | None = None) -> tuple[Scene, Camera]:
    """Things that fly fast and in all directions, turning as they go."""
    s = Studio("whirl", seed, size, 2.0, blur)
    for z in np.geomspace(1.2, 5.0, 9):
        share = s.uniform(0.15, 0.4)
        angle, way = s.uniform(0, 2 * math.pi), s.uniform(0.02, 0.15)
        s.add(
            s.card(share),
            *(s.uniform(-0.9, 0.9), s.uniform(-0.9, 0.9), float(z), share),
            turn=(s.uniform(-0.5, 0.5), s.uniform(-0.5, 0.5), s.uniform(-3, 3)),
            move=(way * math.cos(angle), way * math.sin(angle)),
            spin=s.uniform(-0.3, 0.3),
        )
    return s.finish(s.backdrop("photograph", 12.0))


def gears(seed: int = 0, size: tuple[int, int] = (256, 256), blur: float | None = None) -> tuple[Scene, Camera]:
    """Gear wheels that turn against each other: motion that no straight line describes."""
    s = Studio("gears", seed, size, 2.0, blur)
    for k, z in enumerate(np.geomspace(1.3, 4.5, 8)):
        share = s.uniform(0.3, 0.6)
        rgba = s.card(share, "gear", str(s.draw.choice(["noise", "checker", "line_art"])))
        spin = (1 if k % 2 else -1) * s.uniform(0.2, 1.0)
        s.add(rgba, s.uniform(-0.9, 0.9), s.uniform(-0.9, 0.9), float(z), share, spin=spin)
    return s.finish(s.backdrop("brick", 8.0))


def rain(seed: int = 0, size: tuple[int, int] = (256, 256), blur: float | None = None) -> tuple[Scene, Camera]:
    """Thin bright streaks that fall in front of a still scene."""
    s = Studio("rain", seed, size, 3.0, blur)
    s.add(s.card(0.5, texture="photograph"), s.uniform(-0.5, 0.5), s.uniform(-0.3, 0.5), 3.0, 0.5)
    s.add(s.card(0.4), s.uniform(-0.7, 0.7), s.uniform(-0.5, 0.5), 5.0, 0.4)
    drop = 0.6 * torch.tensor([0.75, 0.85, 1.0, 1.0])[:, None, None] * shapes.rectangle((24, 4))
    for _ in range(40):
        z = float(1 / s.uniform(1 / 2.5, 1 / 0.8))
        share = 0.006 * 2 / z
        way = s.uniform(0.06, 0.12) / z
        place = s.uniform(-1.1, 1.1), s.uniform(-1.1, 1.1)
        s.add(drop, *place, z, share, turn=(0.0, 0.0, -0.1), move=(0.1 * way, way), emission=s.uniform(2, 12))
    return s.finish(s.backdrop("noise", 15.0))


def ramp(seed: int = 0, size: tuple[int, int] = (256, 256), blur: float | None = None) -> tuple[Scene, Camera]:
    """A floor that runs from the camera through the focus to a far wall, with things that stand on it."""
    s = Studio("ramp", seed, size, 2.2, blur)
    near, far = 0.75, 8.0
    ground = 0.55 * s.width(near) * s.size[0] / s.size[1]  # the picture begins a tenth behind the floor's near edge
    texels = s.texels(2.0)
    name = str(s.draw.choice(["checker", "brick", "dead_leaves"]))
    floor = torch.cat([textures.TEXTURES[name](texels, s.seed()), torch.ones(1, *texels)])
    wide = s.width(far) * 1.3
    middle, length = 0.5 * (near + far), far - near
    s.sprites.append(Sprite(floor, (0.0, ground, middle), (max(wide, 3.0), length), rotation=(math.pi / 2, 0.0, 0.0)))
    for z in np.geomspace(1.2, 6.0, 6):
        tall = s.uniform(0.3, 0.7)
        rgba = s.card(tall / s.width(float(z)), str(s.draw.choice(["rectangle", "leaf", "gear", "glyph", "polygon"])))
        x = s.uniform(-0.4, 0.4) * s.width(float(z))
        s.sprites.append(
            Sprite(rgba, (x, ground - tall / 2, float(z)), (tall, tall), rotation=(0.0, s.uniform(-0.9, 0.9), 0.0))
        )
    return s.finish(s.backdrop("photograph", far))


def fence(seed: int = 0, size: tuple[int, int] = (256, 256), blur: float | None = None) -> tuple[Scene, Camera]:
    """A sharp subject behind a fence so near that it is no more than a veil."""
    s = Studio("fence", seed, size, 3.0, 2 * BLUR * size[1] if blur is None else blur)
    share = 1.6
    wire = shapes.grid(s.texels(share), s.seed(), pitch=s.uniform(0.06, 0.1), bar=s.uniform(0.08, 0.16))
    metal = textures.noise(s.texels(share), s.seed())
    s.add(shapes.card(metal, wire), 0.0, 0.0, 0.7, share, turn=(0.0, s.uniform(-0.3, 0.3), s.uniform(-0.2, 0.2)))
    s.add(s.card(0.45, texture="photograph"), s.uniform(-0.3, 0.3), s.uniform(-0.2, 0.2), 3.0, 0.45)
    for z in (4.0, 5.0, 7.0):
        s.add(s.card(0.4), s.uniform(-0.9, 0.9), s.uniform(-0.7, 0.7), z, 0.4, turn=(0.0, s.uniform(-0.6, 0.6), 0.0))
    return s.finish(s.backdrop("lights", 12.0))


def sky(seed: int = 0, size: tuple[int, int] = (256, 256), blur: float | None = None) -> tuple[Scene, Camera]:
    """Leaves and letters before a sky: a background without depth."""
    s = Studio("sky", seed, size, 2.5, blur)
    for z in np.geomspace(1.0, 20.0, 8):
        share = s.uniform(0.15, 0.4)
        rgba = s.card(share, str(s.draw.choice(["leaf", "glyph", "polygon", "ring"])))
        turn = (s.uniform(-0.6, 0.6), s.uniform(-0.6, 0.6), s.uniform(-3, 3))
        s.add(rgba, s.uniform(-0.9, 0.9), s.uniform(-0.9, 0.9), float(z), share, turn=turn)
    h, w = s.size[0] * 5 // 4 + 1, s.size[1] * 5 // 4 + 1
    up = torch.linspace(0, 1, h)[None, :, None]
    blue, haze = torch.tensor([0.12, 0.3, 0.75])[:, None, None], torch.tensor([0.75, 0.8, 0.85])[:, None, None]
    grey = textures.noise((h, w), s.seed()).mean(0, keepdim=True).numpy()  # torch's sums depend on the threads
    clouds = torch.from_numpy((grey - grey.mean()) / max(float(grey.std()), 1e-6) - 0.3).clamp(0, 1)
    picture = torch.lerp(torch.lerp(blue, haze, up).expand(3, h, w), torch.full((3, h, w), 1.1), 0.8 * clouds)
    return s.finish(Backdrop(picture, width=1.25 * s.width(1.0)))


def stack(
    seed: int = 0, size: tuple[int, int] = (256, 256), blur: float | None = None, *, count: int = 300
) -> tuple[Scene, Camera]:
    """Hundreds of small cards, one behind the other: what the number of things costs."""
    check_whole("count", count, 1, MOST_CARDS)
    s = Studio("stack", seed, size, 2.5, blur)
    kinds = [s.card(0.15) for _ in range(12)]
    for depth in np.linspace(1 / 1.2, 1 / 12.0, count):
        z = float(1 / depth)
        share = s.uniform(0.05, 0.15)
        turn = (s.uniform(-0.5, 0.5), s.uniform(-0.5, 0.5), s.uniform(-3, 3))
        s.add(kinds[s.draw.integers(len(kinds))], s.uniform(-1, 1), s.uniform(-1, 1), z, share, turn=turn)
    return s.finish(s.backdrop("noise", 15.0))


RECIPES: dict[str, Callable[..., tuple[Scene, Camera]]] = {
    f.__name__: f for f in (coins, whirl, gears, rain, ramp, fence, sky, stack)
}
"""All recipes by name: ``recipe(seed, size, blur)`` with the size (H, W) and the largest CoC radius in px."""


def _with_sparkles(rgba: Tensor, draw: np.random.Generator, count: int, peak: float) -> Tensor:
    """Small bright glints on a card, where it is opaque."""
    _, h, w = rgba.shape
    y, x = torch.meshgrid(torch.arange(h) + 0.5, torch.arange(w) + 0.5, indexing="ij")
    out = rgba.clone()
    for _ in range(count):
        radius = draw.uniform(0.7, max(0.8, 0.02 * w))
        cx, cy = draw.uniform(0.15, 0.85) * w, draw.uniform(0.15, 0.85) * h
        glint = (radius + 0.5 - torch.hypot(x - cx, y - cy)).clamp(0, 1) * rgba[3]
        colour = torch.tensor([1.0, draw.uniform(0.7, 1.0), draw.uniform(0.4, 0.9)])[:, None, None]
        out[:3] = torch.maximum(out[:3], glint * colour * draw.uniform(0.2, 1.0) * peak)
    return out
