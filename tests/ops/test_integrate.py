import doctest
import math
from collections.abc import Callable
from functools import partial
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.nn import functional as F

import torchbokeh.ops.integrate
from torchbokeh.ops.integrate import (
    difference_x,
    laplacian,
    lattice_green,
    poisson_fft,
    poisson_pyramid,
    running_sum_x,
)

F64 = torch.float64
FARBMAN = (
    torch.tensor([0.15, 0.5, 0.7, 0.5, 0.15], dtype=F64),
    torch.tensor([0.15, 0.5, 0.7, 0.5, 0.15], dtype=F64),
    torch.tensor([0.175, 0.547, 0.175], dtype=F64),
)
# Unlike Farbman's, the two kernels differ: a swap of the two must show.
OTHER = (
    torch.tensor([0.1, 0.4, 0.9, 0.4, 0.1], dtype=F64),
    torch.tensor([0.2, 0.6, 0.5, 0.6, 0.2], dtype=F64),
    torch.tensor([0.2, 0.5, 0.2], dtype=F64),
)


def pyramid(b: Tensor, kernels: tuple[Tensor, Tensor, Tensor] = FARBMAN) -> Tensor:
    return poisson_pyramid(b, *(k.to(b.dtype) for k in kernels))


free = partial(poisson_fft, compact=False)
torus = partial(poisson_fft, compact=True)
OPERATORS: dict[str, Callable[[Tensor], Tensor]] = {
    "difference_x": difference_x,
    "laplacian": laplacian,
    "running_sum_x": running_sum_x,
    "free": free,
    "torus": torus,
    "pyramid": pyramid,
}
EXACT = [(difference_x, running_sum_x), (laplacian, free), (laplacian, torus)]
every_operator = pytest.mark.parametrize("operator", OPERATORS.values(), ids=OPERATORS)
sizes = st.tuples(st.integers(1, 3), st.integers(1, 3), st.integers(1, 19), st.integers(1, 19))
seeds = st.integers(0, 2**32)
small = settings(deadline=None, max_examples=15)


def random(*shape: int, seed: int = 0, dtype: torch.dtype = F64) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=F64).to(dtype)


def compact(*shape: int, seed: int = 0) -> Tensor:
    """Random image that vanishes on its border."""
    u = random(*shape, seed=seed)
    inside = torch.zeros_like(u)
    inside[..., 1:-1, 1:-1] = u[..., 1:-1, 1:-1]
    return inside


def point(height: int, width: int, y: int, x: int) -> Tensor:
    b = torch.zeros(1, 1, height, width, dtype=F64)
    b[..., y, x] = 1.0
    return b


def distance(height: int, width: int, y: float, x: float) -> Tensor:
    return torch.hypot(
        (torch.arange(height, dtype=F64) - y)[:, None].expand(height, width),
        (torch.arange(width, dtype=F64) - x)[None].expand(height, width),
    )


def green_around(height: int, width: int, y: int, x: int) -> Tensor:
    """The lattice Green's function around the pixel (y, x)."""
    table = lattice_green(height, width)
    return table[(torch.arange(height) - y).abs()][:, (torch.arange(width) - x).abs()]


# --- the operators ---------------------------------------------------------------------------------------------


def test_running_sum_of_two_points_is_a_row_of_a_disc() -> None:
    b = torch.zeros(1, 1, 2, 8)
    b[..., 0, 2], b[..., 0, 5] = 3.0, -3.0
    assert running_sum_x(b)[0, 0].tolist() == [[0, 0, 3, 3, 3, 0, 0, 0], [0] * 8]


@given(sizes, seeds)
@small
def test_difference_and_running_sum_undo_each_other(size: tuple[int, ...], seed: int) -> None:
    u = random(*size, seed=seed)
    torch.testing.assert_close(running_sum_x(difference_x(u)), u)
    torch.testing.assert_close(difference_x(running_sum_x(u)), u)


def test_laplacian_of_a_polynomial() -> None:
    y, x = torch.arange(7.0, dtype=F64)[:, None], torch.arange(6.0, dtype=F64)
    u = (2 * x**2 + y**2 + x * y - 3 * x + 1)[None, None]
    torch.testing.assert_close(laplacian(u)[..., 1:-1, 1:-1], torch.full((1, 1, 5, 4), 6.0, dtype=F64))


def test_laplacian_takes_zero_outside_the_image() -> None:
    assert laplacian(torch.ones(1, 1, 3, 4))[0, 0].tolist() == [[-2, -1, -1, -2], [-1, 0, 0, -1], [-2, -1, -1, -2]]
    assert laplacian(torch.ones(1, 1, 1, 1)).item() == -4


# --- the Green's function --------------------------------------------------------------------------------------


def test_green_function_has_its_known_values() -> None:
    g = lattice_green(3, 3)
    pi = math.pi
    expected = [[0, 1 / 4, 1 - 2 / pi], [1 / 4, 1 / pi, 2 / pi - 1 / 4], [1 - 2 / pi, 2 / pi - 1 / 4, 4 / 3 / pi]]
    torch.testing.assert_close(g, torch.tensor(expected, dtype=F64), atol=1e-14, rtol=0)


def test_green_function_on_the_diagonal() -> None:
    """g(n, n) = 1/pi * (1 + 1/3 + ... + 1/(2n - 1)), across the change from quadrature to expansion."""
    odd = 2 * torch.arange(1, 200, dtype=F64) - 1
    torch.testing.assert_close(
        lattice_green(200, 200).diagonal()[1:], (1 / odd).cumsum(0) / math.pi, atol=1e-12, rtol=0
    )


@pytest.mark.parametrize(("height", "width"), [(150, 150), (3, 300), (90, 20)])
def test_stencil_on_green_function_is_a_point(height: int, width: int) -> None:
    g = green_around(2 * height - 1, 2 * width - 1, height - 1, width - 1)[None, None]
    expected = point(2 * height - 1, 2 * width - 1, height - 1, width - 1)
    inside = (..., slice(1, -1), slice(1, -1))
    torch.testing.assert_close(laplacian(g)[inside], expected[inside], atol=1e-12, rtol=0)


def test_green_function_grows_as_a_logarithm() -> None:
    far = (math.log(5000) + 0.5772156649015329 + 1.5 * math.log(2)) / (2 * math.pi)
    assert lattice_green(1, 5001)[0, 5000].item() == pytest.approx(far, abs=1e-9)


@pytest.mark.parametrize(("height", "width", "name"), [(0, 3, "height"), (3, -1, "width")])
def test_green_function_refuses_an_empty_table(height: int, width: int, name: str) -> None:
    with pytest.raises(ValueError, match=f"{name}: expected at least 1, got"):
        lattice_green(height, width)


# --- the inverses ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("pair", EXACT, ids=["scanline", "free", "torus"])
@given(sizes, seeds)
@small
def test_inverse_undoes_the_operator(pair: tuple[Any, Any], size: tuple[int, ...], seed: int) -> None:
    operator, inverse = pair
    u = compact(*size, seed=seed)
    torch.testing.assert_close(inverse(operator(u)), u, atol=1e-11, rtol=0)


@pytest.mark.parametrize(("height", "width"), [(1, 1), (1, 31), (17, 1), (23, 10)])
def test_free_response_to_a_point_is_the_green_function(height: int, width: int) -> None:
    y, x = height // 3, width - 1
    u = free(point(height, width, y, x))[0, 0]
    torch.testing.assert_close(u, green_around(height, width, y, x), atol=1e-11, rtol=0)


@given(sizes, seeds)
@small
def test_operator_undoes_the_free_inverse_of_any_buffer(size: tuple[int, ...], seed: int) -> None:
    """Also where the buffer's sum is not zero, but for the border, where the stencil lacks a neighbour."""
    b = random(*size, seed=seed)
    b_again = laplacian(free(F.pad(b, (1, 1, 1, 1))))[..., 1:-1, 1:-1]
    torch.testing.assert_close(b_again, b, atol=1e-11, rtol=0)


def test_torus_leaves_out_the_mean_and_centres_the_edges() -> None:
    b = random(2, 3, 12, 10)  # both lengths are fast: no padding, so the torus is the buffer's own
    u = torus(b)
    around = F.pad(u, (1, 1, 1, 1), mode="circular")
    torch.testing.assert_close(laplacian(around)[..., 1:-1, 1:-1], b - b.mean((-2, -1), keepdim=True))
    edges = u[..., 0, :].sum(-1) + u[..., -1, :].sum(-1) + u[..., 0].sum(-1) + u[..., -1].sum(-1)
    torch.testing.assert_close(edges, torch.zeros(2, 3, dtype=F64))


def disc(height: int, width: int, y: float, x: float, radius: float) -> Tensor:
    return (distance(height, width, y, x) <= radius).to(F64)[None, None]


@pytest.mark.parametrize(
    ("height", "width", "y", "x", "radius"),
    [
        (64, 64, 30.3, 31.6, 8.0),
        (97, 64, 50.0, 31.0, 16.0),
        (127, 151, 61.7, 80.2, 40.0),
        (200, 256, 99.5, 127.5, 16.0),
    ],
)
def test_all_inverses_agree_on_a_disc(height: int, width: int, y: float, x: float, radius: float) -> None:
    u = disc(height, width, y, x, radius)
    torch.testing.assert_close(running_sum_x(difference_x(u)), u)
    torch.testing.assert_close(free(laplacian(u)), u, atol=1e-12, rtol=0)
    torch.testing.assert_close(torus(laplacian(u)), u, atol=1e-12, rtol=0)
    error = (pyramid(laplacian(u)) - u)[0, 0].abs()
    outside = distance(height, width, y, x) - radius
    assert error.max() < 0.15
    assert error[outside < -4].max() < 0.035
    assert error[outside > 4].max() < 0.025
    assert error[outside > radius + 10].max() < 0.01


@pytest.mark.parametrize(("y", "x"), [(64, 64), (63, 65), (40, 90)])
def test_pyramid_response_to_a_point(y: int, x: int) -> None:
    error = pyramid(point(129, 129, y, x))[0, 0] - green_around(129, 129, y, x)
    r = distance(129, 129, y, x)
    constant = error[r > 3].mean()
    assert constant.item() == pytest.approx(-1.33, abs=0.01)
    assert (error - constant).abs().max() < 0.025
    assert (error - constant)[r > 3].abs().max() < 0.01


def pyramid_on_a_large_canvas(b: Tensor, h1: Tensor, h2: Tensor, g: Tensor) -> Tensor:
    """The definition: plain convolutions, every second sample, zero insertion, far from any border."""

    def filtered(x: Tensor, k: Tensor) -> Tensor:
        return F.conv2d(x, torch.outer(k, k)[None, None], padding="same")

    def zeros_inserted(x: Tensor) -> Tensor:
        wide = x.new_zeros(1, 1, 2 * x.shape[-2], 2 * x.shape[-1])
        wide[..., ::2, ::2] = x
        return wide

    height, width = b.shape[-2:]
    levels = math.ceil(math.log2(max(height, width))) + 1
    origin = 8 * 2**levels  # a sample of every level; the grids of the levels line up at pixel (2, 2) of the buffer
    rows, columns = slice(origin - 2, origin - 2 + height), slice(origin - 2, origin - 2 + width)
    a = [b.new_zeros(1, 1, 2 * origin, 2 * origin)]
    a[0][..., rows, columns] = b
    for _ in range(levels):
        a.append(filtered(a[-1], h1)[..., ::2, ::2])
    u = filtered(a[-1], g)
    for fine in a[-2::-1]:
        u = filtered(zeros_inserted(u), h2) + filtered(fine, g)
    return -u[..., rows, columns]


@pytest.mark.parametrize("size", [(1, 1), (1, 5), (2, 1), (3, 3), (4, 7), (8, 8), (13, 9)])
def test_pyramid_cuts_nothing_off(size: tuple[int, int]) -> None:
    b = random(1, 1, *size)
    torch.testing.assert_close(pyramid(b, OTHER), pyramid_on_a_large_canvas(b, *OTHER))


def test_pyramid_is_the_same_in_a_larger_buffer() -> None:
    b = random(1, 2, 37, 41)
    padded = pyramid(F.pad(b, (0, 20, 0, 9)), OTHER)
    torch.testing.assert_close(padded[..., :37, :41], pyramid(b, OTHER))


@given(sizes, seeds)
@small
def test_swapping_the_kernels_transposes_the_pyramid(size: tuple[int, ...], seed: int) -> None:
    x, y = random(*size, seed=seed), random(*size, seed=seed + 1)
    h1, h2, g = OTHER
    left, right = (poisson_pyramid(x, h1, h2, g) * y).sum(), (x * poisson_pyramid(y, h2, h1, g)).sum()
    torch.testing.assert_close(left, right, atol=1e-9, rtol=1e-9)


def test_kernels_of_every_level() -> None:
    b = random(1, 2, 21, 18)
    squares = [torch.outer(k, k)[None] for k in OTHER]
    torch.testing.assert_close(poisson_pyramid(b, *squares), pyramid(b, OTHER))
    torch.testing.assert_close(poisson_pyramid(b, *(k.expand(3, -1, -1) for k in squares)), pyramid(b, OTHER))
    wide = F.pad(squares[2], (1, 1, 1, 1))
    torch.testing.assert_close(poisson_pyramid(b, *squares[:2], wide), pyramid(b, OTHER))
    # Those of the finest level alone: what is beyond it has the same kernels as before.
    fine = [torch.cat([2 * k, k]) for k in squares]
    coarse = F.conv2d(b.movedim(1, 0), 2 * squares[0][None], stride=2, padding=4)
    up = F.conv_transpose2d(
        poisson_pyramid(coarse, *OTHER), 2 * squares[1][None], stride=2, padding=4, output_padding=(0, 1)
    )
    want = up - F.conv2d(b.movedim(1, 0), 2 * squares[2][None], padding=1)
    torch.testing.assert_close(poisson_pyramid(b, *fine), want.movedim(0, 1), rtol=1e-6, atol=1e-3)
    with pytest.raises(ValueError, match=r"h1: expected shape \(L, 5, 5\), got \(1, 4, 4\)"):
        poisson_pyramid(b, torch.zeros(1, 4, 4, dtype=F64), *squares[1:])
    with pytest.raises(ValueError, match="h2: expected kernels of at least one level"):
        poisson_pyramid(b, squares[0], squares[1][:0], squares[2])


# --- what holds for every operator -----------------------------------------------------------------------------


@every_operator
@given(sizes, seeds)
@small
def test_linear(operator: Callable[[Tensor], Tensor], size: tuple[int, ...], seed: int) -> None:
    x, y = random(*size, seed=seed), random(*size, seed=seed + 1)
    torch.testing.assert_close(operator(3 * x - 2 * y), 3 * operator(x) - 2 * operator(y), atol=1e-9, rtol=1e-9)
    assert not operator(torch.zeros_like(x)).any()


@every_operator
def test_a_batch_is_its_images_one_by_one(operator: Callable[[Tensor], Tensor]) -> None:
    x = random(3, 2, 11, 13)
    one_by_one = [[operator(channel[None, None]) for channel in image] for image in x]
    torch.testing.assert_close(operator(x), torch.cat([torch.cat(image, 1) for image in one_by_one]))


@every_operator
def test_gradient(operator: Callable[[Tensor], Tensor]) -> None:
    assert torch.autograd.gradcheck(operator, random(2, 1, 5, 4).requires_grad_())


def test_gradient_to_the_kernels() -> None:
    b = random(1, 2, 5, 4)
    assert torch.autograd.gradcheck(partial(poisson_pyramid, b), [k.clone().requires_grad_() for k in OTHER])


@every_operator
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-6), (torch.float16, 2e-3), (torch.bfloat16, 2e-2)])
def test_low_precision(operator: Callable[[Tensor], Tensor], dtype: torch.dtype, tolerance: float) -> None:
    x = compact(1, 2, 21, 18).to(dtype)
    out, expected = operator(x), operator(x.to(F64))
    assert out.dtype == dtype
    assert ((out.to(F64) - expected).abs() <= tolerance * expected.abs().max()).all()


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_pyramid_runs_half_precision_in_float32(dtype: torch.dtype) -> None:
    b, kernels = random(1, 2, 40, 33).to(dtype), [k.to(dtype) for k in OTHER]
    expected = poisson_pyramid(b.float(), *(k.float() for k in kernels)).to(dtype)
    torch.testing.assert_close(poisson_pyramid(b, *kernels), expected, atol=0, rtol=0)


@every_operator
def test_gradient_after_the_first_call_ran_in_inference_mode(operator: Callable[[Tensor], Tensor]) -> None:
    """What is kept from one call to the next must not carry the mode of the first."""
    with torch.inference_mode():
        operator(random(1, 1, 29, 3))
    x = random(1, 1, 29, 3).requires_grad_()
    operator(x).square().sum().backward()
    assert x.grad is not None
    assert x.grad.any()


# --- a very bright pixel ---------------------------------------------------------------------------------------


def highlight() -> tuple[Tensor, Tensor]:
    """A spot of 2^20 on a dim image whose differences are exact in float32, and where the dim part is."""
    inside = torch.randint(0, 4, (90, 120), generator=torch.Generator().manual_seed(0))
    u = F.pad(inside[None, None].to(torch.float32), (4, 4, 4, 4))
    spot = disc(98, 128, 40, 50, 6)[0, 0] > 0
    u[..., spot] = 2.0**20
    return u, ~spot


@pytest.mark.parametrize("pair", EXACT, ids=["scanline", "free", "torus"])
def test_highlight_leaks_nothing(pair: tuple[Any, Any]) -> None:
    operator, inverse = pair
    u, dim = highlight()
    assert (inverse(operator(u)) - u)[..., dim].abs().max() < 1e-6


def test_running_sum_of_many_small_steps_beside_a_highlight() -> None:
    b = torch.rand(1, 1, 4, 1000, generator=torch.Generator().manual_seed(0)) * 0.01
    b[..., 100], b[..., 700] = 3e5, -3e5
    error = running_sum_x(b) - b.to(F64).cumsum(-1)
    assert error[..., 700:].abs().max() < 1e-6


def test_highlight_leaks_little_through_the_pyramid() -> None:
    u, dim = highlight()
    b = laplacian(u)
    assert (pyramid(b) - pyramid(b.to(F64)))[..., dim].abs().max() < 1e-6 * u.max()


# --- bad input and documentation -------------------------------------------------------------------------------


@every_operator
def test_bad_buffer(operator: Callable[[Tensor], Tensor]) -> None:
    with pytest.raises(ValueError, match=r"^[ub]: expected shape \(B, C, H, W\), got \(3, 4\)"):
        operator(torch.zeros(3, 4))
    with pytest.raises(TypeError, match=r"^[ub]: expected a floating-point tensor, got torch.int64"):
        operator(torch.zeros(1, 1, 3, 4, dtype=torch.int64))


@pytest.mark.parametrize(("name", "taps"), [("h1", 5), ("h2", 5), ("g", 3)])
def test_bad_kernel(name: str, taps: int) -> None:
    kernels = dict(zip(("h1", "h2", "g"), FARBMAN, strict=True))
    with pytest.raises(ValueError, match=rf"^{name}: expected shape \({taps}\), got \(4,\)"):
        poisson_pyramid(torch.zeros(1, 1, 4, 4), **(kernels | {name: torch.zeros(4)}))
    with pytest.raises(ValueError, match=rf"^{name}: expected device cpu, got meta"):
        poisson_pyramid(torch.zeros(1, 1, 4, 4), **(kernels | {name: torch.zeros(taps, device="meta")}))


def test_examples_in_the_documentation() -> None:
    result = doctest.testmod(torchbokeh.ops.integrate)
    assert result.attempted > 8
    assert result.failed == 0
