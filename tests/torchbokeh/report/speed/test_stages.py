import time
from contextlib import contextmanager

import pytest
import torch

from torchbokeh.report.speed import stages as module
from torchbokeh.report.speed.stages import REST, shares, stages

SECONDS = {"splat": 0.01, "sum": 0.005}


@contextmanager
def recorded():
    yield dict(SECONDS)


def work():
    time.sleep(0.02)
    return torch.zeros(1)


def test_stages_and_the_rest_are_the_whole():
    found = {row["stage"]: row for row in shares(work, recorded, 3)}
    assert list(found) == [*SECONDS, REST]
    assert found["splat"]["seconds"] == 0.01
    assert found["splat"]["share"] == pytest.approx(2 * found["sum"]["share"])
    assert sum(row["share"] for row in found.values()) == pytest.approx(1, rel=0.2)


def test_a_stage_that_is_not_always_there_counts_as_nothing():
    calls = iter([{"a": 0.001}, {"a": 0.001, "b": 0.001}, {"a": 0.001}])

    @contextmanager
    def sometimes():
        yield next(calls)

    assert {row["stage"]: row["seconds"] for row in shares(work, sometimes, 3)}["b"] == 0


def test_every_quality_and_radius_has_its_stages(tiny):
    rows = stages(tiny, lambda line: None)
    assert {(row["quality"], row["radius"]) for row in rows} == {
        (quality, radius) for quality in module.QUALITY_NAMES for radius in tiny.photo_radii
    }
    assert rows[0].keys() == {"quality", "radius", "stage", "seconds", "share"}
    assert {row["stage"] for row in rows} >= {"mean", "collect", "picture"}


def test_without_kernels_there_are_none(monkeypatch, tiny):
    monkeypatch.setattr(module, "numba_is_there", lambda: False)
    assert stages(tiny, lambda line: None) == []
