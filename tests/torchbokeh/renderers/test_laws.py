"""Laws of every quality, at odd sizes, at borders and in batches, where scenes and plans do not fit each other."""

import pytest
import torch
from torch import Tensor

import torchbokeh as tb

QUALITIES = ("exact", "high", "balanced", "fast")
ODD = [(61, 67), (33, 33), (45, 98), (9, 5), (64, 64)]


def ramp(height: int, width: int, low: float = -12.0, high: float = 18.0) -> Tensor:
    return torch.linspace(low, high, width).expand(1, 1, height, width).contiguous()


def kinds(height: int, width: int) -> dict[str, Tensor]:
    """Signed CoC of scenes that ask for different plans."""
    x = torch.arange(width).expand(height, width)
    noise = 8 * torch.randn(height, width, generator=torch.Generator().manual_seed(0))
    planes = torch.where(x < width / 2, -9.0, 7.0)
    found = {"flat": torch.full((height, width), -5.6), "far": torch.full((height, width), 13.0), "planes": planes}
    found |= {"noise": noise, "sharp": torch.zeros(height, width), "ramp": ramp(height, width)[0, 0]}
    return {name: coc[None, None] for name, coc in found.items()}


@pytest.mark.parametrize("size", [(61, 67), (33, 33), (45, 98), (301, 401), (64, 64)])
@pytest.mark.parametrize("quality", QUALITIES)
def test_a_foreground_at_the_border_stays_opaque(quality: str, size: tuple[int, int]) -> None:
    height, width = size
    image, coc = torch.full((1, 3, *size), 0.1), torch.full((1, 1, *size), 6.0)
    image[..., height // 2 :, width // 2 :] = 1.0
    coc[..., height // 2 :, width // 2 :] = -12.0
    corner = tb.LensBlur(quality=quality)(image, coc=coc)[..., -1, -1]
    torch.testing.assert_close(corner, torch.ones_like(corner), rtol=0, atol=2e-3)


@pytest.mark.parametrize("size", ODD)
@pytest.mark.parametrize("quality", QUALITIES)
def test_layers_in_focus_are_plainly_over_one_another(quality: str, size: tuple[int, int]) -> None:
    draw = torch.Generator().manual_seed(1)
    layers = torch.rand(1, 3, 4, *size, generator=draw)
    layers[:, :, :3] *= layers[:, :, 3:]
    want = torch.zeros(1, 4, *size)
    for k in (2, 1, 0):
        want = layers[:, k] + (1 - layers[:, k, 3:]) * want
    coc = 0.98 * torch.rand(1, 3, 1, *size, generator=draw) - 0.49
    torch.testing.assert_close(tb.LensBlur(quality=quality)(layers, coc=coc), want, rtol=0, atol=1e-5)


@pytest.mark.parametrize("radius", [0.0, 0.4, 3.0])
@pytest.mark.parametrize("quality", QUALITIES)
def test_a_half_transparent_layer_has_no_frame(quality: str, radius: float) -> None:
    layers = torch.full((1, 2, 4, 61, 67), 0.5)
    layers[:, 1] = torch.tensor([0.0, 0.0, 0.0, 1.0])[:, None, None]
    out = tb.LensBlur(quality=quality)(layers, coc=torch.full((1, 2, 1, 61, 67), radius))
    torch.testing.assert_close(out[:, :3], torch.full_like(out[:, :3], 0.5), rtol=0, atol=1e-3)


@pytest.mark.parametrize("size", [(33, 33), (18, 30)])
@pytest.mark.parametrize("quality", QUALITIES)
def test_white_stays_white_by_the_plan_of_any_scene(quality: str, size: tuple[int, int]) -> None:
    white, blur, scenes = torch.ones(1, 3, *size), tb.LensBlur(quality=quality), kinds(*size)
    for mine in scenes.values():
        plan = blur.plan(white, coc=mine)
        for theirs in scenes.values():
            out = blur(white, coc=theirs, plan=plan)
            torch.testing.assert_close(out, white, rtol=0, atol=1e-4)


@pytest.mark.parametrize("quality", QUALITIES)
def test_a_picture_in_a_batch_is_what_it_is_alone(quality: str) -> None:
    size = 31, 44
    scenes = torch.cat([*kinds(*size).values()])
    images = torch.rand(len(scenes), 3, *size, generator=torch.Generator().manual_seed(2))
    images[:, :, 9, 7] = 200.0
    for render in (
        lambda image, coc: tb.LensBlur(quality=quality)(image, coc=coc),
        lambda image, coc: tb.KernelSplatting(quality=quality)(image, coc),
    ):
        together = render(images, scenes)
        alone = [render(images[n : n + 1], scenes[n : n + 1]) for n in range(len(scenes))]
        torch.testing.assert_close(together, torch.cat(alone), rtol=1e-6, atol=1e-6)


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
