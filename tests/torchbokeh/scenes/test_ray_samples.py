"""Samples of a scene: against the accumulation buffer, and against where and what was put up."""

import math

import pytest
import torch
from torch import Tensor

from torchbokeh import AccumulationBuffer, ThinLens
from torchbokeh.picture.samples import Samples, pinhole_position
from torchbokeh.scenes import Backdrop, Camera, Scene, Sprite, samples

SHUTTER, DOT = 1 / 50, 0.01


def camera(size: tuple[int, int] = (24, 32), f_number: float = 1.0, focus: float = 2.0) -> Camera:
    return Camera(ThinLens(0.05, f_number, focus, 0.036), size, SHUTTER)


def plain(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float32)[:, None, None].expand(-1, 8, 8).clone()


def dot(z: float, velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Scene:
    """A white dot, a centimetre across for each metre of distance, before a black sky."""
    card = Sprite(plain(1, 1, 1, 1), (0.02 * z, -0.01 * z, z), (DOT * z, DOT * z), velocity=velocity)
    return Scene((card,), Backdrop(plain(0, 0, 0)))


def seen(found: Samples, name: str, where: Tensor) -> Tensor:
    """The values ``(N, C)`` of a map where ``(1, S, 1, H, W)``."""
    return getattr(found, name).movedim(2, -1)[where[:, :, 0]]


def test_their_mean_is_the_picture() -> None:
    generator = torch.Generator().manual_seed(1)
    noise = torch.rand(3, 4, 9, 9, generator=generator)
    noise[:, :3] *= noise[:, 3:]
    cards = tuple(
        Sprite(t, (x, 0.1 * x, z), (0.5, 0.6), (0.4, -0.5, 0.3), (x / SHUTTER, 0.0, 1.0), (3.0, 0.0, 20.0), emission=2)
        for t, x, z in zip(noise, (-0.2, 0.0, 0.3), (1.4, 2.0, 3.0), strict=True)
    )
    scene = Scene(cards, Backdrop(torch.rand(3, 6, 8, generator=generator), 6.0, 0.3))
    want = AccumulationBuffer(views=2048)(scene, camera())[:, :3]
    found = samples(scene, camera(), 256)
    assert bool(found.present.all())
    # 256 independent samples of a spread of 0.4 would be off by 0.025.
    assert float((found.colour.mean(1) - want).square().mean().sqrt()) < 0.02


@pytest.mark.parametrize("depth", [1.2, 2.0, 5.0])
def test_samples_of_a_moving_dot_map_back_to_one_point(depth: float) -> None:
    look = camera((48, 64))
    way = 12.0 * depth / look.focal_px  # in metres, for 12 px
    found = samples(dot(depth, (way / SHUTTER, -0.5 * way / SHUTTER, 0.0)), look, 64)
    hit = found.colour[:, :, :1] > 0
    centre = torch.tensor([32 + 0.02 * look.focal_px, 24 - 0.01 * look.focal_px]) - 0.5
    middle = pinhole_position(found).movedim(2, -1)[hit[:, :, 0]]
    assert len(middle) > 30
    assert float((middle - centre).abs().max()) < 0.5 * 9 / 8 * DOT * look.focal_px + 1e-3  # half the dot and its rim
    spread = seen(found, "position", hit).std(0)
    radius = abs(float(look.lens.coc(torch.tensor([[depth]]), 64)))
    for axis, length in enumerate((12.0, 6.0)):  # variance of a disc, and of a segment
        assert float(spread[axis]) == pytest.approx(math.sqrt(radius**2 / 4 + length**2 / 12), rel=0.25)
    torch.testing.assert_close(seen(found, "motion", hit), torch.tensor([[12.0, -6.0]]).expand(len(middle), 2))
    assert float((seen(found, "coc", hit).abs() - radius).abs().max()) < 1e-4


def test_coc_is_that_of_the_depth_where_the_ray_met_it() -> None:
    scene = Scene((Sprite(plain(1, 0, 0, 1), (-0.6, 0.0, 2.5), (1.2, 4.0)),), Backdrop(plain(0, 1, 0)))
    found = samples(scene, camera(), 4)
    red = found.colour[:, :, :1] > 0.5
    for where, depth in ((red, 2.5), (~red, math.inf)):
        want = camera().lens.coc(torch.tensor([[depth]]), 32)
        assert bool(where.any())
        torch.testing.assert_close(seen(found, "coc", where), want.expand(int(where.sum()), 1))
    assert float(found.motion.abs().max()) == 0


def test_a_translucent_card_stops_its_share_of_the_rays() -> None:
    scene = Scene((Sprite(plain(0.15, 0, 0, 0.3), (0.0, 0.0, 2.0), (9.0, 9.0)),), Backdrop(plain(0, 1, 0), 4.0))
    found = samples(scene, camera(), 64)
    colours = found.colour.movedim(2, -1).reshape(-1, 3)
    card = colours[:, 0] > 0
    torch.testing.assert_close(colours[card], torch.tensor([[0.5, 0.0, 0.0]]).expand(int(card.sum()), 3))
    torch.testing.assert_close(colours[~card], torch.tensor([[0.0, 1.0, 0.0]]).expand(int((~card).sum()), 3))
    assert float(card.double().mean()) == pytest.approx(0.3, abs=0.005)


def test_points_are_spread_evenly_over_pixel_lens_and_shutter() -> None:
    found = samples(dot(3.0), camera((5, 6)), 16)
    y, x = torch.meshgrid(torch.arange(5.0), torch.arange(6.0), indexing="ij")
    inside = found.position - torch.stack([x, y])
    assert float(inside.abs().max()) <= 0.5 + 1e-5
    assert float(found.lens.norm(dim=2).max()) <= 1 + 1e-6
    assert found.time.min() >= -0.5
    assert found.time.max() <= 0.5
    for values in (found.time[0, :, 0], inside[0, :, 0], inside[0, :, 1]):
        torch.testing.assert_close(values.sort(0)[0].diff(dim=0), torch.full((15, 5, 6), 1 / 16), rtol=0, atol=1e-5)
    # Equal areas of the disc are met equally often: the squared radius is uniform.
    assert float(found.lens.square().sum(2).mean()) == pytest.approx(0.5, abs=0.01)
    assert float(found.lens.mean((1, 3, 4)).abs().max()) < 0.03


def test_a_seed_gives_the_same_samples_with_any_number_of_threads() -> None:
    scene, threads = dot(3.0), torch.get_num_threads()
    first = samples(scene, camera(), 3, seed=5)
    try:
        torch.set_num_threads(3)
        again = samples(scene, camera(), 3, seed=5)
    finally:
        torch.set_num_threads(threads)
    assert all(torch.equal(a, b) for a, b in zip(first, again, strict=True))
    assert not torch.equal(first.lens, samples(scene, camera(), 3, seed=6).lens)


def test_what_meets_nothing_is_not_present() -> None:
    scene = Scene((Sprite(plain(1, 1, 1, 1), (0.0, 0.0, -1.0), (9.0, 9.0)), *dot(3.0).sprites))
    found = samples(scene, camera(), 8)
    assert 0 < int(found.present.sum()) < 100
    assert float(found.colour[found.present.expand_as(found.colour)].min()) == 1


def test_bad_arguments_are_named() -> None:
    with pytest.raises(TypeError, match="scene: expected a Scene, got str"):
        samples("coins", camera())  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="camera: expected a Camera, got NoneType"):
        samples(dot(3.0), None)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="scene: expected at least one card or a backdrop, got none"):
        samples(Scene(()), camera())
    with pytest.raises(ValueError, match="per_pixel: expected at least 1, got 0"):
        samples(dot(3.0), camera(), 0)
    with pytest.raises(TypeError, match=r"per_pixel: expected an int, got 1\.5"):
        samples(dot(3.0), camera(), 1.5)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="seed: expected 0 or more, got -1"):
        samples(dot(3.0), camera(), seed=-1)
