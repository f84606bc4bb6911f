"""The thin lens: focal length, f-number and focus distance say how blurred a depth is."""

import math

import torch
from torch import Tensor

from torchbokeh.lens.base import Lens, check_map, check_width
from torchbokeh.lens.dispersion import Dispersion
from torchbokeh.lens.field_map import Field
from torchbokeh.lens.parameters import check_parameter
from torchbokeh.ops.checks import check_number

RANGES = {"focal_length": (1e-6, 1e4), "f_number": (1e-6, 1e12), "sensor_width": (1e-4, 1e4)}
"""Parameters of a `ThinLens`: beyond these, radii would leave the range of float32."""

NEAREST = 1e-9
"""Metres: what is nearer counts as depth 0, whose radius is infinite."""


class ThinLens(Lens):
    """A thin lens: focal length, f-number, focus distance and sensor width say how large the blur is.

    The CoC radius in pixels is, with ``E = focal_length / (2 * f_number)`` the radius of the aperture::

        coc = E * F / (df - F) * (d - df) / d * width / sensor_width

    positive behind the focus distance ``df``, negative before it. It is evaluated in reciprocal distances, as
    ``E * F * (1/df - 1/d) / (1 - F/df)``, so ``d = inf`` (sky) and ``df = inf`` take their limits, and so do
    the gradients.

    Args:
        focal_length: F, in metres, > 0, within `RANGES` as the f-number and the sensor width are.
        f_number: N, > 0; the aperture is ``F / N`` wide.
        focus_distance: df, in metres from the lens, > F; ``inf`` focuses on infinity.
        sensor_width: in metres, > 0; the image's ``width`` pixels cover it.
        dispersion: chromatic aberration; ``None`` for none.

    Each but the last is a number, a 0-d or ``(B,)`` floating-point tensor, or an ``nn.Parameter``. Numbers are held in
    float32; give float64 tensors where the last digits count.

    Raises:
        TypeError: not a number or floating-point tensor.
        ValueError: out of its range, or shapes or devices that do not go together.

    Source: the defocus equation (3.2) of the defocus and bokeh dissertation.

    Example:
        >>> import torch
        >>> from torchbokeh.lens import ThinLens
        >>> lens = ThinLens(focal_length=0.050, f_number=1.8, focus_distance=2.0, sensor_width=0.036)
        >>> depth = torch.tensor([1.0, 2.0, torch.inf]).view(1, 1, 1, 3)
        >>> [round(r, 2) for r in lens.coc(depth, width=1920).flatten().tolist()]
        [-18.99, 0.0, 18.99]
    """

    focal_length: Tensor
    f_number: Tensor
    focus_distance: Tensor
    sensor_width: Tensor

    def __init__(
        self,
        focal_length: float | Tensor,
        f_number: float | Tensor,
        focus_distance: float | Tensor,
        sensor_width: float | Tensor,
        *,
        dispersion: Dispersion | None = None,
    ) -> None:
        super().__init__()
        self.keep(
            focal_length=focal_length,
            f_number=f_number,
            focus_distance=focus_distance,
            sensor_width=sensor_width,
        )
        for name, (low, high) in RANGES.items():
            value = getattr(self, name)
            check_parameter(name, value, (value > 0) & value.isfinite(), "a positive finite value")
            check_parameter(name, value, (value >= low) & (value <= high), f"from {low:g} to {high:g}")
        focus, focal = torch.broadcast_tensors(self.focus_distance, self.focal_length)
        # Nearer to it by less, rounding would make the blur infinite.
        beyond = (focus > focal) & (1 - focal.float() / focus.float() > 1e-6)
        nearest = focal[~beyond][:1].tolist()
        if nearest:
            want = f"more than the focal length ({nearest[0]:g} m)"
            check_parameter("focus_distance", focus, beyond, want)
        if dispersion is not None and not isinstance(dispersion, Dispersion):
            raise TypeError(f"dispersion: expected a Dispersion or None, got {type(dispersion).__name__}")
        self.dispersion = dispersion

    @property
    def aperture_radius(self) -> Tensor:
        """``E = focal_length / (2 * f_number)`` in metres, of the parameters' shape: scalar or ``(B,)``."""
        return self.focal_length / (2 * self.f_number)

    def coc(self, depth: Tensor, width: int, *, field: Field | None = None) -> Tensor:
        """Signed CoC radius in pixels, positive behind the focus distance.

        Args:
            depth: ``(B, 1, H, W)`` or ``(..., H, W)``, metres along the optical axis, > 0; ``inf`` is sky.
            width: width of the sensor in pixels.
            field: without effect: depth is planar.

        Returns:
            The shape of ``depth``, float32 or float64. Finite at ``inf``, with gradient 0 to such a depth.

        Raises:
            TypeError: ``depth`` is no floating-point tensor, or ``width`` no integer.
            ValueError: wrong shape or device, ``width`` < 1, or a depth <= 0 or NaN. Looking at the values
                costs a device synchronisation and is left out in ``torch.compile`` and ``torch.export``.

        Example:
            >>> lens = ThinLens(0.050, 1.8, focus_distance=torch.inf, sensor_width=0.036)
            >>> lens.coc(torch.full((1, 1, 2, 2), torch.inf), width=1920).abs().max().item()
            0.0
        """
        d, f, n, df, sensor = self.aligned("depth", depth, width)
        check_map("depth", d, d >= NEAREST, "values above 0 (inf is sky)")
        gain, focus = _optics(f, n, df, sensor, width)
        # reciprocal(), not a quotient: its derivative, minus its own square, is 0 at inf and never NaN.
        return gain * (focus - d.reciprocal())

    def depth(self, coc: Tensor, width: int) -> Tensor:
        """Depth in metres at which the signed CoC radius is ``coc``: the inverse of :meth:`coc`.

        The CoC grows towards a limit as the depth goes to infinity. At that limit and beyond it the answer is
        ``inf``, with gradient 0. NaN stays NaN.

        Args:
            coc: ``(B, 1, H, W)`` or ``(..., H, W)``, signed radius in pixels.
            width: width of the whole image in pixels.

        Returns:
            The shape of ``coc``, float32 or float64.

        Raises:
            TypeError: ``coc`` is no floating-point tensor, or ``width`` no integer.
            ValueError: wrong shape or device, or ``width`` < 1.

        Example:
            >>> lens = ThinLens(0.050, 1.8, focus_distance=2.0, sensor_width=0.036)
            >>> lens.depth(torch.tensor([[0.0, 100.0]]), width=1920).tolist()
            [[2.0, inf]]
        """
        c, f, n, df, sensor = self.aligned("coc", coc, width)
        gain, focus = _optics(f, n, df, sensor, width)
        # The same product as coc() forms at infinity, so that its limit comes back as exactly 1 / inf.
        return _distance((gain * focus - c) / gain)

    def coc_shift(self, wavelength: float, width: int, field: Field | None = None) -> Tensor:
        """How much larger the signed CoC radius of a wavelength is than :meth:`coc`, in px, at every depth.

        The sensor stays where it is, so ``1 / df(λ) = 1 / df + 1 / F(λ) - 1 / F``, which is (4.5) of the dissertation:
        a sum of dioptres, whatever the depth. It needs no condition like (4.6): light that would be in focus beyond
        infinity is blurred like any other.

        Args:
            wavelength: in nanometres.
            width: width of the whole image in pixels.
            field: where in the picture; ``None`` for the middle.

        Returns:
            Broadcasts with ``(B, 1, H, W)``; 0 without dispersion.

        Example:
            >>> lens = ThinLens(0.05, 1.8, 2.0, 0.036, dispersion=Dispersion("BK7", axial=0.5))
            >>> round(lens.coc_shift(475.0, width=1920).item(), 2)
            6.36
        """
        check_width(width)
        if self.dispersion is None:
            return super().coc_shift(wavelength, width, field)
        gain, _ = _optics(self.focal_length, self.f_number, self.focus_distance, self.sensor_width, width)
        parts = gain / self.focal_length, self.dispersion.power(wavelength, field)
        dioptres, power = (t.view(-1, 1, 1, 1) if t.dim() == 1 else t for t in parts)
        return dioptres * power

    def focus_at(self, wavelength: float) -> Tensor:
        """Focus distance of a wavelength in metres, in the middle of the picture: (4.5) of the dissertation.

        Raises:
            ValueError: it lies beyond infinity: condition (4.6) fails.

        Example:
            >>> lens = ThinLens(0.05, 1.8, 2.0, 0.036, dispersion=Dispersion("BK7"))
            >>> round(lens.focus_at(475.0).item(), 3)
            1.194
        """
        power = torch.zeros(()) if self.dispersion is None else self.dispersion.power(wavelength)
        nearness = self.focus_distance.reciprocal() + power / self.focal_length
        if not bool((nearness > 0).all()):
            raise ValueError(
                f"wavelength: expected one that is in focus at a finite distance, got {wavelength:g} nm, whose focal "
                f"length is too long; focus nearer than {(-self.focal_length / power).min().item():g} m, or take it "
                "as the reference of the dispersion"
            )
        return nearness.reciprocal()

    def hyperfocal(self, max_coc: float, width: int) -> Tensor:
        """Shortest focus distance that keeps infinity sharp.

        It is ``F * (1 + E * width / (sensor_width * max_coc))``, whatever the lens's own focus distance.
        Focused there, the far limit is infinity and the near limit exactly half this distance.

        Args:
            max_coc: largest CoC radius in pixels that still counts as sharp, > 0.
            width: width of the whole image in pixels.

        Returns:
            Metres, of the parameters' shape: scalar or ``(B,)``.

        Raises:
            TypeError: ``max_coc`` is no number, or ``width`` no integer.
            ValueError: ``max_coc`` is not positive and finite, or ``width`` < 1.

        Example:
            >>> lens = ThinLens(0.050, 8.0, focus_distance=2.0, sensor_width=0.036)
            >>> round(lens.hyperfocal(max_coc=0.5, width=1920).item(), 2)
            16.72
        """
        _check_sharpness(max_coc, width)
        return self.focal_length * (1 + self.aperture_radius * (width / max_coc) / self.sensor_width)

    def near_limit(self, max_coc: float, width: int) -> Tensor:
        """Nearest depth whose CoC radius is at most ``max_coc`` pixels; see :meth:`far_limit`."""
        return self._limit(-1, max_coc, width)

    def far_limit(self, max_coc: float, width: int) -> Tensor:
        """Farthest depth whose CoC radius is at most ``max_coc`` pixels.

        ``inf`` when the lens is focused at the hyperfocal distance or beyond.

        Args, result and errors are those of :meth:`hyperfocal`.

        Example:
            >>> lens = ThinLens(0.050, 8.0, focus_distance=2.0, sensor_width=0.036)
            >>> [round(limit(0.5, 1920).item(), 3) for limit in (lens.near_limit, lens.far_limit)]
            [1.791, 2.265]
        """
        return self._limit(1, max_coc, width)

    def _limit(self, side: int, max_coc: float, width: int) -> Tensor:
        _check_sharpness(max_coc, width)
        gain, focus = _optics(self.focal_length, self.f_number, self.focus_distance, self.sensor_width, width)
        return _distance((gain * focus - side * max_coc) / gain)


def _optics(f: Tensor, n: Tensor, df: Tensor, sensor: Tensor, width: int) -> tuple[Tensor, Tensor]:
    """Pixels of CoC per dioptre of defocus, and the reciprocal focus distance: ``coc = gain * (1/df - 1/d)``.

    From the usual form: ``(d - df) / d = df * (1/df - 1/d)`` and ``df / (df - F) = 1 / (1 - F/df)``.
    """
    focus = df.reciprocal()
    return f * f / (2 * n) / (1 - f * focus) * width / sensor, focus


def _distance(dioptres: Tensor) -> Tensor:
    """Reciprocal, with inf and gradient 0 where there is no positive distance; NaN stays NaN."""
    beyond = dioptres <= 0
    return dioptres.masked_fill(beyond, 1).reciprocal().masked_fill(beyond, math.inf)


def _check_sharpness(max_coc: float, width: int) -> None:
    check_number("max_coc", max_coc)
    if not 0 < max_coc < math.inf:
        raise ValueError(f"max_coc: expected a positive finite number of pixels, got {max_coc}")
    check_width(width)
