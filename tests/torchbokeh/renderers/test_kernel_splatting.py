"""`KernelSplatting` against its functions, its plan, and what it refuses."""

import dataclasses
import doctest
import math
import os
import subprocess
import sys
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

import torchbokeh.renderers.kernel_splatting
from torchbokeh import Disc, KernelSplatting, Polygon, SplattingPlan
from torchbokeh.ops.merge import splat_merged
from torchbokeh.ops.splat import splat_spans
from torchbokeh.plan.quality import QUALITIES, ROUNDING

NAMES = [q.name for q in QUALITIES]


def scene(b: int = 1, c: int = 3, h: int = 60, w: int = 80, reach: float = 60.0) -> tuple[Tensor, Tensor]:
    seed = torch.Generator().manual_seed(7)
    image = torch.rand(b, c, h, w, generator=seed)
    coc = torch.nn.functional.avg_pool2d((torch.rand(b, 1, h, w, generator=seed) * 2 - 1) * 8 * reach, 9, 1, 4)
    return image, coc.clamp(-reach, reach)


@pytest.mark.parametrize("quality", QUALITIES, ids=NAMES)
@pytest.mark.parametrize("aperture", [Disc(), Polygon(5, 0.3)], ids=["disc", "pentagon"])
def test_it_is_its_function(quality: Any, aperture: Disc) -> None:
    image, coc = scene(2)
    got = KernelSplatting(aperture, quality.name)(image, coc)
    if quality.merging is None:
        splat = splat_spans(torch.cat([image, torch.ones_like(coc)], 1), coc, aperture.profile(), integrate=True)
        want = splat[:, :3] / splat[:, 3:]
    else:
        want = splat_merged(image, coc, aperture.profile(), quality.merging, ones=True, normalise=True)[:, :3]
    torch.testing.assert_close(got, want, rtol=0, atol=1e-6)


@settings(deadline=None, max_examples=20)
@given(
    st.sampled_from(NAMES),
    st.integers(1, 50),
    st.integers(1, 50),
    st.sampled_from([0.0, 1.0, 20.0, 300.0, 1e4]),
    st.sampled_from(["disc", "3-gon", "6-gon"]),
)
def test_constant_in_constant_out(quality: str, height: int, width: int, reach: float, aperture: str) -> None:
    seed = torch.Generator().manual_seed(height * 51 + width)
    coc = (torch.rand(1, 1, height, width, generator=seed) * 2 - 1) * reach
    image = torch.tensor([0.003, 0.7, 5e4]).view(1, 3, 1, 1).repeat(1, 1, height, width)
    out = KernelSplatting(aperture, quality)(image, coc)
    torch.testing.assert_close(out, image, rtol=2e-5, atol=0)


@pytest.mark.parametrize("quality", NAMES)
def test_gradients_reach_image_and_radii(quality: str) -> None:
    image, coc = (t.requires_grad_() for t in scene())
    KernelSplatting(quality=quality)(image, coc).square().sum().backward()
    for leaf in (image, coc):
        assert leaf.grad is not None
        assert leaf.grad.isfinite().all()
        assert leaf.grad.any()


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
@pytest.mark.parametrize("quality", ["exact", "balanced"])
def test_dtypes(dtype: torch.dtype, quality: str) -> None:
    image, coc = scene(h=30, w=40, reach=20)
    out = KernelSplatting(quality=quality)(image.to(dtype), coc)
    assert out.dtype == dtype
    want = KernelSplatting(quality=quality)(image.to(dtype).double(), coc.double())
    torch.testing.assert_close(out.double(), want, rtol=0, atol=1e-2 if dtype.itemsize == 2 else 1e-3)


def test_the_plan_says_what_happens() -> None:
    image, coc = scene(reach=60.0)
    plan = KernelSplatting(quality="balanced").plan(image, coc)
    assert plan.size == (60, 80)
    assert plan.largest == pytest.approx(coc.abs().max().item())
    assert plan.quality.name == "balanced"
    assert plan.highest == 2  # 80 px leave room for no more
    assert 0 < plan.predicted_error <= plan.quality.error
    assert "blocks of up to 4 x 4 pixels" in str(plan)
    assert not plan.sharp


def test_what_is_sharp_passes_through() -> None:
    image, coc = scene(reach=0.4)
    for quality in NAMES:
        splatting = KernelSplatting(quality=quality)
        assert splatting.plan(image, coc).sharp
        assert torch.equal(splatting(image, coc), image)
        assert "passes through" in str(splatting.plan(image, coc))


def test_small_blur_merges_nothing() -> None:
    image, coc = scene(reach=4.0)
    plan = KernelSplatting(quality="fast").plan(image, coc)
    assert plan.highest == 0
    assert plan.predicted_error == ROUNDING
    assert "every pixel is splatted by itself" in str(plan)


def test_a_tolerance_picks_the_quality() -> None:
    image, coc = scene(reach=60.0)
    assert KernelSplatting(tolerance=0.0).plan(image, coc).quality.name == "exact"
    assert KernelSplatting(tolerance=1.0).plan(image, coc).quality.name == "fast"
    picked = KernelSplatting(quality="fast", tolerance=0.01).plan(image, coc)
    assert picked.predicted_error <= 0.01
    got = KernelSplatting(tolerance=0.01)(image, coc)
    assert torch.equal(got, KernelSplatting(quality=picked.quality.name)(image, coc))


def test_a_plan_is_used_again() -> None:
    image, coc = scene()
    splatting = KernelSplatting()
    plan = splatting.plan(image, coc)
    assert torch.equal(splatting(image, coc, plan=plan), splatting(image, coc))
    exact = dataclasses.replace(plan, quality=QUALITIES[0], highest=0)
    assert torch.equal(splatting(image, coc, plan=exact), KernelSplatting(quality="exact")(image, coc))


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"image": None}, TypeError, "image: expected a tensor of shape"),
        ({"image": torch.rand(3, 60, 80)}, ValueError, "image: expected shape"),
        ({"coc": torch.rand(1, 1, 60, 81)}, ValueError, "coc: expected shape"),
        ({"coc": torch.full((1, 1, 60, 80), math.nan)}, ValueError, "coc: expected finite radii, got 4800"),
        ({"plan": "balanced"}, TypeError, "plan: expected a SplattingPlan, got str"),
        (
            {"plan": SplattingPlan((1, 2), 1.0, QUALITIES[0], 0, 0.0, False)},
            ValueError,
            "plan: expected one for size",
        ),
    ],
)
def test_what_is_refused(change: dict[str, Any], error: type[Exception], message: str) -> None:
    image, coc = scene()
    arguments = {"image": image, "coc": coc, **change}
    with pytest.raises(error, match=message):
        KernelSplatting()(**arguments)


def test_empty_pictures() -> None:
    assert KernelSplatting()(torch.rand(0, 3, 4, 5), torch.rand(0, 1, 4, 5)).shape == (0, 3, 4, 5)
    assert KernelSplatting()(torch.rand(1, 3, 0, 5), torch.rand(1, 1, 0, 5)).shape == (1, 3, 0, 5)


def test_repr_and_examples() -> None:
    assert "quality='fast'" in repr(KernelSplatting(quality="fast"))
    assert "tolerance=0.01" in repr(KernelSplatting(tolerance=0.01))
    assert doctest.testmod(torchbokeh.renderers.kernel_splatting).failed == 0


MEMORY = """
import sys
from pathlib import Path
import torch
from torchbokeh import KernelSplatting

def resident(key):
    lines = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return int(lines[key].split()[0]) * 1024

def forget():
    Path("/proc/self/clear_refs").write_text("5")
    return resident("VmRSS")

splatting, backward, radius = KernelSplatting(quality=sys.argv[1]), sys.argv[2] == "backward", float(sys.argv[3])
for side in (64, 1024):  # the first compiles
    image = torch.rand(1, 3, side, side).requires_grad_(backward)
    coc = torch.linspace(-radius, radius, side).expand(1, 1, side, side).contiguous().requires_grad_(backward)
    plan, grad = splatting.plan(image, coc), torch.rand(1, 3, side, side)
    before = forget()
    out = splatting(image, coc, plan=plan)
    if backward:
        before = forget()
        out.backward(grad)
print((resident("VmHWM") - before) / 1024**2)
"""


@pytest.mark.slow
@pytest.mark.skipif(not os.access("/proc/self/clear_refs", os.W_OK), reason="this system does not tell peak memory")
@pytest.mark.parametrize("radius", [10.0, 100.0])
@pytest.mark.parametrize(
    ("quality", "way", "most"),
    [("balanced", "forward", 45), ("balanced", "backward", 125), ("exact", "forward", 70), ("exact", "backward", 180)],
)
def test_memory_is_that_of_the_docstring(quality: str, way: str, most: float, radius: float) -> None:
    command = [sys.executable, "-P", "-c", MEMORY, quality, way, str(radius)]
    done = subprocess.run(
        command, capture_output=True, text=True, check=True, env={**os.environ, "OMP_NUM_THREADS": "1"}
    )
    assert 10 < float(done.stdout) < most


@pytest.mark.parametrize(("radius", "single"), [(7.9, False), (8.0, True), (-11.3, True)])
@pytest.mark.parametrize("aperture", ["disc", "5-gon"])
def test_one_radius_for_all_takes_a_single_convolution(radius: float, single: bool, aperture: str) -> None:
    splatting = KernelSplatting(aperture, quality="exact")
    image, coc = torch.rand(2, 3, 30, 41), torch.full((2, 1, 30, 41), radius)
    plan = splatting.plan(image, coc)
    assert (plan.uniform is not None) == single == ("a single convolution" in str(plan))
    torch.testing.assert_close(
        splatting(image, coc), splatting(image, coc, plan=dataclasses.replace(plan, uniform=None)), rtol=1e-5, atol=1e-6
    )
    asked = coc.clone().requires_grad_()
    splatting(image, asked).square().sum().backward()
    assert float(asked.grad.abs().max()) > 0
    coc[0, 0, 3, 4] += 0.1
    assert splatting.plan(image, coc).uniform is None


@pytest.mark.parametrize("quality", NAMES)
def test_radii_beyond_all_measure_leave_a_mean(quality: str) -> None:
    image = torch.rand(1, 3, 16, 20, generator=torch.Generator().manual_seed(0))
    for radius in (1e6, 1e30):
        out = KernelSplatting(quality=quality)(image, torch.full((1, 1, 16, 20), radius))
        torch.testing.assert_close(out, image.mean((2, 3), keepdim=True).expand_as(out), atol=1e-4, rtol=0)
