import math

import numpy as np
import pytest
import torch

from torchbokeh.ops.splat import splat_spans
from torchbokeh.psfs import Disc
from torchbokeh.report.speed.discs import disc


@pytest.mark.parametrize("radius", [0.0, 0.3, 0.5, 0.51, 1.0, 1.5, 2.37, 7.5, 20.0])
def test_a_disc_sums_to_one_and_is_symmetric(radius):
    psf = disc(radius)
    assert psf.sum() == pytest.approx(1)
    assert psf.shape == (psf.shape[1],) * 2
    for turned in (psf[::-1], psf[:, ::-1], psf.T):
        np.testing.assert_allclose(turned, psf, atol=1e-12)
    assert psf[0].max() > 0  # no empty rim


def test_small_radii_are_the_identity():
    assert disc(0.5).tolist() == [[1.0]]


def test_inner_pixels_hold_their_share_of_the_area():
    assert disc(10.0)[10, 10] == pytest.approx(1 / (math.pi * 100), rel=1e-3)


@pytest.mark.parametrize("radius", [1.3, 4.0, 9.6])
def test_a_disc_is_that_of_the_exact_splat(radius):
    """The splat replaces each row of the disc by a rectangle of the same area: only the ends of the rows differ."""
    n = len(disc(radius)) // 2
    dot = torch.zeros(1, 1, 2 * n + 1, 2 * n + 1, dtype=torch.float64)
    dot[..., n, n] = 1
    splat = splat_spans(dot, torch.full_like(dot, radius), Disc().profile(), integrate=True)[0, 0].numpy()
    assert np.abs(splat - disc(radius)).sum() < 0.25 / radius
