"""Modules that undo the differential operator of a domain (LKS sections 4 and 6.3)."""

from pathlib import Path

import torch
from torch import Tensor, nn

from torchbokeh.ops.checks import check_flag, check_image
from torchbokeh.ops.integrate import difference_x, laplacian, poisson_fft, poisson_pyramid, running_sum_x

_SHAPE = ("B", "C", "H", "W")

TRAINED = Path(__file__).parent / "weights" / "pyramid.safetensors"
"""Kernels of `PyramidIntegrator`, made by ``python examples/train_integrator.py``."""


class Integrator(nn.Module):
    """A differential operator and its inverse, both linear, on buffers of shape (B, C, H, W).

    Calling the module integrates: ``integrator(integrator.differentiate(u))`` is ``u`` for every image that
    vanishes on its border. Subclasses say how.
    """

    def forward(self, buffer: Tensor) -> Tensor:
        """Integrate a buffer of splatted differences.

        Args:
            buffer: shape (B, C, H, W).

        Returns:
            Image, shape (B, C, H, W), same dtype.

        Raises:
            TypeError: ``buffer`` is not a floating-point tensor.
            ValueError: ``buffer`` does not have four dimensions.
        """
        return self._integrate(check_image("buffer", buffer, _SHAPE))

    def differentiate(self, image: Tensor) -> Tensor:
        """Apply the differential operator to an image.

        Args:
            image: shape (B, C, H, W), zero on its border.

        Returns:
            Buffer, shape (B, C, H, W), same dtype.

        Raises:
            TypeError: ``image`` is not a floating-point tensor.
            ValueError: ``image`` does not have four dimensions.
        """
        return self._differentiate(check_image("image", image, _SHAPE))

    def adjoint(self, image: Tensor) -> Tensor:
        """Apply the transpose of the integration: ``sum(integrator(b) * u) == sum(b * adjoint(u))``.

        Args:
            image: shape (B, C, H, W).

        Returns:
            Buffer, shape (B, C, H, W), same dtype.

        Raises:
            TypeError: ``image`` is not a floating-point tensor.
            ValueError: ``image`` does not have four dimensions.
        """
        check_image("image", image, _SHAPE)
        pullback = torch.func.vjp(self._integrate, torch.zeros_like(image))[1]
        return pullback(image)[0]

    def _integrate(self, buffer: Tensor) -> Tensor:
        raise NotImplementedError

    def _differentiate(self, image: Tensor) -> Tensor:
        return laplacian(image)


class ScanlineIntegrator(Integrator):
    """Horizontal differences and their running sum along x: exact, one pass over the buffer.

    A NaN or infinite value goes on to the right end of its row.

    Example:
        >>> scanline = ScanlineIntegrator()
        >>> u = torch.rand(1, 4, 8, 8)
        >>> torch.allclose(scanline(scanline.differentiate(u)), u, atol=1e-6)
        True
    """

    def _integrate(self, buffer: Tensor) -> Tensor:
        return running_sum_x(buffer)

    def _differentiate(self, image: Tensor) -> Tensor:
        return difference_x(image)


class FFTIntegrator(Integrator):
    """5-point Laplacian and its lattice Green's function by FFT: exact, see `torchbokeh.ops.integrate.poisson_fft`.

    A NaN or infinite value spoils all of its channel.

    Args:
        compact: the integrated images are known to vanish on their border, so that a torus of the buffer's own
            size will do. Sparsified spreadlets break this unless their low moments vanish.

    Example:
        >>> fft = FFTIntegrator()
        >>> u = torch.nn.functional.pad(torch.rand(1, 4, 8, 8), (1, 1, 1, 1))
        >>> torch.allclose(fft(fft.differentiate(u)), u, atol=1e-5)
        True
    """

    def __init__(self, compact: bool = False) -> None:
        super().__init__()
        self.compact = check_flag("compact", compact)

    def extra_repr(self) -> str:
        """Show the configuration in ``repr``."""
        return f"compact={self.compact}"

    def _integrate(self, buffer: Tensor) -> Tensor:
        return poisson_fft(buffer, compact=self.compact)


class PyramidIntegrator(Integrator):
    """5-point Laplacian and a convolution pyramid: approximate, convolutions only, time linear in the pixels.

    The kernels are parameters, with the symmetry of the square by construction: only one eighth of each is stored. By
    default they are trained ones, of their own on the finest levels and one set for all coarser ones;
    `torchbokeh.learn.training` trains them. It runs at any size. A NaN or infinite value spoils all of its channel.

    Args:
        weights: ``"trained"``, which come with the package, or ``"published"``: those of Farbman et al. 2011,
            "Convolution Pyramids", the same on every level; `torchbokeh.ops.integrate.poisson_pyramid` tells their
            error.
        levels: how often the size is halved; ``None`` fits each picture. A fixed number makes one network for all
            sizes, see `torchbokeh.learn.export.export_onnx`; 13 do for 4096 px.

    Attributes:
        h1: analysis kernels of 5 x 5, ``(L, 6)``: at (0, 0), (0, 1), (1, 1), (0, 2), (1, 2) and (2, 2).
        h2: synthesis kernels, likewise.
        g: kernels of each level of 5 x 5, likewise; the published ones of 3 x 3, ``(1, 3)``.

    Raises:
        ValueError: other weights.

    Example:
        >>> pyramid = PyramidIntegrator()
        >>> u = torch.zeros(1, 1, 64, 64)
        >>> u[..., 16:48, 16:48] = 1.0
        >>> abs(pyramid(pyramid.differentiate(u))[0, 0, 32, 32].item() - 1.0) < 0.02
        True
    """

    def __init__(self, weights: str = "trained", levels: int | None = None) -> None:
        super().__init__()
        if weights not in ("trained", "published"):
            raise ValueError(f"weights: expected 'trained' or 'published', got {weights!r}")
        if levels is not None and (not isinstance(levels, int) or isinstance(levels, bool) or levels < 1):
            raise ValueError(f"levels: expected a whole number above 0 or None, got {levels!r}")
        self.weights = weights
        self.levels = levels
        h, g = torch.tensor([0.7, 0.5, 0.15]), torch.tensor([0.547, 0.175])
        eighths = {"h1": _eighth(h), "h2": _eighth(h), "g": _eighth(g)}
        if weights == "trained":
            from safetensors.torch import load_file

            eighths = load_file(TRAINED)
        self.h1, self.h2, self.g = (nn.Parameter(eighths[name]) for name in ("h1", "h2", "g"))

    def extra_repr(self) -> str:
        """Show the configuration in ``repr``."""
        return f"weights={self.weights!r}, levels={self.levels or 'auto'}"

    def _integrate(self, buffer: Tensor) -> Tensor:
        h1, h2, g = (_whole(kernel) for kernel in (self.h1, self.h2, self.g))
        return poisson_pyramid(buffer, h1, h2, g, self.levels)


def _places(reach: int) -> list[tuple[int, int]]:
    """Of an eighth of a kernel: (0, 0), (0, 1), (1, 1), (0, 2), ..."""
    return [(y, x) for x in range(reach + 1) for y in range(x + 1)]


def _eighth(side: Tensor) -> Tensor:
    """Of the kernel that is a product of its taps 0, 1, ... along both axes: ``(1, N)``."""
    return torch.stack([side[y] * side[x] for y, x in _places(len(side) - 1)])[None]


def _whole(eighth: Tensor) -> Tensor:
    """``(L, N) -> (L, n, n)``."""
    reach = {3: 1, 6: 2}[eighth.shape[1]]
    numbers = {place: k for k, place in enumerate(_places(reach))}
    span = [abs(k) for k in range(-reach, reach + 1)]
    index = [[numbers[min(y, x), max(y, x)] for x in span] for y in span]
    return eighth[:, torch.tensor(index, device=eighth.device)]
