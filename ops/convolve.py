"""One point-spread function for the whole picture: a single convolution."""

import math

import torch
from torch import Tensor

from torchbokeh.ops.checks import check_image, check_number
from torchbokeh.ops.composite import TINY
from torchbokeh.ops.spans import Profile, check_profile, working_dtype
from torchbokeh.ops.splat import splat_spans

CONVOLVE_FROM = 8.0
"""Radius in px from which one convolution is faster than a splat of every pixel."""


def convolve(values: Tensor, psf: Tensor) -> Tensor:
    """Spread one PSF from every pixel, by FFT; the cost does not depend on what the PSF looks like.

    It is computed in double where the device has it: in float32 a highlight of 1e6 would leave 1e-1 all over.

    Args:
        values: ``(B, C, H, W)``, what each pixel spreads.
        psf: ``(B, 1, h, w)`` or ``(1, 1, h, w)``, h and w odd, its centre in the middle.

    Returns:
        ``(B, C, H, W)`` in the dtype of ``values``; beyond the border there is nothing. Differentiable to both.

    Raises:
        TypeError: an argument is not a floating-point tensor.
        ValueError: shapes or devices do not fit.

    Example:
        >>> line = torch.zeros(1, 1, 1, 5)
        >>> line[..., 2] = 1.0
        >>> convolve(line, torch.tensor([[[[0.25, 0.5, 0.25]]]])).round(decimals=6)
        tensor([[[[0.0000, 0.2500, 0.5000, 0.2500, 0.0000]]]])
    """
    from scipy.fft import next_fast_len

    check_image("values", values, ("B", "C", "H", "W"))
    check_image("psf", psf, ("B", 1, "h", "w"), like=values)
    if len(psf) not in (1, len(values)) or psf.shape[2] % 2 == 0 or psf.shape[3] % 2 == 0:
        raise ValueError(f"psf: expected 1 or {len(values)} of odd height and width, got shape {tuple(psf.shape)}")
    if values.numel() == 0:
        return values.clone()
    size, reach = values.shape[2:], [n // 2 for n in psf.shape[2:]]
    padded = [next_fast_len(n + 2 * r, real=True) for n, r in zip(size, reach, strict=True)]
    dtype = working_dtype(values.device)
    spectrum = torch.fft.rfft2(psf.to(dtype), s=padded)
    inside = tuple(slice(r, r + n) for r, n in zip(reach, size, strict=True))

    def spread(channel: Tensor) -> Tensor:
        whole = torch.fft.irfft2(torch.fft.rfft2(channel.to(dtype), s=padded) * spectrum, s=padded)
        return whole[(..., *inside)].to(values.dtype)

    # One channel at a time: all of them in double would need several times the memory of the picture.
    return torch.cat([spread(values[:, k : k + 1]) for k in range(values.shape[1])], 1)


def blur_uniform(values: Tensor, radius: float, profile: Profile) -> Tensor:
    """Blur with one flat convex PSF for every pixel, divided by its coverage.

    Args:
        values: ``(B, C, H, W)``, what each pixel spreads.
        radius: signed radius in px.
        profile: the unit shape of the PSF.

    Returns:
        ``(B, C, H, W)`` in the dtype of ``values``, differentiable to ``values`` and ``profile``.

    Raises:
        TypeError: ``values`` is not a floating-point tensor.
        ValueError: ``radius`` is not finite.

    Example:
        >>> from torchbokeh.psfs import Disc
        >>> blur_uniform(torch.ones(1, 1, 33, 33), 20.0, Disc().profile()).mean().round(decimals=6)
        tensor(1.)
    """
    check_image("values", values, ("B", "C", "H", "W"))
    check_profile(profile, values)
    if not math.isfinite(check_number("radius", radius)):
        raise ValueError(f"radius: expected a finite number of px, got {radius}")
    if values.numel() == 0:
        return values.clone()
    # What lies farther away than the picture is large need not be drawn.
    shape = float(profile.knots.detach().abs().max() + profile.bulge.detach().abs())
    reach = [min(math.ceil(abs(radius) * shape) + 1, n - 1) for n in values.shape[2:]]
    dot = values.new_zeros(1, 1, *(2 * r + 1 for r in reach), dtype=working_dtype(values.device))
    dot[..., reach[0], reach[1]] = 1.0
    return blur_with(values, splat_spans(dot, torch.full_like(dot, radius), profile, integrate=True))


def blur_with(values: Tensor, psf: Tensor) -> Tensor:
    """`convolve`, divided by the coverage: arguments, result and errors are the same."""
    check_image("values", values, ("B", "C", "H", "W"))
    check_image("psf", psf, ("B", 1, "h", "w"), like=values)
    coverage = convolve(torch.ones_like(values[: len(psf), :1]), psf)
    return convolve(values, psf) / coverage.clamp_min(TINY)
