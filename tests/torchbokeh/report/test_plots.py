from itertools import combinations

import pytest

pytest.importorskip("matplotlib")

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from torchbokeh.report.plots import _Label, _write_labels, draw


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


def test_labels_cover_neither_each_other_nor_points():
    figure = Figure(figsize=(5, 4), layout="constrained")
    axes = figure.subplots()
    labels = [_Label(1 + 0.02 * k, 1 + 0.01 * (k % 3), f"name {k}", "k") for k in range(8)]
    axes.plot([label.x for label in labels], [label.y for label in labels], "o")
    axes.margins(0.5)
    _write_labels(figure, axes, labels)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    boxes = [text.get_window_extent(canvas.get_renderer()) for text in axes.texts]
    assert len(boxes) >= 6
    assert not any(a.overlaps(b) for a, b in combinations(boxes, 2))
    points = axes.transData.transform([(label.x, label.y) for label in labels])
    assert not any(box.contains(*point) for box in boxes for point in points)
