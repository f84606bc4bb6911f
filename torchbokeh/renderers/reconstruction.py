"""Reconstruction from stochastic samples: each spreads its PSF about where a pinhole would see it (LKS section 6.2)."""

import math

import torch
from torch import Tensor

from torchbokeh.banks.splat import bank_of_motion, splat_bank
from torchbokeh.compose.surroundings import Surrounding
from torchbokeh.ops.checks import check_whole
from torchbokeh.ops.composite import bin_weights, fill_until_full, pull_push
from torchbokeh.picture.samples import Samples, checked_samples, pinhole_position, pixel_positions
from torchbokeh.plan.bins import bin_centres
from torchbokeh.plan.decide import passed
from torchbokeh.plan.lights import BRIGHTER, lights_at_border
from torchbokeh.psfs.bank import PsfBank
from torchbokeh.psfs.model import Labels

KNOWN = 0.1
"""A pixel that all PSFs together cover less than this is filled in from its surroundings, as far as it lacks."""


def reconstruct(samples: Samples, *, bank: PsfBank | None = None, layers: int = 4) -> Tensor:
    """The picture that noisy samples through lens and shutter are of.

    Every sample spreads the PSF of its CoC and motion, not about its own pixel, which would blur the picture once
    more, but about `pinhole_position`; the sum is divided by the coverage. A plain picture is the special case of
    samples in the middle of their pixels, of the lens and of the exposure.

    Samples are put into soft bins of constant parallax, and what a bin covers hides what is behind it: light from
    behind does not leak over edges that are sharper. One layer is the plain mean of all PSFs. Where lights near the
    border would show that nothing is known of what lies beyond it, the picture goes on there without them.

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
    samples, dtype = checked_samples(samples), samples.colour.dtype
    bank = bank_of_motion(samples.colour.device) if bank is None else _checked_bank(bank)
    check_whole("layers", layers, 1)
    # What an item needs does not depend on the others.
    return torch.cat(
        [_of_one(Samples(*item), bank, layers) for item in zip(*(t.split(1) for t in samples), strict=True)]
    ).to(dtype)


def _of_one(samples: Samples, bank: PsfBank, layers: int) -> Tensor:
    """The picture of a batch of one, surrounded where there are lights near the border."""
    coc, (height, width) = samples.coc.detach(), samples.coc.shape[3:]
    largest, farthest = float(coc.abs().max()), float(samples.motion.detach().norm(dim=2).max())
    lit = passed(lights_at_border(samples.colour[0], coc[0], largest, farthest), BRIGHTER)
    if not lit:
        return _mean_of(samples, bank, layers)
    around = Surrounding(min(math.ceil(largest + farthest), min(height, width) // 2))
    whole = around.cut(_mean_of(around.of_samples(samples), bank, layers))
    return whole if lit == 1 else lit * whole + (1 - lit) * _mean_of(samples, bank, layers)


def _mean_of(samples: Samples, bank: PsfBank, layers: int) -> Tensor:
    low, high = samples.coc.detach().aminmax()
    bins = _splat_bins(samples, bin_centres(float(low), float(high), layers), bank)
    colour, coverage = fill_until_full([(b[:, :-1], b[:, -1:]) for b in bins])
    # Sparse PSFs leave ripples, and beside a light these would be more than a mean can be.
    low, high = (end((1, 3, 4))[..., None, None] for end in (samples.colour.amin, samples.colour.amax))
    return pull_push(colour.clamp(low, high), (coverage / KNOWN).clamp(0, 1))


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
