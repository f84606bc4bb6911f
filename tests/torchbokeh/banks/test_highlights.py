import math

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch import Tensor

from torchbokeh import PsfBank
from torchbokeh.banks.highlights import CONTRAST, DARK, brightness_classes, support
from torchbokeh.banks.splat import bank_of_motion, splat_bank
from torchbokeh.ops.capsules import splat_capsules
from torchbokeh.psfs.model import Labels

F64 = torch.float64
few = settings(deadline=None, max_examples=40, suppress_health_check=[HealthCheck.function_scoped_fixture])


@pytest.fixture(scope="module")
def bank() -> PsfBank:
    return bank_of_motion(torch.device("cpu"))


def with_coverage(image: Tensor) -> Tensor:
    return torch.cat([image, torch.ones_like(image[:, :1])], 1)


def everywhere(*way: float, size: tuple[int, int]) -> Tensor:
    return torch.tensor(way, dtype=F64).view(1, 2, 1, 1).expand(1, 2, *size).contiguous()


@few
@given(seed=st.integers(0, 999), decades=st.floats(0, 12), black=st.floats(0, 0.5))
def test_brightness_classes_make_up_the_picture(seed: int, decades: float, black: float) -> None:
    draw = torch.Generator().manual_seed(seed)
    image = 10 ** (decades * torch.rand(1, 3, 17, 23, dtype=F64, generator=draw))
    image *= torch.rand(1, 1, 17, 23, generator=draw) >= black
    found = brightness_classes(with_coverage(image), 1)
    assert (torch.stack(found).sum(0) == 1).all()
    assert len(found) <= 1 + math.ceil(decades / math.log10(CONTRAST))
    brightness = image.amax(1, keepdim=True)
    for k, pixels in enumerate(found):
        left = brightness[torch.stack(found[k:]).any(0) & (brightness > 0)].sort().values
        if len(left):
            dark = left[int(DARK * len(left))]
            assert (brightness[pixels] <= CONTRAST * dark).all()


def test_what_has_no_dark_parts_is_spread_at_once() -> None:
    for image in (torch.rand(2, 3, 9, 9) + 0.05, torch.zeros(1, 3, 9, 9), torch.full((1, 3, 1, 1), 1e9)):
        assert len(brightness_classes(with_coverage(image), 1)) == 1
    assert len(brightness_classes(torch.ones(1, 1, 5, 5), 1)) == 1  # coverage alone
    for covered in (0.0, 1e-15):
        assert (
            len(brightness_classes(torch.cat([torch.ones(1, 3, 5, 5), torch.full((1, 1, 5, 5), covered)], 1), 1)) == 1
        )


@pytest.mark.parametrize("odd", [math.nan, math.inf, 1e-45, -1e9])
def test_odd_values_end_in_some_class(odd: float) -> None:
    image = torch.ones(1, 3, 9, 9)
    image[..., 4, 4] = odd
    found = brightness_classes(with_coverage(image), 1)
    assert (torch.stack(found).sum(0) == 1).all()
    assert len(found) <= 2


def test_brightness_classes_of_a_batch_are_those_of_its_pictures() -> None:
    image = torch.ones(3, 3, 20, 20)
    image[1, :, :9] = 1e3
    image[2, :, 3:5], image[2, :, 7:] = 1e3, 1e6
    found = brightness_classes(with_coverage(image), 1)
    assert len(found) == 3
    for n in range(3):
        alone = brightness_classes(with_coverage(image[n : n + 1]), 1)
        assert len(alone) == n + 1
        for k, pixels in enumerate(found):
            assert torch.equal(pixels[n : n + 1], alone[k] if k < len(alone) else torch.zeros_like(pixels[:1]))


def test_half_the_light_in_half_the_parts_is_as_bright() -> None:
    image = torch.ones(1, 3, 20, 20)
    image[..., :3] = 90.0
    assert len(brightness_classes(with_coverage(image) / 8, 1)) == 1
    image[..., :3] = 110.0
    assert len(brightness_classes(with_coverage(image) / 8, 1)) == 2


@few
@given(
    radius=st.floats(0.0, 12.0),
    length=st.floats(0.0, 40.0),
    angle=st.floats(0.0, 6.3),
    ahead=st.floats(-0.5, 0.5),
    x=st.integers(0, 30),
    y=st.integers(0, 24),
)
def test_the_support_of_a_pixel_holds_all_of_its_psf(
    bank: PsfBank, radius: float, length: float, angle: float, ahead: float, x: int, y: int
) -> None:
    size = (25, 31)
    bright = torch.zeros(1, 1, *size, dtype=torch.bool)
    bright[..., y, x] = True
    way = everywhere(length * math.cos(angle), length * math.sin(angle), size=size)
    coc = torch.full((1, 1, *size), radius, dtype=F64)
    found = support(bright, [Labels(coc, motion=way, offset=ahead * way)], bank)
    pixel = torch.tensor([y * size[1] + x])
    shape = torch.tensor([radius], dtype=F64), way[:, :, 0, 0], ahead * way[:, :, 0, 0]
    psf = splat_capsules(bright.to(F64), pixel, *shape)
    assert not (psf > 0)[~found].any()
    area = math.pi * max(radius, 0.5) ** 2 + 2 * radius * length
    assert int(found.sum()) < 4 * area + 12 * (radius + length + 4)


@pytest.mark.parametrize("share", [0.2, 0.7])
@pytest.mark.parametrize("contrast", [1e3, 1e6])
def test_a_bright_region_adds_nothing_to_the_dark_around_it(bank: PsfBank, contrast: float, share: float) -> None:
    size, radius, way = (60, 80), 3.0, (5.0, -3.0)
    image = torch.ones(1, 3, *size)
    edge = int(share * size[1])
    image[..., :edge] = contrast
    coc, motion = torch.full((1, 1, *size), radius), everywhere(*way, size=size).float()
    out = splat_bank(with_coverage(image), Labels(coc, motion=motion), bank)
    plain = splat_bank(with_coverage(torch.ones_like(image)), Labels(coc, motion=motion), bank)
    reach = edge + math.ceil(radius + math.hypot(*way) / 2) + 2
    torch.testing.assert_close(out[..., reach:], plain[..., reach:], rtol=0, atol=2e-3)
    pixels = torch.arange(image[0, 0].numel())
    geometry = (t[0].flatten(1).T for t in (motion, torch.zeros_like(motion)))
    dense = splat_capsules(with_coverage(image), pixels, coc.flatten(), *geometry)
    assert float((out - dense).abs().sum() / dense.abs().sum()) < 0.01


def test_the_gradient_of_a_bright_region_is_that_of_what_is_drawn(bank: PsfBank) -> None:
    image = torch.ones(1, 1, 12, 14, dtype=F64)
    image[..., :4] = 1e3
    labels = Labels(torch.full((1, 1, 12, 14), 2.0, dtype=F64), motion=everywhere(4.0, 1.0, size=(12, 14)))
    aim = torch.rand(1, 2, 12, 14, dtype=F64, generator=torch.Generator().manual_seed(0))
    leaf = image.requires_grad_()
    (grad,) = torch.autograd.grad((aim * splat_bank(with_coverage(leaf), labels, bank)).sum(), leaf)
    step = torch.randn(image.shape, dtype=F64, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        change = [(aim * splat_bank(with_coverage(image + e * step), labels, bank)).sum() for e in (1e-3, -1e-3)]
    assert float((change[0] - change[1]) / 2e-3) == pytest.approx(float((grad * step).sum()), rel=1e-9)
