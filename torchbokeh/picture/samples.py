"""Samples of a picture through lens and shutter, as a stochastic renderer takes them."""

from typing import NamedTuple

import torch
from torch import Tensor

from torchbokeh.ops.checks import check_image
from torchbokeh.ops.dispatch import compute_dtype
from torchbokeh.ops.planes import pixel_centres

SLACK = 1e-2
"""How far in px rounding may put a sample outside its pixel."""

CHANNELS = {"colour": 3, "position": 2, "lens": 2, "time": 1, "coc": 1, "motion": 2}
"""Of every map of `Samples` that holds numbers."""


class Samples(NamedTuple):
    """Samples of a picture through lens and shutter, S for each pixel, each of one surface.

    Attributes:
        colour: ``(B, S, 3, H, W)`` linear radiance.
        position: ``(B, S, 2, H, W)``, where in its pixel the sample is: x and y in px of the picture, 0 being the
            centre of the first pixel.
        lens: ``(B, S, 2, H, W)``, its point (x, y) of the lens, in units of the aperture radius.
        time: ``(B, S, 1, H, W)`` in units of the shutter time: -0.5 is when it opens, 0.5 when it closes.
        coc: ``(B, S, 1, H, W)`` signed CoC radius in px of the surface, positive behind the focus.
        motion: ``(B, S, 2, H, W)``, the way (dx, dy) in px of the surface while the shutter is open.
        present: ``(B, S, 1, H, W)`` bool: False where there is no sample. What the other maps hold there does not
            count.
    """

    colour: Tensor
    position: Tensor
    lens: Tensor
    time: Tensor
    coc: Tensor
    motion: Tensor
    present: Tensor


def pinhole_position(samples: Samples) -> Tensor:
    """Where each sample's surface is seen from the middle of the lens at the middle of the exposure: y' of LKS.

    From the point u of the lens, a surface of CoC r that belongs at y' is seen at ``y' + r u``; by the time t its
    motion m has taken it ``t m`` farther.

    Args:
        samples: see `Samples`.

    Returns:
        ``(B, S, 2, H, W)``: x and y in px, 0 being the centre of the first pixel.

    Raises:
        TypeError: not `Samples`.

    Example:
        >>> from torchbokeh import scenes
        >>> from torchbokeh.scenes import samples
        >>> pinhole_position(samples(*scenes.whirl(size=(24, 32)))).shape
        torch.Size([1, 1, 2, 24, 32])
    """
    if not isinstance(samples, Samples):
        raise TypeError(f"samples: expected Samples, got {type(samples).__name__}")
    return samples.position - samples.coc * samples.lens - samples.time * samples.motion


def checked_samples(samples: Samples) -> Samples:
    """Samples of one dtype, with zeros where there is none.

    Raises:
        TypeError: a map is not a floating-point tensor, or ``present`` not one of bools.
        ValueError: a shape, device or value does not fit.
    """
    if not isinstance(samples, Samples):
        raise TypeError(f"samples: expected Samples, got {type(samples).__name__}")
    b, s, _, h, w = check_image("samples.colour", samples.colour, ("B", "S", 3, "H", "W")).shape
    if samples.colour.numel() == 0:
        raise ValueError(f"samples.colour: expected at least one sample, got shape {tuple(samples.colour.shape)}")
    present = samples.present
    if not isinstance(present, Tensor) or present.dtype != torch.bool:
        kind = present.dtype if isinstance(present, Tensor) else type(present).__name__
        raise TypeError(f"samples.present: expected a tensor of bools, got {kind}")
    check_image("samples.present", present.float(), (b, s, 1, h, w), like=samples.colour)
    dtype, maps = compute_dtype(samples.colour), {}
    for name, channels in CHANNELS.items():
        given = check_image(f"samples.{name}", getattr(samples, name), (b, s, channels, h, w), like=samples.colour)
        maps[name] = torch.where(present, given.to(dtype), 0.0)
        bad = int((~maps[name].isfinite()).sum())
        if bad:
            raise ValueError(f"samples.{name}: expected finite numbers where a sample is present, got {bad} others")
    off = float(((maps["position"].detach() - pixel_positions(maps["position"])) * present).abs().max())
    if off > 0.5 + SLACK:
        raise ValueError(
            f"samples.position: expected points within their own pixels, got one {off:g} px from its centre"
        )
    return samples._replace(**maps)


def pixel_positions(like: Tensor) -> Tensor:
    """Centres of all pixels ``(2, H, W)``, x and y in px, 0 being that of the first."""
    return torch.stack(pixel_centres((like.shape[-2], like.shape[-1]), like)) - 0.5
