"""What the operators answer to other derivatives than the first in backward mode: right values, or an error by name."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode

from torchbokeh.ops.capsules import splat_capsules
from torchbokeh.ops.dispatch import has_numbers
from torchbokeh.ops.merge import Merging, splat_merged
from torchbokeh.ops.points import PointTable, splat_points
from torchbokeh.ops.splat import splat_spans
from torchbokeh.ops.surface import blur_surface
from torchbokeh.psfs import Disc

F64 = torch.float64
SIZE = (4, 5)

pytestmark = pytest.mark.filterwarnings("ignore:`torch.jit.script`:DeprecationWarning")
Splat = Callable[[Tensor, Tensor], Tensor]


def image(dtype: torch.dtype = F64) -> Tensor:
    return torch.rand(1, 2, *SIZE, generator=torch.Generator().manual_seed(1), dtype=F64).to(dtype)


def radii(dtype: torch.dtype = F64) -> Tensor:
    return (1 + 4 * torch.rand(1, 1, *SIZE, generator=torch.Generator().manual_seed(2), dtype=F64)).to(dtype)


def spans(values: Tensor, coc: Tensor) -> Tensor:
    return splat_spans(values, coc, Disc().profile(), integrate=True)


def differences(values: Tensor, coc: Tensor) -> Tensor:
    return splat_spans(values, coc, Disc().profile())


def points(values: Tensor, coc: Tensor) -> Tensor:
    offsets, weights = torch.tensor([[0.3, -1.0], [-1.2, 0.1]]), torch.tensor([0.4, 0.6])
    table = PointTable(offsets.to(values), weights.to(values), torch.tensor([0, 2]))
    index = torch.zeros(1, 1, *SIZE, dtype=torch.int64)
    turn = torch.eye(2).to(coc).view(1, 2, 2, 1, 1) * coc[:, None]
    return splat_points(values, index, table, pad=8, rotation=turn)


def merged(values: Tensor, coc: Tensor) -> Tensor:
    return splat_merged(values, coc, Disc().profile(), Merging(1, 100.0), highest=1, ones=True, normalise=True)


def surface(values: Tensor, coc: Tensor) -> Tensor:
    return blur_surface(values, None, coc, [2.0], Disc().profile(), Merging(1, 100.0), 1)[0]


def capsules(values: Tensor, coc: Tensor) -> Tensor:
    pixels = torch.tensor([8, 15])
    return splat_capsules(values, pixels, coc.flatten()[pixels], coc.new_ones(2, 2), coc.new_zeros(2, 2))


def penalty(splat: Splat, values: Tensor, coc: Tensor) -> Tensor:
    """The squared gradient of a loss to the image."""
    (by_values,) = torch.autograd.grad(splat(values, coc).square().sum(), values, create_graph=True)
    return by_values.square().sum()


@pytest.mark.parametrize("splat", [spans, differences, points, merged])
def test_second_derivatives_to_the_image(splat: Splat) -> None:
    coc = radii()
    values = image().requires_grad_()
    assert torch.autograd.gradgradcheck(lambda values: splat(values, coc).square(), (values,), fast_mode=True)


@pytest.mark.parametrize("splat", [spans, differences, points])
def test_a_penalty_on_the_gradient_of_the_image_reaches_the_radius(splat: Splat) -> None:
    values, coc = image().requires_grad_(), radii().requires_grad_()
    (slope,) = torch.autograd.grad(penalty(splat, values, coc), coc)
    way = torch.randn(coc.shape, generator=torch.Generator().manual_seed(3), dtype=F64)
    ends = [penalty(splat, values, coc.detach() + step * way).item() for step in (1e-6, -1e-6)]
    assert (ends[0] - ends[1]) / 2e-6 == pytest.approx(float((slope * way).sum()), rel=1e-5)


@pytest.mark.parametrize("splat", [spans, differences, points, merged])
def test_second_derivatives_of_kernels_are_those_of_the_definitions(splat: Splat) -> None:
    found = []
    for dtype in (torch.float32, F64):
        values, coc = image(dtype).requires_grad_(), radii(dtype).requires_grad_()
        found.append(torch.autograd.grad(penalty(splat, values, coc), (values, coc)))
    for single, double in zip(*found, strict=True):
        torch.testing.assert_close(single.double(), double, rtol=1e-4, atol=1e-5 * float(double.abs().max()))


@pytest.mark.parametrize("splat", [spans, points, merged])
def test_a_gradient_of_the_gradient_of_radii_is_refused(splat: Splat) -> None:
    coc = radii().requires_grad_()
    (by_coc,) = torch.autograd.grad(splat(image(), coc).square().sum(), coc, create_graph=True)
    with pytest.raises(
        RuntimeError, match=r"splat_.*: has second derivatives through the gradient of its values alone"
    ):
        by_coc.sum().backward()


@pytest.mark.parametrize("splat", [spans, points, merged, surface, capsules])
@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_forward_mode_and_torch_func_are_refused_by_name(splat: Splat, dtype: torch.dtype) -> None:
    values, coc = image(dtype), radii(dtype)
    match = r"(splat|blur)_.*: has no derivative in forward mode .* nor under torch.func"
    with pytest.raises(RuntimeError, match=match):
        torch.func.jvp(lambda v: splat(v, coc), (values,), (values,))
    with pytest.raises(RuntimeError, match=match):
        torch.func.jvp(lambda r: splat(values, r), (coc,), (coc,))
    with pytest.raises(RuntimeError, match=match):
        torch.func.grad(lambda v: splat(v, coc).sum())(values)
    with pytest.raises(RuntimeError, match=match):
        torch.func.jacrev(lambda v: splat(v, coc).sum())(values)
    with torch.autograd.forward_ad.dual_level(), pytest.raises(RuntimeError, match=match):
        splat(torch.autograd.forward_ad.make_dual(values, values), coc)


@pytest.mark.filterwarnings("ignore:There is a performance drop")
def test_vmap_is_a_batch() -> None:
    values, coc = torch.cat([image(), 2 * image()]), torch.cat([radii(), 2 * radii()])
    found = torch.func.vmap(lambda v, r: spans(v[None], r[None])[0])(values, coc)
    torch.testing.assert_close(found, spans(values, coc))


def test_what_has_no_numbers() -> None:
    assert has_numbers(image())
    assert not has_numbers(image().to("meta"))
    assert not has_numbers(FakeTensorMode().from_tensor(image()))
    seen = []
    torch.func.vmap(lambda t: (seen.append(has_numbers(t)), t)[1])(image())
    assert seen == [False]
