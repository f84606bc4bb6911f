"""Reconstruction from stochastic samples: each spreads its PSF about where a pinhole would see it (LKS section 6.2)."""

from numbers import Integral
from typing import NamedTuple

import torch
from torch import Tensor

from torchbokeh.banks.splat import bank_of_motion, splat_bank
from torchbokeh.compose.surfaces import bin_centres
from torchbokeh.ops.checks import check_image
from torchbokeh.ops.composite import bin_weights, fill_until_full, pull_push
from torchbokeh.ops.dispatch import compute_dtype
from torchbokeh.ops.planes import pixel_centres
from torchbokeh.psfs.bank import PsfBank
from torchbokeh.psfs.model import Labels

KNOWN = 0.1
"""A pixel that all PSFs together cover less than this is filled in from its surroundings, as far as it lacks."""

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


def reconstruct(samples: Samples, *, bank: PsfBank | None = None, layers: int = 4) -> Tensor:
    """The picture that noisy samples through lens and shutter are of.

    Every sample spreads the PSF of its CoC and motion, not about its own pixel, which would blur the picture once
    more, but about `pinhole_position`; the sum is divided by the coverage. A plain picture is the special case of
    samples in the middle of their pixels, of the lens and of the exposure.

    Samples are put into soft bins of constant parallax, and what a bin covers hides what is behind it: light from
    behind does not leak over edges that are sharper. One layer is the plain mean of all PSFs.

    Args:
        samples: see `Samples`, and `torchbokeh.scenes.samples`, which casts them.
        bank: PSFs of one channel, of a model that takes CoC or motion; ``None`` for the bank ``"combined"``.
        layers: most bins.

    Returns:
        ``(B, 3, H, W)`` in the dtype of ``samples.colour``, differentiable to that; to the other maps as far as
        positions, directions and sizes of the PSFs depend on them. 0 where a whole picture has no sample.

    Raises:
        TypeError: a map is not a floating-point tensor, ``present`` not one of bools, ``bank`` no `PsfBank` or
            ``layers`` no int.
        ValueError: a shape, device or value does not fit, ``layers`` is not positive, or the bank is coloured or
            needs another map.

    Source: Leimkühler et al., "Laplacian Kernel Splatting" (2018), section 6.2 and figure 7.

    Example:
        >>> from torchbokeh import scenes
        >>> from torchbokeh.scenes import samples
        >>> reconstruct(samples(*scenes.whirl(size=(24, 32)))).shape
        torch.Size([1, 3, 24, 32])
    """
    samples, dtype = _checked(samples), samples.colour.dtype
    bank = bank_of_motion(samples.colour.device) if bank is None else _checked_bank(bank)
    if not isinstance(layers, Integral) or isinstance(layers, bool):
        raise TypeError(f"layers: expected an int, got {layers!r}")
    if layers < 1:
        raise ValueError(f"layers: expected at least 1, got {layers}")
    low, high = samples.coc.detach().aminmax()
    bins = _splat_bins(samples, bin_centres(float(low), float(high), layers), bank)
    colour, coverage = fill_until_full([(b[:, :-1], b[:, -1:]) for b in bins])
    return pull_push(colour, (coverage / KNOWN).clamp(0, 1)).to(dtype)


def _checked(samples: Samples) -> Samples:
    """Samples of one dtype, with zeros where there is none."""
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


def _checked_bank(bank: PsfBank) -> PsfBank:
    if not isinstance(bank, PsfBank):
        raise TypeError(f"bank: expected a PsfBank or None, got {type(bank).__name__}")
    if bank.values.shape[1] != 1:
        raise ValueError(f"bank: expected PSFs of one channel, got {bank.values.shape[1]}")
    return bank


def _splat_bins(samples: Samples, centres: tuple[float, ...], bank: PsfBank) -> list[Tensor]:
    """Colour times coverage, and last coverage, ``(B, 4, H, W)`` of every bin."""
    count = samples.colour.shape[1]
    bins = [torch.zeros_like(samples.colour[:, 0, :1])] * len(centres)
    for number in range(count):
        one = Samples(*(t[:, number] for t in samples))
        values = torch.cat([one.colour, one.present.to(one.colour)], 1) / count
        for k, weight in enumerate(bin_weights(one.coc, centres)):
            bins[k] = bins[k] + _splat_about(values * weight, one, bank)
    return bins


def _splat_about(values: Tensor, one: Samples, bank: PsfBank) -> Tensor:
    """Splat ``(B, C, H, W)`` about the pinhole positions of one sample of each pixel."""
    shift = pinhole_position(one) - pixel_positions(values)
    return splat_bank(values, Labels(coc=one.coc, motion=one.motion, offset=shift), bank)
