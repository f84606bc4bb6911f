"""Lights near the border: which count, and how the surroundings come in."""

import pytest
import torch
from torch import Tensor

import torchbokeh as tb
from torchbokeh.plan.lights import SHOWN, lights_at_border

H, W, R = 60, 80, 10.0


def light(y: int, x: int, value: float = 200.0, ground: float = 0.05) -> Tensor:
    image = torch.full((1, 3, H, W), ground)
    image[..., y, x] = value
    return image


def flat(radius: float = R) -> Tensor:
    return torch.full((1, 1, H, W), radius)


@pytest.mark.parametrize(("y", "x", "near"), [(30, 0, True), (30, 19, True), (30, 20, False), (59, 40, True)])
def test_only_those_within_two_radii_count(y: int, x: int, near: bool) -> None:
    assert (lights_at_border(light(y, x), flat(), R) > 0) == near


def test_it_is_their_contrast_in_units_of_what_shows() -> None:
    image = light(3, 4)
    ordinary = image.mean()
    want = 200.0 / ordinary / max(SHOWN * R**2, 4.0)
    assert lights_at_border(image, flat(), R) == pytest.approx(want.item())
    assert lights_at_border(1e-30 * image.double(), flat().double(), R) == pytest.approx(want.item())
    layers = torch.cat([image, torch.ones(1, 1, H, W)], 1)[:, None]
    assert lights_at_border(layers, flat()[:, None], R) == pytest.approx(want.item())


def test_even_pictures_sharp_ones_and_black_ones_have_none() -> None:
    noise = torch.rand(2, 3, H, W, generator=torch.Generator().manual_seed(0))
    for image, radius in ((noise, R), (light(0, 0), 0.4), (torch.zeros(1, 3, H, W), R)):
        assert lights_at_border(image, flat(radius).expand(len(image), -1, -1, -1), radius) == 0


def test_a_card_that_ends_near_the_border_is_no_light() -> None:
    layers = torch.zeros(1, 1, 4, H, W)
    layers[..., :10, :10] = 0.5
    assert lights_at_border(layers, flat()[:, None], R) == 0


def test_surroundings_come_gradually() -> None:
    coc = flat() + torch.linspace(0, 1, W)
    shares, pictures = [], []
    for value in torch.linspace(0.15, 0.7, 56).tolist():
        image = light(30, 2, value)
        plan = tb.KernelSplatting().plan(image, coc)
        parts = list(tb.LensBlur().plan(image, coc=coc).pictures())
        assert sum(p.share for p in parts if p.plan.surrounded) == pytest.approx(plan.lit)
        shares.append(plan.lit)
        pictures.append(torch.cat([tb.LensBlur()(image, coc=coc), tb.KernelSplatting(quality="exact")(image, coc)]))
    assert shares[0] == 0
    assert shares[-1] == 1
    assert any(0 < s < 1 for s in shares)
    change = torch.stack(pictures).diff(dim=0).abs().amax((2, 3, 4))
    assert (change.amax(0) < 3 * change.amin(0)).all()  # as much light comes in each step


def test_the_plan_says_what_is_assumed() -> None:
    assert "Lights near the border: 10 px around" in str(tb.LensBlur().plan(light(30, 2), coc=flat()))
    assert "Lights near the border: 10 px around" in str(tb.KernelSplatting().plan(light(30, 2), flat()))
    for plan in (tb.LensBlur().plan(light(30, 40), coc=flat()), tb.KernelSplatting().plan(light(30, 40), flat())):
        assert plan.surrounded == 0
        assert "Lights" not in str(plan)
