"""The cases of ``torchbokeh report --stability`` at small sizes: every bound is kept."""

import json
import math

import pytest
import torch

from torchbokeh.report.stability import checks
from torchbokeh.report.stability.bounds import PRECISIONS
from torchbokeh.report.stability.cases import Case, beyond, cases, even
from torchbokeh.report.stability.mechanisms import mechanism_rows
from torchbokeh.report.stability.pictures import render_rows, rows_of
from torchbokeh.report.stability.renderer import Renderer
from torchbokeh.report.stability.renderers import options, renderers
from torchbokeh.report.stability.rows import row
from torchbokeh.report.stability.scenes import scene_rows
from torchbokeh.report.stability.sweeps import plan_rows, sweep_rows

NAMES, OPTIONS = [r.name for r in renderers()], list(options())
PLAIN = [name for name in NAMES if name not in [r.name for r in OPTIONS]]
STIFFEST = (
    "1e+06 beside grey",
    "denormal (1e-40)",
    "even, 10000 px",
    "2000 px",
    "up to 2000 px, anywhere",
    "1 x 1",
    "batch of 0",
)


def all_kept(rows) -> int:
    """How many rows there are, none of them broken."""
    rows = list(rows)
    parts = ("renderer", "case", "precision", "what", "measured", "bound")
    broken = [", ".join(str(r[part]) for part in parts) for r in rows if not r["kept"]]
    assert not broken, "\n".join(broken)
    return len(rows)


def test_a_row_is_kept_up_to_its_bound_and_never_for_nan() -> None:
    assert row("a", "b: c", "float32", "error", 1.0, 1.0)["kept"]
    assert not row("a", "b: c", "float32", "error", 1.1, 1.0)["kept"]
    assert not row("a", "b: c", "float32", "error", math.nan, 1.0)["kept"]


def test_far_is_beyond_the_reach_of_every_highlight() -> None:
    case = Case("dynamic range", "two", torch.ones(1, 3, 9, 11), even(9, 11, 1.0), bright=((4, 2),))
    assert int((~beyond(case, 1.0, mirrored=False)).sum()) == 5
    assert int((~beyond(case, 1.0, mirrored=True)).sum()) == 10


@pytest.mark.parametrize("name", PLAIN)
def test_pictures_keep_their_bounds_in_single_precision(name: str) -> None:
    assert all_kept(render_rows(12, PRECISIONS[1:2], [name])) > 50


@pytest.mark.parametrize(
    "renderer",
    # Of two qualities, the quicker one.
    [r for r in OPTIONS if r.name.replace("exact", "balanced") == r.name or r.kind == "composed"],
    ids=lambda renderer: renderer.name,
)
def test_options_keep_their_bounds_in_the_stiffest_cases(renderer: Renderer) -> None:
    chosen = [case for case in cases(8) if case.name in STIFFEST and renderer.takes(case)]
    assert len(chosen) >= 4
    all_kept(row for case in chosen for row in rows_of(renderer, case, PRECISIONS[1], {}))


@pytest.mark.slow
@pytest.mark.parametrize("name", PLAIN)
def test_pictures_keep_their_bounds_in_every_precision(name: str) -> None:
    others = [p for p in PRECISIONS if p.name != "float32"]
    assert all_kept(render_rows(12, others, [name])) > 300


@pytest.mark.slow
@pytest.mark.parametrize("name", [r.name for r in OPTIONS])
def test_options_keep_their_bounds(name: str) -> None:
    chosen = [p for p in PRECISIONS if p.name in ("float64", "float32", "float16")]
    assert all_kept(render_rows(8, chosen, [name])) > 100


@pytest.mark.parametrize("name", ["KernelSplatting, exact", "LensBlur image, balanced"])
def test_half_precision_keeps_its_dtype_and_its_rounding(name: str) -> None:
    assert all_kept(render_rows(12, PRECISIONS[2:], [name])) > 100


def test_a_highlight_leaks_into_no_pixel_that_it_does_not_reach() -> None:
    rows = list(checks.highlight_rows(96))
    assert {r["renderer"] for r in rows} == set(NAMES)
    assert all(r["pixels"] > 400 for r in rows)
    all_kept(rows)


MOVING = [r.name for r in renderers() if r.bank is not None]


def test_a_field_of_highlights_leaks_no_more_than_one() -> None:
    rows = list(checks.field_rows(MOVING))
    assert [r["renderer"] for r in rows] == MOVING
    assert all(r["pixels"] > 1000 for r in rows)
    all_kept(rows)


@pytest.mark.parametrize(
    "part",
    [
        checks.lens_rows,
        checks.integrator_rows,
        checks.layer_rows,
        checks.bank_rows,
        checks.gradient_rows,
        scene_rows,
        sweep_rows,
    ],
    ids=lambda part: part.__name__,
)
def test_parts_keep_their_bounds(part) -> None:
    assert all_kept(part(24)) >= 4


def test_a_blur_may_be_applied_again_and_again() -> None:
    all_kept(checks.iteration_rows(16, 20))


@pytest.mark.slow
def test_a_blur_may_be_applied_a_hundred_times_and_descended_a_thousand() -> None:
    all_kept(checks.iteration_rows(24, 100))
    all_kept(checks.descent_rows(16, 1000))


def test_a_change_of_plan_is_no_change_of_picture() -> None:
    rows = list(plan_rows(24))
    assert all_kept(rows) > 60
    assert max(r["measured"] for r in rows if not r.get("stated")) < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("size", [(64, 8192), (4096, 4096)])
def test_large_pictures_are_finite_and_a_constant_stays_constant(size: tuple[int, int]) -> None:
    all_kept(checks.large_rows(*size))


def test_every_mechanism_is_of_use() -> None:
    rows = list(mechanism_rows(96))
    assert len(rows) >= 10
    for found in rows:
        assert found["with"] < 0.1 * found["without"], found["mechanism"]


@pytest.mark.slow
def test_the_chapter_is_written_whole(tmp_path) -> None:
    pytest.importorskip("matplotlib")
    from torchbokeh.report.chapters import STABILITY, write_chapter

    said: list[str] = []
    found = STABILITY.run(STABILITY.settings.quick(), said.append)
    paths = write_chapter(STABILITY, found, tmp_path)
    assert {p.name for p in tmp_path.iterdir()} == {p.name for p in paths}
    again = json.loads((tmp_path / "stability.json").read_text(encoding="utf-8"))
    assert len(again["rows"]) == len(found["rows"])
    text = (tmp_path / "stability.md").read_text(encoding="utf-8")
    assert "0 of them broken" in text
    assert all(name in text for name in NAMES)
    assert "stability: mechanisms" in said
