"""`torch.compile` and `torch.export` with a plan: one graph, no recompilation, the numbers of eager mode."""

import shutil
from collections.abc import Iterator

import pytest
import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode

import torchbokeh as tb

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning:torch", "ignore::DeprecationWarning")

SIZE = (24, 32)


@pytest.fixture(autouse=True)
def fresh() -> Iterator[None]:
    torch._dynamo.reset()
    yield
    torch._dynamo.reset()


def scene(kind: str, seed: int = 0) -> tuple[Tensor, Tensor]:
    """A picture or layers, and depths on both sides of a focus at 2 m."""
    height, width = SIZE
    generator = torch.Generator().manual_seed(seed)
    if kind == "layers":
        layers = torch.rand(1, 2, 4, height, width, generator=generator)
        layers[:, :, :3] *= layers[:, :, 3:]
        depth = torch.tensor([1.2, 4.0]).view(1, 2, 1, 1, 1) + torch.rand(1, 2, 1, height, width, generator=generator)
        return layers, depth
    depth = torch.linspace(1, 6, width).expand(1, 1, height, width) + torch.rand(1, 1, *SIZE, generator=generator)
    return torch.rand(1, 3, height, width, generator=generator), depth


def assert_same(found: Tensor, wanted: Tensor) -> None:
    torch.testing.assert_close(found, wanted, rtol=1e-5, atol=1e-6)  # compilers write some operators out


def lens_blur(quality: str) -> tb.LensBlur:
    return tb.LensBlur(tb.ThinLens(0.05, 0.05, 2.0, 0.036), quality=quality)


@pytest.mark.parametrize(
    ("kind", "quality"),
    [
        ("image", "balanced"),
        pytest.param("image", "exact", marks=pytest.mark.slow),
        pytest.param("layers", "balanced", marks=pytest.mark.slow),
        pytest.param("layers", "exact", marks=pytest.mark.slow),
    ],
)
def test_one_graph_for_ten_depth_maps(kind: str, quality: str) -> None:
    blur = lens_blur(quality)
    image, depth = scene(kind)
    plan = blur.plan(image, depth)
    compiled = torch.compile(blur, fullgraph=True, backend="aot_eager")
    assert_same(compiled(image, depth, plan=plan), blur(image, depth, plan=plan))
    with torch._dynamo.config.patch(error_on_recompile=True):
        for seed in range(1, 10):
            image, depth = scene(kind, seed)
            assert_same(compiled(image, depth, plan=plan), blur(image, depth, plan=plan))


@pytest.mark.slow
@pytest.mark.parametrize("quality", ["exact", "balanced"])
def test_gradients_are_those_of_eager_mode(quality: str) -> None:
    blur = lens_blur(quality)
    image, depth = (t.requires_grad_() for t in scene("image"))
    focus = torch.nn.Parameter(torch.tensor(2.0))
    blur.lens = tb.ThinLens(0.05, 0.05, focus, 0.036)
    plan = blur.plan(image, depth)
    compiled = torch.compile(blur, fullgraph=True, backend="aot_eager")
    found, wanted = (
        torch.autograd.grad(run(image, depth, plan=plan).square().sum(), (image, depth, focus))
        for run in (compiled, blur)
    )
    for one, other in zip(found, wanted, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-5 * float(other.abs().max()))


@pytest.mark.parametrize("quality", ["exact", "balanced"])
def test_kernel_splatting(quality: str) -> None:
    splatting = tb.KernelSplatting(quality=quality)
    image = scene("image")[0]
    coc = 20 * torch.rand(1, 1, *SIZE)
    plan = splatting.plan(image, coc)
    compiled = torch.compile(splatting, fullgraph=True, backend="aot_eager")
    assert_same(compiled(image, coc, plan=plan), splatting(image, coc, plan=plan))
    with torch._dynamo.config.patch(error_on_recompile=True):
        for _ in range(10):
            coc = 20 * torch.rand(1, 1, *SIZE)
            assert_same(compiled(image, coc, plan=plan), splatting(image, coc, plan=plan))


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="inductor needs a C++ compiler")
def test_default_backend() -> None:
    blur = lens_blur("balanced")
    image, depth = scene("image")
    plan = blur.plan(image, depth)
    compiled = torch.compile(blur, fullgraph=True)
    torch.testing.assert_close(compiled(image, depth, plan=plan), blur(image, depth, plan=plan))


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("g++") is None, reason="inductor needs a C++ compiler")
@pytest.mark.parametrize(("quality", "kind", "threads"), [("balanced", "image", 2)])
def test_gradients_of_the_default_backend(quality: str, kind: str, threads: int) -> None:
    """One route: the compiler takes minutes. What it stumbled over, filling holes, is tried at many sizes by itself."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads)  # on two, inductor writes other loops
    try:
        blur = lens_blur(quality)
        image, depth = (t.requires_grad_() for t in scene(kind))
        plan = blur.plan(image, depth)
        found, wanted = (
            torch.autograd.grad(run(image, depth, plan=plan).square().sum(), (image, depth))
            for run in (torch.compile(blur, fullgraph=True), blur)
        )
    finally:
        torch.set_num_threads(before)
    for one, other in zip(found, wanted, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-5 * float(other.abs().max()))


@pytest.mark.parametrize("quality", ["exact", "balanced"])
def test_fake_tensors(quality: str) -> None:
    blur = lens_blur(quality)
    planned = blur.planned(blur.plan(*scene("image")))
    with FakeTensorMode(allow_non_fake_inputs=True) as mode:
        image, depth = (mode.from_tensor(t) for t in scene("image"))
        assert planned(image, depth).shape == image.shape


@pytest.mark.parametrize("quality", ["exact", "balanced"])
def test_a_penalty_on_gradients(quality: str) -> None:
    blur = lens_blur(quality)
    image, depth = scene("image")
    plan = blur.plan(image, depth)

    def penalty(image: Tensor) -> Tensor:
        loss = blur(image, depth, plan=plan).square().sum()
        return torch.autograd.grad(loss, image, create_graph=True)[0].square().sum()

    (slope,) = torch.autograd.grad(penalty(image.requires_grad_()), image)
    # It is quadratic in the image.
    torch.testing.assert_close((slope * image).sum(), 2 * penalty(image), rtol=1e-4, atol=0)


@pytest.mark.parametrize("quality", ["exact", "balanced"])
def test_forward_mode_is_refused(quality: str) -> None:
    image, depth = scene("image")
    with pytest.raises(RuntimeError, match="has no derivative in forward mode"):
        torch.func.jvp(lambda t: lens_blur(quality)(t, depth), (image,), (image,))
    with pytest.raises(RuntimeError, match="has no derivative in forward mode"):
        torch.func.jvp(lambda t: tb.KernelSplatting(quality=quality)(t, 5 * depth), (image,), (image,))


@pytest.mark.parametrize("quality", ["exact", "balanced"])
def test_exported_program(quality: str) -> None:
    blur = lens_blur(quality)
    planned = blur.planned(blur.plan(*scene("image")))
    with torch.no_grad():
        program = torch.export.export(planned, scene("image"))
        for seed in range(3):
            given = scene("image", seed)
            assert_same(program.module()(*given), planned(*given))
