import importlib.util

import pytest
import torch

from torchbokeh.report.speed import baselines as module
from torchbokeh.report.speed.baselines import absent, baselines

NAMES = list(baselines())


@pytest.fixture
def without(monkeypatch):
    """Hide packages."""

    def hide(*names):
        found = importlib.util.find_spec
        monkeypatch.setattr(module, "find_spec", lambda name: None if name in names else found(name))

    return hide


@pytest.mark.parametrize("name", NAMES)
def test_shapes_and_constant_in_constant_out(name):
    method = baselines()[name]
    image, coc = torch.full((1, 3, 20, 24), 0.6), torch.full((1, 1, 20, 24), 3.3)
    if not method.one_depth:
        coc[..., 12:] = -2.1
    out = method.run(image, coc)
    assert out.shape == image.shape
    assert out.dtype == torch.float32
    if method.normalised:
        torch.testing.assert_close(out, image, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("name", NAMES)
def test_a_method_leaves_its_input_alone_and_costs_more_where_there_is_more(name):
    method = baselines()[name]
    image, coc = torch.rand(1, 3, 24, 24), torch.full((1, 1, 24, 24), 2.0)
    kept = image.clone(), coc.clone()
    method.run(image, coc)
    assert torch.equal(image, kept[0])
    assert torch.equal(coc, kept[1])
    assert 0 < method.work(coc) < method.work(torch.full((1, 1, 48, 48), 2.0))


def test_what_takes_too_long_or_does_not_apply_is_said():
    found = baselines()
    coc = torch.linspace(-30, 30, 64 * 64).reshape(1, 1, 64, 64)
    assert "one blur radius" in found["kornia filter2d"].obstacle(coc, cap=10.0)
    assert "limit of 1e-09 s" in found["layered FFT 8, over"].obstacle(coc, cap=1e-9)
    assert found["layered FFT 8, over"].obstacle(coc, cap=10.0) is None


def test_names_say_what_there_is():
    families = {method.family for method in baselines().values()}
    assert families >= {"layered FFT", "layered direct", "fixed kernel"}
    assert all(name == method.name for name, method in baselines().items())
    assert all(method.description for method in baselines().values())


def test_what_is_not_installed_is_left_out_and_named(without):
    without("numba")
    assert not any(method.family in ("dense scatter", "gather") for method in baselines().values())
    assert [line.split(":")[0] for line in absent()] == ["dense scatter and gather filter"]
