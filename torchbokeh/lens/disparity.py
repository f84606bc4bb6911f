"""A lens for maps of disparity."""

from torch import Tensor

from torchbokeh.lens.base import Lens, check_map
from torchbokeh.lens.field_map import Field
from torchbokeh.lens.parameters import check_parameter


class DisparityLens(Lens):
    """A lens for maps of disparity: ``coc = strength * (focus_disparity - disparity)``.

    Disparity is larger for nearer things and may have any unit and offset, as from a stereo pair or a
    network. Here the ``depth`` of the :class:`Lens` interface is that disparity, any finite value. With
    ``disparity = a / depth`` it is the :class:`ThinLens` with ``focus_disparity = a / df`` and
    ``strength = E * F / (1 - F / df) * width / sensor_width / a``.

    Args:
        strength: pixels of CoC radius per unit of disparity, finite; 0 blurs nothing and a negative one
            takes larger values as farther.
        focus_disparity: the disparity that is in focus, finite.

    Each is given and held as for :class:`ThinLens`.

    Raises:
        TypeError: not a number or floating-point tensor.
        ValueError: not finite, or shapes or devices that do not go together.

    Example:
        >>> import torch
        >>> from torchbokeh.lens import DisparityLens
        >>> lens = DisparityLens(strength=30.0, focus_disparity=0.5)
        >>> lens.coc(torch.tensor([[0.0, 0.5, 1.0]]), width=1920).tolist()
        [[15.0, 0.0, -15.0]]
    """

    strength: Tensor
    focus_disparity: Tensor

    def __init__(self, strength: float | Tensor, focus_disparity: float | Tensor) -> None:
        super().__init__()
        self.keep(strength=strength, focus_disparity=focus_disparity)
        for name, value in self.values().items():
            check_parameter(name, value, value.isfinite(), "a finite value")
            check_parameter(name, value, value.abs() <= 1e18, "at most 1e18 in size")

    def coc(self, depth: Tensor, width: int, *, field: Field | None = None) -> Tensor:
        """Signed CoC radius in pixels, positive behind the disparity in focus.

        Args:
            depth: disparity, ``(B, 1, H, W)`` or ``(..., H, W)``, finite.
            width: width of the sensor in pixels; without effect on the result.
            field: without effect.

        Returns:
            The shape of ``depth``, float32 or float64.

        Raises:
            TypeError: ``depth`` is no floating-point tensor, or ``width`` no integer.
            ValueError: wrong shape or device, ``width`` < 1, or a disparity infinite or NaN; the values are
                looked at as in :meth:`ThinLens.coc`.
        """
        disparity, strength, focus = self.aligned("depth", depth, width)
        coc = strength * (focus - disparity)
        check_map("depth", disparity, coc.isfinite(), "finite disparities")
        return coc

    def depth(self, coc: Tensor, width: int) -> Tensor:
        """Disparity at which the signed CoC radius is ``coc``: the inverse of :meth:`coc`.

        A ``strength`` of 0 has no inverse and gives infinite or NaN values.

        Args:
            coc: ``(B, 1, H, W)`` or ``(..., H, W)``, signed radius in pixels.
            width: width of the whole image in pixels; without effect on the result.

        Returns:
            The shape of ``coc``, float32 or float64.

        Raises:
            TypeError: ``coc`` is no floating-point tensor, or ``width`` no integer.
            ValueError: wrong shape or device, or ``width`` < 1.

        Example:
            >>> import torch
            >>> DisparityLens(30.0, focus_disparity=0.5).depth(torch.tensor([[15.0]]), width=640).item()
            0.0
        """
        c, strength, focus = self.aligned("coc", coc, width)
        return focus - c / strength
