"""Modules that undo the differential operator of a domain (LKS sections 4 and 6.3)."""

import torch
from torch import Tensor, nn

from torchbokeh.ops._checks import check_image
from torchbokeh.ops.integrate import difference_x, laplacian, poisson_fft, poisson_pyramid, running_sum_x

_SHAPE = ("B", "C", "H", "W")


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
        self.compact = compact

    def extra_repr(self) -> str:
        """Show the configuration in ``repr``."""
        return f"compact={self.compact}"

    def _integrate(self, buffer: Tensor) -> Tensor:
        return poisson_fft(buffer, compact=self.compact)


class PyramidIntegrator(Integrator):
    """5-point Laplacian and a convolution pyramid: approximate, convolutions only, time linear in the pixels.

    The kernels are parameters, symmetric by construction: only the centre and one side are stored. They start at
    the values of Farbman et al. 2011, "Convolution Pyramids"; `torchbokeh.ops.integrate.poisson_pyramid` tells
    their error.

    Attributes:
        h1: analysis kernel, taps at 0, ±1, ±2, shape (3,).
        h2: synthesis kernel, taps at 0, ±1, ±2, shape (3,).
        g: kernel of each level, taps at 0, ±1, shape (2,).

    Example:
        >>> pyramid = PyramidIntegrator()
        >>> u = torch.zeros(1, 1, 64, 64)
        >>> u[..., 16:48, 16:48] = 1.0
        >>> abs(pyramid(pyramid.differentiate(u))[0, 0, 32, 32].item() - 1.0) < 0.02
        True
    """

    def __init__(self) -> None:
        super().__init__()
        self.h1 = nn.Parameter(torch.tensor([0.7, 0.5, 0.15]))
        self.h2 = nn.Parameter(torch.tensor([0.7, 0.5, 0.15]))
        self.g = nn.Parameter(torch.tensor([0.547, 0.175]))

    def _integrate(self, buffer: Tensor) -> Tensor:
        h1, h2, g = (torch.cat((side[1:].flip(0), side)) for side in (self.h1, self.h2, self.g))
        return poisson_pyramid(buffer, h1, h2, g)
