"""The reference renderer: the mean of many views through the lens while the shutter is open."""

from numbers import Real

from torch import Tensor, nn

from torchbokeh.lens import Lens
from torchbokeh.ops import sampling
from torchbokeh.ops.checks import check_image, check_whole
from torchbokeh.picture.request import Optics, Request
from torchbokeh.psfs.aperture import Aperture, parse_aperture
from torchbokeh.scenes.camera import Camera
from torchbokeh.scenes.scene import Scene
from torchbokeh.views.cards import accumulate_scene
from torchbokeh.views.layers import accumulate_layers
from torchbokeh.views.points import Views
from torchbokeh.views.prism import Prism
from torchbokeh.views.setup import ViewSettings

MOST = 1 << 20
"""Views, and sub-samples of each, at most: there are tables of them."""

LAST = (1 << 62) - 1
"""Largest seed, and number of raster cells per pixel."""


class AccumulationBuffer(nn.Module):
    """Depth of field and motion blur as the mean of many pinhole pictures: exact in the limit of many views.

    Each view looks through its own point of the lens at its own time. Points are those of the Halton sequence, mapped
    to the aperture so that equal areas are met equally often; times are stratified over the open shutter. It takes a
    `torchbokeh.scenes.Scene`, which has an exact picture through every point, or layers with depth, each of which is
    warped by the parallax of its pixels.

    Three techniques spend fewer operations on the same picture (chapter 3 of the defocus and bokeh dissertation).
    Each has its own switch, all are off:

    * ``level_of_detail`` (3.2): a blurred card shows a coarser level of its texture.
    * ``reuse`` (3.3): views that put a card on the same raster cell share one rendering of it.
    * ``subsamples`` (3.4): every view is blurred once more over the lens around it, by casting rays through its own
      depth.

    A pixel of a layer that is NaN or infinite spoils no more than its PSF, in its channel.

    Memory does not grow with the number of views, but where a gradient is asked for: that keeps every view.

    Args:
        lens: turns the depth of layers into signed CoC; ``None`` for scenes, whose camera has one.
        aperture: ``"disc"``, ``"N-gon"`` such as ``"6-gon"``, or a `torchbokeh.psfs.Aperture`.
        views: how many, N.
        level_of_detail: share of a CoC's area that one texel may cover: 0 is off, 1 as in the text, where texels
            blur about as much as the lens does. ``"auto"`` is ``2 / views``: as much as lies between two views.
        reuse: raster cells per pixel and direction: 0 is off, 1 as in the text, 2 its finer grid.
        subsamples: S, for each view; 0 is off.
        seed: turn the sequence at random, for a picture with independent noise; ``None`` takes it as it is.
        first: index of the first view in the sequence, to go on where another buffer ended.

    Raises:
        TypeError: an argument of the wrong kind.
        ValueError: a value out of its range.

    Example:
        >>> import torch
        >>> import torchbokeh as tb
        >>> buffer = tb.AccumulationBuffer(tb.ThinLens(0.050, 1.8, 2.0, sensor_width=0.036), views=16)
        >>> buffer(torch.rand(1, 2, 4, 24, 32), torch.full((1, 2, 1, 24, 32), 3.0)).shape
        torch.Size([1, 4, 24, 32])
    """

    views: int
    level_of_detail: float
    reuse: int
    subsamples: int
    seed: int | None
    first: int

    def __init__(
        self,
        lens: Lens | None = None,
        aperture: str | Aperture = "disc",
        views: int = 256,
        *,
        level_of_detail: float | str = 0.0,
        reuse: int = 0,
        subsamples: int = 0,
        seed: int | None = None,
        first: int = 0,
    ) -> None:
        super().__init__()
        if lens is not None and not isinstance(lens, Lens):
            raise TypeError(f"lens: expected a Lens, got {type(lens).__name__}")
        self.lens = lens
        self.aperture = parse_aperture(aperture)
        self.views = check_whole("views", views, 1, MOST)
        if isinstance(level_of_detail, str) and level_of_detail == "auto":
            level_of_detail = min(1.0, 2 / self.views)
        if not isinstance(level_of_detail, Real) or isinstance(level_of_detail, bool):
            raise TypeError(f"level_of_detail: expected a number or 'auto', got {level_of_detail!r}")
        if not 0 <= level_of_detail <= 1:
            raise ValueError(f"level_of_detail: expected a share from 0 to 1, got {level_of_detail}")
        self.level_of_detail = float(level_of_detail)
        self.reuse = check_whole("reuse", reuse, 0, LAST)
        self.subsamples = check_whole("subsamples", subsamples, 0, MOST)
        self.seed = None if seed is None else check_whole("seed", seed, 0, LAST)
        self.first = check_whole("first", first, 0, sampling.MOST)

    def extra_repr(self) -> str:
        """The settings, for ``print``."""
        names = ("views", "level_of_detail", "reuse", "subsamples", "seed", "first")
        return ", ".join(f"{name}={getattr(self, name)}" for name in names)

    def forward(
        self,
        source: Scene | Tensor,
        depth: Camera | Tensor | None = None,
        *,
        coc: Tensor | None = None,
        motion: Tensor | None = None,
    ) -> Tensor:
        """Render.

        Args:
            source: a `Scene`, or layers ``(B, L, 4, H, W)`` of premultiplied RGBA, front to back.
            depth: the scene's `Camera`; or of the layers ``(B, L, 1, H, W)``, metres (``inf`` is sky) for a
                `ThinLens`, disparity for a `DisparityLens`.
            coc: signed CoC radius of the layers in px, in the place of ``depth``.
            motion: of the layers ``(B, L, 2, H, W)``, the way (dx, dy) in px over the open shutter.

        Returns:
            ``(B, 4, H, W)`` premultiplied RGBA, with ``B = 1`` for a scene. That of a scene is differentiable to its
            textures and the aperture, not to the camera; that of layers to the layers, their depth, their motion, the
            lens and the aperture.

        Raises:
            TypeError: an argument of the wrong kind.
            ValueError: shapes, devices or values do not fit: see the message.
        """
        settings = ViewSettings(self.level_of_detail, self.reuse, self.subsamples)
        if isinstance(source, Scene):
            if not isinstance(depth, Camera):
                raise TypeError(f"depth: expected a Camera beside the scene, got {type(depth).__name__}")
            for name, value in (("lens", self.lens), ("coc", coc), ("motion", motion)):
                if value is not None:
                    raise ValueError(f"{name}: expected None for a scene, got {type(value).__name__}")
            return accumulate_scene(source, depth, *self._spread(depth.lens, depth.size), settings)
        if not isinstance(source, Tensor):
            raise TypeError(f"source: expected a Scene, with its Camera, or layers, got {type(source).__name__}")
        check_image("source", source, ("B", "L", 4, "H", "W"))
        if motion is not None:
            check_image("motion", motion, (*source.shape[:2], 2, *source.shape[3:]), like=source)
            if not bool(motion.isfinite().all()):
                raise ValueError(f"motion: expected finite ways, got {int((~motion.isfinite()).sum())} that are not")
        request = Request.of(Optics(self.lens), source, depth, coc=coc, motion=motion)
        layers, radii, moved, *_ = request.working()
        views = self._spread(self.lens, request.sensor.size)
        displacement = moved.displacements[0] if moved else None
        return request.answered(accumulate_layers(layers, radii, displacement, *views, settings))

    def _spread(self, lens: Lens | None, size: tuple[int, int]) -> tuple[Views, Prism | None]:
        """The views, and what a lens does to their wavelengths where these are told apart."""
        return Views.spread(self.views, self.aperture.profile(), first=self.first, seed=self.seed), None
