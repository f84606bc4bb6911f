"""The pinhole picture of a scene, its layers, and the geometry beside them."""

import importlib.util
import math
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from torchbokeh import ThinLens
from torchbokeh.scenes import RECIPES, Backdrop, Camera, Scene, Sprite

# pytest puts no folder on the path: the helper beside this file is loaded by its place.
spec = importlib.util.spec_from_file_location("scene_tracer", Path(__file__).with_name("_tracer.py"))
tracer = importlib.util.module_from_spec(spec)
spec.loader.exec_module(tracer)

DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
INF = math.inf
SIZE = (24, 32)
QUARTER = math.pi / 2


def camera(size: tuple[int, int] = SIZE, focus: float = 2.0, shutter: float = 0.02) -> Camera:
    return Camera(ThinLens(0.05, 2.0, focus, 0.036), size, shutter)


def flat(red: float, green: float, blue: float, *alpha: float, side: int = 64) -> Tensor:
    return torch.tensor([red, green, blue, *alpha]).float()[:, None, None].expand(-1, side, side).clone()


def card(colour: tuple[float, ...], position: tuple[float, float, float], size: tuple[float, float], **more) -> Sprite:
    return Sprite(flat(*colour), position, size, **more)


RED, GREEN, BLUE = (0.8, 0.1, 0.1, 1.0), (0.1, 0.7, 0.1, 1.0), (0.1, 0.2, 0.9, 1.0)
WALL, SKY = Backdrop(flat(0.3, 0.4, 0.5), 6.0), Backdrop(flat(0.5, 0.6, 0.9))


def over(layers: Tensor) -> Tensor:
    """Put layers ``(L, 4, H, W)`` over one another, from behind."""
    out = torch.zeros(4, *layers.shape[2:], dtype=torch.float64)
    for layer in layers.flip(0).double():
        out = layer + (1 - layer[3]) * out
    return out


def check(seen: dict[str, Tensor], size: tuple[int, int]) -> None:
    """What holds for every picture."""
    count = len(seen["layers"])
    shapes = {"image": (3,), "alpha": (1,), "depth": (1,), "motion": (2,), "shutter_depth": (2,)}
    shapes |= {"layers": (count, 4), "layer_depth": (count, 1), "layer_motion": (count, 2)}
    shapes |= {"layer_shutter_depth": (count, 2)}
    assert {name: tuple(t.shape) for name, t in seen.items()} == {name: (*s, *size) for name, s in shapes.items()}
    assert all(t.dtype == torch.float32 and not t.isnan().any() for t in seen.values())
    assert all(bool(seen[k].isfinite().all()) for k in ("image", "alpha", "motion", "layers", "layer_motion"))
    assert all(bool((t > 0).all()) for name, t in seen.items() if "depth" in name)
    picture = torch.cat([seen["image"], seen["alpha"]]).double()
    torch.testing.assert_close(picture, over(seen["layers"]), rtol=1e-5, atol=1e-5)
    empty = seen["layers"][:, 3:] == 0
    assert bool((seen["layers"] * empty == 0).all() and (seen["layer_motion"] * empty == 0).all())
    assert bool(seen["layer_depth"][empty].isposinf().all())
    assert bool(seen["layer_shutter_depth"][empty.expand_as(seen["layer_shutter_depth"])].isposinf().all())


@pytest.mark.parametrize("recipe", RECIPES)
@pytest.mark.parametrize("size", [(24, 32), (33, 17), (8, 8)])
def test_layers_of_recipes_are_the_picture(recipe: str, size: tuple[int, int]) -> None:
    scene, look = RECIPES[recipe](1, size)
    check(scene.render(look, samples=3), size)
    if size != SIZE:
        return
    capped = scene.render(look, samples=3, layers=2)
    check(capped, size)
    assert len(capped["layers"]) == 2


def exact(scene: Scene, look: Camera, samples: int) -> np.ndarray:
    """The pinhole picture at half time by the tracer, ``(4, H, W)``."""
    height, width = look.size
    y, x = np.mgrid[:height, :width]
    offsets = (np.arange(samples) + 0.5) / samples - 0.5
    shift = np.stack(np.meshgrid(offsets, offsets), -1).reshape(-1, 2)
    pixels = np.stack([x.ravel(), y.ravel()], 1)
    none = np.zeros((len(shift), 2))
    return tracer.trace_views(scene, look, none, none[:, 0], shift, pixels).T.reshape(4, height, width)


@pytest.mark.parametrize("samples", [1, 4])
def test_a_card_alone_is_what_the_tracer_sees(samples: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torchbokeh.scenes.scene._minified", lambda *_: 0)  # the tracer knows no levels
    found = 0
    for seed in range(80):
        scene, look = tracer.random_scene(seed)
        for alone in (Scene(scene.sprites[:1]), Scene((), scene.backdrop)):
            seen = alone.render(look, samples=samples)
            check(seen, look.size)
            want = exact(alone, look, samples)
            np.testing.assert_allclose(torch.cat([seen["image"], seen["alpha"]]), want, rtol=1e-5, atol=2e-5)
            found += bool(want.any())
    assert found > 60


def test_many_cards_are_what_the_tracer_sees_but_in_shared_pixels() -> None:
    # Where two cards share a pixel, or cut through each other in it, they are put together from their means.
    errors = []
    for seed in range(40):
        scene, look = tracer.random_scene(seed)
        seen = scene.render(look, samples=4)
        check(seen, look.size)
        want = exact(scene, look, 4)
        off = np.abs(torch.cat([seen["image"], seen["alpha"]]).numpy() - want).max(0) / max(1.0, want.max())
        errors.append(off.ravel())
    errors = np.concatenate(errors)
    assert (errors > 0.02).mean() < 0.05
    assert errors.mean() < 0.005


def test_depth_at_both_ends_of_the_exposure() -> None:
    coming = Sprite(flat(*RED), position=(0.0, 0.0, 2.0), size=(0.5, 0.4), velocity=(0.3, 0.0, -20.0))
    look = camera(shutter=0.02)
    seen = Scene((coming,), WALL).render(look)
    there = seen["layers"][0, 3] == 1
    torch.testing.assert_close(seen["layer_shutter_depth"][0][:, there].mean(1), torch.tensor([2.2, 1.8]))
    torch.testing.assert_close(seen["shutter_depth"][:, there].mean(1), torch.tensor([2.2, 1.8]))
    torch.testing.assert_close(seen["shutter_depth"][:, 0, 0], torch.tensor([6.0, 6.0]))


def test_hidden_surfaces_are_there() -> None:
    front, back = card(RED, (0.0, 0.0, 1.5), (0.3, 0.3)), card(GREEN, (0.05, 0.02, 3.0), (0.7, 0.5))
    away = replace(front, position=(50.0, 0.0, 1.5))
    whole, revealed = (Scene((s, back), WALL).render(camera()) for s in (front, away))
    assert len(whole["layers"]) == 3
    assert len(revealed["layers"]) == 2
    hidden = whole["layers"][0, 3] == 1
    assert int(hidden.sum()) > 20
    assert not torch.equal(whole["image"][:, hidden], revealed["image"][:, hidden])
    for name in ("layers", "layer_depth", "layer_motion"):
        assert torch.equal(whole[name][1:], revealed[name])


def random_stack(count: int, seed: int) -> tuple[Sprite, ...]:
    """Cards that face the camera: none cuts through another."""
    draw = np.random.default_rng(seed)
    out = []
    for z in draw.permutation(np.linspace(1, 5, count)):
        x, y, wide = draw.uniform(-0.3, 0.3) * z, draw.uniform(-0.2, 0.2) * z, draw.uniform(0.05, 0.3) * z
        texture = torch.from_numpy(draw.random((4, 9, 9))).float()
        out.append(Sprite(texture, (x, y, float(z)), (wide, wide), rotation=(0.0, 0.0, draw.uniform(-3, 3))))
    return tuple(out)


@pytest.mark.parametrize("seed", range(5))
def test_every_card_lies_in_one_layer_whole(seed: int) -> None:
    cards = random_stack(14, seed)
    seen = Scene(cards).render(camera())
    layer_of = []
    for sprite in cards:
        alone = Scene((sprite,)).render(camera())
        there = alone["alpha"][0] > 0
        if not there.any():
            continue
        same = [
            k for k in range(len(seen["layers"])) if torch.equal(seen["layers"][k, 3][there], alone["alpha"][0][there])
        ]
        assert len(same) == 1
        for whole, part in (("layers", "layers"), ("layer_depth", "layer_depth")):
            assert torch.equal(seen[whole][same[0]][:, there], alone[part][0][:, there])
        layer_of.append((sprite.position[2], same[0], there))
    # In the order of depth where they overlap, and no more layers than it takes.
    depths = []
    for z, layer, there in sorted(layer_of, key=lambda c: c[0]):
        before = [k for other, k, seen_there in layer_of if other < z and (there & seen_there).any()]
        assert layer == max(before, default=-1) + 1
        depths.append(layer)
    assert len(seen["layers"]) == max(depths) + 1 < len(cards)


def test_cards_beside_each_other_share_a_layer() -> None:
    seen = Scene((card(RED, (-0.4, 0.0, 2.0), (0.4, 0.4)), card(BLUE, (0.4, 0.0, 4.0), (0.8, 0.8))), SKY).render(
        camera()
    )
    assert len(seen["layers"]) == 2
    assert set(seen["layer_depth"][0].unique().tolist()) == {2.0, 4.0, INF}


def test_cards_that_cut_through_each_other_are_sorted_in_every_pixel() -> None:
    # Two walls that cross in the middle, each nearer on one side.
    size = (4.0, 1.0)
    left_near, right_near = (
        card(c, (0.0, 0.0, 2.0), size, rotation=(0.0, a, 0.0)) for c, a in ((RED, -0.6), (BLUE, 0.6))
    )
    seen = Scene((left_near, right_near)).render(camera())
    check(seen, SIZE)
    middle = seen["image"][:, 12]
    depth = seen["layer_depth"][:, 0, 12]
    assert len(depth) == 2
    assert bool((depth[0] <= depth[1]).all())
    colours = torch.tensor([RED[:3], BLUE[:3]])
    nearer = (camera_depth(left_near), camera_depth(right_near))
    for x in range(32):
        want = colours[0] if nearer[0][x] < nearer[1][x] else colours[1]
        torch.testing.assert_close(middle[:, x], want)
    assert 0 < sum(float(a) < float(b) for a, b in zip(*nearer, strict=True)) < 32


def camera_depth(sprite: Sprite) -> Tensor:
    """Depth of a card's plane along the middle row."""
    return Scene((sprite,)).render(camera())["depth"][0, 12]


def test_a_ring_of_three() -> None:
    # Each bar lies over the next: no order of whole cards is right.
    bars = []
    for k, colour in enumerate((RED, GREEN, BLUE)):
        angle = k * 2 * math.pi / 3
        along = torch.tensor([math.cos(angle), math.sin(angle)])
        x, y = (0.28 * torch.tensor([along[1], -along[0]])).tolist()
        # Tilted about its short axis, so that one end is nearer.
        turn = tracer.Rotation.from_rotvec([0, 0, angle]) * tracer.Rotation.from_rotvec([0, 0.3, 0])
        bars.append(card(colour, (x, y, 2.0), (1.4, 0.2), rotation=tuple(turn.as_rotvec().tolist())))
    look = camera((48, 64))
    seen = Scene(tuple(bars)).render(look)
    check(seen, (48, 64))
    want = exact(Scene(tuple(bars)), look, 8)
    off = np.abs(seen["image"].numpy() - want[:3]).max(0)
    assert (off > 0.02).mean() < 0.06  # the bars' edges
    visible = [
        int(((seen["image"] - torch.tensor(c[:3])[:, None, None]).abs().amax(0) < 1e-3).sum())
        for c in (RED, GREEN, BLUE)
    ]
    whole = [int((Scene((b,)).render(look)["alpha"] == 1).sum()) for b in bars]
    assert all(0.4 * w < v < 0.95 * w for v, w in zip(visible, whole, strict=True))


def test_the_most_layers() -> None:
    scene = Scene(random_stack(14, 0), WALL)
    full = scene.render(camera())
    count = len(full["layers"])
    assert count > 4
    for most in (1, 2, 3, count, count + 5):
        seen = scene.render(camera(), layers=most)
        check(seen, SIZE)
        assert len(seen["layers"]) == min(most, count)
        for name in ("image", "alpha"):
            torch.testing.assert_close(seen[name], full[name], rtol=1e-5, atol=1e-6)
        assert torch.equal(seen["layers"][: most - 1], full["layers"][: most - 1])
    alone = scene.render(camera(), layers=1)
    assert torch.equal(alone["layers"][0], torch.cat([alone["image"], alone["alpha"]]))
    assert torch.equal(alone["layer_depth"][0], full["depth"])


@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (0.5, 0.0, 0.0), (0.3, -0.8, 0.2)])
def test_depth_is_that_of_the_plane_at_the_centres_of_pixels(turn: tuple[float, float, float]) -> None:
    sprite, look = card(RED, (0.1, -0.1, 2.5), (1.2, 0.9), rotation=turn), camera()
    depth = Scene((sprite,), SKY).render(look)["depth"][0].double()
    normal = tracer.Rotation.from_rotvec(turn).as_matrix()[:, 2]
    y, x = np.mgrid[:24, :32] + 0.5
    ray = np.stack([(x - 16) / look.focal_px, (y - 12) / look.focal_px, np.ones_like(x)])
    want = np.dot(normal, sprite.position) / np.tensordot(normal, ray, 1)
    inside = Scene((sprite,)).render(look)["alpha"][0] == 1
    assert 100 < int(inside.sum()) < 700
    np.testing.assert_allclose(depth[inside], want[inside], rtol=1e-6)
    assert bool(depth[:, 0].isposinf().all())
    assert Scene((sprite,), WALL).render(look)["depth"][0, 0, 0] == 6.0


@pytest.mark.parametrize(
    ("velocity", "spin"),
    [((3.0, -2.0, 0.0), (0.0, 0.0, 0.0)), ((0.0, 0.0, 0.0), (5.0, -9.0, 30.0)), ((0.5, 1.0, -20.0), (0.0, 0.0, 0.0)),
     ((3.0, 2.0, 5.0), (9.0, 9.0, -20.0))],
)  # fmt: skip
def test_motion_is_the_way_of_a_point(velocity: tuple[float, ...], spin: tuple[float, ...]) -> None:
    start = np.array([0.1, -0.1, 2.5])
    sprite = card(RED, tuple(start), (1.2, 0.9), rotation=(0.3, 0.4, 0.2), velocity=velocity, angular_velocity=spin)
    look = camera()
    seen = Scene((sprite,), WALL).render(look)
    inside = seen["layers"][0, 3] == 1
    y, x = np.mgrid[:24, :32] + 0.5
    depth = seen["layer_depth"][0, 0].double().numpy()
    middle = np.array([16.0, 12.0])
    point = np.stack([(x - 16) / look.focal_px, (y - 12) / look.focal_px, np.ones_like(x)], -1) * depth[..., None]
    point = point[inside.numpy()] - start

    def at(time: float) -> np.ndarray:
        there = tracer.Rotation.from_rotvec(np.array(spin) * time).apply(point) + start + np.array(velocity) * time
        return middle + look.focal_px * there[:, :2] / there[:, 2:]

    want = at(0.01) - at(-0.01)
    assert np.abs(want).max() > 0.3
    np.testing.assert_allclose(seen["motion"][:, inside].T, want, rtol=1e-4, atol=1e-4)
    outside = seen["layers"][0, 3] == 0
    assert not seen["motion"][:, outside].any()
    assert not seen["layer_motion"][1].any()
    still = Scene((sprite,), WALL).render(camera(shutter=0.0))
    assert not still["motion"].any()
    assert torch.equal(still["image"], seen["image"])


def test_anti_aliasing() -> None:
    look = camera((8, 8), focus=INF)
    px = 2.0 / look.focal_px  # of a pixel at a depth of 2 m
    # A card whose right edge runs through the middle of a column, and the lower one a quarter into a row.
    seen = Scene((card(RED, (0.0, 0.0, 2.0), (3 * px, 2.5 * px)),)).render(look, samples=8)
    alpha = seen["alpha"][0]
    torch.testing.assert_close(alpha[4], torch.tensor([0.0, 0, 0.5, 1, 1, 0.5, 0, 0]), rtol=0, atol=1e-6)
    torch.testing.assert_close(alpha[:, 4], torch.tensor([0.0, 0, 0.25, 1, 1, 0.25, 0, 0]), rtol=0, atol=1e-6)
    torch.testing.assert_close(seen["image"][:, 4, 2], 0.5 * torch.tensor(RED[:3]))
    # More samples, and a finer texture than the samples can see, come out the same.
    fine = Sprite(
        torch.rand(4, 600, 600, generator=torch.Generator().manual_seed(0)), (0.0, 0.0, 2.0), (6 * px, 6 * px)
    )
    few, many = (Scene((fine,)).render(look, samples=n)["layers"] for n in (4, 32))
    torch.testing.assert_close(few, many, rtol=0, atol=0.03)
    torch.testing.assert_close(many[0, :, 2:6, 2:6].mean((1, 2)), fine.texture.mean((1, 2)), rtol=0, atol=0.01)


def test_emission_brightens_and_does_not_cover_more() -> None:
    dark, bright = (Scene((card(RED, (0.0, 0.0, 2.0), (0.3, 0.3), emission=e),)).render(camera()) for e in (1.0, 7.0))
    torch.testing.assert_close(bright["image"], 7 * dark["image"])
    assert torch.equal(bright["alpha"], dark["alpha"])


def test_a_card_seen_all_but_edge_on_is_not_lost_behind_the_wall() -> None:
    # The centres of its pixels look past it, where its plane may be behind the wall, or the camera.
    for seed in range(60):
        draw = np.random.default_rng(seed)
        z = draw.uniform(1, 4)
        x = z * draw.uniform(-0.3, 0.3)
        turn = (0.0, QUARTER + math.atan2(x, z) + draw.normal(0, 0.004), 0.0)
        sliver = card((1.0, 1.0, 1.0, 1.0), (x, 0.0, z), (1.0, 1.0), rotation=turn, emission=8.0)
        seen = Scene((sliver,), WALL).render(camera())
        check(seen, SIZE)
        alone = Scene((sliver,)).render(camera())
        there = alone["alpha"][0] > 0
        if there.any():
            assert torch.equal(seen["layers"][0][:, there], alone["layers"][0][:, there])
            reach = alone["depth"][alone["depth"].isfinite()]
            assert z - 0.51 < float(reach.min()) <= float(reach.max()) < z + 0.51


@pytest.mark.parametrize(
    "sprite",
    [
        card(RED, (0.0, 0.0, 2.0), (1.0, 1.0), rotation=(0.0, QUARTER, 0.0)),
        card(RED, (0.3, 0.2, 1.0), (9.0, 9.0), rotation=(QUARTER, 0.0, 0.0)),
        card(RED, (0.0, 0.0, -1.0), (1.0, 1.0)),
        card(RED, (0.0, 0.0, 0.0), (1.0, 1.0)),
        card(RED, (0.0, 0.2, 0.0), (3.0, 30.0), rotation=(QUARTER, 0.0, 0.0)),
        card(RED, (0.0, 0.0, 1e-4), (1.0, 1.0), velocity=(1.0, 0.0, -9.0), angular_velocity=(9.0, 0.0, 0.0)),
        card(RED, (0.0, 0.0, 1e6), (1.0, 1.0)),
        card(RED, (9e5, 0.0, 1.0), (1.0, 1.0)),
        card(RED, (0.0, 0.0, 1.0), (1e6, 1e6), rotation=(0.5, 0.5, 0.5)),
    ],
)  # fmt: skip
@pytest.mark.parametrize("behind", [None, SKY, WALL])
def test_odd_places_are_finite(sprite: Sprite, behind: Backdrop | None) -> None:
    check(Scene((sprite,), behind).render(camera()), SIZE)


def test_a_floor_that_runs_under_the_camera_keeps_its_detail() -> None:
    stripes = (torch.arange(64) % 2).float().expand(4, 64, 64).clone()
    stripes[3] = 1.0
    floor = Sprite(stripes, (0.0, 0.3, 0.0), (4.0, 40.0), rotation=(QUARTER, 0.0, 0.0))
    seen = Scene((floor,)).render(camera())
    assert float(seen["alpha"][0, -1].min()) == 1
    assert float(seen["image"][0, -1].std()) > 0.2


def test_nothing_to_see() -> None:
    for scene in (Scene(()), Scene((card(RED, (0.0, 0.0, -1.0), (1.0, 1.0)),))):
        seen = scene.render(camera())
        check(seen, SIZE)
        assert len(seen["layers"]) == 0
        assert not seen["alpha"].any()
        assert bool(seen["depth"].isposinf().all())
    assert len(Scene(())) == 0
    assert len(Scene((), SKY)) == 1


@pytest.mark.parametrize("device", DEVICES)
def test_to_keeps_everything_but_the_device(device: str) -> None:
    scene = Scene(
        (card(RED, (0.1, 0.0, 2.0), (0.5, 0.4), rotation=(0.1, 0.2, 0.3), velocity=(1.0, 2.0, 3.0),
              angular_velocity=(4.0, 5.0, 6.0), emission=7.0), card(BLUE, (0.0, 0.1, 3.0), (1.0, 1.0))),
        Backdrop(flat(0.1, 0.2, 0.3), 5.0, 0.5),
    )  # fmt: skip
    there = scene.to(device)
    for old, new in zip((*scene.sprites, scene.backdrop), (*there.sprites, there.backdrop), strict=True):
        assert new.texture.device.type == device
        assert torch.equal(new.texture.cpu(), old.texture)
        assert all(getattr(new, f.name) == getattr(old, f.name) for f in fields(old) if f.name != "texture")
    assert Scene(()).to(device).backdrop is None
    for name, want in scene.render(camera()).items():
        got = there.render(camera())[name]
        assert got.device.type == device
        torch.testing.assert_close(got.cpu(), want, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float16])
def test_textures_of_any_precision_give_float32(dtype: torch.dtype) -> None:
    sprites = random_stack(5, 3)
    want = Scene(sprites, WALL).render(camera())
    other = tuple(replace(s, texture=s.texture.to(dtype)) for s in sprites)
    seen = Scene(other, replace(WALL, texture=WALL.texture.to(dtype))).render(camera())
    check(seen, SIZE)
    for name in want:
        torch.testing.assert_close(seen[name], want[name], rtol=2e-3, atol=2e-3)


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: Scene((WALL,)), TypeError, "sprites: expected Sprites, got Backdrop"),
        (lambda: Scene((), 3.0), TypeError, "backdrop: expected a Backdrop or None, got float"),
        (lambda: Scene(()).render(camera(), samples=0), ValueError, "samples: expected at least 1, got 0"),
        (lambda: Scene(()).render(camera(), layers=0), ValueError, "layers: expected at least 1, got 0"),
    ],
)
def test_errors(call: Any, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        call()


def test_sprites_may_be_a_list() -> None:
    sprites = [card(RED, (0.0, 0.0, 2.0), (1.0, 1.0))]
    scene = Scene(sprites)
    sprites.clear()
    assert len(scene) == 1
