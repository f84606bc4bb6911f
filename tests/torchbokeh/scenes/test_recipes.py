"""Recipes: each keeps what it promises, at any size, and is the same whenever and wherever it is drawn."""

import hashlib
import math
import os
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from scipy import ndimage
from torch import Tensor

from torchbokeh import scenes
from torchbokeh.scenes import RECIPES, Camera, Scene, Sprite
from torchbokeh.scenes.sprite import place

SIZE = (48, 64)
SEEDS = range(2)


def numbers(scene: Scene, camera: Camera) -> Tensor:
    """All that a scene and its camera are, in one row."""
    parts = [scene.backdrop.texture.flatten(), torch.tensor([scene.backdrop.distance, scene.backdrop.width])]
    for s in scene.sprites:
        rows = (*s.position, *s.size, *s.rotation, *s.velocity, *s.angular_velocity, s.emission)
        parts += [s.texture.flatten(), torch.tensor(rows)]
    parts += [torch.stack(list(camera.lens.values().values())), torch.tensor([*camera.size, camera.shutter])]
    return torch.cat([p.double() for p in parts])


def digest(scene: Scene, camera: Camera) -> str:
    return hashlib.sha256(numbers(scene, camera).numpy().tobytes()).hexdigest()


def corner_depths(sprite: Sprite) -> Tensor:
    h, w = sprite.texture.shape[1:]
    corners = torch.tensor([[0, 0, 1], [w, 0, 1], [w, h, 1], [0, h, 1]], dtype=torch.float64)
    return (corners @ place([sprite], None, torch.zeros(1))[0, 0].T)[:, 2]


def cocs(scene: Scene, camera: Camera) -> Tensor:
    """Signed CoC at the corners of everything."""
    depths = [corner_depths(s) for s in scene.sprites]
    depths.append(torch.tensor([scene.backdrop.distance], dtype=torch.float64))
    return camera.lens.coc(torch.cat(depths)[None], camera.size[1])[0]


@pytest.mark.parametrize("name", RECIPES)
def test_a_seed_is_a_scene(name: str) -> None:
    once, again, other = (RECIPES[name](seed, SIZE) for seed in (5, 5, 6))
    assert torch.equal(numbers(*once), numbers(*again))
    a, b = numbers(*once), numbers(*other)
    assert a.shape != b.shape or float((a != b).float().mean()) > 0.3


def test_scenes_are_the_same_in_a_fresh_process() -> None:
    here = [digest(*recipe(3, (12, 20))) for recipe in RECIPES.values()]
    code = f"""
import importlib.util
spec = importlib.util.spec_from_file_location("recipes_again", {__file__!r})
again = importlib.util.module_from_spec(spec)
spec.loader.exec_module(again)
print(*[again.digest(*recipe(3, (12, 20))) for recipe in again.RECIPES.values()])
"""
    env = {**os.environ, "PYTHONHASHSEED": "77", "OMP_NUM_THREADS": "1"}
    out = subprocess.run([sys.executable, "-P", "-c", code], env=env, capture_output=True, text=True, check=True)
    assert out.stdout.split() == here


def test_names() -> None:
    assert list(RECIPES) == ["coins", "whirl", "gears", "rain", "ramp", "fence", "sky", "stack"]
    assert all(getattr(scenes, name) is recipe for name, recipe in RECIPES.items())


def share(sprite: Sprite, camera: Camera) -> float:
    """Width of a card as a share of the picture's."""
    return sprite.size[0] * camera.focal_px / sprite.position[2] / camera.size[1]


def test_recipes_draw_from_streams_of_their_own() -> None:
    # Each draws the width of its first card first, evenly between two bounds.
    drawn = []
    for recipe, low, high in ((scenes.coins, 0.18, 0.32), (scenes.whirl, 0.15, 0.4), (scenes.gears, 0.3, 0.6)):
        widths = np.array([share(scene.sprites[0], camera) for scene, camera in (recipe(k, (8, 8)) for k in range(4))])
        drawn.append((widths - low) / (high - low))
    drawn = np.concatenate(drawn)
    assert np.all((drawn > 0) & (drawn < 1))
    assert np.abs(np.subtract.outer(drawn, drawn))[~np.eye(12, dtype=bool)].min() > 1e-4


@pytest.mark.parametrize("size", [(8, 8), (1, 1), (np.int64(5), np.int64(40))])
@pytest.mark.parametrize("name", RECIPES)
def test_any_size(name: str, size: tuple[int, int]) -> None:
    scene, camera = RECIPES[name](2, size)
    assert camera.size == size
    seen = scene.render(camera, samples=2, layers=3)
    assert seen["image"].shape == (3, *size)
    assert bool(seen["image"].isfinite().all() and (seen["image"] >= 0).all())
    torch.testing.assert_close(seen["alpha"], torch.ones(1, *size), rtol=0, atol=1e-5)  # there is always a backdrop
    assert bool((seen["layer_depth"] > 0).all())


@pytest.mark.parametrize("name", RECIPES)
def test_blur_is_the_largest_coc_of_anything(name: str) -> None:
    for seed in SEEDS:
        for blur in (0.3, 7.0, 300.0, None):
            scene, camera = RECIPES[name](seed, SIZE, blur)
            want = blur or (0.08 if name == "fence" else 0.04) * SIZE[1]
            assert float(cocs(scene, camera).abs().max()) == pytest.approx(want, rel=1e-5)
        # Only the lens depends on it.
        sharp, dull = (RECIPES[name](seed, SIZE, blur) for blur in (0.0, 9.0))
        assert torch.equal(numbers(sharp[0], dull[1]), numbers(*dull))
        assert float(cocs(*sharp).abs().max()) < 1e-4
        if name == "stack" and seed:
            continue  # slow to draw
        seen = dull[0].render(dull[1], samples=2)
        shown = dull[1].lens.coc(seen["layer_depth"], SIZE[1])[seen["layers"][:, 3:] > 0]
        assert float(shown.abs().max()) <= 9.0 * (1 + 1e-5)  # also in pixels whose centres look past a card
        assert float(shown.abs().max()) > 9.0 * 0.8
        assert float(shown.min()) < -1 < 1 < float(shown.max())  # something in front of the focus, and behind


@pytest.mark.parametrize("name", RECIPES)
def test_everything_is_in_front_of_the_camera_and_moves_at_a_sensible_speed(name: str) -> None:
    moving = name in ("whirl", "gears", "rain")
    fastest = []
    for seed in SEEDS if moving else (0,):
        scene, camera = RECIPES[name](seed, SIZE)
        assert min(float(corner_depths(s).min()) for s in scene.sprites) > 0.3
        seen = scene.render(camera, samples=2)
        assert float(seen["depth"].min()) > 0.3
        fastest.append(float(seen["layer_motion"].norm(dim=1).max()) / SIZE[1])
        still = [not any((*s.velocity, *s.angular_velocity)) for s in scene.sprites]
        assert all(still) is not moving
    if moving:
        assert 0.05 < min(fastest) <= max(fastest) < 0.4  # of the picture's width
    else:
        assert max(fastest) == 0


def each(
    recipe: Callable[..., tuple[Scene, Camera]], samples: int = 3, size: tuple[int, int] = (72, 96)
) -> list[tuple[Scene, Camera, dict[str, Tensor]]]:
    found = []
    for seed in SEEDS:
        scene, camera = recipe(seed, size)
        found.append((scene, camera, scene.render(camera, samples=samples)))
    return found


def test_coins_have_many_small_bright_highlights_near_and_far() -> None:
    for scene, camera, seen in each(scenes.coins):
        bright = (seen["image"].amax(0) > 5).numpy()
        _, spots = ndimage.label(bright)
        assert spots >= 15
        assert bright.mean() < 0.1
        assert float(seen["image"].max()) > 15
        signed = camera.lens.coc(seen["depth"], 96)[0].numpy()[bright]
        assert signed.max() > 1.5
        assert any(float(s.texture[:3].max()) > 5 and float(corner_depths(s).max()) < 1.6 for s in scene.sprites)


def test_whirl_goes_in_all_directions() -> None:
    ways = np.array([s.velocity[:2] for seed in range(8) for s in scenes.whirl(seed, SIZE)[0].sprites])
    angles = np.arctan2(ways[:, 1], ways[:, 0])
    assert min(np.histogram(angles, 8, (-np.pi, np.pi))[0]) >= 3
    for scene, _, seen in each(scenes.whirl):
        assert all(s.angular_velocity[2] for s in scene.sprites)
        fast = seen["motion"].norm(dim=0)
        assert float((fast > 2).float().mean()) > 0.1


def test_gears_turn_about_their_middles() -> None:
    for scene, camera, _ in each(scenes.gears):
        spins = np.array([s.angular_velocity[2] for s in scene.sprites]) * camera.shutter
        assert np.all(spins[::2] < 0)
        assert np.all(spins[1::2] > 0)
        assert np.all((np.abs(spins) >= 0.2) & (np.abs(spins) <= 1.0))
        for sprite, spin in zip(scene.sprites, spins, strict=True):
            seen = Scene((sprite,)).render(camera)
            there = seen["alpha"][0] > 0
            if int(there.sum()) < 20:
                continue
            # The way is (dx, dy) = A (x, y) + b with A a quarter turn times the chord of the angle.
            y, x = torch.nonzero(there, as_tuple=True)
            rows = torch.stack([x + 0.5, y + 0.5, torch.ones(len(x))], 1).double()
            ways = seen["motion"][:, there].T.double()
            fit = torch.linalg.lstsq(rows, ways).solution
            chord = 2 * math.sin(spin / 2)
            want = torch.tensor([[0, chord], [-chord, 0]], dtype=torch.float64)
            torch.testing.assert_close(fit[:2], want, rtol=0, atol=1e-3)
            torch.testing.assert_close(rows @ fit, ways, rtol=0, atol=1e-3)
            middle = torch.linalg.solve(fit[:2].T, -fit[2])
            centre = (
                0.5 * torch.tensor([96, 72]) + camera.focal_px * torch.tensor(sprite.position[:2]) / sprite.position[2]
            )
            torch.testing.assert_close(middle, centre.double(), rtol=0, atol=0.1)


def test_rain_is_thin_bright_streaks_in_front() -> None:
    for scene, camera, seen in each(scenes.rain):
        drops = [s for s in scene.sprites if any(s.velocity)]
        assert len(drops) == 40
        assert not any(any(s.velocity) for s in scene.sprites[:2])
        for drop in drops:
            assert drop.size[1] == pytest.approx(6 * drop.size[0])  # a drop is 6 times as long as wide
            assert drop.velocity[1] > 5 * abs(drop.velocity[0])
            assert float(corner_depths(drop).max()) < float(camera.lens.focus_distance)
            way = drop.velocity[1] * camera.shutter * camera.focal_px / drop.position[2]
            assert way > 1.5 * drop.size[0] * camera.focal_px / drop.position[2]
            assert 1 < float(drop.texture[:3].max()) * drop.emission < 10
        moved = seen["layer_motion"].norm(dim=1) > 1
        assert 0 < float((moved & (seen["layers"][:, 3] > 0.05)).any(0).float().mean()) < 0.2
        assert float(seen["motion"][:, :1].isfinite().float().min()) == 1


@pytest.mark.parametrize("size", [(96, 96), (72, 96), (54, 96), (96, 54)])
def test_ramp_goes_through_the_focus(size: tuple[int, int]) -> None:
    for scene, camera, seen in each(scenes.ramp, size=size):
        floor = Scene(scene.sprites[:1]).render(camera)
        rows = floor["depth"][0, :, size[1] // 2]
        rows = rows[rows.isfinite()]
        assert len(rows) > 0.4 * size[0]
        assert bool((rows.diff() < 0).all())  # nearer downwards
        signed = camera.lens.coc(rows[None], size[1])[0] / size[1] * 96
        assert float(signed[-1]) < -2.5
        assert float(signed[0]) > 1
        assert float(signed.abs().min()) < 0.3
        assert float(seen["depth"].max()) == 8.0
        # What stands on it has its foot on the ground.
        ground = scene.sprites[0].position[1]
        assert all(s.position[1] + s.size[1] / 2 == pytest.approx(ground) for s in scene.sprites[1:])


def test_fence_is_a_defocused_veil_before_a_sharp_subject() -> None:
    for seed in range(8):
        scene, camera = scenes.fence(seed, (72, 96))
        assert share(scene.sprites[0], camera) == pytest.approx(1.6, rel=1e-5)
        wires = Scene(scene.sprites[:1]).render(camera)
        assert 0.1 < float(wires["alpha"].mean()) < 0.6
        signed = camera.lens.coc(wires["depth"], 96)[wires["alpha"] > 0]
        assert float(signed.max()) < -4
        covered = wires["alpha"][0] > 0.5
        for third in (covered[:, :32], covered[:, 32:64], covered[:, 64:]):
            assert 0.05 < float(third.float().mean()) < 0.7  # all over the picture, never shut
        subject = Scene(scene.sprites[1:2]).render(camera)
        assert float((subject["alpha"] > 0.5).float().mean()) > 0.03
        assert float(camera.lens.coc(subject["depth"], 96)[subject["alpha"] > 0].abs().max()) < 1e-4


def test_sky_is_infinitely_far() -> None:
    for scene, _, seen in each(scenes.sky):
        far = seen["depth"].isposinf()
        assert 0.2 < float(far.float().mean()) < 0.95
        assert scene.backdrop.distance == math.inf
        assert bool((seen["layers"][-1, 3] == 1).all())
        assert float(scene.backdrop.texture.std()) > 0.05


def test_stack_has_hundreds_of_cards() -> None:
    for scene, _, seen in each(scenes.stack, samples=1, size=(36, 48)):
        assert len(scene.sprites) >= 200
        depths = np.array([s.position[2] for s in scene.sprites])
        assert np.all(np.diff(depths) > 0)
        assert depths[-1] > 9 * depths[0]
        assert len(seen["layers"]) > 10
        assert len({id(s.texture) for s in scene.sprites}) <= 12  # they share their textures
    assert len(scenes.stack(0, SIZE, count=7)[0].sprites) == 7


@pytest.mark.parametrize(
    ("wrong", "error", "message"),
    [
        ({"seed": -1}, ValueError, "seed: "),
        ({"seed": 1.5}, TypeError, "seed: "),
        ({"size": (0, 5)}, ValueError, "size: "),
        ({"size": 5}, TypeError, "size: "),
        ({"blur": -1.0}, ValueError, "blur: .* got -1.0"),
        ({"blur": math.inf}, ValueError, "blur: "),
        ({"blur": math.nan}, ValueError, "blur: "),
    ],
)
@pytest.mark.parametrize("name", ["coins", "stack"])
def test_errors(name: str, wrong: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        RECIPES[name](**{"seed": 0, "size": (8, 8), **wrong})
