"""Operating points: what they are called, what they promise, and how a tolerance picks one."""

import itertools

import pytest
import torch
from torch import Tensor

import torchbokeh as tb
from torchbokeh.ops.merge import splat_merged
from torchbokeh.ops.splat import splat_spans
from torchbokeh.plan.quality import QUALITIES, ROUNDING, check_quality, choose, merged_shares

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
    everything = [0.0, 1.0, 1.0, 1.0]
    for quality in QUALITIES:
        assert choose("exact", quality.error, everything) == (quality, quality.error)
    assert choose("fast", 0.0, everything)[0].name == "exact"
    assert choose("exact", 1.0, everything)[0].name == "fast"
    # Where little is wide enough to be merged, little is wrong.
    assert choose("exact", 0.001, [0.0, 0.01, 0.02, 0.03])[0].name == "fast"
    assert choose("exact", ROUNDING, [0.0, 0.0, 0.0, 0.0])[0].name == "fast"
    assert choose("exact", 0.9 * ROUNDING, [0.0, 0.0, 0.0, 0.0])[0].name == "exact"
    assert choose("balanced", None, everything)[0].name == "balanced"


def test_shares_count_what_is_merged() -> None:
    coc = torch.tensor([0.0, -4.9, 5.0, 7.9, -8.0, 15.9, 16.0, -100.0]).view(1, 1, 2, 4)
    assert [round(s.item() * 8) for s in merged_shares(coc, "exact", 0.1)] == [0, 2, 4, 6]
    twice, there = torch.cat([coc, coc]), torch.cat([coc * 0 + 1, coc * 0]) > 0
    assert merged_shares(twice, "exact", 0.1, there) == merged_shares(coc, "exact", 0.1)
    assert [round(s.item() * 8) for s in merged_shares(coc, "balanced", None)] == [0, 0, 4, 0]


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
