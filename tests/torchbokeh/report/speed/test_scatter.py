"""The compiled baselines against the obvious loops."""

import math

import numpy as np
import pytest
import torch

from torchbokeh.ops.splat import splat_spans
from torchbokeh.psfs import Disc
from torchbokeh.report.speed.discs import disc

scatter = pytest.importorskip("torchbokeh.report.speed.scatter", reason="the kernels need numba")


@pytest.fixture
def picture():
    """Image and signed CoC of odd sizes, larger than one tile, with a highlight."""
    draw = torch.Generator().manual_seed(0)
    image = torch.rand(1, 3, 21, 38, generator=draw)
    image[..., 7, 11] = 50.0
    coc = 6 * (2 * torch.rand(1, 1, 21, 38, generator=draw) - 1)
    coc[..., :9] = 0.0
    return image, coc


def brute_scatter(image, coc):
    """Every pixel adds its disc, radii rounded to the table's steps."""
    height, width = image.shape[2:]
    out = np.zeros((4, height + 40, width + 40))
    for y in range(height):
        for x in range(width):
            psf = disc(round(abs(coc[0, 0, y, x].item()) * scatter.STEPS) / scatter.STEPS)
            n = len(psf) // 2
            value = np.append(image[0, :, y, x].double().numpy(), 1.0)
            out[:, y + 20 - n : y + 21 + n, x + 20 - n : x + 21 + n] += value[:, None, None] * psf
    out = out[:, 20:-20, 20:-20]
    return out[:3] / out[3]


def brute_gather(image, coc):
    """Every pixel collects from all others, whatever their distance."""
    height, width = image.shape[2:]
    radius = coc[0, 0].abs().clamp_min(0.5).double().numpy()
    y, x = np.mgrid[:height, :width]
    out = np.zeros((3, height, width))
    for v in range(height):
        for u in range(width):
            weight = np.clip(radius + 0.5 - np.hypot(y - v, x - u), 0, 1) / (math.pi * (radius**2 + 1 / 12))
            out[:, v, u] = (weight * image[0].double().numpy()).sum((1, 2)) / weight.sum()
    return out


@pytest.mark.parametrize("by_rows", [False, True])
def test_the_dense_scatter_is_the_obvious_one(picture, by_rows):
    out = scatter.dense_scatter(*picture, by_rows=by_rows)
    np.testing.assert_allclose(out[0].numpy(), brute_scatter(*picture), rtol=1e-4, atol=1e-5)


def test_the_gather_is_the_obvious_one(picture):
    np.testing.assert_allclose(scatter.gather(*picture)[0].numpy(), brute_gather(*picture), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("method", ["dense_scatter", "gather"])
def test_threads_change_nothing_but_rounding(picture, method):
    one = getattr(scatter, method)(*picture)
    torch.set_num_threads(3)
    np.testing.assert_allclose(getattr(scatter, method)(*picture).numpy(), one.numpy(), rtol=1e-5, atol=1e-6)


def test_both_are_near_the_exact_splat(picture):
    image, coc = picture
    coc = coc.sign() * 4.0  # a radius of the table, so that no rounding is in the way
    values = torch.cat([image.clamp(max=1), torch.ones_like(coc)], 1)
    exact = splat_spans(values, coc, Disc().profile(), integrate=True)
    for method in (scatter.dense_scatter, scatter.gather):
        error = (method(values[:, :3], coc) - exact[:, :3] / exact[:, 3:]).abs()
        assert error.mean() < 0.01


def test_search_windows_hold_every_disc_that_reaches_the_tile(picture):
    _, coc = picture
    reach = scatter.search_windows(coc)
    height, width = coc.shape[2:]
    assert reach.shape == (-(-height // scatter.TILE), -(-width // scatter.TILE))
    y, x = np.mgrid[:height, :width]
    radius = coc[0, 0].abs().numpy() + 0.5
    for v in range(height):
        for u in range(width):
            covers = np.hypot(y - v, x - u) < radius
            assert (radius[covers] <= reach[v // scatter.TILE, u // scatter.TILE] + 1e-5).all()


def test_search_windows_are_small_where_blur_is_small():
    coc = torch.zeros(1, 1, 64, 64)
    coc[..., 60, 60] = 10.0
    reach = scatter.search_windows(coc)
    assert reach[3, 3] == reach[2, 3] == 10.5
    assert reach[0, 0] == 1.0
