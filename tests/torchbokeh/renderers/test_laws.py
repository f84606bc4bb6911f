"""Chosen scenes in which every quality has to keep a law; those drawn at random are in ``tests/properties``."""

import pytest
import torch

import torchbokeh as tb

QUALITIES = ("exact", "high", "balanced", "fast")


@pytest.mark.parametrize("size", [(61, 67), (33, 33), (45, 98), (301, 401), (64, 64)])
@pytest.mark.parametrize("quality", QUALITIES)
def test_a_foreground_at_the_border_stays_opaque(quality: str, size: tuple[int, int]) -> None:
    height, width = size
    image, coc = torch.full((1, 3, *size), 0.1), torch.full((1, 1, *size), 6.0)
    image[..., height // 2 :, width // 2 :] = 1.0
    coc[..., height // 2 :, width // 2 :] = -12.0
    corner = tb.LensBlur(quality=quality)(image, coc=coc)[..., -1, -1]
    torch.testing.assert_close(corner, torch.ones_like(corner), rtol=0, atol=2e-3)


@pytest.mark.parametrize("radius", [0.0, 0.4, 3.0])
@pytest.mark.parametrize("quality", QUALITIES)
def test_a_half_transparent_layer_has_no_frame(quality: str, radius: float) -> None:
    layers = torch.full((1, 2, 4, 61, 67), 0.5)
    layers[:, 1] = torch.tensor([0.0, 0.0, 0.0, 1.0])[:, None, None]
    out = tb.LensBlur(quality=quality)(layers, coc=torch.full((1, 2, 1, 61, 67), radius))
    torch.testing.assert_close(out[:, :3], torch.full_like(out[:, :3], 0.5), rtol=0, atol=1e-3)


@pytest.mark.parametrize("radius", [5.7, 12.3, 20.0, 31.0])
@pytest.mark.parametrize("quality", QUALITIES[1:])
def test_a_light_before_black_keeps_its_disc(quality: str, radius: float) -> None:
    image = torch.zeros(1, 3, 128, 128)
    image[..., 61, 66] = 1000.0
    coc = torch.full((1, 1, 128, 128), radius)
    coc[..., :2, :2] += 0.01  # not one convolution
    for render in (tb.KernelSplatting(quality=quality), lambda i, c: tb.LensBlur(quality=quality)(i, coc=c)):
        got = render(image, coc)
        want = tb.KernelSplatting(quality="exact")(image, coc)
        assert float((got - want).abs().sum() / want.sum()) < 0.002
        place = torch.stack([(got[0, 0].sum(d) * torch.arange(128)).sum() / got[0, 0].sum() for d in (1, 0)])
        torch.testing.assert_close(place, torch.tensor([61.0, 66.0]), rtol=0, atol=0.02)
