"""The cases of ``torchbokeh report --stability`` at small sizes: every bound is kept, and a fault breaks one."""

import json
import math

import numpy as np
import pytest
import torch
from torch import Tensor

import torchbokeh
from torchbokeh import KernelSplatting
from torchbokeh.psfs.combined import Combined, capsule
from torchbokeh.psfs.refit import Sparse
from torchbokeh.psfs.represent import Represented, laplacian, nonzero
from torchbokeh.report.stability import checks
from torchbokeh.report.stability.bounds import PRECISIONS
from torchbokeh.report.stability.cases import Case, beyond, cases, even, slope, texture
from torchbokeh.report.stability.pictures import highlight_rows, off, render_rows, row, rows_of
from torchbokeh.report.stability.renderers import Renderer, renderers

RENDERERS = list(renderers())
NAMES = [r.name for r in RENDERERS]
WHOLE = ("KernelSplatting, exact", "KernelSplatting, balanced", "LensBlur image, balanced")
"""Renderers that go through all cases; the others through the stiffest ones."""

QUICK = [r for r in RENDERERS if r.kind == "merged" or r.quality in ("exact", "balanced")]
"""Without compositions at the qualities that differ from `"balanced"` in numbers alone: these are slow tests."""

STIFFEST = (
    "1e+06 beside grey",
    "denormal (1e-40)",
    "even, 10000 px",
    "slope -9 to 9 px",
    "2000 px",
    "up to 2000 px, anywhere",
    "1 x 1",
    "3 x 5",
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
    case = Case("dynamic range", "one", torch.ones(1, 3, 9, 11), even(9, 11, 1.0), bright=(4, 2))
    assert int((~beyond(case, 1.0, mirrored=False)).sum()) == 5
    assert int((~beyond(case, 1.0, mirrored=True)).sum()) == 10
    square = Case("highlight", "four", torch.ones(1, 3, 9, 11), even(9, 11, 1.0), bright=(0, 0), across=2)
    assert int((~beyond(square, 1.0, mirrored=False)).sum()) == 8


@pytest.mark.parametrize("name", WHOLE)
def test_pictures_keep_their_bounds_in_single_precision(name: str) -> None:
    assert all_kept(render_rows(12, PRECISIONS[1:2], [name])) > 80


@pytest.mark.parametrize("renderer", [r for r in QUICK if r.name not in WHOLE], ids=lambda renderer: renderer.name)
def test_the_stiffest_pictures_keep_their_bounds(renderer: Renderer) -> None:
    chosen = [case for case in cases(8) if case.name in STIFFEST and renderer.takes(case)]
    assert len(chosen) >= 4
    all_kept(row for case in chosen for row in rows_of(renderer, case, PRECISIONS[1], {}))


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_pictures_keep_their_bounds_in_every_precision(name: str) -> None:
    assert all_kept(render_rows(8, names=[name])) > 250


@pytest.mark.parametrize("name", WHOLE)
def test_half_precision_keeps_its_dtype_and_its_rounding(name: str) -> None:
    chosen = [(case, r) for case in cases(12) if case.name in STIFFEST for r in RENDERERS if r.name == name]
    for precision in PRECISIONS[2:]:
        all_kept(row for case, r in chosen if r.takes(case) for row in rows_of(r, case, precision, {}))


class Faulty(torch.nn.Module):
    """`KernelSplatting` with a fault in float32 alone."""

    def __init__(self, fault: str) -> None:
        super().__init__()
        self.fault, self.blur = fault, KernelSplatting()

    def forward(self, image: Tensor, coc: Tensor) -> Tensor:
        out = self.blur(image, coc)
        if image.dtype == torch.float64:
            return out
        if self.fault == "weights":
            return out * (1 + 1e-4)
        if self.fault == "huge radii":
            return torch.where(coc.abs() > 1e3, torch.nan, out)
        return out + 1e-6 * image.mean((2, 3), keepdim=True)


@pytest.mark.parametrize(("fault", "what"), [("weights", "error"), ("huge radii", "not finite"), ("leak", "far-field")])
def test_a_fault_of_a_kernel_breaks_a_bound(fault: str, what: str) -> None:
    renderer = Renderer("faulty", "splat", lambda quality, width: Faulty(fault), RENDERERS[0].inputs)
    chosen = [case for case in cases(12) if case.name in ("1e+06 beside grey", "slope -9 to 9 px", "even, 10000 px")]
    found = [row for case in chosen for row in rows_of(renderer, case, PRECISIONS[1], {})]
    assert any(what in row["what"] and not row["kept"] for row in found)


@pytest.mark.parametrize("names", [[r.name for r in QUICK], pytest.param(NAMES, marks=pytest.mark.slow)], ids=len)
def test_highlights_leak_into_no_pixel_that_they_do_not_reach(names: list[str]) -> None:
    rows = list(highlight_rows(96, names=names))
    assert {r["renderer"] for r in rows} == set(names)
    assert all(r["pixels"] > 400 for r in rows)
    all_kept(rows)


@pytest.mark.parametrize(
    "part",
    [
        checks.lens_rows,
        checks.layer_rows,
        checks.scene_rows,
        checks.gradient_rows,
        checks.sweep_rows,
    ],
    ids=lambda part: part.__name__,
)
def test_parts_keep_their_bounds(part) -> None:
    assert all_kept(part(24)) >= 4


def test_a_blur_may_be_applied_again_and_again() -> None:
    all_kept(checks.iteration_rows(16, 20))


@pytest.mark.slow
def test_a_blur_may_be_applied_a_hundred_times() -> None:
    all_kept(checks.iteration_rows(24, 100))


@pytest.mark.slow
@pytest.mark.parametrize("quality", ["exact", "balanced"])
def test_colours_and_radii_may_be_descended_to_a_thousand_times(quality: str) -> None:
    blur = torchbokeh.LensBlur(quality=quality)
    aim = blur(texture(16, 16).float(), coc=slope(16, 16, -4.0, 6.0).float()).detach()
    leaves = [torch.ones_like(aim).requires_grad_(), torch.ones(1, 1, 16, 16).requires_grad_()]
    adam, losses = torch.optim.Adam(leaves, lr=0.02), []
    for _ in range(1000):
        loss = (blur(leaves[0], coc=leaves[1]) - aim).square().mean()
        adam.zero_grad()
        loss.backward()
        adam.step()
        losses.append(loss.item())
    assert all(bool(t.isfinite().all()) for t in (*leaves, torch.tensor(losses)))
    assert losses[-1] < losses[0]


@pytest.mark.slow
@pytest.mark.parametrize("size", [(64, 8192), (4096, 4096)])
def test_large_pictures_are_finite_and_a_constant_stays_constant(size: tuple[int, int]) -> None:
    all_kept(checks.large_rows(*size))


SPARSE = nonzero(laplacian(capsule(3.0, 6.0)))
ODD = {
    "one point": Represented("direct", Sparse(np.zeros((1, 2), np.int64), np.ones((1, 1)))),
    "all points of a Laplacian": Represented("laplacian", SPARSE),
    "a Laplacian of non-zero sum": Represented(
        "laplacian", SPARSE._replace(values=SPARSE.values + 1e-4 * np.abs(SPARSE.values).max())
    ),
    "half of the light beyond the picture": Represented(
        "direct", Sparse(np.array([[96, 0], [0, 0]]), np.array([[0.5], [0.5]]))
    ),
}


@pytest.mark.parametrize("name", ODD)
def test_a_constant_stays_constant_whatever_the_psf(name: str) -> None:
    model = Combined(radius=8.0, length=16.0)
    bank = torchbokeh.PsfBank(model, [ODD[name]] * len(model.grid))
    image, motion = torch.full((1, 3, 24, 24), 0.7), torch.tensor([6.0, 0.0]).view(1, 2, 1, 1).expand(1, 2, 24, 24)
    out = KernelSplatting(bank=bank)(image, even(24, 24, 3.0).float(), motion=motion)
    # As many roundings as a buffer has points, each of a constant relative to its coverage.
    assert off(out, 0.7) < 1e-4


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
    assert all(name in text for name in STABILITY.settings.quick().renderers)
    assert "stability: highlights" in said
