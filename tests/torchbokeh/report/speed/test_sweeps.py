import pytest
import torch

from torchbokeh.report.rows import of
from torchbokeh.report.speed import sweeps
from torchbokeh.report.speed.methods import own_methods
from torchbokeh.report.speed.sweeps import thread_counts, threads

TIMES = {"seconds", "quartile_low", "quartile_high", "fastest", "slowest", "runs"}
OWN = list(own_methods())


def test_run_time_depends_on(report, tiny):
    assert {row["radius"] for row in of(report["experiments"]["radius"], method=OWN[0])} == set(tiny.sweep_radii)
    assert {row["size"] for row in of(report["experiments"]["pixels"], method=OWN[0])} == set(tiny.sweep_sizes)
    assert {row["threads"] for row in of(report["experiments"]["threads"], method=OWN[0])} == set(thread_counts())
    for name in ("radius", "pixels", "threads"):
        assert all(row.keys() >= TIMES for row in of(report["experiments"][name]) if "skipped" not in row)


def test_memory_is_measured_at_some_sizes(report):
    small, large = of(report["experiments"]["pixels"], method=OWN[0])
    assert small["peak_bytes"] is None
    assert small["bytes_per_megapixel"] is None
    assert large["bytes_per_megapixel"] == pytest.approx(1e6 * (40 + len(OWN[0])))


def test_the_bits_are_compared_over_threads(report):
    found = of(report["experiments"]["threads"])
    assert {row["same_bits"] for row in found if row["threads"] == 1} == {True}
    assert {row["method"] for row in found} == set(OWN)


def test_thread_counts_double_up_to_all(monkeypatch):
    monkeypatch.setattr(sweeps, "processors", lambda: 6)
    assert thread_counts() == [1, 2, 4, 6]
    monkeypatch.setattr(sweeps, "processors", lambda: 1)
    assert thread_counts() == [1]


def test_threads_are_put_back():
    before = torch.get_num_threads()

    def fail():
        with threads(before + 1):
            assert torch.get_num_threads() == before + 1
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert torch.get_num_threads() == before
