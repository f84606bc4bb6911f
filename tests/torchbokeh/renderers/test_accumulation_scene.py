"""`AccumulationBuffer` on scenes: against a ray tracer that shares nothing with it, and its three techniques."""

import importlib.util
import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

import torchbokeh.views.cards as module
import torchbokeh.views.setup as setup
from torchbokeh import AccumulationBuffer, ThinLens
from torchbokeh.psfs import Ellipse
from torchbokeh.scenes import Backdrop, Camera, Scene, Sprite
from torchbokeh.views.points import Views, shared_views
from torchbokeh.views.setup import ViewSettings

# pytest puts no folder on the path: the helper beside this file is loaded by its place.
spec = importlib.util.spec_from_file_location("scene_tracer", Path(__file__).parents[1] / "scenes" / "_tracer.py")
tracer = importlib.util.module_from_spec(spec)
spec.loader.exec_module(tracer)

DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
OFF = {"level_of_detail": 0.0, "reuse": 0, "subsamples": 0}


def texture(channels: int, height: int, width: int, seed: int, alpha: float | None = None) -> Tensor:
    out = torch.rand(channels, height, width, generator=torch.Generator().manual_seed(seed))
    if channels == 4:
        if alpha is not None:
            out[3] = alpha
        out[:3] *= out[3]
    return out


def plain(red: float, green: float, blue: float, *alpha: float, side: int = 32) -> Tensor:
    return torch.tensor([red, green, blue, *alpha]).float()[:, None, None].expand(-1, side, side).clone()


def camera(f_number: float, focus: float, size: tuple[int, int] = (48, 64), shutter: float = 0.0) -> Camera:
    return Camera(ThinLens(0.05, f_number, focus, 0.036), size, shutter)


def coc_at(look: Camera, depth: float) -> float:
    return float(look.lens.coc(torch.tensor([[depth]]), look.size[1]))


def rms(a: Tensor, b: Tensor) -> float:
    return float((a - b).square().mean().sqrt())


def cards(speed: float = 0.0, turn: float = 0.0) -> tuple[Sprite, ...]:
    """Two that cut through each other, one nearer that shines, and a half-transparent one behind; all tilted."""

    def way(*metres: float) -> tuple[float, ...]:
        return tuple(speed * m for m in metres)

    return (
        Sprite(
            *(texture(4, 8, 9, 0, 1.0), (-0.1, 0.0, 2.0), (0.7, 0.5), (0.2, 0.9, 0.3), way(3, 1, 0)),
            angular_velocity=(0.0, 0.0, turn),
        ),
        Sprite(
            *(texture(4, 7, 6, 1), (0.1, 0.05, 2.0), (0.6, 0.6), (0.5, -0.8, 0.0), way(-2, 2, 4)),
            angular_velocity=(0.0, turn, 0.0),
        ),
        Sprite(
            *(texture(4, 5, 5, 2, 1.0), (0.15, -0.1, 1.0), (0.12, 0.16), (-0.7, 0.2, 1.0), way(1, -3, 2)), emission=6.0
        ),
        Sprite(
            *(texture(4, 6, 6, 3, 0.5), (-0.3, 0.2, 4.0), (1.5, 1.5), (0.3, 0.0, 0.4), way(6, 0, 0)),
            angular_velocity=(turn, 0.0, 0.0),
        ),
    )


WALL, SKY = Backdrop(texture(3, 6, 8, 4), 6.0, 0.3), Backdrop(texture(3, 6, 8, 5), math.inf, 0.3)
SMALL = (24, 32)
SHUTTER = 1 / 50
CASES = {
    "depth of field, wall": (Scene(cards(), WALL), camera(0.15, 2.0, SMALL)),
    "motion, sky": (Scene(cards(1.0, 30.0), SKY), camera(1e6, 2.0, SMALL, SHUTTER)),
    "both, sky": (Scene(cards(1.0, 30.0), SKY), camera(0.15, 1.5, SMALL, SHUTTER)),
    "both, wall, focus in front of all": (Scene(cards(1.0, 30.0), WALL), camera(0.3, 0.8, SMALL, SHUTTER)),
    "both, focus at infinity, no backdrop": (Scene(cards(1.0, -30.0)), camera(0.2, math.inf, SMALL, SHUTTER)),
}


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-4), (torch.float64, 1e-10)])
def test_every_view_is_what_the_tracer_sees(dtype: torch.dtype, tolerance: float) -> None:
    # Random scenes of cards at any angle, in the same lens points at the same times: no noise to hide behind.
    for seed in range(300 if dtype == torch.float32 else 100):
        scene, look = tracer.random_scene(seed, dtype)
        buffer = AccumulationBuffer(views=3, seed=seed, first=seed)
        views = Views.spread(3, buffer.aperture.profile(), seed=seed, first=seed)
        height, width = look.size
        y, x = np.mgrid[:height, :width]
        pixels = np.stack([x.ravel(), y.ravel()], 1)
        want = tracer.trace_views(scene, look, views.lens.numpy(), views.time.numpy(), views.shift.numpy(), pixels)
        got = buffer(scene, look)
        assert got.shape == (1, 4, height, width)
        assert got.dtype == dtype
        off = np.abs(got[0].numpy().reshape(4, -1).T - want).max()
        assert off <= tolerance, f"scene {seed} is off by {off}"


@pytest.mark.parametrize("case", CASES)
def test_mean_is_that_of_random_rays(case: str) -> None:
    scene, look = CASES[case]
    got = AccumulationBuffer(views=4096)(scene, look)[0].double().numpy()
    mean, variance = tracer.trace_picture(scene, look, samples=256, seed=1)
    off = got - mean
    # The tracer's own noise explains the difference: pooled over the picture, in every pixel, and in its mean.
    assert 0.6 < (off**2).sum() / variance.sum() < 1.4
    noisy = variance > 0.1 * variance.mean((1, 2), keepdims=True).clip(1e-9)
    assert noisy.sum() > 500
    assert 0.85 < (off[noisy] ** 2 / variance[noisy]).mean() < 1.2
    assert np.all(np.abs(off.sum((1, 2))) <= 4 * np.sqrt(variance.sum((1, 2))) + 1e-3)


@pytest.mark.slow
def test_mean_of_many_random_rays() -> None:
    scene, look = Scene(cards(1.0, 30.0), SKY), camera(0.3, 1.5, (12, 16), SHUTTER)
    got = AccumulationBuffer(views=8192)(scene, look)[0].double().numpy()
    mean, _ = tracer.trace_picture(scene, look, samples=3000, seed=2)
    assert np.abs(got - mean).sum() / mean.sum() < 0.008


def test_wrong_pictures_are_found_out() -> None:
    # The tests above can fail: a lens or a shutter that is open 10 % too far is far outside the noise.
    scene, look = CASES["both, sky"]
    mean, variance = tracer.trace_picture(scene, look, samples=256, seed=1)
    for wrong in (camera(0.15 / 1.1, 1.5, SMALL, SHUTTER), camera(0.15, 1.5, SMALL, 1.5 * SHUTTER)):
        off = AccumulationBuffer(views=2048)(scene, wrong)[0].double().numpy() - mean
        assert (off**2).sum() / variance.sum() > 1.5


def test_halves_of_the_sequence_agree_better_than_random_ones() -> None:
    scene, look = CASES["both, sky"]
    first, second = (AccumulationBuffer(views=128, first=n)(scene, look) for n in (0, 128))
    assert not torch.equal(first, second)
    whole = AccumulationBuffer(views=256)(scene, look)
    assert rms((first + second) / 2, whole) < 0.3 * rms(first, second)  # but for the strata of the times
    draw = np.random.default_rng(0)
    random = [
        Views(
            *map(torch.from_numpy, (tracer.random_disc(draw, 128), draw.random(128) - 0.5, draw.random((128, 2)) - 0.5))
        )
        for _ in range(8)
    ]
    pictures = [module.accumulate_scene(scene, look, views, None, ViewSettings()) for views in random]
    apart = np.median([rms(a, b) for a, b in zip(pictures[::2], pictures[1::2], strict=True)])
    assert rms(first, second) < 0.7 * apart


def test_error_falls_faster_than_that_of_random_views() -> None:
    # At random N ** -0.5. Three runs of the sequence, for a slope that does not hang on one of them.
    scene, look = CASES["both, sky"]
    reference = AccumulationBuffer(views=8192, seed=9)(scene, look)
    counts = [16, 32, 64, 128, 256, 512, 1024]
    errors = [
        np.sqrt(np.mean([rms(AccumulationBuffer(views=n, seed=s)(scene, look), reference) ** 2 for s in (None, 0, 1)]))
        for n in counts
    ]
    slope = np.polyfit(np.log(counts), np.log(errors), 1)[0]
    assert slope < -0.62
    assert all(b < a for a, b in pairwise(errors))


def test_seeds_give_independent_noise() -> None:
    scene, look = CASES["both, sky"]
    reference = AccumulationBuffer(views=8192)(scene, look)
    runs = [AccumulationBuffer(views=32, seed=seed)(scene, look) for seed in range(16)]
    assert torch.equal(runs[3], AccumulationBuffer(views=32, seed=3)(scene, look))
    each = np.sqrt(np.mean([rms(run, reference) ** 2 for run in runs]))
    # The error of the mean of 16 independent pictures is a quarter; of equal ones it would not fall.
    assert 0.1 < rms(torch.stack(runs).mean(0), reference) / each < 0.4


def inside(corners: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Share of each pixel within a convex outline ``(N, 2)`` around the middle of the picture, clockwise."""
    n = 4
    y, x = (np.mgrid[: size[0] * n, : size[1] * n] + 0.5) / n - np.array(size)[:, None, None] / 2
    edges = zip(corners, np.roll(corners, -1, 0), strict=True)
    within = np.all([(bx - ax) * (y - ay) - (by - ay) * (x - ax) >= 0 for (ax, ay), (bx, by) in edges], 0)
    return within.reshape(size[0], n, size[1], n).mean((1, 3))


@pytest.mark.parametrize(("depth", "focus", "upright"), [(4.0, 1.0, True), (1.0, 4.0, False)])
def test_highlight_has_the_shape_of_the_aperture(depth: float, focus: float, upright: bool) -> None:
    look = camera(0.075, focus, (33, 33))
    radius = coc_at(look, depth)
    assert (radius > 0) is upright
    assert 10 < abs(radius) < 14
    dot = Scene((Sprite(plain(1, 1, 1, 1, side=8), (0.0, 0.0, depth), (0.03 * depth, 0.03 * depth), emission=50.0),))
    angle = 2 * np.pi * np.arange(5) / 5
    pentagon = np.stack([np.sin(angle), -np.cos(angle)], 1) * radius  # a corner on top; point-mirrored in front
    got = AccumulationBuffer(aperture="5-gon", views=4096)(dot, look)[0, 0].numpy().ravel()

    def alike(aperture: np.ndarray) -> float:
        return float(np.corrcoef(got, inside(aperture, look.size).ravel())[0, 1])

    assert alike(pentagon) > 0.95
    assert alike(-pentagon) < alike(pentagon) - 0.05
    # Its area says how bright it is.
    area, of_dot = 2.5 * np.sin(0.4 * np.pi) * radius**2, (0.03 * look.focal_px) ** 2
    assert got.reshape(33, 33)[14:19, 14:19].mean() == pytest.approx(50 * of_dot / area, rel=0.05)


def test_any_aperture_is_taken() -> None:
    look = camera(0.075, 1.0, (33, 33))
    dot = Scene((Sprite(plain(1, 1, 1, 1, side=8), (0.0, 0.0, 4.0), (0.12, 0.12)),))
    got = AccumulationBuffer(aperture=Ellipse(2.0), views=1024)(dot, look)[0, 3]
    rows, columns = (got.sum(d) > 0.01 * got.sum(d).max() for d in (1, 0))
    assert int(rows.sum()) > 1.6 * int(columns.sum())


def test_nothing_moves_and_a_pinhole_is_the_picture_of_render() -> None:
    # Cards one by one: where two share a pixel, `render` takes them to cover it independently.
    for k, card in enumerate(cards()):
        for behind in (WALL, SKY, None) if k == 0 else (None,):
            scene, look = Scene((card,), behind), camera(1e7, 2.0)
            got = AccumulationBuffer(views=1024)(scene, look)[0]
            want = scene.render(look, samples=16)
            assert rms(got, torch.cat([want["image"], want["alpha"]])) < 0.003 * card.emission


@pytest.mark.parametrize("case", CASES)
def test_techniques_that_have_nothing_to_do_change_no_bit(case: str) -> None:
    scene, look = CASES[case]
    plain_views = AccumulationBuffer(views=48)(scene, look)
    assert torch.equal(AccumulationBuffer(views=48, **OFF)(scene, look), plain_views)
    # Raster cells so fine that each view has its own, and levels so low that none reaches 1.
    assert torch.equal(AccumulationBuffer(views=48, reuse=10**9)(scene, look), plain_views)
    assert torch.equal(AccumulationBuffer(views=48, level_of_detail=1e-6)(scene, look), plain_views)
    # A single view at the middle of the lens has sub-samples all over it, but a pinhole has nothing to blur.
    sharp = camera(1e7, 2.0, SMALL, look.shutter)
    torch.testing.assert_close(
        *(AccumulationBuffer(views=48, subsamples=s)(scene, sharp) for s in (4, 0)), rtol=1e-5, atol=1e-6
    )


def test_reuse(monkeypatch: pytest.MonkeyPatch) -> None:
    parents = []

    def spy(*args: Tensor) -> Tensor:
        parents.append(shared_views(*args))
        return parents[-1]

    monkeypatch.setattr(setup, "shared_views", spy)
    sharp = Sprite(texture(4, 48, 64, 0, 1.0), (0.0, 0.0, 2.0), (1.2, 0.9))
    scene = Scene((*cards()[2:], sharp), WALL)
    look = camera(1.4, 2.0)
    brute = AccumulationBuffer(views=256)(scene, look)
    errors, renderings = [], []
    for grid in (1, 2, 4, 8):
        errors.append(rms(AccumulationBuffer(views=256, reuse=grid)(scene, look), brute))
        renderings.append([len(own.unique()) for own in parents[-1].T])
    # In focus only the shift in the pixel counts, which meets (grid + 1)² raster cells; the others cost more.
    assert [r[2] for r in renderings[:3]] == [1, 9, 25]
    assert all(r[2] <= min(r) for r in renderings)
    assert all(max(r) < 256 for r in renderings[:3])
    # A cell is 1/grid px wide: a better picture for more renderings.
    assert all(b < 0.6 * a for a, b in pairwise(errors))
    assert errors[1] < 0.025 < 0.2 < float(brute.std())


def test_reuse_of_what_moves_and_of_frames_with_subsamples() -> None:
    fast = Sprite(texture(4, 12, 16, 0, 1.0), (0.0, 0.0, 2.0), (0.6, 0.4), velocity=(20.0, 5.0, 0.0))
    scene, look = Scene((fast,), SKY), camera(1.4, 2.0, shutter=SHUTTER)
    brute = AccumulationBuffer(views=128)(scene, look)
    assert rms(AccumulationBuffer(views=128, reuse=2)(scene, look), brute) < 0.2 * rms(
        brute[0, :3], scene.render(look)["image"]
    )
    # In focus all views show the one rendering, also with sub-samples, which see frames in groups.
    sharp = Scene((), Backdrop(texture(3, 48, 64, 0), 2.0, 0.6))
    without, with_them = (AccumulationBuffer(views=48, reuse=1, subsamples=s)(sharp, look) for s in (0, 3))
    torch.testing.assert_close(with_them, without, rtol=1e-5, atol=1e-6)


def test_reuse_is_as_good_in_front_of_the_focus_as_behind_it() -> None:
    # A card in front of the focus moves against the lens point, and its raster cells with it.
    look = camera(1.0, 2.0)

    def error(coc: float) -> float:
        depth = float(look.lens.depth(torch.tensor([[coc]]), look.size[1]))
        scene = Scene((Sprite(texture(4, 48, 64, 0, 1.0), (0.0, 0.0, depth), (0.6 * depth, 0.45 * depth)),))
        brute, shared = (AccumulationBuffer(views=128, reuse=grid)(scene, look) for grid in (0, 2))
        return rms(shared, brute)

    for coc in (0.5, 0.65, 0.8):
        assert 0 < error(-coc) < 1.5 * error(coc)


@pytest.mark.parametrize("turns", [1, 2, 4])
def test_reuse_of_a_card_that_comes_back_to_where_it_was(turns: int) -> None:
    halves = torch.cat([plain(1, 0, 0, 1), plain(0, 0, 1, 1)], 2)
    spin = (0.0, 0.0, 2 * math.pi * turns / SHUTTER)
    scene = Scene((Sprite(halves, (0.0, 0.0, 2.0), (1.0, 1.0), angular_velocity=spin),))
    look = camera(1e6, 2.0, SMALL, SHUTTER)
    brute, shared = (AccumulationBuffer(views=256, reuse=grid)(scene, look) for grid in (0, 2))
    assert float((shared - brute).abs().max()) < 0.05


def test_nothing_is_shared_of_a_card_that_reaches_behind_the_lens() -> None:
    floor = Sprite(
        texture(4, 16, 16, 0, 1.0), (0.0, 0.3, 0.5), (4.0, 4.0), (math.pi / 2, 0.0, 0.0), velocity=(2.0, 0.0, 0.0)
    )
    scene, look = Scene((floor,)), camera(1e9, 2.0, SMALL, SHUTTER)
    brute, shared = (AccumulationBuffer(views=32, reuse=grid)(scene, look) for grid in (0, 1))
    assert float(brute[:, 3].max()) > 0.9
    assert torch.equal(shared, brute)


def test_level_of_detail_does_not_pop(monkeypatch: pytest.MonkeyPatch) -> None:
    # The focus is pulled in small steps, through the levels 2.4 to 3.1 of a card of noise.
    scene = Scene((Sprite(texture(4, 64, 64, 0, 1.0), (0.0, 0.0, 2.0), (1.0, 1.0)),), Backdrop(plain(0.1, 0.1, 0.1)))
    mean_levels: list[float] = []
    split = setup.detail_levels

    def steps(levels) -> list[float]:
        monkeypatch.setattr(setup, "detail_levels", levels)
        mean_levels.clear()
        focus = np.linspace(1.4, 1.05, 41)
        pictures = [AccumulationBuffer(views=128, level_of_detail=1.0)(scene, camera(0.3, f)) for f in focus]
        return [rms(a, b) for a, b in pairwise(pictures)]

    def spy(*args) -> Tensor:
        levels = split(*args)
        mean_levels.append(float(levels[:, 0].double().mean()))
        return levels

    def rounded(*args) -> Tensor:
        levels = spy(*args).double()
        return levels.mean(0, keepdim=True).round().long().expand(len(levels), -1)

    smooth = steps(spy)
    assert mean_levels[0] < 2.5
    assert mean_levels[-1] > 3.0
    assert max(smooth) < 2.5 * np.median(smooth)
    jumping = steps(rounded)
    assert max(jumping) > 5 * np.median(jumping)


def test_level_of_detail_is_a_trade() -> None:
    scene = Scene((Sprite(texture(4, 64, 64, 0, 1.0), (0.0, 0.0, 4.0), (2.0, 2.0)),), Backdrop(plain(0.2, 0.1, 0.1)))
    reference = AccumulationBuffer(views=2048)(scene, camera(0.4, 1.5))
    errors = [
        rms(AccumulationBuffer(views=256, level_of_detail=level)(scene, camera(0.4, 1.5)), reference)
        for level in (0.0, 0.5, 1.0)
    ]
    assert errors[0] < errors[1] < errors[2] < 0.3 * float(reference.std())


@pytest.mark.parametrize("settings", [{}, {"reuse": 2}])
def test_subsamples_are_nearer_to_the_reference_than_none(settings: dict[str, float]) -> None:
    rows = [(-0.3, 1.0, 0.4), (0.2, 1.2, 0.3), (0.6, 4.0, 1.5), (-0.6, 6.0, 2.0)]
    pieces = [
        Sprite(texture(4, 24, 32, k, 1.0), (x, 0.0, z), (wide, wide), rotation=(0.0, 0.4, 0.3))
        for k, (x, z, wide) in enumerate(rows)
    ]
    scene, look = Scene(tuple(pieces), SKY), camera(0.15, 2.0)
    reference = AccumulationBuffer(views=1024)(scene, look)
    for count in (8, 16, 32):
        without, with_them = (
            rms(AccumulationBuffer(views=count, subsamples=s, **settings)(scene, look), reference) for s in (0, 4)
        )
        assert with_them < 0.9 * without


def test_missed_rays_see_the_sky_but_not_a_wall() -> None:
    # One view, blurred over the whole lens: what the red card hid is nowhere in the picture.
    red, blue = plain(1, 0, 0, 1), plain(0, 0, 1)
    look = camera(0.3, 2.0)
    assert coc_at(look, 1.0) < -3
    sums, errors = {}, {}
    for name, behind in {"sky": Backdrop(blue), "wall": Backdrop(blue, 3.0), "nothing": None}.items():
        scene = Scene((Sprite(red, (0.0, 0.0, 1.0), (0.2, 0.2)),), behind)
        reference = AccumulationBuffer(views=1024)(scene, look)
        one = AccumulationBuffer(views=1, subsamples=32)(scene, look)
        sums[name] = float(one[:, 0].sum() / reference[:, 0].sum())
        errors[name] = rms(one, reference)
        assert errors[name] < rms(AccumulationBuffer(views=1)(scene, look), reference)
        assert bool((one[:, 3] >= 0).all() and (one[:, 3] <= 1 + 1e-6).all())
    assert sums["sky"] == pytest.approx(1, abs=0.02)
    assert sums["nothing"] == pytest.approx(1, abs=0.02)
    # Case I of the text: blocked, so that the card grows outwards and keeps its own place.
    assert 1.1 < sums["wall"] < 1.3
    assert errors["sky"] < 0.4 * errors["wall"]


def test_missed_rays_are_blocked_where_the_sky_is_hidden() -> None:
    near, far = plain(1, 0, 0, 1), plain(0, 1, 0, 1)
    cards = (Sprite(near, (0.0, 0.0, 1.0), (0.2, 0.2)), Sprite(far, (0.0, 0.0, 3.0), (9.0, 9.0)))
    one = AccumulationBuffer(views=1, subsamples=32)(Scene(cards, Backdrop(plain(0, 0, 1))), camera(0.3, 2.0))
    assert float(one[:, 2].max()) == 0  # no blue light leaks
    assert bool((one[:, 0] > 0.1).float().mean() > 0.1)


@pytest.mark.parametrize("settings", [{}, {"reuse": 2}, {"level_of_detail": 1.0}, {"subsamples": 4}])
def test_without_a_backdrop_alpha_is_coverage(settings: dict[str, float]) -> None:
    scene, look = Scene(cards()), camera(0.3, 1.5)
    alpha = AccumulationBuffer(views=64, **settings)(scene, look)[0, 3]
    want = AccumulationBuffer(views=1024)(scene, look)[0, 3]
    assert float(want[0, 0]) == float(alpha[0, 0]) == 0
    assert bool(((want > 0.05) & (want < 0.95)).float().mean() > 0.2)
    assert rms(alpha, want) < 0.05


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.float16])
def test_every_technique_on_every_device_and_dtype(device: str, dtype: torch.dtype) -> None:
    scene, look = Scene(cards(1.0, 30.0), SKY), camera(0.5, 1.5, (12, 16), SHUTTER)
    other = Scene(
        tuple(Sprite(**{**vars(s), "texture": s.texture.to(device, dtype)}) for s in scene.sprites),
        Backdrop(SKY.texture.to(device, dtype), SKY.distance, SKY.width),
    )
    for settings in ({}, {"reuse": 2}, {"level_of_detail": 1.0}, {"subsamples": 3}, {"reuse": 1, "subsamples": 3}):
        got = AccumulationBuffer(views=20, **settings)(other, look)
        assert got.dtype == torch.promote_types(dtype, torch.float32)
        assert got.device.type == device
        want = AccumulationBuffer(views=20, **settings)(scene, look)
        # Rays that graze an edge may go either way.
        assert float((got.cpu().float() - want).abs().median()) < 3e-3
        assert rms(got.cpu().float(), want) < 0.02


@pytest.mark.parametrize("settings", [{}, {"reuse": 2}, {"level_of_detail": 1.0}, {"subsamples": 3}])
def test_odd_scenes(settings: dict[str, float]) -> None:
    white = plain(1, 1, 1, 1, side=4)
    scenes = {
        "empty": Scene(()),
        "behind the camera": Scene((Sprite(white, (0.0, 0.0, -2.0), (1.0, 1.0)),)),
        "edge-on": Scene((Sprite(white, (0.0, 0.0, 2.0), (1.0, 1.0), rotation=(0.0, math.pi / 2, 0.0)),)),
        "floor through the lens": Scene((Sprite(white, (0.0, 0.3, 0.0), (4.0, 4.0), rotation=(math.pi / 2, 0, 0)),)),
        "backdrop alone": Scene((), SKY),
    }
    seen = {}
    for name, scene in scenes.items():
        seen[name] = AccumulationBuffer(views=16, **settings)(scene, camera(1.4, 2.0, SMALL))
        assert seen[name].shape == (1, 4, *SMALL)
        assert bool(seen[name].isfinite().all())
    assert all(not seen[name].any() for name in ("empty", "behind the camera"))
    assert float(seen["edge-on"].max()) < 0.2
    assert float(seen["floor through the lens"][0, 3, -1].min()) == 1.0
    assert float(seen["floor through the lens"][0, 3, :8].max()) == 0.0
    assert float(seen["backdrop alone"][:, 3].min()) > 1 - 1e-6


@pytest.mark.parametrize("settings", [{}, {"level_of_detail": 0.5, "reuse": 1, "subsamples": 2}], ids=str)
def test_gradient_reaches_the_textures(settings: dict[str, float]) -> None:
    wall = Backdrop(texture(3, 4, 4, 1).double(), 4.0)
    focus = torch.nn.Parameter(torch.tensor(1.5))  # one that is being learned elsewhere is no obstacle
    look = Camera(ThinLens(0.05, 0.5, focus, 0.036), (6, 8))

    def render(rgba: Tensor) -> Tensor:
        card = Sprite(rgba, (0.0, 0.0, 2.0), (0.8, 0.8), (0.1, 0.3, 0.0))
        return AccumulationBuffer(views=3, **settings)(Scene((card,), wall), look)

    rgba = (0.2 + 0.5 * texture(4, 5, 5, 0, 1.0)).double().requires_grad_()
    assert torch.autograd.gradcheck(render, (rgba,), fast_mode=True)
