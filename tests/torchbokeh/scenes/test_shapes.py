import doctest
import hashlib
import math
import os
import pickle
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import torchbokeh.scenes._raster
import torchbokeh.scenes.shapes
from torchbokeh.scenes._raster import fill, stroke
from torchbokeh.scenes.shapes import SHAPES, card, disc, gear, glyph, grid, leaf, polygon, rectangle, ring

every = pytest.mark.parametrize("name", SHAPES)
Shape = Callable[..., Tensor]

SETTINGS: list[tuple[Shape, str, Any, Any]] = [
    (ring, "inner", 0.2, 0.7),
    (polygon, "corners", 3, 6),
    (polygon, "rotation", 0.0, 0.3),
    (polygon, "depth", 0.0, 0.5),
    (leaf, "lobes", 0, 4),
    (leaf, "slenderness", 1.5, 4.0),
    (gear, "teeth", 8, 20),
    (gear, "hole", 0.0, 0.4),
    (grid, "pitch", 0.1, 0.3),
    (grid, "bar", 0.1, 0.5),
    (grid, "diagonal", False, True),
    (glyph, "characters", "a", "Hi"),
]


def shoelace(corners: np.ndarray) -> float:
    x, y = corners.T
    return abs(0.5 * float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum()))


@every
@pytest.mark.parametrize("size", [(1, 1), (2, 2), (3, 5), (1, 40), (40, 1), (33, 64), (64, 47)])
def test_any_size_is_covered_inside_its_border(name: str, size: tuple[int, int]) -> None:
    for seed in (0, 1, 2):
        cover = SHAPES[name](size, seed)
        assert cover.shape == (1, *size)
        assert cover.dtype == torch.float32
        assert cover.is_contiguous()
        assert cover.min() >= 0
        assert cover.max() <= 1
        border = cover.clone()
        border[:, 1:-1, 1:-1] = 0
        assert border.abs().max() == 0
        if min(size) > 30:
            assert 0.01 < cover.mean() < 0.98


@every
def test_shapes_are_as_large_as_the_card(name: str) -> None:
    for size in ((64, 64), (41, 80), (120, 50)):
        cover = SHAPES[name](size, 3)[0]
        rows, columns = (cover.amax(axis).nonzero() for axis in (1, 0))
        reach = max((rows.max() - rows.min() + 1) / (size[0] - 2), (columns.max() - columns.min() + 1) / (size[1] - 2))
        assert reach > (0.85 if name == "polygon" else 0.94) * min(size) / max(size)


@every
def test_edges_are_one_texel_wide(name: str) -> None:
    cover = SHAPES[name]((128, 128), 1)[0]
    mixed = (cover > 0) & (cover < 1)
    # No more mixed texels than edges have: every one has an empty and a full one near it.
    spread = torch.nn.functional.max_pool2d(torch.stack([cover, 1 - cover])[None], 5, 1, 2)[0]
    assert bool((spread[:, mixed] > 0.6).float().mean() > 0.9) or not mixed.any()
    if name != "rectangle":
        assert mixed.any()


@every
def test_the_seed_decides(name: str) -> None:
    shape = SHAPES[name]
    first = shape((40, 56), 5)
    kept = first.clone()
    first.zero_()
    assert torch.equal(shape((40, 56), 5), kept)
    others = [shape((40, 56), seed) for seed in (6, 7, 2**80)]
    assert all(torch.equal(other, kept) == (name in ("disc", "rectangle")) for other in others)
    assert pickle.loads(pickle.dumps(shape)) is shape


def test_a_fresh_process_cuts_the_same() -> None:
    code = (
        "import hashlib\nfrom torchbokeh.scenes.shapes import SHAPES\n"
        "for f in SHAPES.values(): print(hashlib.sha256(f((40, 56), 11).numpy().tobytes()).hexdigest())"
    )
    environment = {**os.environ, "PYTHONHASHSEED": "7"}
    run = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    here = [hashlib.sha256(f((40, 56), 11).numpy().tobytes()).hexdigest() for f in SHAPES.values()]
    assert run.stdout.split() == here


@pytest.mark.parametrize("size", [(64, 64), (41, 80), (200, 101)])
def test_areas_have_their_closed_form(size: tuple[int, int]) -> None:
    radius = 0.5 * min(size) - 1
    assert disc(size).sum().item() == pytest.approx(math.pi * radius**2, rel=1e-4)
    assert ring(size, inner=0.6).sum().item() == pytest.approx(math.pi * radius**2 * 0.64, rel=1e-4)
    assert ring(size, inner=1.0).sum().item() == 0
    assert torch.equal(ring(size, inner=0.0), disc(size))
    for n in (3, 4, 7):
        want = 0.5 * n * radius**2 * math.sin(2 * math.pi / n)
        for rotation in (0.0, 0.4):
            assert polygon(size, corners=n, rotation=rotation, depth=0.0).sum().item() == pytest.approx(want, rel=1e-4)
            star = polygon(size, corners=n, rotation=rotation, depth=0.5)
            assert star.sum().item() == pytest.approx(0.5 * want, rel=1e-4)
    assert rectangle(size).sum().item() == (size[0] - 2) * (size[1] - 2)


@pytest.mark.parametrize("diagonal", [False, True])
def test_a_grid_covers_its_share(diagonal: bool) -> None:
    cover = grid((400, 300), 2, pitch=0.05, bar=0.3, diagonal=diagonal)
    assert cover[:, 1:-1, 1:-1].mean().item() == pytest.approx(1 - 0.7**2, abs=0.01)


def test_rotation_turns_counter_clockwise_from_a_corner_on_top() -> None:
    upright = polygon((65, 65), corners=3, rotation=0.0, depth=0.0)
    assert upright[0, :5, 32].sum() > 0.5
    assert (upright - upright.flip(2)).abs().max() < 1e-5
    turned = polygon((65, 65), corners=3, rotation=math.pi / 2, depth=0.0)
    assert (turned - upright.rot90(1, (1, 2))).abs().max() < 1e-5


def test_fill_is_exact() -> None:
    draw = np.random.default_rng(0)
    step = (np.arange(12 * 16) + 0.5) / 16
    y, x = step[:, None], step[None]
    for _ in range(20):
        corners = draw.uniform(-4, 16, (3, 2))
        edges = np.roll(corners, -1, 0) - corners
        side = [e[0] * (y - c[1]) - e[1] * (x - c[0]) > 0 for c, e in zip(corners, edges, strict=True)]
        inside = (side[0] == side[1]) & (side[1] == side[2])
        want = inside.reshape(12, 16, 12, 16).mean((1, 3))
        got = fill((12, 12), corners)[0].numpy()
        assert np.abs(got - want).max() < 0.06
        assert np.array_equal(got, fill((12, 12), corners[::-1])[0].numpy())
        assert fill((40, 40), corners + 12).sum().item() == pytest.approx(shoelace(corners), abs=1e-4)


def test_fill_adds_up_and_cuts_holes() -> None:
    square = np.array([[1.0, 1.0], [5.0, 1.0], [5.0, 5.0], [1.0, 5.0]])
    assert fill((6, 6), square, square + 0.5).max() == 1
    assert fill((6, 6), square, 0.5 * square[::-1] + 1.5).sum() == 12
    assert fill((6, 6)).sum() == 0
    assert fill((2, 2), 1e5 * (square - 3)).tolist() == [[[1.0, 1.0], [1.0, 1.0]]]
    assert fill((6, 6), np.zeros((0, 2)), square[:1], square[:2]).sum() == 0


def test_a_stroke_has_its_width() -> None:
    slanted = np.array([[4.0, 5.0], [25.0, 20.0]])
    length = float(np.hypot(*(slanted[1] - slanted[0])))
    assert fill((30, 30), stroke(slanted, 3.0)).sum().item() == pytest.approx(3 * length, rel=1e-5)
    swelling = stroke(np.linspace(*slanted, 9), np.linspace(1, 3, 9))
    assert fill((30, 30), swelling).sum().item() == pytest.approx(2 * length, rel=1e-5)


@pytest.mark.parametrize(("shape", "name", "low", "high"), SETTINGS)
def test_settings_have_an_effect(shape: Shape, name: str, low: Any, high: Any) -> None:
    covers = [shape((64, 80), 3, **{name: value}) for value in (low, high)]
    assert (covers[0] - covers[1]).abs().mean() > 1e-3


@pytest.mark.parametrize(("shape", "name", "low", "high"), SETTINGS)
def test_settings_are_checked(shape: Shape, name: str, low: Any, high: Any) -> None:
    wrong: Any = 5 if isinstance(low, str) else "much"
    with pytest.raises(TypeError, match=f"{name}: expected"):
        shape((8, 8), 3, **{name: wrong})
    outside: tuple[Any, ...] = ("", " ", "a\nb") if isinstance(low, str) else (-2000, 10**9)
    for value in () if isinstance(low, bool) else outside:
        with pytest.raises(ValueError, match=f"{name}: expected"):
            shape((8, 8), 3, **{name: value})


@every
def test_size_and_seed_are_checked(name: str) -> None:
    with pytest.raises(ValueError, match="size: expected"):
        SHAPES[name]((0, 4), 0)
    with pytest.raises(TypeError, match="size: expected"):
        SHAPES[name]((4,), 0)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="seed: expected"):
        SHAPES[name]((4, 4), -1)
    with pytest.raises(TypeError, match="seed: expected"):
        SHAPES[name]((4, 4), 1.5)  # type: ignore[arg-type]


@pytest.mark.parametrize("characters", ["A", "j", "f", "bokeh", "—", ".", "Åg"])
def test_glyphs_fill_the_card(characters: str) -> None:
    for size in ((64, 64), (40, 90), (91, 40)):
        cover = glyph(size, characters=characters)[0]
        rows, columns = (cover.amax(axis).nonzero() for axis in (1, 0))
        spare = min(size[0] - 2 - (rows.max() - rows.min() + 1), size[1] - 2 - (columns.max() - columns.min() + 1))
        assert 0 <= spare <= 4


def test_bad_outlines_are_named() -> None:
    with pytest.raises(ValueError, match=r"outlines: expected finite corners of shape \(V, 2\), got shape \(3, 3\)"):
        fill((4, 4), np.zeros((3, 3)))
    with pytest.raises(ValueError, match="outlines: expected finite corners"):
        fill((4, 4), np.full((3, 2), np.nan))
    with pytest.raises(ValueError, match=r"points: expected shape \(V, 2\) with V >= 2, got \(1, 2\)"):
        stroke(np.zeros((1, 2)), 1.0)


def test_a_card_is_premultiplied() -> None:
    texture, cover = torch.rand(3, 5, 7) * 9, torch.rand(1, 5, 7)
    rgba = card(texture, cover)
    assert rgba.shape == (4, 5, 7)
    assert torch.equal(rgba[:3], texture * cover)
    assert torch.equal(rgba[3:], cover)
    assert card(texture.double(), cover.double()).dtype == torch.float64


def test_bad_cards_are_named() -> None:
    texture, cover = torch.ones(3, 5, 7), torch.ones(1, 5, 7)
    with pytest.raises(ValueError, match=r"texture: expected shape \(3, H, W\), got \(1, 5, 7\)"):
        card(cover, cover)
    with pytest.raises(ValueError, match=r"coverage: expected shape \(1, 5, 7\), got \(1, 7, 5\)"):
        card(texture, torch.ones(1, 7, 5))
    with pytest.raises(TypeError, match="coverage: expected a tensor"):
        card(texture, None)  # type: ignore[arg-type]
    for bad in (-0.1, math.nan, math.inf):
        with pytest.raises(ValueError, match="texture: expected finite values from 0"):
            card(texture * bad, cover)
    for bad in (-0.1, math.nan, 1.1):
        with pytest.raises(ValueError, match="coverage: expected finite values from 0 to 1"):
            card(texture, cover * bad)


def test_examples() -> None:
    for module in (torchbokeh.scenes.shapes, torchbokeh.scenes._raster):
        assert doctest.testmod(module).failed == 0
