"""Differential operators and their inverses: a domain is one such pair (LKS sections 4 and 6.3).

===========  ==============================  =======================================================
domain       operator                        inverse
===========  ==============================  =======================================================
scanline     `difference_x`                  `running_sum_x`, exact
laplacian    `laplacian`, 5-point stencil    `poisson_fft`, exact, or `poisson_pyramid`, approximate
===========  ==============================  =======================================================

All of them are linear, work on buffers ``(B, C, H, W)`` one channel at a time, and return the dtype they are
given.
"""

import functools
from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from torchbokeh.ops.checks import MOST_PIXELS, check_flag, check_image, check_pixels, check_whole

_SHAPE = ("B", "C", "H", "W")
_NEAR = 128  # offsets below this take the integral of the Green's function, the others its expansion


def difference_x(u: Tensor) -> Tensor:
    """Backward difference along x, with zero to the left of the image.

    Args:
        u: image, shape (B, C, H, W).

    Returns:
        ``u[x] - u[x-1]``, shape (B, C, H, W); `running_sum_x` undoes it.

    Raises:
        TypeError: ``u`` is not a floating-point tensor.
        ValueError: ``u`` does not have four dimensions.

    Example:
        >>> difference_x(torch.tensor([[[[0.0, 2.0, 2.0, 0.0]]]]))
        tensor([[[[ 0.,  2.,  0., -2.]]]])
    """
    check_image("u", u, _SHAPE)
    return u - F.pad(u, (1, 0))[..., :-1]


def running_sum_x(b: Tensor) -> Tensor:
    """Running sum along x: the inverse of `difference_x`.

    A float32 buffer is summed in float64 wherever the device has it: in float32 one pixel of radiance 1e6 leaves
    about 5e-2 behind along the rest of its row. What rounding ``b`` itself loses cannot be recovered here.

    Args:
        b: buffer of horizontal differences, shape (B, C, H, W).

    Returns:
        Image of shape (B, C, H, W), in the dtype of ``b``.

    Raises:
        TypeError: ``b`` is not a floating-point tensor.
        ValueError: ``b`` does not have four dimensions.

    Example:
        >>> running_sum_x(torch.tensor([[[[0.0, 2.0, 0.0, -2.0]]]]))
        tensor([[[[0., 2., 2., 0.]]]])
    """
    check_image("b", b, _SHAPE)
    # torch's CPU kernel itself accumulates wider than it stores, float32 in float64: one pass instead of three.
    if b.device.type in ("cpu", "mps"):
        return b.cumsum(-1)
    return b.cumsum(-1, dtype=torch.float64).to(b.dtype)


def laplacian(u: Tensor) -> Tensor:
    """5-point Laplacian: the four neighbours minus four times the centre, zero outside the image.

    The output has the size of the input, so what a border pixel adds to its neighbour outside is cut off. Pad ``u``
    until it vanishes on its border if the result is to be integrated again.

    Args:
        u: image, shape (B, C, H, W).

    Returns:
        Laplacian of ``u``, shape (B, C, H, W), in units of ``u`` per pixel squared.

    Raises:
        TypeError: ``u`` is not a floating-point tensor.
        ValueError: ``u`` does not have four dimensions.

    Example:
        >>> u = torch.zeros(1, 1, 3, 3)
        >>> u[..., 1, 1] = 1.0
        >>> laplacian(u)[0, 0]
        tensor([[ 0.,  1.,  0.],
                [ 1., -4.,  1.],
                [ 0.,  1.,  0.]])
    """
    check_image("u", u, _SHAPE)
    p = F.pad(u, (1, 1, 1, 1))
    rows, columns = p[..., 1:-1], p[..., 1:-1, :]
    return rows[..., :-2, :] + rows[..., 2:, :] + columns[..., :-2] + columns[..., 2:] - 4 * u


def poisson_fft(b: Tensor, *, compact: bool) -> Tensor:
    """Invert the 5-point Laplacian with its lattice Green's function, in the Fourier domain.

    ``compact=True`` divides by the symbol ``2 cos kx + 2 cos ky - 4`` on a torus the size of the buffer, and
    shifts the result so that its four edges average to zero. It is exact if ``b`` is the Laplacian of an image that
    vanishes on its border, and costs a quarter of the other. Any other buffer is answered with the periodic
    solution for ``b - mean(b)``.

    ``compact=False`` convolves ``b`` with the free-space Green's function `lattice_green` on a doubled domain
    (Hockney). It is exact for every ``b``; where the sum of ``b`` is not zero the solution grows as
    ``sum(b) / (2 pi) * log(distance)``.

    Everything is computed in float64 where the device has it: in float32 one pixel of radiance 1e6 leaks about 5e-2
    over the whole image. What rounding ``b`` itself loses cannot be recovered here. Sizes are padded with zeros to
    lengths the FFT is fast at, and the last few spectra are kept in memory.

    Args:
        b: Laplacian of an image, shape (B, C, H, W).
        compact: whether the image is known to vanish on the border of the buffer.

    Returns:
        Image of shape (B, C, H, W), in the dtype of ``b``.

    Raises:
        TypeError: ``b`` is not a floating-point tensor.
        ValueError: ``b`` does not have four dimensions.

    Example:
        >>> u = torch.zeros(1, 1, 5, 5)
        >>> u[..., 1:4, 2] = 1.0
        >>> torch.allclose(poisson_fft(laplacian(u), compact=True), u, atol=1e-6)
        True
    """
    check_image("b", b, _SHAPE)
    check_flag("compact", compact)
    from scipy.fft import next_fast_len

    height, width = b.shape[-2:]
    reach = 1 if compact else 2
    size = (next_fast_len(reach * height - reach + 1, True), next_fast_len(reach * width - reach + 1, True))
    inverse = torch.from_numpy(_torus_spectrum(*size) if compact else _green_spectrum(*size))
    dtype = torch.float32 if b.device.type == "mps" else torch.float64
    inverse = inverse.to(dtype).to(b.device)
    planes = b.reshape(-1, height, width)

    def solved(b: Tensor) -> Tensor:
        u = torch.fft.irfft2(torch.fft.rfft2(b.to(dtype), s=size) * inverse, s=size)[..., :height, :width]
        if compact:
            edges = torch.cat((u[..., 0], u[..., -1], u[..., 0, :], u[..., -1, :]), dim=-1)
            u = u - edges.mean(-1)[..., None, None]
        return u.to(b.dtype)

    # On a CPU several planes at once take three times as long as one by one.
    one_by_one = b.device.type == "cpu" and len(planes) > 0
    return torch.cat([solved(p) for p in planes.split(1 if one_by_one else len(planes) or 1)]).reshape(b.shape)


def poisson_pyramid(b: Tensor, h1: Tensor, h2: Tensor, g: Tensor, levels: int | None = None) -> Tensor:
    """Invert the 5-point Laplacian approximately with a convolution pyramid (Farbman et al. 2011).

    Analysis: ``a_0 = b``, ``a_{l+1} = downsample2(h1 * a_l)``. Synthesis: ``u_L = -g * a_L``,
    ``u_l = h2 * upsample2(u_{l+1}) - g * a_l``. Kernels act along both axes, and upsampling inserts zeros. Farbman's
    kernels ``h1 = h2 = (.15, .5, .7, .5, .15)``, ``g = (.175, .547, .175)`` approximate minus the Green's function,
    hence the sign. Each level is padded so that nothing is cut off: the pyramid runs on the infinite plane.

    With Farbman's kernels the response to a point is within .025 of the Green's function nearer than 3 px and
    within .01 beyond, but for a constant: -1.33 for a buffer of 129 px, .11 lower each time the size doubles. In
    the Laplacian of an image that vanishes on its border the constants of all points cancel. A disc of height 1
    comes back with an error of up to .15 within 4 px of its rim, .035 further inside, .025 further outside and .01
    a radius away.

    Runs in float32 (float64 for float64 input), so very bright pixels leak about 1e-7 of their radiance everywhere.

    Args:
        b: Laplacian of an image, shape (B, C, H, W), any size.
        h1: analysis kernel, symmetric, shape (5,), that acts along both axes on every level; or ``(L, 5, 5)``, those of
            the L finest levels, of which the last stands for all that are coarser.
        h2: synthesis kernel, alike. Swapping it with ``h1`` gives the transposed operator.
        g: kernel of each level, symmetric, shape (3,), (L, 3, 3) or (L, 5, 5).
        levels: how often the size is halved; ``None`` for one more than it takes to come down to one pixel. More
            change little, fewer lose what is wider than ``2**levels`` px.

    Returns:
        Image of shape (B, C, H, W), in the dtype of ``b``.

    Raises:
        TypeError: ``b`` or a kernel is not a floating-point tensor.
        ValueError: ``b`` does not have four dimensions, a kernel has another shape or device than it should, or
            ``levels`` is below 1.

    Example:
        >>> h, g = torch.tensor([0.15, 0.5, 0.7, 0.5, 0.15]), torch.tensor([0.175, 0.547, 0.175])
        >>> u = torch.zeros(1, 1, 64, 64)
        >>> u[..., 16:48, 16:48] = 1.0
        >>> abs(poisson_pyramid(laplacian(u), h, h, g)[0, 0, 32, 32].item() - 1.0) < 0.02
        True
    """
    check_image("b", b, _SHAPE)
    for name, kernel, taps in (("h1", h1, 5), ("h2", h2, 5), ("g", g, 3)):
        several = isinstance(kernel, Tensor) and kernel.dim() == 3
        taps = 5 if several and kernel.shape[-1] == 5 else taps
        check_image(name, kernel, ("L", taps, taps) if several else (taps,), like=b)
        if len(kernel) == 0:
            raise ValueError(f"{name}: expected kernels of at least one level, got shape {tuple(kernel.shape)}")
    if levels is not None and levels < 1:
        raise ValueError(f"levels: expected at least 1, got {levels}")
    channels = b.shape[1]
    dtype = torch.promote_types(b.dtype, torch.float32)

    def per_level(kernel: Tensor) -> Callable[[int], Tensor]:
        square = kernel.to(dtype) if kernel.dim() == 3 else torch.outer(kernel.to(dtype), kernel.to(dtype))[None]
        return lambda level: square[min(level, len(square) - 1)].expand(channels, 1, *square.shape[1:])

    analysis, synthesis, own = per_level(h1), per_level(h2), per_level(g)

    def filtered(x: Tensor, level: int) -> Tensor:
        return F.conv2d(x, -own(level), padding=g.shape[-1] // 2, groups=channels)

    a = [b.to(dtype)]
    count = (max(b.shape[-2:]) - 1).bit_length() + 1 if levels is None else levels
    # Convolutions are what autocast takes to half precision.
    with torch.autocast(b.device.type, enabled=False):
        for level in range(count):
            # A padding of 4 keeps every coarse sample that a kernel of radius 2 reaches: even positions from -2 on.
            a.append(F.conv2d(a[-1], analysis(level), stride=2, padding=4, groups=channels))
        u = filtered(a.pop(), count)
        while a:
            fine = a.pop()
            u = F.conv_transpose2d(u, synthesis(len(a)), stride=2, padding=4, output_padding=1, groups=channels)
            u = u[..., : fine.shape[-2], : fine.shape[-1]] + filtered(fine, len(a))
    return u.to(b.dtype)


def lattice_green(height: int, width: int) -> Tensor:
    """Free-space Green's function of the 5-point Laplacian: its `laplacian` is 1 at the origin, 0 elsewhere.

    ``g(0, 0) = 0``, ``g(1, 0) = 1/4``, ``g(1, 1) = 1/pi``, and ``(log r + gamma + 3/2 log 2) / (2 pi)`` far away.
    LKS section 4 takes ``log(r + 1/2) / (2 pi)``, the Green's function of the plane and not that of the stencil.

    Args:
        height: number of rows, at least 1.
        width: number of columns, at least 1.

    Returns:
        ``g(y, x)`` for ``y < height``, ``x < width``, float64 on the CPU, shape (height, width), accurate to
        1e-12. ``g`` is even in ``x`` and in ``y``.

    Raises:
        ValueError: ``height`` or ``width`` is below 1.

    Example:
        >>> lattice_green(2, 2)
        tensor([[0.0000, 0.2500],
                [0.2500, 0.3183]], dtype=torch.float64)
    """
    for name, n in (("height", height), ("width", width)):
        check_whole(name, n, 1, MOST_PIXELS)
    check_pixels("height", height, width)
    return torch.from_numpy(_green_table(height, width))


def _green_table(height: int, width: int) -> NDArray[np.float64]:
    """`lattice_green` as an array."""
    y2 = np.arange(height, dtype=np.float64)[:, None] ** 2
    x2 = np.arange(width, dtype=np.float64) ** 2
    r2 = np.maximum(y2 + x2, 1.0)
    cos4 = 1.0 - 8.0 * x2 * y2 / r2**2  # of four and eight times the polar angle
    cos8 = 2.0 * cos4**2 - 1.0
    # Expansion for large r, up to O(r^-6): Martinsson & Rodin, "Asymptotic expansions of lattice Green's
    # functions", 2002.
    table = (0.5 * np.log(r2) + np.euler_gamma + 1.5 * np.log(2.0)) / (2.0 * np.pi)
    table -= cos4 / (24.0 * np.pi * r2) + (18.0 * cos4 + 25.0 * cos8) / (480.0 * np.pi * r2**2)
    table[:_NEAR, :_NEAR] = _green_near()[:height, :width]
    return table


@functools.cache
def _green_near() -> NDArray[np.float64]:
    """`lattice_green` for offsets below `_NEAR`, by Gauss-Legendre quadrature.

    The inverse Fourier integral over one frequency is closed: with ``cosh s = 2 - cos k``,
    ``g(y, x) = 1/pi * integral from 0 to pi of (1 - cos(k x) exp(-s y)) / (2 sinh s) dk``.
    """
    node, weight = np.polynomial.legendre.leggauss(2 * _NEAR)
    k = 0.5 * np.pi * (node + 1.0)
    s = 2.0 * np.arcsinh(np.sin(0.5 * k))
    weight = 0.25 * weight / np.sinh(s)
    offset = np.arange(_NEAR, dtype=np.float64)[:, None]
    # 1 - cos * exp = (1 - exp) + exp * (1 - cos), each without cancellation where k is small
    column = -np.expm1(-s * offset) @ weight
    return np.asarray(column[:, None] + (np.exp(-s * offset) * weight) @ (2.0 * np.sin(0.5 * k * offset) ** 2).T)


# The spectra are kept as arrays: a tensor would remember the inference mode or export trace it was born in.
@functools.lru_cache(maxsize=16)
def _torus_spectrum(height: int, width: int) -> NDArray[np.float64]:
    """One over the symbol of the 5-point Laplacian on a torus, 0 for the constant, as rfft2 lays it out."""
    ky = 2.0 * np.pi * np.fft.fftfreq(height)
    kx = 2.0 * np.pi * np.fft.rfftfreq(width)
    symbol = -4.0 * (np.sin(0.5 * ky)[:, None] ** 2 + np.sin(0.5 * kx) ** 2)
    symbol[0, 0] = np.inf
    return 1.0 / symbol


@functools.lru_cache(maxsize=16)
def _green_spectrum(height: int, width: int) -> NDArray[np.float64]:
    """Spectrum of `lattice_green` wrapped around a torus, real as it is even, as rfft2 lays it out."""
    y, x = np.arange(height), np.arange(width)
    table = _green_table(height // 2 + 1, width // 2 + 1)
    wrapped = table[np.minimum(y, height - y)][:, np.minimum(x, width - x)]
    return np.ascontiguousarray(np.fft.rfft2(wrapped).real)
