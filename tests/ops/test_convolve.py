"""One PSF for the whole picture, against the splat of every pixel."""

import math

import pytest
import torch

from torchbokeh.ops.composite import TINY
from torchbokeh.ops.convolve import blur_uniform, convolve
from torchbokeh.ops.splat import splat_spans
from torchbokeh.psfs import Aperture, Disc, Ellipse, Polygon

F64 = torch.float64


def noise(*shape: int) -> torch.Tensor:
    return torch.rand(*shape, dtype=F64, generator=torch.Generator().manual_seed(1))


def splatted(values: torch.Tensor, radius: float, aperture: Aperture) -> torch.Tensor:
    coc = torch.full_like(values[:, :1], radius)
    values = torch.cat([values, torch.ones_like(coc)], 1)
    out = splat_spans(values, coc, aperture.profile(), integrate=True)
    return out[:, :-1] / out[:, -1:].clamp_min(TINY)


@pytest.mark.parametrize("radius", [0.0, 0.7, 3.3, -9.6, 40.0, 1e4])
@pytest.mark.parametrize("aperture", [Disc(), Polygon(5, rotation=0.3), Ellipse(squeeze=2.0)])
@pytest.mark.parametrize("size", [(19, 30), (1, 12), (17, 1), (1, 1)])
def test_it_is_the_splat_of_every_pixel(radius: float, aperture: Aperture, size: tuple[int, int]) -> None:
    values = noise(2, 3, *size)
    torch.testing.assert_close(
        blur_uniform(values, radius, aperture.profile()), splatted(values, radius, aperture), rtol=1e-9, atol=1e-12
    )


def test_gradients_are_those_of_the_splat() -> None:
    values, aim = noise(1, 2, 14, 17).requires_grad_(), noise(1, 2, 14, 17)
    squeeze = torch.nn.Parameter(torch.tensor(1.3, dtype=F64))
    found = [
        torch.autograd.grad((aim * blur(values)).sum(), [values, squeeze])
        for blur in (
            lambda v: blur_uniform(v, 5.2, Ellipse(squeeze=squeeze).profile()),
            lambda v: splatted(v, 5.2, Ellipse(squeeze=squeeze)),
        )
    ]
    torch.testing.assert_close(found[0], found[1], rtol=1e-8, atol=1e-11)


def test_a_highlight_leaves_nothing_behind_far_away() -> None:
    values = torch.ones(1, 1, 64, 200)
    values[0, 0, 30, 30] = 1e6
    out = blur_uniform(values, 12.0, Disc().profile())
    assert float((out[..., 60:] - 1).abs().max()) < 1e-6


def test_each_picture_of_a_batch_may_have_its_own_psf() -> None:
    values, psfs = noise(2, 3, 9, 11), noise(2, 1, 3, 5)
    both = convolve(values, psfs)
    for n in range(2):
        torch.testing.assert_close(both[n : n + 1], convolve(values[n : n + 1], psfs[n : n + 1]))
    want = torch.nn.functional.conv2d(values[:1].movedim(1, 0), psfs[:1].flip(2, 3), padding=(1, 2)).movedim(0, 1)
    torch.testing.assert_close(both[:1], want)


def test_bad_arguments_are_named() -> None:
    values = noise(2, 1, 4, 4)
    with pytest.raises(ValueError, match=r"psf: expected 1 or 2 of odd height and width, got shape \(1, 1, 2, 3\)"):
        convolve(values, noise(1, 1, 2, 3))
    with pytest.raises(ValueError, match=r"psf: expected 1 or 2 .* got shape \(3, 1, 3, 3\)"):
        convolve(values, noise(3, 1, 3, 3))
    with pytest.raises(TypeError, match="values: expected a tensor"):
        blur_uniform([1.0], 2.0, Disc().profile())  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="radius: expected a finite number of px, got nan"):
        blur_uniform(values, math.nan, Disc().profile())
    assert blur_uniform(values[:0], 3.0, Disc().profile()).shape == (0, 1, 4, 4)
    assert convolve(values[:, :0], noise(1, 1, 3, 3)).shape == (2, 0, 4, 4)
