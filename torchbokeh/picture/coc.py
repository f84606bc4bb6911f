"""The signed circle of confusion from what a renderer is given: depth and a lens, or the CoC itself."""

import torch
from torch import Tensor

from torchbokeh.lens import Lens
from torchbokeh.ops.checks import check_image

WIDEST = 1e5
"""Radius in px from which on radii are not told apart: such a disc covers any picture evenly. That of 1e7 px would put
less on a pixel than counts as coverage (`torchbokeh.ops.composite.TINY`)."""


def signed_coc(lens: Lens | None, image: Tensor, depth: object, coc: object, margin: int = 0) -> Tensor:
    """The signed CoC of a picture or of layers, from the one of ``depth`` and ``coc`` that is there.

    ``margin`` px on each side lie beyond the sensor.
    """
    if (depth is None) == (coc is None):
        raise ValueError("depth: expected either depth or coc, got " + ("both" if coc is not None else "neither"))
    if coc is None:
        return signed_map(lens, image, "depth", depth, is_coc=False, margin=margin)
    return signed_map(lens, image, "coc", coc, is_coc=True)


def signed_map(
    lens: Lens | None, image: Tensor, name: str, value: object, *, is_coc: bool, margin: int = 0, channels: int = 1
) -> Tensor:
    """The signed CoC of one map of depth or of CoC, which has the shape of the image but for its channels."""
    checked = check_image(name, value, (*image.shape[:-3], channels, *image.shape[-2:]), like=image)
    if not is_coc:
        if lens is None:
            raise ValueError(f"{name}: expected coc, since there is no lens, got depth")
        try:
            return lens.coc(checked, image.shape[-1] - 2 * margin).clamp(-WIDEST, WIDEST)
        except ValueError as error:  # of a lens, it is the depth that is wrong
            if name == "depth":
                raise
            raise ValueError(f"{name}: {str(error).removeprefix('depth: ')}") from error
    if not torch.compiler.is_compiling() and checked.numel():
        low, high = checked.detach().aminmax()  # several times as fast as `isfinite`; NaN is both
        if not bool((high - low).isfinite()):
            raise ValueError(f"{name}: expected finite radii, got {int((~checked.isfinite()).sum())} that are not")
        if bool((high > WIDEST) | (low < -WIDEST)):
            return checked.clamp(-WIDEST, WIDEST)
    return checked
