"""Reconstruction from stochastic samples: limits, conservation, linearity, and the picture the samples are of."""

import math

import pytest
import torch
from torch import Tensor

from torchbokeh import AccumulationBuffer, KernelSplatting, ThinLens
from torchbokeh.picture.samples import Samples, pinhole_position
from torchbokeh.psfs import PsfBank
from torchbokeh.psfs.combined import capsule
from torchbokeh.renderers.reconstruction import reconstruct
from torchbokeh.report.measure import errors
from torchbokeh.scenes import Backdrop, Camera, Scene, Sprite, samples, whirl

CHANNELS = {"colour": 3, "position": 2, "lens": 2, "time": 1, "coc": 1, "motion": 2}


def pixels(height: int, width: int) -> Tensor:
    y, x = torch.meshgrid(torch.arange(float(height)), torch.arange(float(width)), indexing="ij")
    return torch.stack([x, y])


def still(colour: Tensor, coc: float = 0.0, motion: tuple[float, float] = (0.0, 0.0)) -> Samples:
    """Samples ``(B, S, 3, H, W)`` in the middle of pixel, lens and shutter: a plain picture."""
    b, s, _, h, w = colour.shape
    maps = {name: colour.new_zeros(b, s, count, h, w) for name, count in CHANNELS.items()}
    maps["position"] += pixels(h, w).to(colour)
    maps["coc"] += coc
    maps["motion"] += colour.new_tensor(motion)[:, None, None]
    return Samples(**{**maps, "colour": colour}, present=torch.ones(b, s, 1, h, w, dtype=torch.bool))


def scattered(flat: Samples, seed: int) -> Samples:
    """The same surface, sampled at random points of pixel, lens and shutter."""
    draw = torch.Generator().manual_seed(seed)

    def uniform(like: Tensor) -> Tensor:
        return torch.rand(like.shape, generator=draw, dtype=like.dtype) - 0.5

    angle, radius = 2 * math.pi * uniform(flat.time), (uniform(flat.time) + 0.5).sqrt()
    lens = radius * torch.cat([angle.cos(), angle.sin()], 2)
    return flat._replace(position=flat.position + uniform(flat.position), lens=lens, time=uniform(flat.time))


def noise(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
    return torch.rand(*shape, dtype=dtype, generator=torch.Generator().manual_seed(3))


def l1(a: Tensor, b: Tensor) -> float:
    return float((a - b).abs().sum() / b.abs().sum())


def test_a_plain_picture_is_splatted_as_ever() -> None:
    bank = PsfBank.load("combined")
    colour = noise(2, 1, 3, 30, 40)
    one = still(colour, 4.0, (9.0, -5.0))
    want = KernelSplatting(bank=bank, quality="exact")(colour[:, 0], one.coc[:, 0], motion=one.motion[:, 0])
    torch.testing.assert_close(reconstruct(one, bank=bank, layers=1), want, rtol=1e-5, atol=1e-6)
    # Twice the same samples are as good as once.
    twice = Samples(*(torch.cat([t, t], 1) for t in one))
    torch.testing.assert_close(reconstruct(twice, bank=bank, layers=1), want, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("layers", [1, 4])
def test_a_constant_picture_stays_constant(layers: int) -> None:
    colour = torch.tensor([0.2, 0.7, 3.0])[:, None, None].expand(1, 2, 3, 24, 32)
    one = scattered(still(colour, 0.0, (6.0, 2.0)), 1)
    one = one._replace(
        coc=16 * noise(1, 2, 1, 24, 32) - 8,
        present=noise(1, 2, 1, 24, 32) > 0.3,
        colour=torch.where(noise(1, 2, 1, 24, 32) > 0.3, colour, torch.nan),
    )
    torch.testing.assert_close(reconstruct(one, layers=layers), colour[:, 0], rtol=1e-4, atol=0)


def test_scattered_samples_of_a_light_make_one_psf_not_two() -> None:
    radius, motion, light = 5.0, (8.0, 0.0), 50.0
    flat = still(torch.zeros(1, 16, 3, 41, 49), radius, motion)
    one = scattered(flat, 2)
    home = pinhole_position(one)
    lit = ((home - torch.tensor([24.0, 20.0])[:, None, None]).abs() <= 0.5).all(2, keepdim=True)
    one = one._replace(colour=light * lit.float().expand_as(one.colour))
    psf = torch.from_numpy(capsule(radius, math.hypot(*motion))).float()
    want = torch.zeros(1, 3, 41, 49)
    h, w = psf.shape[1:]
    want[..., 20 - h // 2 : 21 + h // 2, 24 - w // 2 : 25 + w // 2] = light * psf
    again = one._replace(lens=flat.lens, time=flat.time)
    found = {name: l1(p, want) for name, p in (("one", reconstruct(one)), ("two", reconstruct(again)))}
    assert found["one"] < 0.25  # what is left is noise, of some 16 samples of the light
    assert found["two"] > 0.5
    assert l1(one.colour.mean(1), want) > 0.6


def test_it_is_linear_in_the_colours() -> None:
    one = scattered(still(noise(1, 2, 3, 14, 17, dtype=torch.float64), 0.0, (4.0, 3.0)), 3)
    coc, present = 12 * noise(1, 2, 1, 14, 17, dtype=torch.float64) - 6, noise(1, 2, 1, 14, 17) > 0.4
    one = one._replace(coc=coc, present=present)
    colour, aim = one.colour.clone().requires_grad_(), noise(1, 3, 14, 17, dtype=torch.float64)
    (adjoint,) = torch.autograd.grad((aim * reconstruct(one._replace(colour=colour))).sum(), colour)
    other = noise(2, 2, 3, 14, 17, dtype=torch.float64)[1:]
    # Asked for a gradient, no pixel is left out for being 0, so that the padding of both is the same.
    want = (aim * reconstruct(one._replace(colour=other.requires_grad_()))).sum()
    torch.testing.assert_close((adjoint * other).sum(), want, rtol=1e-9, atol=0)
    assert float(adjoint[~present.expand_as(adjoint)].abs().max()) == 0


@pytest.mark.parametrize("name", ["position", "time", "coc", "motion"])
def test_gradients_to_the_geometry_are_its_derivatives(name: str) -> None:
    one = scattered(still(noise(1, 1, 3, 12, 13, dtype=torch.float64), 4.0, (5.0, 3.0)), 3)
    one = one._replace(coc=one.coc - 9 * noise(1, 1, 1, 12, 13, dtype=torch.float64))
    aim = noise(1, 3, 12, 13, dtype=torch.float64)

    def found(value: Tensor) -> Tensor:
        return (aim * reconstruct(one._replace(**{name: value}))).sum()

    value = getattr(one, name).clone().requires_grad_()
    (slope,) = torch.autograd.grad(found(value), value)
    step = 1e-7 * (noise(*value.shape, dtype=torch.float64) - 0.5)
    # The least and the greatest CoC say where the bins lie, which is a choice.
    step = torch.where((one.coc > one.coc.min()) & (one.coc < one.coc.max()), step, 0.0)
    with torch.no_grad():
        want = (found(value + step) - found(value - step)) / 2
    torch.testing.assert_close((slope * step).sum(), want, rtol=1e-3, atol=0)


def test_the_mean_of_many_noisy_pictures_is_that_of_many_samples() -> None:
    scene, camera = whirl(2, (40, 40))
    want = reconstruct(samples(scene, camera, 64, seed=1))
    single = [reconstruct(samples(scene, camera, 1, seed=100 + k)) for k in range(16)]
    noisy, mean = l1(single[0], want), l1(torch.stack(single).mean(0), want)
    assert mean < 0.03
    assert mean < 0.4 * noisy  # a quarter, but for the noise of 64 samples


def test_it_comes_near_the_truth_from_one_sample_per_pixel() -> None:
    scene, camera = whirl(2, (64, 64))
    truth = AccumulationBuffer(views=512)(scene, camera)[:, :3]
    found = samples(scene, camera)
    ours, noisy = (errors(p, truth, flip=False)["ssim"] for p in (reconstruct(found), found.colour.mean(1)))
    assert noisy is not None
    assert noisy < 0.5
    assert ours is not None
    assert ours > 0.9


def test_layers_keep_light_from_behind_off_a_sharp_edge() -> None:
    wall, card = torch.ones(3, 4, 4), torch.zeros(4, 64, 64)
    card[3] = 1
    camera = Camera(ThinLens(0.05, 0.1, 2.0, 0.036), (32, 32), 0.0)
    scene = Scene((Sprite(card, (-1.0, 0.0, 2.0), (2.0, 9.0)),), Backdrop(wall))
    found = samples(scene, camera, 4)
    assert float(found.coc.max()) > 5
    truth = AccumulationBuffer(views=256)(scene, camera)[:, :3]
    inside = truth[..., :14]
    assert float(inside.max()) < 1e-3
    one, four = (reconstruct(found, layers=n)[..., :14].mean() for n in (1, 4))
    assert float(one) > 0.02
    assert float(four) < 0.4 * float(one)


def test_holes_are_filled_from_their_surroundings() -> None:
    colour = pixels(16, 20)[:1].expand(1, 1, 3, 16, 20).clone()
    one = still(colour)
    present = one.present.clone()
    present[..., 6:9, 9:12] = False
    found = reconstruct(one._replace(present=present, coc=torch.where(present, one.coc, torch.nan)))
    # A sample spreads to the pixels beside its own, which only evens out where it has both neighbours.
    torch.testing.assert_close(found[..., 1:5, 1:-1], colour[:, 0, :, 1:5, 1:-1], rtol=1e-5, atol=1e-5)
    hole = found[..., 6:9, 9:12]
    assert 6 < float(hole.min()) < float(hole.max()) < 14
    assert float(reconstruct(one._replace(present=torch.zeros_like(present))).abs().max()) == 0


def test_bad_arguments_are_named() -> None:
    one = still(noise(1, 2, 3, 8, 9))
    with pytest.raises(TypeError, match="samples: expected Samples, got Tensor"):
        reconstruct(one.colour)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"samples.colour: expected shape \(B, S, 3, H, W\), got \(1, 2, 1, 8, 9\)"):
        reconstruct(one._replace(colour=one.coc))
    with pytest.raises(ValueError, match=r"samples.colour: expected at least one sample, got shape \(1, 0, 3, 8, 9\)"):
        reconstruct(Samples(*(t[:, :0] for t in one)))
    with pytest.raises(TypeError, match=r"samples.present: expected a tensor of bools, got torch.float32"):
        reconstruct(one._replace(present=one.coc))
    with pytest.raises(ValueError, match=r"samples.motion: expected shape \(1, 2, 2, 8, 9\), got \(1, 2, 1, 8, 9\)"):
        reconstruct(one._replace(motion=one.coc))
    with pytest.raises(ValueError, match=r"samples.coc: expected finite numbers where a sample is present, got 144 "):
        reconstruct(one._replace(coc=one.coc + torch.inf))
    with pytest.raises(ValueError, match=r"samples.position: expected points within their own pixels, got one 0.6"):
        reconstruct(one._replace(position=one.position + 0.6))
    with pytest.raises(TypeError, match="bank: expected a PsfBank or None, got str"):
        reconstruct(one, bank="combined")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="bank: expected PSFs of one channel, got 3"):
        reconstruct(one, bank=PsfBank.load("physical-lens"))
    with pytest.raises(TypeError, match="layers: expected an int, got True"):
        reconstruct(one, layers=True)
    with pytest.raises(ValueError, match="layers: expected at least 1, got 0"):
        reconstruct(one, layers=0)
