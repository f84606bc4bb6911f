import dataclasses

import pytest
import torch

from torchbokeh.report.scenes import photo
from torchbokeh.report.speed import gradients as module
from torchbokeh.report.speed.autograd import DENSE, SPANS, gradient_methods, held
from torchbokeh.report.speed.gradients import gradient_section, gradients, timed
from torchbokeh.report.speed.memory import is_known, peak_memory
from torchbokeh.report.speed.methods import Method, own_name

EXACT = own_name("exact")


@pytest.mark.parametrize("name", gradient_methods())
def test_every_method_keeps_a_constant_and_takes_time_both_ways(name):
    method = gradient_methods()[name]
    seen = dataclasses.replace(photo(32, 4.0), image=torch.full((1, 3, 32, 32), 0.7))
    torch.testing.assert_close(method.run(seen.image, seen.coc), seen.image, rtol=1e-3, atol=1e-3)
    assert len(timed(method, seen)) == 2
    assert min(timed(method, seen)) > 0


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
    text = gradient_section(list(rows.values()), small.row(), [])
    assert f"| {DENSE} | - | - | - | - | - |" in text
    assert "Left out: LensBlur exact at 40 px, radius 4 px" in text


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
