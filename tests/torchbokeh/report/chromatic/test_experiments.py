import math

import numpy as np
import pytest
import torch

from torchbokeh.report.chromatic.experiments import (
    ACCUMULATION,
    BLURS,
    SPECTRA,
    banding,
    dispersing,
    dot_lens,
    profile,
    times_equal,
)
from torchbokeh.report.scenes import still


def test_every_method_is_held_against_the_truth(report, tiny):
    rows = report["experiments"]["chromatic_truth"]
    methods = {("truth", "halves"), *((ACCUMULATION, str(n)) for n in tiny.chromatic_views)}
    methods |= {(f"LensBlur, {given}", quality) for given in ("layers", "image") for quality in BLURS}
    cases = {(row["scene"], row["spectrum"], row["axial"], row["lateral"]) for row in rows}
    assert cases == {("coins", spectrum, *strength) for spectrum in SPECTRA for strength in tiny.chromatic_strengths}
    assert {(row["method"], row["setting"]) for row in rows} == methods
    assert len(rows) == len(cases) * len(methods)
    for row in rows:
        assert 0 < row["ssim"] < 1
        assert row["spread"] > 0
        assert ("times_equal" in row) == row["method"].startswith("LensBlur")


def test_more_views_are_nearer(report, tiny):
    rows = [row for row in report["experiments"]["chromatic_truth"] if row["method"] == ACCUMULATION]
    l1 = {n: np.mean([row["l1"] for row in rows if row["setting"] == str(n)]) for n in tiny.chromatic_views}
    assert l1[tiny.chromatic_views[1]] < l1[tiny.chromatic_views[0]]


def test_the_lens_stays_but_for_dispersion():
    _, camera = still("coins", 40, 3.0)
    lens = dispersing(camera, "continuous", 0.5, 0.03).lens
    assert lens.dispersion.spectrum == "continuous"
    assert (lens.dispersion.axial, lens.dispersion.lateral) == (0.5, torch.tensor(0.03))
    depth = torch.linspace(0.5, 9, 8)[None]
    assert torch.equal(lens.coc(depth, 40), camera.lens.coc(depth, 40))


def test_equal_errors_are_found_on_the_line():
    line = [(1.0, 0.1), (4.0, 0.025), (16.0, 0.0125)]
    assert times_equal(1.0, 0.05, line) == pytest.approx((2.0, ""))  # half the error is twice the time here
    ratio, bound = times_equal(2.0, 0.0125 * math.sqrt(2), line)
    assert (ratio, bound) == (pytest.approx(4.0), "")
    assert times_equal(0.5, 0.01, line) == (32.0, ">")
    assert times_equal(0.5, 0.2, line) == (2.0, "<")
    assert times_equal(1.0, 0.0, [(1.0, 0.1), (3.0, 0.0)]) == pytest.approx((3.0, ""))


def test_run_time_is_a_line_over_views(report, tiny):
    rows = report["experiments"]["chromatic_samples"]
    assert [(row["spectrum"], row["views"]) for row in rows] == [(s, n) for s in SPECTRA for n in tiny.sample_views]
    assert all(row["seconds"] > 0 and row["r2"] <= 1 for row in rows)
    assert all(row["drawn"] == row["views"] for row in rows)


def test_a_lens_spreads_a_dot_as_wanted():
    lens = dot_lens(96, 10.0, "rgb")
    assert lens.coc_shift(475.0, 96).item() == pytest.approx(10, rel=1e-4)
    assert lens.coc_shift(650.0, 96).item() == 0


def test_a_profile_is_the_chromaticity_of_rings():
    at = torch.arange(64) - 31.5
    away = torch.hypot(at, at[:, None])
    red, blue = (away < 10).float(), (away < 20).float()
    found = profile(torch.stack([3 * red, torch.zeros_like(red), blue]))
    assert len(found) == 32
    assert found[:9] == pytest.approx(0.5)
    assert found[11:] == pytest.approx(-1)


def test_steps_are_bands_and_smooth_changes_are_none():
    at = np.arange(64)
    step, smooth = np.where(at < 30, 0.3, -0.8), 0.3 - 1.1 / (1 + np.exp((30 - at) / 4))
    assert banding(step) > 20 * banding(smooth)
    assert banding(step) == pytest.approx(banding(5 * step + 2))
    assert banding(np.full(64, 0.3)) == pytest.approx(0, abs=1e-6)


def test_a_spectrum_has_fewer_bands_than_three_lights(report):
    of = {(row["method"][:8], row["spectrum"]): row["banding"] for row in report["experiments"]["chromatic_bands"]}
    assert of["LensBlur", "rgb"] > 10 * of["LensBlur", "continuous"]
    assert of["Chromati", "rgb"] > 2 * of["Chromati", "continuous"]
