import doctest
import hashlib
import os
import pickle
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

import torchbokeh.scenes._pictures
import torchbokeh.scenes.textures
from torchbokeh.scenes._pictures import PHOTOGRAPHS
from torchbokeh.scenes.textures import (
    TEXTURES,
    brick,
    checker,
    dead_leaves,
    lights,
    line_art,
    noise,
    photograph,
    text,
    voronoi,
)

every = pytest.mark.parametrize("name", TEXTURES)
Texture = Callable[..., Tensor]

SETTINGS: list[tuple[Texture, str, Any, Any]] = [
    (noise, "octaves", 1, 5),
    (noise, "cells", 2.0, 8.0),
    (noise, "roughness", 0.2, 0.8),
    (noise, "warp", 0.0, 1.0),
    (noise, "colours", 2, 6),
    (voronoi, "cells", 4.0, 12.0),
    (voronoi, "border", 0.0, 0.2),
    (voronoi, "shading", 0.0, 0.9),
    (brick, "rows", 4.0, 9.0),
    (brick, "mortar", 0.0, 0.3),
    (brick, "variation", 0.1, 0.9),
    (checker, "cells", 2.0, 5.0),
    (checker, "rotation", 0.0, 0.4),
    (dead_leaves, "count", 5, 50),
    (dead_leaves, "smallest", 0.01, 0.1),
    (dead_leaves, "exponent", 2.0, 4.0),
    (text, "points", 0.1, 0.2),
    (text, "words", "blur", "sharp"),
    (line_art, "strokes", 3, 12),
    (line_art, "width", 0.005, 0.03),
    (photograph, "name", "coffee", "chelsea"),
    (lights, "count", 3, 30),
    (lights, "peak", 10.0, 50.0),
]


def digest(name: str, size: tuple[int, int] = (40, 56), seed: int = 11) -> str:
    return hashlib.sha256(TEXTURES[name](size, seed).numpy().tobytes()).hexdigest()


@every
@pytest.mark.parametrize("size", [(1, 1), (3, 5), (1, 40), (40, 1), (33, 64), (64, 47)])
def test_any_size_gives_linear_radiance(name: str, size: tuple[int, int]) -> None:
    for seed in (0, 1, 2):
        picture = TEXTURES[name](size, seed)
        assert picture.shape == (3, *size)
        assert picture.dtype == torch.float32
        assert picture.is_contiguous()
        assert picture.isfinite().all()
        assert picture.min() >= 0
        assert picture.max() <= (100 if name == "lights" else 1)


@every
def test_pictures_have_contrast_and_colour(name: str) -> None:
    pictures = torch.stack([TEXTURES[name]((64, 64), seed).clamp(max=1) for seed in range(12)])
    assert pictures.flatten(2).std(2).mean() > 0.05
    assert 0.02 < pictures.mean() < 0.7
    assert (pictures.amax(1) - pictures.amin(1)).mean() > 0.005


@every
def test_the_seed_decides(name: str) -> None:
    texture = TEXTURES[name]
    first = texture((40, 56), 5)
    kept = first.clone()
    first.zero_()  # nothing that is kept from call to call may be the caller's to overwrite
    assert torch.equal(texture((40, 56), 5), kept)
    assert all(not torch.equal(texture((40, 56), seed), kept) for seed in (6, 7, 2**80))
    assert pickle.loads(pickle.dumps(texture)) is texture


def test_the_number_of_threads_does_not_matter() -> None:
    before = torch.get_num_threads()
    try:
        digests = []
        for threads in (1, 3):
            torch.set_num_threads(threads)
            digests.append([digest(name, (205, 211)) for name in TEXTURES])
    finally:
        torch.set_num_threads(before)
    assert digests[0] == digests[1]


def test_a_fresh_process_paints_the_same() -> None:
    code = (
        "import hashlib\nfrom torchbokeh.scenes.textures import TEXTURES\n"
        "for f in TEXTURES.values(): print(hashlib.sha256(f((40, 56), 11).numpy().tobytes()).hexdigest())"
    )
    environment = {**os.environ, "PYTHONHASHSEED": "7"}
    run = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert run.stdout.split() == [digest(name) for name in TEXTURES]


def test_heavy_packages_wait_until_they_are_needed() -> None:
    code = (
        "import sys, torch\nold = set(sys.modules)\nimport torchbokeh.scenes.textures, torchbokeh.scenes.shapes\n"
        "new = {m.split('.')[0] for m in set(sys.modules) - old}\n"
        "assert not new & {'skimage', 'PIL', 'kornia', 'scipy', 'numba'}, new"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize(("texture", "name", "low", "high"), SETTINGS)
def test_settings_have_an_effect(texture: Texture, name: str, low: Any, high: Any) -> None:
    pictures = [texture((48, 64), 3, **{name: value}) for value in (low, high)]
    assert (pictures[0] - pictures[1]).abs().mean() > 1e-3
    assert all(p.min() >= 0 for p in pictures)


@pytest.mark.parametrize(("texture", "name", "low", "high"), SETTINGS)
def test_settings_are_checked(texture: Texture, name: str, low: Any, high: Any) -> None:
    wrong: Any = [1] if isinstance(low, str) else "much"
    with pytest.raises((TypeError, ValueError), match=f"{name}: expected"):
        texture((8, 8), 3, **{name: wrong})
    for out_of_range in ("  ",) if isinstance(low, str) else (-2000, 10**9):
        with pytest.raises(ValueError, match=f"{name}: expected"):
            texture((8, 8), 3, **{name: out_of_range})


@every
def test_size_and_seed_are_checked(name: str) -> None:
    with pytest.raises(ValueError, match="size: expected"):
        TEXTURES[name]((0, 4), 0)
    with pytest.raises(TypeError, match="size: expected"):
        TEXTURES[name]((4.0, 4), 0)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="seed: expected"):
        TEXTURES[name]((4, 4), -1)
    with pytest.raises(TypeError, match="seed: expected"):
        TEXTURES[name]((4, 4), None)  # type: ignore[arg-type]


@pytest.mark.parametrize("texture", [voronoi, checker, brick])
def test_a_larger_picture_shows_the_same_larger(texture: Texture) -> None:
    small, large = texture((64, 96), 4), texture((256, 384), 4)
    reduced = torch.nn.functional.avg_pool2d(large, 4)
    assert (reduced - small).abs().mean() < 0.02


def test_checkers_are_exact() -> None:
    picture = checker((64, 64), 2, cells=4.0, rotation=0.0)
    white, black = picture.flatten(1).amax(1), picture.flatten(1).amin(1)
    assert torch.allclose(picture.flatten(1).mean(1), 0.5 * (white + black), atol=1e-3)
    share = (picture[0] - black[0]) / (white[0] - black[0])
    # Eight edges cross 64 pixels each, and one pixel at each is mixed.
    assert int(((share > 0.01) & (share < 0.99)).sum()) <= 8 * 64
    fine = checker((64, 64), 2, cells=200.0, rotation=0.3)
    assert fine.flatten(1).std(1).max() < picture.flatten(1).std(1).min()


def test_octaves_finer_than_the_pixels_are_left_out() -> None:
    assert torch.equal(noise((32, 32), 1, cells=4.0, octaves=3), noise((32, 32), 1, cells=4.0, octaves=10))


@pytest.mark.parametrize("name", PHOTOGRAPHS)
def test_photographs_are_in_the_wheel(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    import skimage.data._fetchers

    monkeypatch.setattr(skimage.data._fetchers, "_image_fetcher", None)
    torchbokeh.scenes._pictures._photograph.cache_clear()
    for size in ((24, 40), (9, 2000)):
        picture = photograph(size, 3, name=name)
        assert picture.shape == (3, *size)
        assert picture.std() > 0.01


def test_a_photograph_is_averaged_in_linear_light() -> None:
    from kornia.color import rgb_to_linear_rgb
    from skimage.data import astronaut

    linear = rgb_to_linear_rgb(torch.from_numpy(astronaut().copy()).permute(2, 0, 1)[None] / 255)[0]
    whole = photograph((512, 512), 0, name="astronaut")
    assert min((whole - turned).abs().max().item() for turned in (linear, linear.flip(2))) < 1e-6
    means = torch.stack([photograph((1, 1), seed, name="grass").mean() for seed in range(20)])
    grass = photograph((512, 512), 0, name="grass")
    assert means.mean().item() == pytest.approx(grass.mean().item(), rel=0.05)


def test_lights_reach_their_peak() -> None:
    for peak in (1.0, 50.0, 1e6):
        for seed in range(5):
            assert lights((37, 51), seed, peak=peak).max().item() == pytest.approx(peak, rel=1e-6)
    picture = lights((128, 128), 1, count=40, peak=50.0)
    assert picture.median() < 0.05
    assert (picture.amax(0) > 5).float().mean() < 0.1


def test_text_is_written() -> None:
    narrow, wide = (text((64, 64), 1, points=0.2, words=words) for words in ("i", "M"))
    paper = narrow[:, -1, -1]
    assert not torch.equal(narrow, wide)
    assert (narrow - paper[:, None, None]).abs().max() > 0.2


def test_examples() -> None:
    for module in (torchbokeh.scenes.textures, torchbokeh.scenes._pictures):
        assert doctest.testmod(module).failed == 0
