"""Training of the integration network: its pictures, its errors, and that it learns."""

import doctest

import pytest
import torch

import torchbokeh.learn.training
from torchbokeh.learn.integration import FFTIntegrator, PyramidIntegrator
from torchbokeh.learn.training import KINDS, MARGIN, fit_integrator, laplacian_pictures, relative_errors


@pytest.mark.parametrize("kind", KINDS)
def test_pictures_are_those_of_their_seed_within_an_empty_margin(kind: str) -> None:
    pictures = laplacian_pictures(kind, 3, 24, seed=5)
    assert pictures.shape == (1, 3, 24 + 2 * MARGIN, 24 + 2 * MARGIN)
    assert pictures.dtype == torch.float64
    assert torch.equal(pictures, laplacian_pictures(kind, 3, 24, seed=5))
    assert not torch.equal(pictures, laplacian_pictures(kind, 3, 24, seed=6))
    assert bool(pictures.isfinite().all())
    inside = torch.zeros_like(pictures)
    inside[..., MARGIN:-MARGIN, MARGIN:-MARGIN] = 1
    assert float((pictures * (1 - inside)).abs().max()) == 0
    assert float((pictures * inside).flatten(2).std(2).min()) > 0.01
    assert (float(pictures.max()) == 100) == (kind == "spikes")


def test_an_unknown_kind_is_named() -> None:
    with pytest.raises(ValueError, match="kind: expected one of discs, noise, smooth, spikes, got 'stripes'"):
        laplacian_pictures("stripes", 1, 8, seed=0)
    with pytest.raises(ValueError, match="levels: expected at least 1, got 0"):
        next(fit_integrator(levels=0))


def test_errors_are_relative() -> None:
    pictures = laplacian_pictures("discs", 2, 24, seed=1)
    exact, far = relative_errors(FFTIntegrator(), pictures)
    assert exact < 1e-9
    assert far < 1e-9
    half, far = relative_errors(lambda b: FFTIntegrator()(b) / 2, pictures)
    assert half == pytest.approx(0.5)
    assert far < 1e-9
    shift = pictures.abs().sum((2, 3), keepdim=True) / 24**2
    _, far = relative_errors(lambda b: FFTIntegrator()(b) + 0.1 * shift, pictures)
    assert far == pytest.approx(0.1)


def test_it_learns_from_the_published_kernels() -> None:
    found = list(fit_integrator(levels=2, steps=2, sizes=[24]))
    losses = [loss for loss, _ in found]
    assert losses[1] < 0.8 * losses[0]
    trained = found[-1][1]
    assert trained.h1.shape == (2, 6)
    unseen = laplacian_pictures("noise", 2, 50, seed=99)
    assert relative_errors(trained, unseen)[0] < 0.7 * relative_errors(PyramidIntegrator("published"), unseen)[0]


def test_docstring_examples() -> None:
    assert doctest.testmod(torchbokeh.learn.training).failed == 0
