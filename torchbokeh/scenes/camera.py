"""The camera that looks at a scene."""

from dataclasses import dataclass

import torch
from torch import Tensor

from torchbokeh.lens import ThinLens
from torchbokeh.ops.checks import check_finite, check_kind, check_size


@dataclass(frozen=True)
class Camera:
    """A thin lens in the origin that looks along +z, x to the right and y down, with the sensor behind it.

    The sensor stands where the focus distance is sharp, so the picture of a point at ``(X, Y, Z)`` has its centre at
    ``(W, H) / 2 + focal * (X, Y) / Z`` px, with ``focal = F * df / (df - F) * W / sensor_width``: focusing nearer
    enlarges the picture, as it does in a camera.

    Args:
        lens: a `ThinLens` whose parameters are scalars.
        size: ``(H, W)`` of the picture in px.
        shutter: how long it stays open, in seconds, >= 0; the time 0 of the scene is half way.

    Raises:
        TypeError: ``lens`` is no `ThinLens`, ``size`` not two integers, or ``shutter`` no number.
        ValueError: a batched lens, an empty picture, a negative shutter time.

    Example:
        >>> from torchbokeh import ThinLens
        >>> camera = Camera(ThinLens(0.05, 2.0, torch.inf, sensor_width=0.036), size=(240, 360))
        >>> round(camera.focal_px, 3)
        500.0
    """

    lens: ThinLens
    size: tuple[int, int]
    shutter: float = 1 / 50

    def __post_init__(self) -> None:
        check_kind("lens", self.lens, ThinLens)
        for name, value in self.lens.values().items():
            if value.dim():
                raise ValueError(f"lens: expected scalar parameters, got {name} of shape {tuple(value.shape)}")
        object.__setattr__(self, "size", check_size(self.size))
        check_finite("shutter", self.shutter, 0)

    @property
    def focal_px(self) -> float:
        """Distance of the sensor from the lens, in px."""
        focal, focus = self.lens.focal_length.item(), self.lens.focus_distance.item()
        return focal / (1 - focal / focus) * self.size[1] / self.lens.sensor_width.item()

    def projection(self, lens: Tensor, shift: Tensor) -> Tensor:
        """Matrices ``(V, 3, 4)`` from points ``(X, Y, Z, 1)`` to ``Z * (x, y, 1)`` in px, one for each view.

        A ray through the lens point ``e`` meets the focus plane where the one through the middle of the lens does, so
        a point moves by ``focal * e * (1/df - 1/Z)``: its signed CoC times the lens point in units of the aperture
        radius. A direction ``(X, Y, Z, 0)`` is a point at infinity.

        Args:
            lens: ``(V, 2)`` points (x, y) of the lens in units of the aperture radius.
            shift: ``(V, 2)`` by which the picture moves, in px.
        """
        focal = self.focal_px
        offset = focal * self.lens.aperture_radius.item() * lens.double()
        middle = torch.tensor([self.size[1] / 2, self.size[0] / 2], dtype=torch.float64)
        matrix = torch.zeros(len(lens), 3, 4, dtype=torch.float64)
        matrix[:, 0, 0] = matrix[:, 1, 1] = focal
        matrix[:, :2, 2] = middle + shift.double() + offset / self.lens.focus_distance.item()
        matrix[:, :2, 3] = -offset
        matrix[:, 2, 2] = 1
        return matrix
