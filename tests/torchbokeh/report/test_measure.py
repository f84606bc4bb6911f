import time

import numpy as np
import pytest
import torch

from torchbokeh.report import measure as module
from torchbokeh.report.measure import displayed, errors, measure, pareto_front


def test_equal_pictures_have_no_error():
    picture = torch.rand(1, 3, 24, 24) * 3
    found = errors(picture, picture.clone())
    assert found["ssim"] == pytest.approx(1)
    assert found["psnr"] is None
    assert found["l1"] == 0
    assert not found["flip"]


def test_errors_are_what_their_names_say():
    reference = torch.full((1, 3, 32, 32), 0.25)
    found = errors(reference * 1.1, reference)
    assert found["l1"] == pytest.approx(0.1, rel=1e-5)
    assert found["psnr"] == pytest.approx(-20 * np.log10((1.1 ** (1 / 2.2) - 1) * 0.25 ** (1 / 2.2)), abs=1e-3)
    worse = errors(reference * 2, reference)
    assert worse["ssim"] < found["ssim"] < 1


def test_flip_is_left_out_where_it_is_not_installed(monkeypatch):
    picture = torch.rand(1, 3, 16, 16)
    assert errors(picture, picture, flip=False)["flip"] is None
    monkeypatch.setattr(module, "find_spec", lambda name: None)
    assert errors(picture, picture)["flip"] is None


def test_flip_grows_with_the_error():
    pytest.importorskip("flip_evaluator")
    picture = torch.rand(1, 3, 32, 32)
    near, far = (errors((picture + noise).clamp(0, 1), picture)["flip"] for noise in (0.02, 0.3))
    assert 0 < near < far < 1


def test_a_border_is_left_out():
    reference = torch.rand(1, 3, 24, 24)
    picture = reference.clone()
    picture[..., :4] = 0.0
    assert errors(picture, reference)["l1"] > 0
    assert errors(picture, reference, border=4)["l1"] == 0


def test_wrong_arguments_are_named():
    with pytest.raises(ValueError, match="image"):
        errors(torch.rand(1, 3, 16, 16), torch.rand(1, 3, 16, 17))
    with pytest.raises(ValueError, match="border"):
        errors(torch.rand(1, 3, 16, 16), torch.rand(1, 3, 16, 16), border=5)


def test_a_screen_shows_no_more_than_white():
    assert displayed(torch.full((1, 4, 2, 2), 7.0)).tolist() == np.ones((2, 2, 3)).tolist()


def test_every_work_is_warmed_up_and_takes_its_turns():
    said = []

    def work(name):
        said.append(name)
        return torch.zeros(1)

    found = measure({name: lambda name=name: work(name) for name in "ab"}, repeat=2)
    assert said == ["a", "b", "a", "b", "a", "b"]
    assert [found[name].row["runs"] for name in "ab"] == [2, 2]


@pytest.mark.parametrize(
    ("repeat", "budget", "calls", "runs"), [(5, 0.01, 3, 3), (5, 0.1, 4, 3), (2, 0.1, 3, 2), (1, 0.01, 1, 1)]
)
def test_slow_work_runs_three_times(repeat, budget, calls, runs):
    said = []

    def slow():
        said.append(1)
        time.sleep(0.06)
        return torch.zeros(1)

    row = measure({"slow": slow}, repeat=repeat, budget=budget)["slow"].row
    assert (len(said), row["runs"]) == (calls, runs)
    assert row["fastest"] >= 0.06


def test_a_row_has_median_and_spread():
    row = module.Timing((3.0, 1.0, 2.0, 10.0), torch.zeros(1)).row
    assert row == {
        "seconds": 2.5,
        "quartile_low": 1.75,
        "quartile_high": 4.75,
        "fastest": 1.0,
        "slowest": 10.0,
        "runs": 4,
    }


@pytest.mark.parametrize(
    ("points", "front"),
    [
        ([], []),
        ([(1, 1)], [0]),
        ([(1, 3), (2, 1), (3, 2)], [0, 1]),
        ([(2, 1), (1, 2), (0.5, 3)], [2, 1, 0]),
        ([(1, 1), (1, 1), (1, 0.5)], [2]),
        ([(1, 1), (1, 1)], [0]),
        ([(1, 1), (2, 1)], [0]),
    ],
)
def test_pareto_front(points, front):
    assert pareto_front(points) == front


def test_nothing_beats_the_front_and_something_beats_the_rest():
    points = [tuple(p) for p in np.random.default_rng(0).random((60, 2))]
    front = pareto_front(points)
    for k, p in enumerate(points):
        beaten = any(q[0] < p[0] and q[1] < p[1] for q in points)
        assert beaten != (k in front)
