"""`ProceduralDataset`: a sample is a function of the seed and its index, and holds what its docstring says."""

import itertools
import json
import math
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.utils.data import DataLoader, default_collate

import torchbokeh.datasets.dataset as dataset
from torchbokeh import AccumulationBuffer, ThinLens, datasets, scenes
from torchbokeh.scenes import RECIPES, Camera, ProceduralDataset, Scene

H, W = 12, 16
SMALL = {"resolution": (H, W), "recipes": ("coins", "whirl", "gears", "rain", "ramp", "fence", "sky"), "views": 8}


def small(**settings: Any) -> ProceduralDataset:
    return ProceduralDataset(**{**SMALL, **settings})


def leaves(sample: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in sample.items():
        if isinstance(value, dict):
            yield from leaves(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value


def same(a: dict[str, Any], b: dict[str, Any]) -> bool:
    """The same keys in the same order, and the same bits."""
    pairs = itertools.zip_longest(leaves(a), leaves(b), fillvalue=("", None))
    return all(
        n == m and (torch.equal(x, y) and x.dtype == y.dtype if isinstance(x, Tensor) else x == y)
        for (n, x), (m, y) in pairs
    )


def test_a_sample_is_what_the_docstring_says() -> None:
    for index, recipe in enumerate(RECIPES):
        sample = small(recipes=(recipe,), layers=4)[index]
        shapes = {name: tuple(v.shape) for name, v in leaves(sample) if isinstance(v, Tensor)}
        assert shapes == {
            **{"image": (3, H, W), "depth": (1, H, W), "motion": (2, H, W), "coc": (1, H, W), "target": (3, H, W)},
            **{"layers": (4, 4, H, W), "layer_depth": (4, 1, H, W), "layer_motion": (4, 2, H, W)},
            **{f"lens.{name}": () for name in ("focal_length", "f_number", "focus_distance", "sensor_width")},
        }
        assert sample["recipe"] == recipe
        assert sample["index"] == index
        assert set(sample) == {name.split(".")[0] for name in shapes} | {"recipe", "index"}
        for name, value in leaves(sample):
            if isinstance(value, Tensor):
                assert value.dtype == torch.float32
                assert not value.isnan().any()
                assert "depth" in name or bool(value.isfinite().all())
                assert not value.requires_grad
                assert value.is_contiguous()
        assert bool((sample["depth"] > 0).all() and (sample["layer_depth"] > 0).all())
        assert bool((sample["image"] >= 0).all() and (sample["target"] >= 0).all())
        assert bool((sample["layers"][:, 3] >= 0).all() and (sample["layers"][:, 3] <= 1 + 1e-6).all())


def test_a_sample_depends_on_seed_and_index_alone() -> None:
    data = small(seed=4)
    forwards = [data[i] for i in range(5)]
    backwards = [small(seed=4)[i] for i in reversed(range(5))]
    torch.manual_seed(1)
    np.random.seed(1)  # noqa: NPY002
    for i in range(5):
        assert same(forwards[i], backwards[4 - i])
        assert same(forwards[i], data[i])
        assert not torch.equal(forwards[i]["image"], forwards[(i + 1) % 5]["image"])
        assert not torch.equal(forwards[i]["image"], small(seed=5)[i]["image"])
    # The length is no part of it, and an index may be far out.
    assert same(small(seed=4, length=7)[3], forwards[3])
    far = small(seed=4, length=2**31)
    images = [far[i]["image"] for i in (3, 1003, 3 + 2**10, 3 + 2**16, 2**31 - 1)]
    assert not any(torch.equal(a, b) for a, b in itertools.combinations(images, 2))


def test_threads_do_not_matter() -> None:
    data = small(reuse=2, views=24)
    alone = data[1]
    torch.set_num_threads(2)
    assert same(data[1], alone)


@pytest.mark.parametrize("workers", [0, 2])
def test_data_loader(workers: int) -> None:
    data = small(length=6)
    loader = DataLoader(data, batch_size=None, num_workers=workers)
    samples = list(loader)
    assert [s["index"] for s in samples] == list(range(6))
    for i, sample in enumerate(samples):
        assert same(sample, data[i])


def test_default_collate() -> None:
    data = small(length=6)
    batch = next(iter(DataLoader(data, batch_size=5)))
    assert batch["image"].shape == (5, 3, H, W)
    assert batch["layers"].shape == (5, 6, 4, H, W)
    assert batch["recipe"] == [data[i]["recipe"] for i in range(5)]
    assert batch["index"].tolist() == list(range(5))
    # The lens of the batch, each with its own parameters.
    lens = ThinLens(**batch["lens"])
    torch.testing.assert_close(lens.coc(batch["depth"], W), batch["coc"], rtol=1e-6, atol=1e-6)
    again = default_collate([data[i] for i in range(5)])
    assert torch.equal(again["target"], batch["target"])
    out = AccumulationBuffer(lens, views=4)(batch["layers"], batch["layer_depth"], motion=batch["layer_motion"])
    assert bool(out.isfinite().all())


def test_lens_gives_the_coc() -> None:
    data = small(seed=8)
    for i in range(8):
        sample = data[i]
        assert torch.equal(ThinLens(**sample["lens"]).coc(sample["depth"], W), sample["coc"])


def spied(monkeypatch: pytest.MonkeyPatch, name: str) -> list[tuple[Scene, Camera, tuple[Any, ...]]]:
    """The scenes that a recipe makes from now on."""
    made = []
    recipe = RECIPES[name]

    def spy(*args: Any) -> tuple[Scene, Camera]:
        made.append((*recipe(*args), args))
        return made[-1][:2]

    monkeypatch.setitem(RECIPES, name, spy)
    return made


@pytest.mark.parametrize("name", ["whirl", "ramp", "sky"])
def test_target_and_picture_are_those_of_the_scene(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    made = spied(monkeypatch, name)
    settings = {"views": 12, "level_of_detail": 0.5, "reuse": 1}
    buffers = []

    def spy(**given: Any) -> AccumulationBuffer:
        buffers.append(given)
        return AccumulationBuffer(**given)

    data = small(recipes=(name,), layers=3, **settings)
    monkeypatch.setattr(dataset, "AccumulationBuffer", spy)
    sample = data[2]
    [(scene, camera, args)] = made
    assert buffers[0].items() >= settings.items()
    assert torch.equal(sample["target"], AccumulationBuffer(**buffers[0])(scene, camera)[0, :3])
    data[3], data[2]
    seeds = [given["seed"] for given in buffers]
    assert seeds[0] == seeds[2] != seeds[1], "each sample has noise of its own, always the same"
    del made[1:]
    seen = scene.render(camera, samples=4, layers=3)
    for key in ("image", "depth", "motion", "layers", "layer_depth", "layer_motion"):
        assert torch.equal(sample[key], seen[key])
    assert args[1] == (H, W)
    assert all(torch.equal(sample["lens"][k], v) for k, v in camera.lens.values().items())
    # It converges to the exact picture, of which the pinhole picture is no part.
    exact = AccumulationBuffer(views=2048)(scene, camera)[0, :3]
    fine = small(recipes=(name,), views=512)[2]["target"]
    assert float((fine - exact).abs().mean()) < 0.02 * float(exact.mean())  # their noise is independent


def test_blur_lies_within_its_range(monkeypatch: pytest.MonkeyPatch) -> None:
    made = spied(monkeypatch, "gears")
    radii = []
    for blur, count in (((0.5, 8.0), 24), ((2.0, 2.0), 3), ((0.0, 4.0), 16), (None, 6)):
        data = small(recipes=("gears",), blur=blur, views=1, resolution=(4, W))
        made.clear()
        for i in range(count):
            data[i]
        radii.append(np.array([args[2] for _, _, args in made]))
    drawn, fixed, from_nothing, default = radii
    assert 0.5 <= drawn.min() < 1 < 4 < drawn.max() <= 8
    assert 0.5 < np.log2(drawn).mean() < 1.5  # small blurs are as likely as large ones: 2 is the geometric mean
    assert np.all(fixed == 2)
    assert 0 <= from_nothing.min() < 0.5 < 3.5 < from_nothing.max() <= 4
    assert 0.01 * W <= default.min() < default.max() <= 0.08 * W
    # And it is the blur of what is in the sample.
    sample = small(recipes=("gears",), blur=(3.0, 3.0))[0]
    assert float(sample["coc"].abs().max()) <= 3.0001
    assert small(recipes=("gears",), blur=(0.0, 0.0))[0]["coc"].abs().max() < 1e-4


def test_recipes_are_equally_likely() -> None:
    data = small(recipes=("sky", "ramp"), views=1, resolution=(2, 2))
    names = [data[i]["recipe"] for i in range(30)]
    assert 9 <= names.count("sky") <= 21
    assert names[:15] != names[15:]


def test_layers_are_filled_up_at_the_back() -> None:
    sample = small(recipes=("sky",), layers=30)[0]
    used = int((sample["layers"][:, 3].amax((1, 2)) > 0).sum())
    assert 2 <= used < 12
    assert bool((sample["layers"][:used, 3].amax((1, 2)) > 0).all())
    assert not sample["layers"][used:].any()
    assert not sample["layer_motion"][used:].any()
    assert bool(sample["layer_depth"][used:].isposinf().all())
    left = torch.ones(1, H, W)
    picture = torch.zeros(3, H, W)
    for layer in sample["layers"]:
        picture = picture + left * layer[:3]
        left = left * (1 - layer[3:])
    torch.testing.assert_close(picture, sample["image"], rtol=1e-5, atol=1e-5)
    flat = small(recipes=("sky",), layers=1)[0]
    torch.testing.assert_close(flat["layers"][0, :3], sample["image"], rtol=1e-5, atol=1e-5)


def test_settings_rebuild_the_set() -> None:
    changed = {
        **{"seed": 9, "resolution": (10, 14), "recipes": ["rain", "fence"], "blur": (1, 2.5), "views": 7, "layers": 3},
        **{"level_of_detail": 1, "reuse": 1},
    }
    for data in (ProceduralDataset(), small(seed=np.int64(3)), ProceduralDataset(**changed)):
        text = json.dumps(data.settings())
        again = ProceduralDataset(**json.loads(text), length=data.length)
        assert again.settings() == data.settings()
    assert {name: data.settings()[name] for name in ("seed", "recipes", "views", "layers", "reuse")} == {
        name: changed[name] for name in ("seed", "recipes", "views", "layers", "reuse")
    }
    assert same(ProceduralDataset(**json.loads(text))[4], data[4])


@pytest.mark.parametrize(
    ("changed", "differs", "equal"),
    [
        ({"seed": 1}, "image", "index"),
        ({"resolution": (14, 16)}, "image", "recipe"),
        ({"recipes": ("coins",)}, "image", "index"),
        ({"blur": (3.0, 4.0)}, "coc", "image"),
        ({"views": 9}, "target", "image"),
        ({"layers": 2}, "layers", "target"),
        ({"level_of_detail": 1.0}, "target", "layers"),
        ({"reuse": 1}, "target", "layers"),
    ],
)
def test_every_keyword_has_an_effect(changed: dict[str, Any], differs: str, equal: str) -> None:
    base = {"recipes": ("whirl",), "blur": (2.0, 3.0), "views": 96}
    a, b = small(**base)[0], small(**{**base, **changed})[0]
    assert not torch.equal(a[differs], b[differs])
    assert torch.equal(a[equal], b[equal]) if isinstance(a[equal], Tensor) else a[equal] == b[equal]


def test_length_and_indices() -> None:
    data = small(length=5)
    assert len(data) == 5
    assert len(small()) == 1 << 20
    assert same(data[-1], data[4])
    assert data[-5]["index"] == 0
    for index in (5, -6, 10**9):
        with pytest.raises(IndexError, match=f"index: .* 5, got {index}"):
            data[index]
    assert [s["index"] for s in data] == [0, 1, 2, 3, 4]  # iteration ends
    with pytest.raises(IndexError):
        small(length=0)[0]


@pytest.mark.parametrize(
    ("wrong", "error", "message"),
    [
        ({"seed": -1}, ValueError, "seed: "),
        ({"seed": 1.5}, TypeError, "seed: .* got float"),
        ({"resolution": (0, 4)}, ValueError, "resolution: "),
        ({"resolution": 256}, TypeError, "resolution: "),
        ({"length": -1}, ValueError, "length: .* got -1"),
        ({"length": 2.5}, TypeError, "length: "),
        ({"length": sys.maxsize + 1}, ValueError, "length: "),
        ({"recipes": ("sky", "fog")}, ValueError, "recipes: expected some of coins, .*, got 'fog'"),
        ({"recipes": ()}, ValueError, "recipes: expected at least one"),
        ({"blur": (3.0, 1.0)}, ValueError, "blur: "),
        ({"blur": (-1.0, 1.0)}, ValueError, "blur: "),
        ({"blur": (1.0, math.inf)}, ValueError, "blur: "),
        ({"blur": (1.0, math.nan)}, ValueError, "blur: "),
        ({"blur": (math.nan, 1.0)}, ValueError, "blur: "),
        ({"blur": 3.0}, TypeError, "blur: .* got 3.0"),
        ({"blur": (1.0, 2.0, 3.0)}, TypeError, "blur: "),
        ({"views": 0}, ValueError, "views: "),
        ({"layers": 0}, ValueError, "layers: .* got 0"),
        ({"layers": 2.5}, TypeError, "layers: "),
        ({"level_of_detail": -1.0}, ValueError, "level_of_detail: "),
        ({"reuse": -1}, ValueError, "reuse: "),
    ],
)
def test_errors(wrong: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        small(**wrong)


def test_scenes_forward_the_data_sets() -> None:
    names = ("ProceduralDataset", "read_shards", "write_shards")
    assert all(getattr(scenes, name) is getattr(datasets, name) for name in names)
    assert {*scenes.__all__} <= {*dir(scenes)}
    with pytest.raises(AttributeError, match=r"module 'torchbokeh\.scenes' has no attribute 'nothing'"):
        scenes.nothing  # noqa: B018
