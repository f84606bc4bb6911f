"""``torchbokeh psfs analyse``: the experiments against what they measure, and the files."""

import argparse
import doctest
import json
import math
from itertools import islice

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

pytest.importorskip("matplotlib")

import torchbokeh.commands.psfs
import torchbokeh.report.psfs.analysis
from torchbokeh.commands.psfs import add_psfs
from torchbokeh.psfs.combined import Combined, capsule
from torchbokeh.psfs.quadtree import quadtree
from torchbokeh.report import chapters
from torchbokeh.report.psfs.analysis import (
    METHODS,
    SHARES,
    Elimination,
    PsfSettings,
    coordinates,
    covers,
    equal_sparsity,
    gaussian,
    grid_errors,
    leaves,
    quality,
    random_psfs,
    with_cells,
)
from torchbokeh.report.psfs.chapter import analyse, draw, markdown

PSF = capsule(6.0, 9.0)


def silent(line):
    pass


@pytest.fixture(scope="module")
def found():
    before = torch.get_num_threads()
    torch.set_num_threads(1)  # as tests do: see the conftest of all
    quick = analyse(PsfSettings.quick(), silent)
    torch.set_num_threads(before)
    return quick


@pytest.fixture(scope="module")
def elimination():
    return Elimination(PSF, "quadrants")


def run(*flags):
    parser = argparse.ArgumentParser(exit_on_error=False)
    add_psfs(parser)
    args = parser.parse_args(["analyse", *flags])
    args.run(args)


def test_examples():
    tried = doctest.testmod(torchbokeh.report.psfs.analysis)
    assert tried.attempted
    assert not tried.failed


def test_a_quick_analysis_is_written_whole(found, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(chapters, "PSFS", chapters.PSFS._replace(run=lambda settings, say: found))
    run("--quick", "--out", str(tmp_path / "new"))
    written = capsys.readouterr().out.split()
    assert sorted(written) == sorted(str(path) for path in (tmp_path / "new").iterdir())
    text = (tmp_path / "new" / "psfs.md").read_text(encoding="utf-8")
    pictures = [path.name for path in (tmp_path / "new").glob("*.png")]
    assert pictures
    assert all(f"({name})" in text for name in pictures)
    assert json.loads((tmp_path / "new" / "psfs.json").read_text(encoding="utf-8")) == json.loads(json.dumps(found))


def test_every_experiment_has_rows(found):
    assert all(found["experiments"].values())
    assert found["settings"] == PsfSettings.quick().row()


def test_what_is_not_reached_is_a_dash(found):
    rows = {**found["experiments"], "large": [{**found["experiments"]["large"][0], "ssim": None}]}
    assert "| - |" in markdown({**found, "experiments": rows}, [])


def test_axes_are_named(found):
    for figure in draw(found).values():
        assert all(axes.get_xlabel() for axes in figure.axes if axes.get_label() != "<colorbar>")


def test_flags_choose_settings(tmp_path, monkeypatch):
    asked = []
    run_only = {"run": lambda settings, say: asked.append(settings), "draw": lambda found: {}}
    monkeypatch.setattr(chapters, "PSFS", chapters.PSFS._replace(**run_only, markdown=lambda found, plots: ""))
    run("--out", str(tmp_path))
    run("--out", str(tmp_path), "--quick")
    assert asked == [PsfSettings(), PsfSettings.quick()]


def test_a_folder_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match=r"--out .*file"):
        run("--out", str(tmp_path / "file"))


def test_the_extra_is_asked_for_where_it_is_missing(monkeypatch):
    monkeypatch.setattr(torchbokeh.commands.psfs, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"torchbokeh\[report\]"):
        run()


def test_an_earlier_analysis_is_replaced(found, tmp_path):
    (tmp_path / "psfs.md").write_text("old")
    assert (
        chapters.write_chapter(chapters.PSFS, found, tmp_path)[0]
        .read_text(encoding="utf-8")
        .startswith("# Sparse PSFs")
    )


def test_random_psfs_cover_what_is_asked_and_are_the_same_again():
    first, second = (list(random_psfs(4, (150, 600))) for _ in range(2))
    assert all(150 <= covers(psf) <= 600 for psf in first)
    assert all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))


def test_random_coordinates_visit_boxes_evenly():
    model = with_cells(4)
    places = torch.tensor(list(islice(coordinates(model), 3000)))
    visits = torch.bincount(model.grid.index(places), minlength=len(model.grid)).numpy()
    expected = 3000 / len(model.grid)
    assert np.abs(visits - expected).max() < 5 * math.sqrt(expected)


@given(st.integers(8, 90))
@settings(max_examples=15, deadline=None)
def test_as_many_points_are_taken_as_fit(elimination, count):
    sparse = elimination.within(count)
    assert len(sparse.points) <= count
    assert count < len(sparse.points) + 4  # an orbit has at most four points
    assert len(sparse.points) in elimination.points


def test_all_candidates_are_exact(elimination):
    assert quality(PSF, elimination.within(covers(PSF) * 9)).l1 < 1e-5


@pytest.mark.parametrize(("name", "wanted"), [("ssim", 0.9), ("ssim_frame", 0.9995)])
def test_the_fewest_points_reach_what_is_wanted(elimination, name, wanted):
    least = elimination.least(PSF, name, wanted)
    assert getattr(quality(PSF, elimination.within(least)), name) >= wanted
    assert getattr(quality(PSF, elimination.within(least - 1)), name) < wanted


def test_what_no_set_reaches_is_none(elimination):
    assert elimination.least(PSF, "ssim", 1.1) is None


def test_every_method_is_compared_at_every_sparsity():
    rows = equal_sparsity([PSF], silent)
    assert [(row["share"], row["method"]) for row in rows] == [(s, m) for s in SHARES for m in METHODS]
    assert all(row["sparsity"] <= row["share"] + 0.5 / covers(PSF) for row in rows)
    # Voronoi sums are values for the same points, which the refit betters in the mean square.
    most = [row for row in rows if row["share"] == SHARES[-1]]
    assert most[0]["sparsity"] == most[1]["sparsity"]
    assert most[0]["l1"] < most[1]["l1"]


@pytest.mark.parametrize("l1", [0.02, 0.1])
def test_the_fewest_leaves_reach_an_error(l1):
    count = leaves(PSF, l1)
    assert np.abs(quadtree(PSF, count) - PSF).sum() <= l1
    assert np.abs(quadtree(PSF, count - 1 - count // 100) - PSF).sum() > l1


@pytest.mark.parametrize("sigma", [1.5, 4.0])
def test_a_gaussian_has_its_variance_and_its_symmetries(sigma):
    psf = gaussian(sigma)[0]
    x = np.arange(len(psf)) - len(psf) // 2
    assert psf.sum() == pytest.approx(1.0)
    assert (psf.sum(0) * x**2).sum() == pytest.approx(sigma**2, rel=5e-3)  # the tails are cut
    assert all(np.allclose(psf, other) for other in (psf.T, psf[::-1], psf[:, ::-1]))


def test_a_gaussian_stays_in_the_frame():
    assert gaussian(100.0).shape == (1, 513, 513)


def test_a_psf_in_the_middle_of_a_box_is_met_but_by_the_prefiltered_sample():
    model = with_cells(10)
    middle, prefiltered, linear = grid_errors(model, tuple(model.grid.centres()[20].tolist()))[::2]
    assert middle == linear == pytest.approx(1.0)
    assert 0.2 < prefiltered < 0.999


def test_the_grid_of_the_model_is_left_alone():
    assert len(with_cells(9).grid) == 28
    assert Combined().axes[0].cells != 9
