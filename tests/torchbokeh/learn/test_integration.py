import doctest

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

import torchbokeh.learn.integration
from torchbokeh.learn.integration import FFTIntegrator, Integrator, PyramidIntegrator, ScanlineIntegrator
from torchbokeh.learn.training import KINDS, laplacian_pictures, relative_errors
from torchbokeh.ops.integrate import difference_x, laplacian, poisson_fft, poisson_pyramid, running_sum_x

F64 = torch.float64


BETTER = {"discs": 0.9, "noise": 0.5, "smooth": 0.95, "spikes": 0.6}
"""Share of the error of the published kernels that the trained ones stay below."""


def lopsided_pyramid() -> PyramidIntegrator:
    """A pyramid whose kernels differ, so that it is not its own transpose."""
    pyramid = PyramidIntegrator("published")
    side = torch.tensor([0.5, 0.6, 0.2])
    with torch.no_grad():
        pyramid.h2.copy_(torch.stack([side[y] * side[x] for y, x in EIGHTH])[None])
    return pyramid


EIGHTH = [(0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2)]


def whole(kernels: Tensor, reach: int) -> Tensor:
    """Kernels of which an eighth each is given, filled in by their symmetry."""
    out = torch.zeros(len(kernels), 2 * reach + 1, 2 * reach + 1, dtype=F64)
    for k, (y, x) in enumerate(EIGHTH[: kernels.shape[1]]):
        for down, right in {(a * v, b * u) for a in (1, -1) for b in (1, -1) for v, u in ((y, x), (x, y))}:
            out[:, reach + down, reach + right] = kernels[:, k].double()
    return out


INTEGRATORS: dict[str, Integrator] = {
    "scanline": ScanlineIntegrator(),
    "free": FFTIntegrator(),
    "torus": FFTIntegrator(compact=True),
    "pyramid": PyramidIntegrator(),
    "published pyramid": PyramidIntegrator("published"),
    "lopsided pyramid": lopsided_pyramid(),
}
every_integrator = pytest.mark.parametrize("integrator", INTEGRATORS.values(), ids=INTEGRATORS)


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=F64)


@every_integrator
def test_forward_and_differentiate_are_the_functions(integrator: Integrator) -> None:
    b = random(2, 3, 7, 9)
    if isinstance(integrator, ScanlineIntegrator):
        expected = running_sum_x(b)
    elif isinstance(integrator, FFTIntegrator):
        expected = poisson_fft(b, compact=integrator.compact)
    else:
        assert isinstance(integrator, PyramidIntegrator)
        h1, h2 = (whole(k.detach(), 2) for k in (integrator.h1, integrator.h2))
        g = integrator.g.detach()
        expected = poisson_pyramid(b, h1, h2, whole(g, 1 if g.shape[1] == 3 else 2))
    torch.testing.assert_close(integrator(b), expected, rtol=1e-6, atol=1e-6)
    operator = difference_x if isinstance(integrator, ScanlineIntegrator) else laplacian
    torch.testing.assert_close(integrator.differentiate(b), operator(b))


@pytest.mark.parametrize(
    ("name", "tolerance"), [("scanline", 1e-12), ("free", 1e-11), ("torus", 1e-11), ("pyramid", 0.15)]
)
def test_forward_undoes_differentiate(name: str, tolerance: float) -> None:
    y, x = torch.arange(61.0, dtype=F64)[:, None] - 29.4, torch.arange(83.0, dtype=F64) - 40.7
    disc = (torch.hypot(y, x) <= 20).to(F64)[None, None]
    integrator = INTEGRATORS[name]
    torch.testing.assert_close(integrator(integrator.differentiate(disc)), disc, atol=tolerance, rtol=0)


@every_integrator
@given(st.tuples(st.integers(1, 2), st.integers(1, 2), st.integers(1, 17), st.integers(1, 17)), st.integers(0, 2**32))
@settings(deadline=None, max_examples=15)
def test_adjoint_is_the_transpose(integrator: Integrator, size: tuple[int, ...], seed: int) -> None:
    b, u = random(*size, seed=seed), random(*size, seed=seed + 1)
    left, right = (integrator(b) * u).sum(), (b * integrator.adjoint(u)).sum()
    torch.testing.assert_close(left, right, rtol=1e-9, atol=1e-9)


def test_adjoint_of_the_running_sum_runs_backwards() -> None:
    u = torch.tensor([[[[1.0, 2.0, 4.0]]]])
    assert ScanlineIntegrator().adjoint(u).tolist() == [[[[7.0, 6.0, 4.0]]]]


@every_integrator
def test_adjoint_without_and_with_autograd(integrator: Integrator) -> None:
    u = random(1, 2, 6, 5).requires_grad_()
    adjoint = integrator.adjoint(u)
    with torch.no_grad():
        torch.testing.assert_close(integrator.adjoint(u), adjoint.detach())
    with torch.inference_mode():
        torch.testing.assert_close(integrator.adjoint(u), adjoint.detach())
    b = random(1, 2, 6, 5, seed=1)
    (gradient,) = torch.autograd.grad((adjoint * b).sum(), u)  # the transpose of the transpose
    torch.testing.assert_close(gradient, integrator(b))


@every_integrator
@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision(integrator: Integrator, dtype: torch.dtype) -> None:
    u = random(1, 2, 15, 14).to(dtype)
    for operator in (integrator, integrator.differentiate, integrator.adjoint):
        out, expected = operator(u), operator(u.to(F64))
        assert out.dtype == dtype
        assert ((out.to(F64) - expected).abs() <= 0.02 * expected.abs().max()).all()


def test_pyramid_has_eighths_of_kernels_as_parameters() -> None:
    for weights, levels, last in (("published", 1, 3), ("trained", 5, 6)):
        state = {name: tuple(value.shape) for name, value in PyramidIntegrator(weights).state_dict().items()}
        assert state == {"h1": (levels, 6), "h2": (levels, 6), "g": (levels, last)}
    assert not list(ScanlineIntegrator().parameters())
    assert not list(FFTIntegrator().parameters())
    again = PyramidIntegrator("published")
    again.load_state_dict(lopsided_pyramid().state_dict())
    b = random(1, 1, 9, 8)
    torch.testing.assert_close(again(b), lopsided_pyramid()(b))
    with pytest.raises(ValueError, match="weights: expected 'trained' or 'published', got 'mine'"):
        PyramidIntegrator("mine")


def test_published_kernels_are_those_of_farbman() -> None:
    b, (h, g) = random(1, 1, 33, 20), (torch.tensor([0.15, 0.5, 0.7, 0.5, 0.15]), torch.tensor([0.175, 0.547, 0.175]))
    torch.testing.assert_close(PyramidIntegrator("published")(b), poisson_pyramid(b, *(k.double() for k in (h, h, g))))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("size", [48, 131])
def test_trained_kernels_are_better_where_they_were_not_trained(kind: str, size: int) -> None:
    pictures = laplacian_pictures(kind, 4, size, seed=123_456).float()
    trained, published = (relative_errors(PyramidIntegrator(w), pictures) for w in ("trained", "published"))
    assert trained[0] < BETTER[kind] * published[0]


def test_pyramid_learns_to_undo_the_laplacian_better() -> None:
    pyramid = PyramidIntegrator("published")
    u = torch.nn.functional.pad(torch.rand(1, 1, 20, 20, generator=torch.Generator().manual_seed(0)), (6, 6, 6, 6))
    optimizer = torch.optim.Adam(pyramid.parameters(), lr=1e-3)
    losses = []
    for _ in range(50):
        optimizer.zero_grad()
        loss = (pyramid(pyramid.differentiate(u)) - u).square().mean()
        loss.backward()
        assert all(p.grad is not None and p.grad.abs().min() > 0 for p in pyramid.parameters())
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.6 * losses[0]


@every_integrator
def test_bad_input_is_named(integrator: Integrator) -> None:
    for name, method in (
        ("buffer", integrator),
        ("image", integrator.differentiate),
        ("image", integrator.adjoint),
    ):
        with pytest.raises(ValueError, match=rf"^{name}: expected shape \(B, C, H, W\), got \(4,\)"):
            method(torch.zeros(4))
        with pytest.raises(TypeError, match=rf"^{name}: expected a tensor of shape \(B, C, H, W\), got list"):
            method([0.0])


def test_base_class_is_abstract() -> None:
    with pytest.raises(NotImplementedError):
        Integrator()(torch.zeros(1, 1, 2, 2))


def test_repr_shows_the_configuration() -> None:
    assert repr(FFTIntegrator(compact=True)) == "FFTIntegrator(compact=True)"


def test_examples_in_the_documentation() -> None:
    result = doctest.testmod(torchbokeh.learn.integration)
    assert result.attempted > 6
    assert result.failed == 0


@every_integrator
@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_autocast_changes_nothing(integrator: Integrator, dtype: torch.dtype) -> None:
    b = random(1, 2, 9, 12).float()
    with torch.autocast("cpu", dtype=dtype):
        out = integrator(b)
    assert torch.equal(out, integrator(b))
