import pytest
import torch

from torchbokeh.report.scenes import photo
from torchbokeh.report.speed.autograd import DENSE, SPANS, gradient_methods, held
from torchbokeh.report.speed.methods import own_name

EXACT = own_name("exact")


def slopes(name, seen):
    """Result, and gradients to image and CoC of a loss that looks at every pixel."""
    image, coc = seen.image.clone().requires_grad_(), seen.coc.clone().requires_grad_()
    out = gradient_methods()[name].run(image, coc)
    weights = torch.rand(out.shape, generator=torch.Generator().manual_seed(0))
    (out * weights).sum().backward()
    return out.detach(), image.grad, coc.grad


@pytest.fixture(scope="module")
def odd():
    """Radii of half a pixel more than a whole number have two slopes, one on each side; here are none."""
    return photo(40, 5.0137)


def test_plain_autograd_has_the_gradients_of_the_exact_splat(odd):
    for found, wanted in zip(slopes(SPANS, odd), slopes(EXACT, odd), strict=True):
        torch.testing.assert_close(found, wanted, rtol=1e-4, atol=1e-4 * float(wanted.abs().mean()))


def test_the_dense_splat_is_nearly_the_exact_one(odd):
    """Its discs have softer edges, so that its slopes to the radii are others."""
    out, to_image, to_coc = slopes(DENSE, odd)
    wanted, wanted_to_image, _ = slopes(EXACT, odd)
    assert float((out - wanted).abs().sum() / wanted.abs().sum()) < 0.03
    assert float(torch.cosine_similarity(to_image.flatten(), wanted_to_image.flatten(), 0)) > 0.999
    assert float((to_coc != 0).double().mean()) > 0.9 * float((odd.coc.abs() > 0.5).double().mean())


def test_a_graph_over_points_grows_with_the_radius():
    narrow, wide = photo(64, 4.0).coc, photo(64, 16.0).coc
    for name in (SPANS, DENSE):
        assert held(name, wide) > 1.5 * held(name, narrow)
    assert held(EXACT, wide) == held(EXACT, narrow) < held(SPANS, narrow)


def test_what_is_held_is_about_what_the_graph_holds():
    seen = photo(64, 8.0)
    for name in (SPANS, DENSE):
        kept = {}

        def keep(t, kept=kept):
            kept[t.untyped_storage().data_ptr()] = t.untyped_storage().nbytes()
            return t

        with torch.autograd.graph.saved_tensors_hooks(keep, lambda t: t):
            out = gradient_methods()[name].run(seen.image.clone().requires_grad_(), seen.coc.clone().requires_grad_())
        assert out.requires_grad
        assert 0.7 < held(name, seen.coc) / sum(kept.values()) < 1.5
