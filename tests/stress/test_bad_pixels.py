"""One pixel of a picture that is NaN or infinite: how far it goes is what the renderers' documentation says."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

import torchbokeh as tb

H, W, Y, X = 32, 48, 14, 20
RADIUS = 5.0  # above all that occur

COC = 4 + 0.5 * torch.rand(2, 1, H, W, generator=torch.Generator().manual_seed(0))
BOTH = torch.where(torch.arange(W) < 10, -COC, COC)
MOTION = 3 + torch.rand(2, 2, H, W, generator=torch.Generator().manual_seed(1))
DEEP = COC[:, None].expand(2, 2, 1, H, W).contiguous()


def spoiled(value: float, layers: bool = False) -> Tensor:
    """Two pictures; a pixel of the first channel of the second one is bad."""
    image = torch.rand(2, 2, 4, H, W) if layers else torch.rand(2, 3, H, W)
    if layers:
        image[:, :, 3] = 1
        image[1, 0, 0, Y, X] = value
    else:
        image[1, 0, Y, X] = value
    return image


ROWS = {
    **{
        f"{name}, {quality}": (lambda image, module=module, keyword=keyword: module(image, **{keyword: COC}))
        for quality in ("exact", "balanced", "fast")
        for name, module, keyword in (
            ("KernelSplatting", tb.KernelSplatting(quality=quality), "coc"),
            ("LensBlur", tb.LensBlur(quality=quality), "coc"),
        )
    },
    "LensBlur, layers": lambda image: tb.LensBlur()(image, coc=DEEP),
    "LensBlur, balanced layers": lambda image: tb.LensBlur(quality="balanced")(image, coc=DEEP),
    "ScanlineIntegrator": tb.ScanlineIntegrator(),
}
PSF = {
    "AccumulationBuffer": lambda image: tb.AccumulationBuffer(views=8)(image, coc=DEEP),
    "AccumulationBuffer, sub-samples": lambda image: tb.AccumulationBuffer(views=4, subsamples=4)(image, coc=DEEP),
}
CHANNEL = {
    "FFTIntegrator": tb.FFTIntegrator(),
    "FFTIntegrator, compact": tb.FFTIntegrator(compact=True),
    "PyramidIntegrator": tb.PyramidIntegrator(),
    "KernelSplatting, bank": lambda image: tb.KernelSplatting(bank=tb.PsfBank.load("simple-lens"))(image, COC),
    "KernelSplatting, one radius": lambda image: tb.KernelSplatting("disc", "exact")(image, torch.full_like(COC, 9.0)),
    "LensBlur, one radius": lambda image: tb.LensBlur()(image, coc=torch.full_like(COC, 9.0)),
    "LensBlur, foreground": lambda image: tb.LensBlur()(image, coc=BOTH),
    "LensBlur, balanced foreground": lambda image: tb.LensBlur(quality="balanced")(image, coc=BOTH),
    "LensBlur, motion": lambda image: tb.LensBlur(quality="balanced")(image, coc=COC, motion=MOTION),
}


@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf])
@pytest.mark.parametrize("name", [*ROWS, *PSF, *CHANNEL])
@pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning")  # what they are there for
def test_a_bad_pixel_goes_no_farther_than_is_said(name: str, value: float) -> None:
    renderer: Callable[[Tensor], Tensor] = {**ROWS, **PSF, **CHANNEL}[name]
    bad = ~renderer(spoiled(value, "layers" in name or "Accumulation" in name)).isfinite()
    assert bad[1, 0, Y, X]  # never hidden
    assert not bad[0].any()
    assert not bad[1, 1:].any()
    y, x = bad[1, 0].nonzero().T
    if name not in CHANNEL:
        assert (y - Y).abs().max() <= RADIUS
        assert (X - x).max() <= RADIUS
    if name in PSF:
        assert (x - X).max() <= RADIUS
