import torch

from torchbokeh.report.internals import QUALITY_NAMES
from torchbokeh.report.motion.experiments import DENSE, DENSE_LAYERS, FILTER, RECIPES_IN_MOTION, spinning


def test_the_picture_turns():
    motion = spinning(40, 12.0)
    assert motion.shape == (1, 2, 40, 40)
    assert motion.norm(dim=1).max() == 12
    around = motion[0, :, 1:, 1:] - motion[0, :, :-1, :-1]
    assert torch.allclose(around[0, 0, 0], around[0], atol=1e-4)


def test_every_quality_is_compared_with_the_dense_scatter(report):
    rows = {row["method"]: row for row in report["experiments"]["motion"]}
    assert set(rows) == {DENSE, *(f"bank, {q}" for q in QUALITY_NAMES), "bank, exact, interpolated"}
    assert rows[DENSE]["l1"] == 0
    assert rows[DENSE]["times_dense"] == 1
    for name, row in rows.items():
        assert row["ssim"] > 0.8, name


def test_synthesis_and_reconstruction_are_those_of_the_paper(report):
    rows = report["experiments"]["like_lks"]
    assert {row["scene"] for row in rows} == set(RECIPES_IN_MOTION)
    found = {(row["scene"], row["method"]): row for row in rows}
    for name in RECIPES_IN_MOTION:
        assert found[name, DENSE]["times_dense"] == 1
        assert found[name, FILTER]["ssim"] > 0.3
        assert found[name, "LensBlur, layers, exact"]["ssim"] > 0.6
        assert found[name, "reconstruct, 4 layers"]["ssim"] > found[name, "one sample per pixel"]["ssim"]
        assert found[name, DENSE_LAYERS]["times_dense"] == 1
        assert found[name, "bank, layers, re-weighted"]["ssim"] > 0.5
