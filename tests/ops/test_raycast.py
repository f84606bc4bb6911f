import doctest
import importlib.util
import math
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.nn import functional as F

import torchbokeh.ops.raycast
from torchbokeh.ops import dispatch
from torchbokeh.ops.raycast import coc_bounds, subsample_blur

F32, F64 = torch.float32, torch.float64
DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
few = settings(deadline=None, max_examples=40)


def random(*shape: int, seed: int = 0, dtype: torch.dtype = F64) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=F64).float().to(dtype)


def ring(count: int, radius: float, dtype: torch.dtype = F64) -> Tensor:
    angle = torch.arange(count, dtype=F64) * 2.4 + 0.3
    return (torch.stack([angle.cos(), angle.sin()], 1) * radius).to(dtype)


def surfaces(b: int, h: int, w: int, seed: int = 0) -> Tensor:
    """A ramp through focus with boxes before and behind it."""
    y, x = grid(h, w)
    coc = (0.3 * y - 0.1 * x).expand(b, 1, h, w).clone()
    for k, (top, left, depth) in enumerate((random(6, 3, seed=seed) * torch.tensor([h, w, 40])).tolist()):
        coc[k % b, :, int(top) : int(top) + h // 3, int(left) : int(left) + w // 3] = depth - 20
    return coc.float().double()


def grid(h: int, w: int) -> tuple[Tensor, Tensor]:
    y, x = torch.meshgrid(torch.arange(h, dtype=F64), torch.arange(w, dtype=F64), indexing="ij")
    return y, x


def view(colour: Tensor, coc: Tensor, offset: tuple[float, float], **more: Any) -> Tensor:
    """What a single view sees, got back from its mean with the frame."""
    return 2 * subsample_blur(colour, coc, torch.tensor([offset], dtype=colour.dtype), **more) - colour


@pytest.mark.parametrize("dtype", [F32, F64, torch.float16, torch.bfloat16])
@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("far", [5.0, math.inf])
def test_a_constant_stays_constant_to_the_bit(dtype: torch.dtype, device: str, far: float) -> None:
    coc = torch.cat([surfaces(1, 23, 31), random(1, 1, 23, 31) * 60 - 30]).to(device, dtype)
    colour = torch.full((2, 3, 23, 31), 0.7, dtype=dtype, device=device)
    for count in (1, 4, 7):
        offsets = ring(count, 0.3, dtype).to(device)
        out = subsample_blur(colour, coc, offsets, far=far, background=colour)
        assert torch.equal(out, colour)
        assert out.dtype == dtype


@pytest.mark.parametrize("dtype", [F32, F64])
def test_no_offset_leaves_the_frame(dtype: torch.dtype) -> None:
    colour, coc = random(2, 3, 9, 8, dtype=dtype), surfaces(2, 9, 8).to(dtype)
    assert torch.equal(subsample_blur(colour, coc, torch.zeros(0, 2, dtype=dtype)), colour)
    assert torch.equal(subsample_blur(colour, coc, torch.zeros(3, 2, dtype=dtype)), colour)
    assert torch.equal(subsample_blur(colour, torch.zeros_like(coc), ring(4, 0.2, dtype)), colour)
    # An offset of zero among others counts as another look at the frame.
    offsets = torch.cat([ring(1, 0.3, dtype), torch.zeros(2, 2, dtype=dtype)])
    want = (3 * colour + view(colour, coc, tuple(offsets[0].tolist()))) / 4
    assert torch.allclose(subsample_blur(colour, coc, offsets), want, atol=1e-6)


@pytest.mark.parametrize("dtype", [F32, F64])
@pytest.mark.parametrize("depth", [-7.3, -0.2, 1.0, 12.0])
def test_a_plane_gives_the_mean_of_shifted_copies(dtype: torch.dtype, depth: float) -> None:
    h, w = 30, 41
    colour, offsets = random(1, 3, h, w, dtype=dtype), ring(5, 0.4, dtype)
    y, x = grid(h, w)
    want = colour.double()
    for ux, uy in offsets.tolist():
        where = torch.stack([2 * (x - depth * ux) / (w - 1) - 1, 2 * (y - depth * uy) / (h - 1) - 1], -1)
        want = want + F.grid_sample(colour.double(), where[None], padding_mode="border", align_corners=True)
    got = subsample_blur(colour, torch.full((1, 1, h, w), depth, dtype=dtype), offsets)
    assert torch.allclose(got.double(), want / 6, atol=1e-5 if dtype == F32 else 1e-7)


@pytest.mark.parametrize("dtype", [F32, F64])
@pytest.mark.parametrize("offset", [(0.5, 0.25), (-0.25, 0.5), (0.0, -0.5), (0.5, 0.5)])
@pytest.mark.parametrize("far", [math.inf, 4.0])
def test_a_square_over_a_plane(dtype: torch.dtype, offset: tuple[float, float], far: float) -> None:
    h, w, near, behind = 40, 44, -8.0, 4.0
    colour, background = random(1, 3, h, w, dtype=dtype), random(1, 3, h, w, seed=1, dtype=dtype)
    coc = torch.full((1, 1, h, w), behind, dtype=dtype)
    square = torch.zeros(h, w, dtype=torch.bool)
    square[12:28, 13:30] = True
    coc[..., square] = near
    want = torch.empty_like(colour)
    seen = {"near": 0, "behind": 0, "missed": 0}
    for y in range(h):
        for x in range(w):
            places = []
            for depth in (near, behind):
                i, j = (round(p - depth * u) for p, u in zip((x, y), offset, strict=True))
                places.append((min(max(j, 0), h - 1), min(max(i, 0), w - 1)))
            if square[places[0]]:
                kind, pixel = "near", colour[0, :, places[0][0], places[0][1]]
            elif not square[places[1]]:
                kind, pixel = "behind", colour[0, :, places[1][0], places[1][1]]
            else:
                kind, pixel = "missed", (background if far == 4 else colour)[0, :, y, x]
            seen[kind] += 1
            want[0, :, y, x] = pixel
    assert min(seen.values()) > 20
    got = view(colour, coc, offset, far=far, background=background)
    assert torch.allclose(got, want, atol=1e-6)


def test_without_a_background_the_sky_is_that_of_the_frame() -> None:
    colour, coc = random(1, 3, 30, 30), torch.full((1, 1, 30, 30), 4.0, dtype=F64)
    coc[..., 8:20, 9:22] = -8
    finite = subsample_blur(colour, coc, ring(3, 0.5))
    assert torch.equal(subsample_blur(colour, coc, ring(3, 0.5), far=4.0), finite)
    other = subsample_blur(colour, coc, ring(3, 0.5), far=4.0, background=colour + 1)
    assert (other - finite).abs().max() > 0.2
    # Where a ray hits what is shown, and where no ray can reach the sky, the background plays no part.
    assert torch.equal(other[..., :2, :], finite[..., :2, :])
    assert torch.equal(other[..., 13:15, 15:16], finite[..., 13:15, 15:16])


@pytest.mark.parametrize("dtype", [F32, F64])
@pytest.mark.parametrize("slope", [(0.0, 0.0), (0.4, 0.0), (-1.1, 0.3), (0.2, 2.0), (1.0, -1.2), (-0.5, -2.0)])
def test_a_slanted_plane_has_no_holes(dtype: torch.dtype, slope: tuple[float, float]) -> None:
    h, w = 60, 70
    y, x = grid(h, w)
    coc = 2.0 + slope[0] * (x - 35) + slope[1] * (y - 30)
    colour = torch.stack([3 * x + y, x - 2 * y])[None] / 100
    for ux, uy in ring(6, 0.25).tolist():
        r = coc / (1 + slope[0] * ux + slope[1] * uy)
        i, j = x - r * ux, y - r * uy
        inside = (i > 1) & (i < w - 2) & (j > 1) & (j < h - 2)  # with both ends of the step that hits
        assert inside.sum() > 1000
        want = torch.stack([3 * i + j, i - 2 * j])[None] / 100
        got = view(colour.to(dtype), coc[None, None].to(dtype), (ux, uy))
        assert (got - want)[..., inside].abs().max() < (1e-5 if dtype == F32 else 1e-6)


def test_tolerance_says_which_gaps_are_one_surface() -> None:
    _, x = grid(5, 60)
    coc, colour = 2.6 * (x - 30), x / 60
    want = (x + 30 * 1.3) / 2.3 / 60  # pixels lie 2.3 apart
    coc, colour = coc[None, None], colour[None, None]
    closed = view(colour, coc, (0.5, 0.0), tolerance=1.5)
    assert torch.allclose(closed[0, 0], want, atol=1e-12)
    open_ = (view(colour, coc, (0.5, 0.0), tolerance=1.0)[0, 0] - want).abs() > 0.3 / 60
    assert 15 < open_[2].sum() < 45


def test_the_nearest_surface_hides_the_others() -> None:
    """Three planes, each half as wide as the one behind; their order on the ray is that of depth, not of place."""
    coc = torch.full((1, 1, 1, 48), 10.0, dtype=F64)
    coc[..., 12:36], coc[..., 18:30] = 2.0, -6.0
    colour = torch.where(coc == 10, 0.1, torch.where(coc == 2, 0.2, 0.3))
    got = view(colour, coc, (1.0, 0.0))[0, 0, 0]
    for part, want in (
        (got[12:24], 0.3),  # the nearest, moved by 6 to the left
        (got[32:38], 0.2),  # the middle one, moved by 2 to the right
        (got[2:12], 0.1),
        (got[46:], 0.1),
    ):
        assert (part - want).abs().max() < 1e-6


@pytest.mark.parametrize("depth", [1e4, math.inf])
@pytest.mark.parametrize("dtype", [F32, F64])
def test_beyond_the_image_its_border_goes_on(depth: float, dtype: torch.dtype) -> None:
    colour = random(1, 3, 6, 8, dtype=dtype)
    coc = torch.full((1, 1, 6, 8), depth, dtype=dtype)
    for offset, want in (
        ((0.5, 0.0), colour[..., :1].expand_as(colour)),
        ((-0.5, 0.0), colour[..., -1:].expand_as(colour)),
        ((0.0, 0.5), colour[..., :1, :].expand_as(colour)),
        ((0.5, -0.5), colour[..., -1:, :1].expand_as(colour)),
    ):
        assert torch.allclose(view(colour, coc, offset), want, atol=1e-6)
        assert torch.allclose(view(colour, -coc, (-offset[0], -offset[1])), want, atol=1e-6)


@pytest.mark.parametrize("scale", [1e4, 1e30])
@pytest.mark.parametrize("dtype", [F32, F64])
def test_stiff_scenes_stay_within_the_colours(scale: float, dtype: torch.dtype) -> None:
    colour = random(2, 3, 17, 21, dtype=dtype)
    coc = ((random(2, 1, 17, 21, seed=3) - 0.5) * scale).to(dtype)
    coc[..., 8:, :] = 0.1
    for radius in (1e-6, 0.3, 1e6):
        out = subsample_blur(colour, coc, ring(4, radius, dtype), tolerance=1.5)
        assert out.isfinite().all()
        assert out.min() >= colour.min() - 1e-6
        assert out.max() <= colour.max() + 1e-6


def test_a_highlight_leaves_no_trace_elsewhere() -> None:
    colour, coc = random(1, 3, 40, 40, dtype=F32), surfaces(1, 40, 40).float()
    coc = coc.clamp(-8, 8)
    offsets = ring(4, 0.25, F32)
    plain = subsample_blur(colour, coc, offsets)
    colour[..., 20, 20] = 1e6
    lit = subsample_blur(colour, coc, offsets)
    away = torch.ones(40, 40, dtype=torch.bool)
    away[16:25, 16:25] = False
    assert torch.equal(lit[..., away], plain[..., away])
    assert lit.max() > 1e5


@pytest.mark.parametrize("shape", [(1, 1, 1, 1), (2, 3, 1, 1), (1, 2, 1, 9), (1, 2, 9, 1), (0, 3, 4, 4)])
@pytest.mark.parametrize("dtype", [F32, F64])
def test_small_images(shape: tuple[int, int, int, int], dtype: torch.dtype) -> None:
    colour = random(*shape, dtype=dtype)
    coc = random(shape[0], 1, *shape[2:], seed=1, dtype=dtype) * 20 - 10
    out = subsample_blur(colour, coc, ring(3, 0.4, dtype))
    assert out.shape == colour.shape
    if shape[2:] == (1, 1):
        assert torch.equal(out, colour)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", [F32, F64])
def test_a_batch_is_its_items_one_by_one(device: str, dtype: torch.dtype) -> None:
    colour, coc = random(3, 5, 22, 18, dtype=dtype).to(device), surfaces(3, 22, 18).to(device, dtype)
    coc[1] *= 0.1
    offsets, rest = ring(4, 0.3, dtype).to(device), {"far": 8.0, "background": colour.flip(-1)}
    items = [
        subsample_blur(colour[k : k + 1], coc[k : k + 1], offsets, far=8.0, background=colour.flip(-1)[k : k + 1])
        for k in range(3)
    ]
    assert torch.allclose(subsample_blur(colour, coc, offsets, **rest), torch.cat(items), atol=1e-7)


@few
@given(
    h=st.integers(1, 26),
    w=st.integers(1, 26),
    channels=st.integers(1, 6),
    seed=st.integers(0, 999),
    radius=st.sampled_from([1e-3, 0.1, 0.25, 1.0, 40.0]),
    whole=st.booleans(),
    iterations=st.integers(0, 4),
    tolerance=st.sampled_from([0.0, 0.5, 1.0, 1.5]),
)
def test_the_kernel_computes_what_the_torch_definition_does(
    h: int, w: int, channels: int, seed: int, radius: float, whole: bool, iterations: int, tolerance: float
) -> None:
    colour, background = random(2, channels, h, w, seed=seed), random(2, channels, h, w, seed=seed + 1)
    coc = surfaces(2, h, w, seed)
    coc[1] += random(h, w, seed=seed) * 4
    offsets = (random(5, 2, seed=seed) * 2 - 1) * radius
    if whole:  # rays that meet pixels and depths exactly, and views along one axis
        coc, offsets = coc.round(), (offsets * 8).round() / 8
    keywords: dict[str, Any] = {"far": 6.0, "iterations": iterations, "tolerance": tolerance}
    coc, offsets = coc.float().double(), offsets.float().double()
    want = subsample_blur(colour, coc, offsets, background=background, **keywords)
    images = (t.float() for t in (colour, coc, offsets))
    got = subsample_blur(*images, background=background.float(), **keywords)
    assert (got.dtype, want.dtype) == (F32, F64)
    assert torch.allclose(got.double(), want, atol=1e-6)


def test_without_numba_the_definition_takes_over(monkeypatch: pytest.MonkeyPatch) -> None:
    colour, coc, offsets = random(1, 3, 20, 24, dtype=F32), surfaces(1, 20, 24).float(), ring(4, 0.3, F32)
    fast = subsample_blur(colour, coc, offsets)
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "numba" else find_spec(name))
    dispatch.numba_is_there.cache_clear()
    try:
        with pytest.warns(UserWarning, match="numba is not installed"):
            slow = subsample_blur(colour, coc, offsets)
    finally:
        dispatch.numba_is_there.cache_clear()
    assert torch.allclose(fast, slow, atol=1e-6)


def test_same_bits_for_any_number_of_threads() -> None:
    colour, coc, offsets = random(2, 5, 75, 30, dtype=F32), surfaces(2, 75, 30).float(), ring(4, 0.3, F32)
    results = []
    for count in (1, 2, 3):
        torch.set_num_threads(count)
        results.append(subsample_blur(colour, coc, offsets))
    assert torch.equal(results[0], results[1])
    assert torch.equal(results[0], results[2])


def test_the_layout_in_memory_does_not_matter() -> None:
    colour, coc, offsets = random(2, 3, 20, 24, dtype=F32), surfaces(2, 20, 24).float(), ring(4, 0.3, F32)
    other = colour.contiguous(memory_format=torch.channels_last), coc.mT.contiguous().mT, offsets.T.contiguous().T
    assert torch.equal(subsample_blur(colour, coc, offsets), subsample_blur(*other))


def test_gradients_match_finite_differences() -> None:
    coc, offsets = surfaces(1, 7, 8), ring(3, 0.3)
    images = [random(1, 2, 7, 8, seed=k).requires_grad_() for k in range(2)]

    def blur(colour: Tensor, background: Tensor) -> Tensor:
        return subsample_blur(colour, coc, offsets, far=6.0, background=background)

    blur(*images).sum().backward()
    assert all(t.grad is not None and t.grad.abs().sum() > 0 for t in images)
    assert torch.autograd.gradcheck(blur, images)


def test_float32_gradients_are_those_of_float64() -> None:
    grads = []
    for dtype in (F32, F64):
        colour = random(1, 3, 15, 13, dtype=dtype).requires_grad_()
        coc = surfaces(1, 15, 13).to(dtype).requires_grad_()
        out = subsample_blur(colour, coc, ring(4, 0.3, F32).to(dtype))
        out.square().sum().backward()
        assert colour.grad is not None
        assert coc.grad is None
        grads.append(colour.grad.double())
        plain = subsample_blur(colour.detach(), coc.detach(), ring(4, 0.3, F32).to(dtype))
        assert torch.allclose(plain, out.detach(), atol=1e-6)
    assert torch.allclose(*grads, atol=1e-5)


@few
@given(h=st.integers(1, 14), w=st.integers(1, 14), seed=st.integers(0, 999), reach=st.sampled_from([0.05, 0.3, 2.0]))
def test_bounds_enclose_what_the_rays_meet_and_tighten(h: int, w: int, seed: int, reach: float) -> None:
    coc = surfaces(1, h, w, seed) + random(1, 1, h, w, seed=seed)
    y, x = grid(h, w)
    before = None
    for iterations in range(4):
        low, high = coc_bounds(coc, reach, iterations)
        assert (low <= coc).all()
        assert (high >= coc).all()
        if before is None:
            assert (low == coc.min()).all()
            assert (high == coc.max()).all()
        else:
            assert (low >= before[0]).all()
            assert (high <= before[1]).all()
        before = low, high
        # Every pixel within reach of another by its own circle of confusion lies in the bounds of that other.
        away = torch.maximum((x.flatten()[:, None] - x.flatten()).abs(), (y.flatten()[:, None] - y.flatten()).abs())
        flat = coc.flatten()
        meets = away <= flat.abs() * reach  # [pixel, the other one's]
        assert (flat >= low.flatten()[:, None])[meets].all()
        assert (flat <= high.flatten()[:, None])[meets].all()


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"colour": None}, TypeError, r"colour: expected a tensor of shape \(B, C, H, W\), got NoneType"),
        ({"coc": torch.ones(1, 2, 4, 5)}, ValueError, r"coc: expected shape \(1, 1, 4, 5\), got \(1, 2, 4, 5\)"),
        ({"coc": torch.ones(1, 1, 4, 5).int()}, TypeError, "coc: expected a floating-point tensor"),
        ({"coc": torch.full((1, 1, 4, 5), math.nan)}, ValueError, "coc: expected numbers, got NaN"),
        ({"offsets": torch.ones(2, 3)}, ValueError, r"offsets: expected shape \(S, 2\), got \(2, 3\)"),
        ({"offsets": torch.full((2, 2), math.inf)}, ValueError, "offsets: expected finite numbers"),
        ({"background": torch.ones(1, 1, 4, 5)}, ValueError, r"background: expected shape \(1, 3, 4, 5\), got"),
        ({"far": math.nan}, ValueError, "far: expected a number, got nan"),
        ({"iterations": -1}, ValueError, "iterations: expected at least 0, got -1"),
        ({"tolerance": -0.5}, ValueError, "tolerance: expected at least 0 px, got -0.5"),
        ({"tolerance": math.nan}, ValueError, "tolerance: expected at least 0 px, got nan"),
    ],
)
def test_subsample_blur_refuses(change: dict[str, Any], error: type[Exception], message: str) -> None:
    given_: dict[str, Any] = {"colour": torch.ones(1, 3, 4, 5), "coc": torch.ones(1, 1, 4, 5), "offsets": ring(2, 0.1)}
    with pytest.raises(error, match=message):
        subsample_blur(**{**given_, **change})


def test_examples_in_the_docstrings() -> None:
    result = doctest.testmod(torchbokeh.ops.raycast)
    assert result.attempted > 0
    assert result.failed == 0
