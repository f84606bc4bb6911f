import pytest

pytest.importorskip("matplotlib")

from torchbokeh.report.plots import draw


def test_there_is_a_plot_for_every_experiment(report):
    assert list(draw(report)) == [
        "one_layer_4.png",
        "one_layer_recipes.png",
        "truth.png",
        "radius.png",
        "pixels.png",
        "layers.png",
        "threads.png",
        "chromatic.png",
    ]


def test_nothing_measured_draws_nothing(report):
    assert draw({"experiments": {name: [] for name in report["experiments"]}}) == {}


def test_axes_are_logarithmic_and_named(report):
    axes = draw(report)["one_layer_4.png"].axes[0]
    assert (axes.get_xscale(), axes.get_yscale()) == ("log", "log")
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("seconds", "1 - SSIM")
