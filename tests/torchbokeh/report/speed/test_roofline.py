import torch

from torchbokeh.report.speed.roofline import Rates, least_seconds, measured_rates


def test_rates_are_those_of_a_computer():
    rates = measured_rates(0.02)
    assert 1e8 < rates.bytes < 1e13
    assert 1e6 < rates.points < 1e11


def test_bounds_follow_the_work():
    rates = Rates(1e9, 1e9)
    image = torch.rand(1, 3, 64, 64)
    sharp = least_seconds(image, torch.zeros(1, 1, 64, 64), "balanced", rates)
    assert sharp.keys() == {"mean", "collect", "picture"}
    # One row of two points for each pixel, and four planes in and out.
    assert sharp["picture"] == (2 * 64 * 64 + 8 * 4 * 64 * 64) / 1e9
    wide = least_seconds(image, torch.full((1, 1, 64, 64), 20.0), "balanced", rates)
    assert wide.keys() == {"mean", "collect", "levels", "picture"}
    assert wide["levels"] > 0
    assert least_seconds(image, torch.zeros(1, 1, 64, 64), "exact", rates) == {}
    twice = least_seconds(image, torch.full((1, 1, 64, 64), 20.0), "balanced", Rates(2e9, 2e9))
    assert twice["levels"] == wide["levels"] / 2
