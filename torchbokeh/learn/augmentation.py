"""Depth of field as an augmentation of kornia: `RandomLensBlur` blurs a batch by its depth through random lenses.

``import torchbokeh`` leaves this module alone, since it imports kornia: ``from torchbokeh.augmentation import ...``.
"""

import math
from collections.abc import Mapping
from numbers import Real
from typing import Any

import torch
from kornia.augmentation import IntensityAugmentationBase2D
from kornia.augmentation.random_generator import RandomGeneratorBase
from kornia.color import linear_rgb_to_rgb, rgb_to_linear_rgb
from torch import Tensor

from torchbokeh.lens import ThinLens
from torchbokeh.ops.checks import check_image, check_whole
from torchbokeh.psfs import Aperture
from torchbokeh.renderers.lens_blur import LensBlur

Range = float | tuple[float, float]  # one value, or the ends of a range

FOCAL_LENGTH = (0.024, 0.085)  # metres
F_NUMBER = (1.4, 8.0)
SENSOR_WIDTH = 0.036  # metres: full frame
FOCUS_DISTANCE = (0.5, 10.0)  # metres
FOCUS_QUANTILE = (0.05, 0.95)  # of the depths of a picture
MOST = 1 << 24  # lenses at a time


def plausible_lenses(
    count: int, generator: torch.Generator | None = None, *, depth: Tensor | None = None
) -> dict[str, Tensor]:
    """Random lenses as photographers use them, as keyword arguments for a `torchbokeh.ThinLens`.

    Focal lengths of 24 to 85 mm and f-numbers of 1.4 to 8, both log-uniform, on a sensor 36 mm wide. The focus distance
    is log-uniform from 0.5 to 10 m; with ``depth`` it is a depth of the picture, between its quantiles of 5 and 95 %,
    without the sky, and at least twice the focal length (life size).

    Args:
        count: B, how many.
        generator: where the random numbers come from; ``None`` is torch's own. The lenses are on its device.
        depth: ``(B, 1, H, W)`` in metres; ``inf`` is sky.

    Returns:
        ``focal_length``, ``f_number``, ``sensor_width`` and ``focus_distance``, each ``(B,)``; lengths in metres.

    Raises:
        TypeError: ``count`` is no int, ``generator`` no generator, or ``depth`` no floating-point tensor.
        ValueError: ``count`` is out of its range, or a ``depth`` of another shape or not above 0.

    Example:
        >>> import torch
        >>> import torchbokeh as tb
        >>> from torchbokeh.learn.augmentation import plausible_lenses
        >>> lens = tb.ThinLens(**plausible_lenses(4, torch.Generator().manual_seed(0)))
        >>> lens.coc(torch.full((4, 1, 2, 2), 3.0), width=640).shape
        torch.Size([4, 1, 2, 2])
    """
    check_whole("count", count, 0, MOST)
    if generator is not None and not isinstance(generator, torch.Generator):
        raise TypeError(f"generator: expected a torch.Generator or None, got {type(generator).__name__}")
    if depth is not None:
        depth = _check_depth(depth, count)
        if not bool((depth > 0).all()):
            raise ValueError(f"depth: expected values above 0 (inf is sky), got {int((~(depth > 0)).sum())} others")
    device = torch.device("cpu") if generator is None else generator.device
    focus = {"focus_distance": FOCUS_DISTANCE} if depth is None else {"focus_quantile": FOCUS_QUANTILE}
    optics = {"focal_length": FOCAL_LENGTH, "f_number": F_NUMBER, "sensor_width": (SENSOR_WIDTH, SENSOR_WIDTH)}
    drawn = _draw(optics | focus, count, generator, device, torch.float32)
    return drawn if depth is None else _focused(drawn, depth)


class RandomLensBlur(IntensityAugmentationBase2D):
    """Blur pictures by their depth, each through a lens of its own.

    The depth comes with the call, ``aug(image, depth=depth)``, and is kept with the parameters that were drawn, so
    that ``aug(image, params=aug._params)`` does the same again. A container of kornia passes no keyword on; there, the
    depth is put into the parameters of this child::

        aug = AugmentationSequential(RandomLensBlur(p=0.5), ..., data_keys=["input", "mask", "bbox", "keypoints"])
        params = aug.forward_parameters(image.shape)
        params[0].data["depth"] = depth
        image, mask, boxes, points = aug(image, mask, boxes, points, params=params)

    Masks, boxes and keypoints stay as they are. The depth is not moved by geometric children: put those after this one.
    Every picture is blurred on its own, so that it does not depend on the others of its batch, and those that are left
    out (``p``) cost nothing. Gradients reach the image and the depth; where the focus lies is a constant to them.

    The random numbers are those of torch, as everywhere in kornia: ``torch.manual_seed`` repeats them. Transforms of
    torchvision (v2) take it as a function of a picture and its depth, in ``forward`` of an ``nn.Module`` of your own,
    which returns ``self.aug(image, depth=depth)`` with ``keepdim=True``.

    Args:
        focal_length: in metres: a number, or a pair for a range that is drawn from log-uniformly.
        f_number: likewise.
        sensor_width: likewise, in metres.
        focus_distance: likewise, in metres; ``None`` focuses on a depth of the picture instead.
        focus_quantile: which depth that is: a quantile in [0, 1] of the finite depths, or a pair for a range that is
            drawn from uniformly. Not nearer than twice the focal length (life size); infinity where all is sky.
        linear: images hold linear radiance. Else they hold sRGB, are converted for the blur and converted back.
        aperture: as for `torchbokeh.LensBlur`.
        quality: as for `torchbokeh.LensBlur`.
        max_coc: as for `torchbokeh.LensBlur`: largest radius in px.
        same_on_batch: one lens for the whole batch; a quantile still is that of each picture.
        p: probability that a picture is blurred.
        p_batch: probability that a batch is blurred at all.
        keepdim: a ``(3, H, W)`` image stays one; else it becomes ``(1, 3, H, W)``.

    Raises:
        TypeError: an argument of the wrong kind.
        ValueError: a range that is empty or reaches where there is no lens.

    Example:
        >>> import torch
        >>> from torchbokeh.learn.augmentation import RandomLensBlur
        >>> image, depth = torch.rand(2, 3, 24, 32), torch.linspace(1, 8, 32).expand(2, 1, 24, 32)
        >>> aug = RandomLensBlur(f_number=(1.4, 2.8), p=1.0)
        >>> out = aug(image, depth=depth)
        >>> out.shape, sorted(aug.lenses(aug._params))
        (torch.Size([2, 3, 24, 32]), ['f_number', 'focal_length', 'focus_distance', 'sensor_width'])
        >>> torch.equal(aug(image, params=aug._params), out)
        True
    """

    def __init__(
        self,
        focal_length: Range = FOCAL_LENGTH,
        f_number: Range = F_NUMBER,
        sensor_width: Range = SENSOR_WIDTH,
        focus_distance: Range | None = None,
        focus_quantile: Range = FOCUS_QUANTILE,
        *,
        linear: bool = False,
        aperture: str | Aperture = "disc",
        quality: str = "balanced",
        max_coc: float | None = None,
        same_on_batch: bool = False,
        p: float = 0.5,
        p_batch: float = 1.0,
        keepdim: bool = False,
    ) -> None:
        super().__init__(p=p, p_batch=p_batch, same_on_batch=same_on_batch, keepdim=keepdim)
        ranges = {
            "focal_length": _check_range("focal_length", focal_length),
            "f_number": _check_range("f_number", f_number),
            "sensor_width": _check_range("sensor_width", sensor_width),
        }
        quantile = _check_range("focus_quantile", focus_quantile, share=True)
        if focus_distance is None:
            ranges["focus_quantile"] = quantile
        else:
            ranges["focus_distance"] = _check_range("focus_distance", focus_distance)
            longest, nearest = ranges["focal_length"][1], ranges["focus_distance"][0]
            if nearest <= longest:
                want = f"more than the longest focal length ({longest:g} m)"
                raise ValueError(f"focus_distance: expected {want}, got {nearest:g}")
        if not isinstance(linear, bool):
            raise TypeError(f"linear: expected a bool, got {linear!r}")
        self.blur = LensBlur(None, aperture, quality=quality, max_coc=max_coc)
        self.flags = {"linear": linear}
        self._param_generator = _LensGenerator(ranges)

    def forward(
        self, input: Tensor, params: dict[str, Any] | None = None, *, depth: Tensor | None = None, **kwargs: Any
    ) -> Tensor:
        """Blur a batch.

        Args:
            input: ``(B, 3, H, W)`` or ``(3, H, W)``, sRGB, or linear radiance with ``linear=True``.
            params: those of an earlier call, ``aug._params``, to do the same again; ``None`` draws new ones.
            depth: ``(B, 1, H, W)``, or ``(1, H, W)`` for one picture: metres, ``inf`` is sky. It may be left out where
                ``params`` has it as ``params["depth"]``, and goes before that.
            **kwargs: as for any augmentation of kornia.

        Returns:
            The shape of ``input``, with the batch dimension unless ``keepdim``.

        Raises:
            TypeError: no depth, or one that is no floating-point tensor.
            ValueError: shapes, devices or values do not fit: see the message.
        """
        picture = isinstance(input, Tensor) and input.dim() == 3
        check_image("input", input, (3, "H", "W") if picture else ("B", 3, "H", "W"))
        if depth is not None:
            kwargs["depth"] = depth
        return super().forward(input, params, **kwargs)

    def lenses(self, params: Mapping[str, Any], depth: Tensor | None = None) -> dict[str, Tensor]:
        """The lenses that parameters stand for, as keyword arguments for a `torchbokeh.ThinLens`.

        Args:
            params: of an earlier call, such as ``aug._params``.
            depth: ``(B, 1, H, W)`` in metres; ``None`` takes that of ``params``.

        Returns:
            ``focal_length``, ``f_number``, ``sensor_width`` and ``focus_distance``, each ``(B,)`` and on the device of
            the depth; lengths in metres.

        Raises:
            TypeError: no depth, or one that is no floating-point tensor.
            ValueError: a depth of another shape.
        """
        count = len(params["f_number"])
        depth = _check_depth(params.get("depth") if depth is None else depth, count)
        names = ("focal_length", "f_number", "sensor_width", "focus_distance", "focus_quantile")
        return _focused({name: params[name] for name in names if name in params}, depth)

    def apply_transform(
        self, input: Tensor, params: dict[str, Any], flags: dict[str, Any], transform: Tensor | None = None
    ) -> Tensor:
        """What kornia calls: blur the pictures ``(B, 3, H, W)`` that are to be blurred."""
        count, channels, height, width = input.shape
        if channels != 3:
            raise ValueError(f"image: expected shape (B, 3, H, W), got {tuple(input.shape)}")
        if len(params["f_number"]) != count:
            raise ValueError(f"params: expected those of {count} pictures, got those of {len(params['f_number'])}")
        depth = _check_depth(params.get("depth"), count)
        if depth.shape[-2:] != (height, width):
            raise ValueError(f"depth: expected shape {(count, 1, height, width)}, got {tuple(depth.shape)}")
        if depth.device != input.device:
            raise ValueError(f"depth: expected device {input.device}, got {depth.device}")
        if not input.numel():
            return input
        lenses = self.lenses(params, depth)
        always = self.p == 1 and self.p_batch == 1
        asked = [True] * count if always else (params["batch_prob"] > 0.5).expand(count).tolist()
        out = []
        for k, (image, far) in enumerate(zip(input.split(1), depth.split(1), strict=True)):
            if asked[k]:
                lens: dict[str, Any] = {name: value[k] for name, value in lenses.items()}
                coc = ThinLens(**lens).coc(far, width)
                radiance = image if flags["linear"] else rgb_to_linear_rgb(image)
                radiance = self.blur(radiance, coc=coc)
                image = radiance if flags["linear"] else linear_rgb_to_rgb(radiance)
            out.append(image)
        return torch.cat(out)


class _LensGenerator(RandomGeneratorBase):
    """Draws the parameters of `RandomLensBlur`, each ``(B,)``, from ``(low, high)`` of each."""

    def __init__(self, ranges: Mapping[str, tuple[float, float]]) -> None:
        super().__init__()
        self.ranges = dict(ranges)

    def __repr__(self) -> str:
        return ", ".join(f"{name}={ends}" for name, ends in self.ranges.items())

    def make_samplers(self, device: torch.device, dtype: torch.dtype) -> None:
        """Nothing to make: kornia keeps the device and the dtype itself."""

    def forward(self, batch_shape: tuple[int, ...], same_on_batch: bool = False) -> dict[str, Tensor]:
        """The parameters for a batch of this shape."""
        count = batch_shape[0]
        drawn = _draw(self.ranges, 1 if same_on_batch else count, None, torch.device(self.device), self.dtype)
        return {name: value.expand(count) for name, value in drawn.items()}


def _draw(
    ranges: Mapping[str, tuple[float, float]],
    count: int,
    generator: torch.Generator | None,
    device: torch.device,
    dtype: torch.dtype,
) -> dict[str, Tensor]:
    """One ``(count,)`` tensor for each range: uniform for a quantile, else log-uniform."""
    drawn = {}
    for name, (low, high) in ranges.items():
        if low == high:
            drawn[name] = torch.full((count,), low, device=device, dtype=dtype)
            continue
        share = torch.rand(count, generator=generator, device=device, dtype=dtype)
        even = name == "focus_quantile"
        drawn[name] = low + (high - low) * share if even else low * (share * math.log(high / low)).exp()
    return drawn


def _focused(drawn: Mapping[str, Tensor], depth: Tensor) -> dict[str, Tensor]:
    """The drawn lenses on the device of the depth ``(B, 1, H, W)``, with a focus distance for the focus quantile."""
    dtype = torch.float64 if depth.dtype == torch.float64 else torch.float32
    lenses = {name: value.to(depth.device, dtype) for name, value in drawn.items()}
    if "focus_quantile" not in lenses:
        return lenses
    far = depth.detach().flatten(1).to(dtype).sort(1).values
    last = (far.isfinite().sum(1) - 1).clamp_min(0)
    rank = (lenses.pop("focus_quantile") * last).round().long().minimum(last)
    focus = far.gather(1, rank[:, None])[:, 0]
    lenses["focus_distance"] = torch.maximum(focus, 2 * lenses["focal_length"])
    return lenses


def _check_range(name: str, value: object, *, share: bool = False) -> tuple[float, float]:
    """Both ends of a range, checked: above 0, or in [0, 1] for a share."""
    ends = value if isinstance(value, tuple | list) else (value, value)
    if len(ends) != 2 or not all(isinstance(end, Real) and not isinstance(end, bool) for end in ends):
        raise TypeError(f"{name}: expected a number or a pair of numbers, got {value!r}")
    low, high = (float(end) for end in ends)
    good = 0 <= low <= high <= 1 if share else 0 < low <= high < math.inf
    if not good:
        want = "in [0, 1]" if share else "above 0 and finite"
        raise ValueError(f"{name}: expected values {want}, the lower one first, got {value!r}")
    return low, high


def _check_depth(depth: object, count: int) -> Tensor:
    """The depth ``(count, 1, H, W)``; one picture may come without its batch dimension."""
    if depth is None:
        raise TypeError("depth: expected a tensor, as depth= or as params['depth'], got None")
    if not isinstance(depth, Tensor):
        raise TypeError(f"depth: expected a tensor, got {type(depth).__name__}")
    if not depth.is_floating_point():
        raise TypeError(f"depth: expected a floating-point tensor, got {depth.dtype}")
    whole = depth[None] if depth.dim() == 3 and count == 1 else depth
    if whole.dim() != 4 or whole.shape[:2] != (count, 1):
        raise ValueError(f"depth: expected shape ({count}, 1, H, W), got {tuple(depth.shape)}")
    return whole
