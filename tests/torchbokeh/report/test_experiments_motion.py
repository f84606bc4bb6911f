import torch

from torchbokeh.report.experiments_motion import DENSE, spinning
from torchbokeh.report.methods import QUALITIES


def test_the_picture_turns():
    motion = spinning(40, 12.0)
    assert motion.shape == (1, 2, 40, 40)
    assert motion.norm(dim=1).max() == 12
    around = motion[0, :, 1:, 1:] - motion[0, :, :-1, :-1]
    assert torch.allclose(around[0, 0, 0], around[0], atol=1e-4)


def test_every_quality_is_compared_with_the_dense_scatter(report):
    rows = {row["method"]: row for row in report["experiments"]["motion"]}
    assert set(rows) == {DENSE, *(f"bank, {q}" for q in QUALITIES), "bank, exact, interpolated"}
    assert rows[DENSE]["l1"] == 0
    assert rows[DENSE]["times_dense"] == 1
    for name, row in rows.items():
        assert row["ssim"] > 0.8, name
