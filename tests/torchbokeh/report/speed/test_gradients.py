import dataclasses

import pytest
import torch

from torchbokeh.report.scenes import photo
from torchbokeh.report.speed import gradients as module
from torchbokeh.report.speed.gradients import DENSE, SPANS, gradient_methods, gradient_section, gradients, held, timed
from torchbokeh.report.speed.memory import is_known, peak_memory
from torchbokeh.report.speed.methods import Method, own_name

EXACT = own_name("exact")


def slopes(name, seen):
    """Result, and gradients to image and CoC of a loss that looks at every pixel."""
    image, coc = seen.image.clone().requires_grad_(), seen.coc.clone().requires_grad_()
    out = gradient_methods()[name].run(image, coc)
    weights = torch.rand(out.shape, generator=torch.Generator().manual_seed(0))
    (out * weights).sum().backward()
    return out.detach(), image.grad, coc.grad


@pytest.fixture(scope="module")
def odd():
    """Radii of half a pixel more than a whole number have two slopes, one on each side; here are none."""
    return photo(40, 5.0137)


def test_plain_autograd_has_the_gradients_of_the_exact_splat(odd):
    for found, wanted in zip(slopes(SPANS, odd), slopes(EXACT, odd), strict=True):
        torch.testing.assert_close(found, wanted, rtol=1e-4, atol=1e-4 * float(wanted.abs().mean()))


def test_the_dense_splat_is_nearly_the_exact_one(odd):
    """Its discs have softer edges, so that its slopes to the radii are others."""
    out, to_image, to_coc = slopes(DENSE, odd)
    wanted, wanted_to_image, _ = slopes(EXACT, odd)
    assert float((out - wanted).abs().sum() / wanted.abs().sum()) < 0.03
    assert float(torch.cosine_similarity(to_image.flatten(), wanted_to_image.flatten(), 0)) > 0.999
    assert float((to_coc != 0).double().mean()) > 0.9 * float((odd.coc.abs() > 0.5).double().mean())


@pytest.mark.parametrize("name", gradient_methods())
def test_every_method_keeps_a_constant_and_takes_time_both_ways(name):
    method = gradient_methods()[name]
    seen = dataclasses.replace(photo(32, 4.0), image=torch.full((1, 3, 32, 32), 0.7))
    torch.testing.assert_close(method.run(seen.image, seen.coc), seen.image, rtol=1e-3, atol=1e-3)
    assert len(timed(method, seen)) == 2
    assert min(timed(method, seen)) > 0


def test_a_graph_over_points_grows_with_the_radius():
    narrow, wide = photo(64, 4.0).coc, photo(64, 16.0).coc
    for name in (SPANS, DENSE):
        assert held(name, wide) > 1.5 * held(name, narrow)
    assert held(EXACT, wide) == held(EXACT, narrow) < held(SPANS, narrow)


def test_what_is_held_is_about_what_the_graph_holds():
    seen = photo(64, 8.0)
    for name in (SPANS, DENSE):
        kept = {}

        def keep(t, kept=kept):
            kept[t.untyped_storage().data_ptr()] = t.untyped_storage().nbytes()
            return t

        with torch.autograd.graph.saved_tensors_hooks(keep, lambda t: t):
            out = gradient_methods()[name].run(seen.image.clone().requires_grad_(), seen.coc.clone().requires_grad_())
        assert out.requires_grad
        assert 0.7 < held(name, seen.coc) / sum(kept.values()) < 1.5


def fake_memory(monkeypatch, bytes_of):
    asked = []

    def peak(name, size, radius, *, backward):
        asked.append((name, size, radius, backward))
        return bytes_of(name)

    monkeypatch.setattr(module, "peak_memory", peak)
    return asked


def test_rows_stand_beside_plain_autograd(tiny, monkeypatch):
    asked = fake_memory(monkeypatch, lambda name: 4_000_000 if name == SPANS else 1_000_000)
    rows = {row["method"]: row for row in gradients(tiny, lambda line: None)}
    assert list(rows) == list(gradient_methods())
    (size,), (radius,) = tiny.gradient_sizes, tiny.gradient_radii
    assert asked == [(name, size, radius, True) for name in rows]
    for name, row in rows.items():
        assert row["times_smaller"] == (1 if name == SPANS else 4)
        assert row["forward_seconds"] > 0 < row["backward_seconds"]
        assert row["bytes_per_megapixel"] == pytest.approx(row["peak_bytes"] / (size * size / 1e6))
    assert rows[SPANS]["times_faster"] == 1


def test_what_does_not_fit_is_left_out_and_said(tiny, monkeypatch):
    fake_memory(monkeypatch, lambda name: None)
    small = dataclasses.replace(tiny, gradient_memory=held(EXACT, photo(tiny.gradient_sizes[0], 4.0).coc))
    rows = {row["method"]: row for row in gradients(small, lambda line: None)}
    assert {name for name, row in rows.items() if "skipped" not in row} == {EXACT, own_name("balanced")}
    assert "more than the limit of" in rows[DENSE]["skipped"]
    assert rows[EXACT]["times_faster"] is rows[EXACT]["times_smaller"] is None
    text = gradient_section(list(rows.values()), small.row())
    assert f"| {DENSE} | - | - | - | - | - |" in text
    assert "Left out: LensBlur exact at 40 px, radius 4 px" in text
    assert gradient_section([], small.row()) == ""


def test_the_first_run_is_not_timed(tiny, monkeypatch):
    """It compiles, on a small picture."""
    fake_memory(monkeypatch, lambda name: 1)
    sizes = []

    def run(image, coc):
        sizes.append(image.shape[-1])
        return image * coc

    methods = {name: Method(name, "f", "d", run, lambda coc: 0.0) for name in (SPANS, EXACT)}
    monkeypatch.setattr(module, "gradient_methods", lambda: methods)
    gradients(dataclasses.replace(tiny, repeat=2), lambda line: None)
    size = tiny.gradient_sizes[0]
    assert sizes == [64, 64, *[size] * 6]


@pytest.mark.slow
@pytest.mark.skipif(not is_known(), reason="only Linux tells the peak")
def test_the_backward_pass_counts_in_the_peak():
    """The definition keeps what it expands: hundreds of bytes for each of eleven rows of a pixel, about."""
    pixels = 96 * 96
    forward, both = (peak_memory(SPANS, 96, 8.0, backward=backward) for backward in (False, True))
    assert both > 3000 * pixels
    assert both > 2 * forward


@pytest.mark.slow
@pytest.mark.skipif(not is_known(), reason="only Linux tells the peak")
@pytest.mark.parametrize(("quality", "most"), [("balanced", 45 + 125), ("exact", 70 + 180)])
def test_memory_agrees_with_the_docstring_of_the_splat(quality, most):
    """`KernelSplatting` gives one figure for each pass; here both count, of a picture of a megapixel."""
    found = peak_memory(own_name(quality), 1024, 50.0, backward=True) / 1024**2
    assert 0.4 * most < found < most
