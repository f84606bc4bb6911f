"""Operating points: what they are called, what they promise, and how a tolerance picks one."""

import itertools

import pytest
import torch
from torch import Tensor

import torchbokeh as tb
from torchbokeh.ops.merge import splat_merged
from torchbokeh.ops.splat import splat_spans
from torchbokeh.plan.quality import QUALITIES, ROUNDING, check_quality, choose, predict_errors

MERGED = [q for q in QUALITIES if q.merging is not None]


def test_they_are_ordered_from_exact_to_fast() -> None:
    assert [q.name for q in QUALITIES] == ["exact", "high", "balanced", "fast"]
    assert QUALITIES[0].merging is None
    assert QUALITIES[0].error == 0
    for one, next_one in itertools.pairwise(QUALITIES):
        assert one.error < next_one.error
        assert one.bins >= next_one.bins
    for one, next_one in itertools.pairwise(MERGED):
        assert one.merging is not None
        assert next_one.merging is not None
        assert one.merging.cells > next_one.merging.cells


def relative_error(image: Tensor, coc: Tensor, quality: str) -> float:
    merging = next(q.merging for q in QUALITIES if q.name == quality)
    assert merging is not None
    profile = tb.Disc().profile()
    exact = splat_spans(torch.cat([image, torch.ones_like(coc)], 1), coc, profile, integrate=True)
    want = exact[:, :-1] / exact[:, -1:]
    got = splat_merged(image, coc, profile, merging, ones=True, normalise=True)[:, :-1]
    return float((got - want).abs().sum() / want.abs().sum())


@pytest.mark.slow
@pytest.mark.parametrize("radius", [12.0, 30.0, 80.0])
@pytest.mark.parametrize("name", [name for name in tb.scenes.RECIPES if name != "stack"])
def test_errors_on_the_recipes_are_those_stated(name: str, radius: float) -> None:
    scene, camera = tb.scenes.RECIPES[name](0, size=(384, 512), blur=radius)
    seen = scene.render(camera)
    image = seen["image"][None, :3]
    coc = camera.lens.coc(seen["depth"][None], 512)
    for quality in MERGED:
        assert relative_error(image, coc, quality.name) <= quality.error


def test_a_tolerance_takes_the_fastest_point_that_keeps_to_it() -> None:
    errors = [0.0, 0.004, 0.01, 0.03]
    for quality, error in zip(QUALITIES, errors, strict=True):
        assert choose("exact", error, errors, 50.0) == (quality, error)
    assert choose("fast", 0.003, errors, 50.0)[0].name == "exact"
    assert choose("exact", 1.0, errors, 50.0)[0].name == "fast"


def test_a_name_takes_that_point_and_its_largest_error() -> None:
    for quality in QUALITIES:
        assert choose(quality.name, None, [], 50.0) == (quality, quality.error)
    assert choose("balanced", None, [], 7.9)[1] == ROUNDING
    assert choose("exact", None, [], 7.9)[1] == 0


def test_even_light_and_smooth_radii_are_predicted_to_err_least() -> None:
    even, ramp = torch.ones(1, 3, 96, 96), torch.linspace(20, 40, 96).expand(1, 1, 96, 96)
    for quality, error in zip(QUALITIES, predict_errors(even, ramp), strict=True):
        assert error.item() == pytest.approx(quality.even + (ROUNDING if quality.merging else 0))
    light = torch.zeros(1, 3, 96, 96)
    light[..., 40, 50] = 1.0
    radii = torch.rand(1, 1, 96, 96, generator=torch.Generator().manual_seed(0)) * 40
    for image, coc in ((light, ramp), (even, 10 + radii)):
        for quality, error in zip(QUALITIES, predict_errors(image, coc), strict=True):
            assert quality.error * 0.95 <= error.item() <= quality.error + ROUNDING + 1e-6


def test_where_nothing_is_wide_only_radii_are_rounded() -> None:
    image, coc = torch.rand(1, 3, 40, 40), torch.rand(1, 1, 40, 40) * 4
    assert [e.item() for e in predict_errors(image, coc)] == pytest.approx([0, ROUNDING, ROUNDING, ROUNDING])


def test_a_batch_is_expected_to_err_like_its_worst_picture() -> None:
    generator = torch.Generator().manual_seed(1)
    image = torch.rand(3, 3, 70, 50, generator=generator) ** torch.tensor([0.1, 8.0, 1.0]).view(3, 1, 1, 1)
    coc = torch.rand(3, 1, 1, 1, generator=generator) * 60 + torch.zeros(3, 1, 70, 50)
    alone = torch.stack([torch.stack(predict_errors(i[None], c[None])) for i, c in zip(image, coc, strict=True)])
    torch.testing.assert_close(torch.stack(predict_errors(image, coc)), alone.amax(0))


@pytest.mark.parametrize("scale", [1e-30, 1e30])
def test_predictions_do_not_depend_on_the_unit_of_light(scale: float) -> None:
    image, coc = torch.rand(1, 3, 70, 50, dtype=torch.float64), torch.rand(1, 1, 70, 50, dtype=torch.float64) * 30
    for one, other in zip(predict_errors(image, coc), predict_errors(image * scale, coc), strict=True):
        assert one.item() == pytest.approx(other.item(), rel=1e-5)


@pytest.mark.parametrize("tolerance", [0.005, 0.02])
@pytest.mark.parametrize("period", [5, 12, 15])
@pytest.mark.parametrize("radius", [20.0, 35.4, 45.0])
def test_a_tolerance_holds_for_dots_and_lines(tolerance: float, period: int, radius: float) -> None:
    """Lines of a few pixels beat with the cells that they are merged into, dots with the coverage around them."""
    y, x = torch.meshgrid(torch.arange(140), torch.arange(200), indexing="ij")
    lines, dots = x % period == 0, (x % period == 0) & (y % period == 0)
    image = torch.stack([lines, dots, lines | dots])[None].float()
    for coc in (torch.full((1, 1, 140, 200), radius), (radius * (x // 31 % 3) / 2)[None, None]):
        want = tb.KernelSplatting(quality="exact")(image, coc)
        got = tb.KernelSplatting(tolerance=tolerance)(image, coc)
        assert (got - want).abs().sum() <= tolerance * want.sum()


@pytest.mark.parametrize(
    ("quality", "tolerance", "error", "message"),
    [
        ("best", None, ValueError, "quality: expected one of 'exact', 'high', 'balanced', 'fast', got 'best'"),
        (None, None, ValueError, "quality: expected one of"),
        ("exact", "0.1", TypeError, "tolerance: expected a number or None, got '0.1'"),
        ("exact", True, TypeError, "tolerance: expected a number or None, got True"),
        ("exact", -0.1, ValueError, "tolerance: expected a relative error of at least 0, got -0.1"),
        ("exact", float("nan"), ValueError, "tolerance: expected a relative error of at least 0, got nan"),
    ],
)
def test_what_is_refused(quality: object, tolerance: object, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        check_quality(quality, tolerance)
    for module in (tb.LensBlur, tb.KernelSplatting):
        with pytest.raises(error, match=message):
            module(quality=quality, tolerance=tolerance)
