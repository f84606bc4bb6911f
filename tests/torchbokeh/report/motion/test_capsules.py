import math

import numpy as np
import pytest
import torch

pytest.importorskip("numba")

from torchbokeh.ops.dense import dense_spans
from torchbokeh.psfs import Disc
from torchbokeh.psfs.combined import capsule
from torchbokeh.renderers.reconstruction import Samples
from torchbokeh.report.motion.capsules import (
    dense_capsules,
    dense_layers,
    dense_samples,
    filter_capsules,
    over_reweighted,
)


def picture(n, radius, dx, dy):
    image = torch.ones(1, 3, n, n)
    image[..., n // 2, n // 2] += 1e4
    motion = torch.tensor([dx, dy]).view(1, 2, 1, 1).expand(1, 2, n, n).contiguous()
    return image, torch.full((1, 1, n, n), radius), motion


@pytest.mark.parametrize(("radius", "length"), [(6.0, 14.0), (2.0, 20.0), (9.0, 0.0)])
def test_a_dot_is_the_capsule(radius, length):
    n = 61
    got = ((dense_capsules(*picture(n, radius, -length, 0.0)) - 1) / 1e4)[0, 0].double().numpy()
    want = np.zeros((n, n))
    psf = capsule(radius, length)[0]
    y, x = (n - psf.shape[0]) // 2, (n - psf.shape[1]) // 2
    want[y : y + psf.shape[0], x : x + psf.shape[1]] = psf
    assert got.sum() == pytest.approx(1, abs=2e-3)
    assert np.abs(got - want).sum() < 0.08


def test_it_turns_with_the_motion():
    n, length, angle = 61, 24.0, 0.7
    got = (dense_capsules(*picture(n, 4.0, length * math.cos(angle), length * math.sin(angle)))[0, 0] - 1) / 1e4
    at = torch.arange(n) - n // 2
    along = at[None] * math.cos(angle) + at[:, None] * math.sin(angle)
    across = at[:, None] * math.cos(angle) - at[None] * math.sin(angle)
    assert float((got * along**2).sum()) == pytest.approx(4**2 / 4 + length**2 / 12, rel=0.03)
    assert float((got * across**2).sum()) == pytest.approx(4**2 / 4, rel=0.05)


def test_without_motion_it_is_the_dense_scatter_and_a_constant_stays():
    draw = torch.Generator().manual_seed(1)
    image, coc = torch.rand(1, 3, 40, 50, generator=draw), 9 * torch.rand(1, 1, 40, 50, generator=draw)
    still = torch.zeros(1, 2, 40, 50)
    values = dense_spans(torch.cat([image, torch.ones_like(coc)], 1), coc, Disc().profile())
    want = (values[:, :3] / values[:, 3:]).float()
    assert float((dense_capsules(image, coc, still) - want).abs().mean()) < 0.01  # the rim is sampled, not integrated
    moving = 20 * torch.rand(1, 2, 40, 50, generator=draw)
    torch.testing.assert_close(dense_capsules(torch.ones_like(image), coc, moving), torch.ones_like(image))


def test_the_filter_is_the_scatter_where_all_capsules_are_the_same():
    image, coc, motion = torch.rand(1, 3, 40, 50), torch.full((1, 1, 40, 50), 4.5), torch.ones(1, 2, 40, 50) * 6
    got, want = filter_capsules(image, coc, motion), dense_capsules(image, coc, motion)
    torch.testing.assert_close(got, want, atol=1e-5, rtol=1e-5)
    uneven = motion * torch.rand(1, 1, 40, 50)
    torch.testing.assert_close(filter_capsules(torch.ones_like(image), coc, uneven), torch.ones_like(image))
    assert float((filter_capsules(image, coc, uneven) - dense_capsules(image, coc, uneven)).abs().max()) > 0.01


def test_layers_that_hold_a_picture_are_the_picture():
    image, coc, motion = torch.rand(1, 3, 40, 50), torch.full((1, 1, 40, 50), 4.5), torch.ones(1, 2, 40, 50) * 6
    opaque = torch.cat([image, torch.ones_like(coc)], 1)
    empty = torch.zeros_like(opaque)
    got = dense_layers(torch.stack([empty, opaque], 1), torch.stack([coc, coc], 1), torch.stack([motion, motion], 1))
    torch.testing.assert_close(got, dense_capsules(image, coc, motion), atol=1e-5, rtol=1e-5)


def test_over_stays_within_its_colours():
    front, back = torch.rand(1, 4, 6, 7), torch.rand(1, 4, 6, 7)
    for layer in (front, back):
        layer[:, 3:] = layer[:, 3:] * 1.5
        layer[:, :3] = 0.6 * layer[:, 3:]
    torch.testing.assert_close(over_reweighted([front, back]), torch.full((1, 3, 6, 7), 0.6))


def test_samples_in_the_middle_of_everything_are_the_picture():
    image, coc, motion = torch.rand(1, 3, 20, 30), torch.full((1, 1, 20, 30), 3.5), torch.ones(1, 2, 20, 30) * 4
    at = torch.stack(torch.meshgrid(torch.arange(30.0), torch.arange(20.0), indexing="xy"))[None]
    zero, here = torch.zeros(1, 2, 20, 30), torch.ones(1, 1, 20, 30, dtype=torch.bool)
    samples = Samples(*(t[:, None] for t in (image, at, zero, zero[:, :1], coc, motion, here)))
    want = dense_capsules(image, coc, motion)
    torch.testing.assert_close(dense_samples(samples), want, atol=1e-5, rtol=1e-5)
    lens, time = torch.tensor([0.4, -0.3]).view(1, 1, 2, 1, 1), torch.full((1, 1, 1, 1, 1), 0.25)
    moved = samples._replace(lens=lens.expand(1, 1, 2, 20, 30), time=time.expand(1, 1, 1, 20, 30))
    # All belong to a place 2.4 px to the left and at the height of their pixel: 3.5 * 0.4 + 0.25 * 4, and 0.05 above.
    inside = (..., slice(6, -6), slice(8, -12))
    shifted = 0.6 * want.roll(-2, 3) + 0.4 * want.roll(-3, 3)
    assert float((dense_samples(moved)[inside] - shifted[inside]).abs().max()) < 0.02
