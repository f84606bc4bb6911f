import pytest
import torch

from torchbokeh.ops.splat import splat_spans
from torchbokeh.psfs import Disc
from torchbokeh.report.speed.baselines import _one_kernel
from torchbokeh.report.speed.discs import disc
from torchbokeh.report.speed.layered import bins, direct_convolution, fft_convolution, layer_work, layered

JOINS = ("over", "over, normalised", "sum, normalised")


@pytest.fixture
def picture():
    draw = torch.Generator().manual_seed(1)
    coc = 5 * (2 * torch.rand(1, 1, 5, 7, generator=draw) - 1)
    coc = torch.nn.functional.interpolate(coc, (30, 41), mode="bilinear")
    return torch.rand(1, 3, 30, 41, generator=draw), coc


@pytest.mark.parametrize("radius", [0.7, 3.2, 25.0, 60.0])
def test_both_convolutions_are_the_same(radius):
    """The largest kernel is wider than the picture."""
    planes = torch.rand(2, 4, 17, 23, dtype=torch.float64)
    kernel = torch.from_numpy(disc(radius))
    torch.testing.assert_close(fft_convolution(planes, kernel), direct_convolution(planes, kernel))


def test_a_convolution_turns_no_kernel_around():
    planes = torch.zeros(1, 1, 9, 9, dtype=torch.float64)
    planes[..., 4, 4] = 1
    kernel = torch.arange(9, dtype=torch.float64).reshape(3, 3)
    for convolve in (fft_convolution, direct_convolution):
        torch.testing.assert_close(convolve(planes, kernel)[0, 0, 3:6, 3:6], kernel)


@pytest.mark.parametrize("join", JOINS)
@pytest.mark.parametrize("layers", [1, 4, 16])
def test_by_fft_and_direct_it_is_the_same_picture(picture, join, layers):
    by_fft, direct = (
        layered(*picture, layers=layers, join=join, convolve=convolve)
        for convolve in (fft_convolution, direct_convolution)
    )
    torch.testing.assert_close(by_fft, direct, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("join", JOINS)
def test_constant_in_constant_out_where_it_is_normalised(picture, join):
    out = layered(torch.full_like(picture[0], 0.7), picture[1], layers=8, join=join)
    error = (out - 0.7).abs().max()
    assert error < 1e-4 if "normalised" in join else error > 0.1


@pytest.mark.parametrize("radius", [-6.0, 0.2, 3.3])
def test_one_depth_is_what_kornia_does(radius):
    from kornia.filters import fft_conv, filter2d

    image, coc = torch.rand(1, 3, 24, 31), torch.full((1, 1, 24, 31), radius)
    for join in JOINS[1:]:
        out = layered(image, coc, layers=8, join=join)
        for convolve in (filter2d, fft_conv):
            torch.testing.assert_close(out, _one_kernel(image, coc, convolve), rtol=1e-4, atol=1e-5)


def test_sums_of_many_layers_come_near_the_splat(picture):
    image, coc = picture
    exact = splat_spans(torch.cat([image, torch.ones_like(coc)], 1), coc, Disc().profile(), integrate=True)
    exact = exact[:, :3] / exact[:, 3:]
    errors = [(layered(image, coc, layers=n, join="sum, normalised") - exact).abs().mean() for n in (4, 16, 64)]
    assert errors[0] > errors[1] > errors[2]
    assert errors[2] < 0.005


def test_what_is_near_covers_what_is_far():
    image = torch.zeros(1, 3, 40, 40)
    image[..., 20:] = 1.0
    coc = torch.full((1, 1, 40, 40), 0.4)
    coc[..., 20:] = -4.0  # the bright half stands in front, and reaches over the dark one
    out = layered(image, coc, layers=8)
    assert out[0, 0, 20, 18] > 0.2
    coc[..., 20:] = 4.0  # behind, it does not
    out = layered(image, coc, layers=8)
    assert out[0, 0, 20, 18] < 1e-6


def test_bins_part_the_pixels_and_leave_out_empty_ones():
    coc = torch.tensor([[[[-4.0, -3.9, 3.0, 4.0]]]])
    found = bins(coc, 8)
    assert sum(inside.int() for inside, _ in found).unique().tolist() == [1]
    assert [centre for _, centre in found] == pytest.approx([-3.5, 3.5])
    assert [centre for _, centre in bins(torch.zeros(1, 1, 2, 2), 8)] == pytest.approx([0.0], abs=1e-5)


def test_work_of_the_direct_convolution_grows_with_the_radius():
    small, large = (layer_work(torch.linspace(0, r, 4096).reshape(1, 1, 64, 64), 8) for r in (4.0, 16.0))
    assert large[1] > 8 * small[1]
    assert large[0] < 2 * small[0]


def test_an_unknown_join_is_named():
    with pytest.raises(ValueError, match="join"):
        layered(torch.rand(1, 3, 8, 8), torch.zeros(1, 1, 8, 8), layers=2, join="under")
