import pytest
import torch

from torchbokeh.report.internals import QUALITY_NAMES
from torchbokeh.report.speed.methods import Method, own_methods, own_name


def method(**settings):
    return Method("m", "f", "d", lambda image, coc: image, lambda coc: 1e-3 * coc.numel(), **settings)


def test_own_methods_are_the_qualities():
    assert list(own_methods()) == [own_name(quality) for quality in QUALITY_NAMES]


@pytest.mark.parametrize("quality", QUALITY_NAMES)
def test_own_methods_blur_one_layer(quality):
    image, coc = torch.full((1, 3, 24, 32), 0.5), torch.linspace(-6, 6, 32).expand(1, 1, 24, 32).contiguous()
    own = own_methods()[own_name(quality)]
    torch.testing.assert_close(own.run(image, coc), image, rtol=1e-3, atol=1e-3)
    assert own.obstacle(coc, cap=10.0) is None


def test_more_threads_take_less_time():
    coc = torch.zeros(1, 1, 40, 50)  # two seconds of one thread
    torch.set_num_threads(1)
    assert "about 2 s" in method().obstacle(coc, cap=1.5)
    torch.set_num_threads(2)
    assert method().obstacle(coc, cap=1.5) is None


def test_a_fixed_kernel_needs_one_depth():
    assert method(one_depth=True).obstacle(torch.ones(1, 1, 4, 4), cap=1.0) is None
    assert method(one_depth=True).obstacle(torch.rand(1, 1, 4, 4), cap=1.0) is not None
