"""The base class of models, and the small functions that they share."""

import math
import pickle

import numpy as np
import pytest
import torch

from torchbokeh.psfs.model import Axis, Labels, Place, PsfModel, gaussian, mean_picture, scaled, turned
from torchbokeh.psfs.models import MODELS, model_from

F64 = torch.float64


class Boxes(PsfModel):
    """A box of a width that is its only coordinate, for a renderer that knows depth."""

    name = "boxes"

    def __init__(self) -> None:
        self.axes = (Axis("width", "px", 9.0, 1.0, 6),)

    def dense(self, coordinates):
        n = 2 * int(coordinates[0] // 2) + 1
        return np.full((1, n, n), 1 / n**2)

    def place(self, labels):
        return Place(labels.depth)


def test_a_model_is_a_grid_of_boxes_with_few_words() -> None:
    model = Boxes()
    assert len(model.grid) == 3
    assert model.settings() == {}
    assert model.still(Labels()) is None
    assert model.extent(torch.zeros(3, 1)) is None
    (place,) = model.places(Labels(depth=torch.full((1, 1, 2, 2), 3.0)))
    assert place.frame is None
    (smaller,) = model.places(Labels(depth=torch.full((1, 1, 2, 2), 3.0)), 4)
    assert smaller.scale.unique() == 0.25
    assert torch.equal(smaller.frame[0, :, :, 0, 0], 0.25 * torch.eye(2))
    assert torch.equal(smaller.coordinates, place.coordinates)


def test_renderers_are_told_of_a_model_by_the_reach_of_its_samples() -> None:
    model, labels = Boxes(), Labels(depth=torch.full((1, 1, 2, 2), 3.0))
    reach = torch.tensor([2.0, 2.0, 2.0])
    assert torch.equal(model.area([labels, labels], reach), torch.full((1, 1, 2, 2), 4.0))
    ((shift, radius),) = model.support(labels, reach, torch.ones(1, 1, 2, 2, dtype=torch.bool))
    assert shift.shape == (1, 2, 2, 2)
    assert not shift.any()
    assert bool((radius > math.hypot(2, 2)).all())  # the corners of a square
    values = torch.rand(1, 2, 2, 2)
    assert model.splat_exactly(values, labels, torch.tensor([0])) is None
    assert not model.needs_clipping([labels], (2, 2))
    assert model.clipped(values, labels, 1) == (values, labels)


def test_prefiltering_is_a_weighted_mean() -> None:
    model = Boxes()
    blurred = model.prefiltered((2.0,), (5.0,))
    nodes = gaussian(2.0, 5.0, 3)
    want = mean_picture([model.dense([x]) for x, _ in nodes], [w for _, w in nodes])
    np.testing.assert_allclose(blurred, want)
    assert blurred.sum() == pytest.approx(1)


@pytest.mark.parametrize("count", [1, 2, 3, 7])
def test_nodes_of_an_interval(count: int) -> None:
    rule = gaussian(-1.0, 3.0, count)
    assert len(rule) == count
    assert sum(w for _, w in rule) == pytest.approx(1)
    assert sum(w * x for x, w in rule) == pytest.approx(1)
    assert all(-1 < x < 3 for x, _ in rule)
    if count == 7:  # the variance of a Gaussian of a quarter of the interval, cut at two of its deviations
        assert sum(w * (x - 1) ** 2 for x, w in rule) == pytest.approx(0.774, abs=0.01)


def test_pictures_of_several_sizes_share_their_centre() -> None:
    mean = mean_picture([np.ones((1, 1, 3)), np.ones((1, 3, 1))], [0.25, 0.75])
    assert mean[0].tolist() == [[0, 0.75, 0], [0.25, 1, 0.25], [0, 0.75, 0]]


def test_a_motion_turns_the_x_axis() -> None:
    motion = torch.tensor([[3.0, 0.0, 0.0, -2.0], [4.0, 0.0, -5.0, 0.0]], dtype=F64).view(1, 2, 1, 4)
    frames = turned(motion)[0, :, :, 0]
    for k, (x, y) in enumerate([(0.6, 0.8), (1, 0), (0, -1), (-1, 0)]):
        torch.testing.assert_close(frames[..., k], torch.tensor([[x, -y], [y, x]], dtype=F64))
    asked = motion.clone().requires_grad_()
    turned(asked).sum().backward()
    assert asked.grad.isfinite().all()


def test_places_are_scaled() -> None:
    place = Place(torch.ones(1, 2, 1, 1), offset=torch.ones(1, 2, 1, 1))
    twice = scaled(scaled(place, 4.0), torch.full((1, 1, 1, 1), 0.5))
    assert twice.scale.item() == 2
    assert torch.equal(twice.frame[0, :, :, 0, 0], 2 * torch.eye(2))
    assert twice.offset.flatten().tolist() == [2, 2]


@pytest.mark.parametrize("name", sorted(MODELS))
def test_every_model_is_known_by_its_name_and_settings_and_pickles(name: str) -> None:
    model = model_from(name)
    again = model_from(name, model.settings())
    assert again.settings() == model.settings() == pickle.loads(pickle.dumps(model)).settings()
    assert again.grid.bounds == model.grid.bounds
    assert len(again.grid) == len(model.grid) >= 100
    assert math.prod(a.cells for a in model.axes) > 0
