from itertools import combinations

import pytest

pytest.importorskip("matplotlib")

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from torchbokeh.report.figures import Label, write_labels


def test_labels_cover_neither_each_other_nor_points():
    figure = Figure(figsize=(5, 4), layout="constrained")
    axes = figure.subplots()
    labels = [Label(1 + 0.02 * k, 1 + 0.01 * (k % 3), f"name {k}", "k") for k in range(8)]
    axes.plot([label.x for label in labels], [label.y for label in labels], "o")
    axes.margins(0.5)
    write_labels(figure, axes, labels)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    boxes = [text.get_window_extent(canvas.get_renderer()) for text in axes.texts]
    assert len(boxes) >= 6
    assert not any(a.overlaps(b) for a, b in combinations(boxes, 2))
    points = axes.transData.transform([(label.x, label.y) for label in labels])
    assert not any(box.contains(*point) for box in boxes for point in points)
