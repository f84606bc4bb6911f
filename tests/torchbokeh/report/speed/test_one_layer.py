import pytest
import torch

from torchbokeh.report.rows import of
from torchbokeh.report.scenes import Picture, photo
from torchbokeh.report.settings import Settings
from torchbokeh.report.speed import one_layer
from torchbokeh.report.speed.methods import Method, own_methods
from torchbokeh.report.speed.one_layer import Limits, compare, reference
from torchbokeh.report.speed.registry import one_layer_methods

TIMES = {"seconds", "quartile_low", "quartile_high", "fastest", "slowest", "runs"}
ERRORS = {"ssim", "psnr", "l1", "flip"}
OWN = list(own_methods())


@pytest.fixture(scope="module")
def seen():
    return photo(64, 4.0)


def shift(amount, work=0.0, **settings):
    return Method(f"shift {amount}", "f", "d", lambda image, coc: image + amount, lambda coc: work, **settings)


def test_rows_have_times_errors_and_the_front(seen):
    chosen = {m.name: m for m in (shift(0.0), shift(0.1), shift(0.2, work=99.0))}
    found = {row["method"]: row for row in compare(chosen, seen, seen.image, Limits(2, 1.0, 5.0))}
    assert list(found) == list(chosen)
    assert found["shift 0.0"].keys() == {"method", "family", "pareto"} | TIMES | ERRORS
    assert found["shift 0.0"]["pareto"]
    assert found["shift 0.0"]["l1"] == 0 < found["shift 0.1"]["l1"]
    assert found["shift 0.2"].keys() == {"method", "family", "skipped"}
    assert "limit of 5 s" in found["shift 0.2"]["skipped"]


def test_timing_leaves_the_picture_alone(seen):
    kept = seen.coc.clone(), seen.image.clone()
    one_layer.time_methods([shift(0.0)], seen, Limits(1, 1.0, 1.0))
    assert torch.equal(seen.coc, kept[0])
    assert torch.equal(seen.image, kept[1])


def test_the_reference_is_a_blurred_picture(seen, monkeypatch):
    out = reference(seen)
    assert out.dtype == torch.float64
    flat = reference(Picture(torch.ones_like(seen.image), seen.coc))
    torch.testing.assert_close(flat, torch.ones_like(out))
    monkeypatch.setattr(one_layer, "DEFINITION", 0)
    torch.testing.assert_close(reference(seen).double(), out, rtol=1e-5, atol=1e-5)


def test_one_layer_compares_every_method_on_every_scene(report, tiny):
    for scene, size in (("photo", tiny.photo_size), ("coins", tiny.recipe_size)):
        found = of(report["experiments"]["one_layer"], scene=scene)
        assert [row["method"] for row in found] == list(one_layer_methods())
        assert {row["size"] for row in found} == {size}
        assert any(row.get("pareto") for row in found)
    exact = of(report["experiments"]["one_layer"], method=OWN[0])
    assert all(row["ssim"] > 0.99999 for row in exact)


def test_limits_are_those_of_the_kind():
    settings = Settings(budget=1.0, recipe_budget=2.0, sweep_cap=3.0)
    assert Limits.of(settings, "").budget == 1.0
    assert Limits.of(settings, "recipe_").budget == 2.0
    assert Limits.of(settings, "sweep_").cap == 3.0
