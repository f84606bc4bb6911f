import doctest
import importlib.util
import math
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn
from torch.func import functional_call
from torch.utils.data import DataLoader, Dataset

import torchbokeh.ops.splat
from torchbokeh.ops import dispatch
from torchbokeh.ops.dense import dense_spans
from torchbokeh.ops.integrate import running_sum_x
from torchbokeh.ops.merge import Merging, splat_merged
from torchbokeh.ops.spans import Profile, subdivide
from torchbokeh.ops.splat import PointTable, splat_points, splat_spans
from torchbokeh.psfs import Aperture, Disc, Ellipse, Polygon

F32, F64 = torch.float32, torch.float64
SHAPES = {
    "disc": Disc(),
    "ellipse": Ellipse(1.8, 0.5),
    "hexagon": Polygon(6, 0.3),
    "round blades": Polygon(5, 0.4, 0.7),
}
PIECES = {
    "triangle": Polygon(3, 1.0),
    "square": Polygon(4, math.pi / 4),
    "pentagon": Polygon(5, 0.3, 0.5),
    "hexagon": Polygon(6),
    "ellipse": Ellipse(2.0, 0.4),
}
few = settings(deadline=None, max_examples=15)


@pytest.fixture(params=SHAPES)
def shape(request: pytest.FixtureRequest) -> Aperture:
    return SHAPES[request.param]


def scene(b: int, c: int, h: int, w: int, dtype: torch.dtype = F32, reach: float = 300.0) -> tuple[Tensor, Tensor]:
    """Random values and CoC, radii of both signs from 0 up to ``reach``, evenly spread over their magnitudes."""
    seed = torch.Generator().manual_seed(b * 1000 + c * 100 + h)
    values = torch.rand(b, c, h, w, generator=seed, dtype=F64)
    radius = reach ** torch.empty(b, 1, h, w, dtype=F64).uniform_(-0.3, 1, generator=seed)
    sign = torch.randint(0, 2, radius.shape, generator=seed) * 2 - 1
    radius = torch.where(torch.rand(radius.shape, generator=seed) < 0.05, 0.0, radius)
    # Rounded to float32 first: tests in either dtype then see the same scene.
    return values.float().to(dtype), (radius * sign).float().to(dtype)


def gradients(out: Tensor, seed: Tensor, *inputs: Tensor) -> tuple[Tensor, ...]:
    return torch.autograd.grad(out, inputs, seed.to(out.dtype))


def assert_close(got: Tensor, want: Tensor, relative: float) -> None:
    got, want = got.detach().double(), want.detach().double()
    torch.testing.assert_close(got, want, rtol=0, atol=relative * float(want.abs().max()))


@pytest.mark.parametrize(("dtype", "relative"), [(F32, 1e-5), (F64, 1e-10)])
def test_equals_drawing_every_psf_densely(shape: Aperture, dtype: torch.dtype, relative: float) -> None:
    values, coc = scene(1, 3, 24, 40, dtype)
    want = dense_spans(values, coc, shape.profile())
    assert_close(splat_spans(values, coc, shape.profile(), integrate=True), want, relative)
    assert_close(running_sum_x(splat_spans(values, coc, shape.profile())), want, relative)


@pytest.mark.parametrize("size", [(1, 1), (1, 17), (17, 1), (2, 3)])
@pytest.mark.parametrize("dtype", [F32, F64])
def test_tiny_images(shape: Aperture, dtype: torch.dtype, size: tuple[int, int]) -> None:
    values, coc = scene(2, 2, *size, dtype, reach=10.0)
    want = dense_spans(values, coc, shape.profile())
    assert_close(splat_spans(values, coc, shape.profile(), integrate=True), want, 1e-5)


@pytest.mark.parametrize("dtype", [torch.float16, F32, F64])
@pytest.mark.parametrize("size", [(0, 3, 4, 5), (2, 0, 4, 5), (2, 3, 0, 5), (2, 3, 4, 0)])
def test_empty_pictures(dtype: torch.dtype, size: tuple[int, ...]) -> None:
    values = torch.zeros(size, dtype=dtype, requires_grad=True)
    coc = torch.zeros(size[0], 1, *size[2:], dtype=dtype)
    merged = splat_merged(values, coc.float(), Disc().profile(), Merging(4.0, 0.015))
    for out in (splat_spans(values, coc, Disc().profile()), merged):
        assert out.shape == values.shape
        assert out.dtype == values.dtype
        out.sum().backward()
    assert values.grad is not None


def test_the_default_dtype_changes_nothing() -> None:
    values, coc = scene(1, 2, 9, 14, F32)
    profile, asked = Disc().profile(), coc.clone().requires_grad_()
    want = splat_spans(values, asked, profile)
    torch.set_default_dtype(F64)
    try:
        out = splat_spans(values, asked, profile)
        grad = torch.autograd.grad(out.sum(), asked)
    finally:
        torch.set_default_dtype(F32)
    assert torch.equal(out, want)
    assert torch.equal(grad[0], torch.autograd.grad(want.sum(), asked)[0])


@pytest.mark.parametrize("dtype", [F32, F64])
def test_radii_within_a_pixel_leave_the_image_as_it_is(shape: Aperture, dtype: torch.dtype) -> None:
    values, _ = scene(1, 2, 5, 9, dtype)
    coc = torch.linspace(-0.5, 0.5, 45, dtype=dtype).reshape(1, 1, 5, 9)
    assert_close(splat_spans(values, coc, shape.profile(), integrate=True), values, 1e-6)


@pytest.mark.parametrize("channels", [1, 2, 3, 4, 5])
@pytest.mark.parametrize("integrate", [True, False])
def test_the_kernel_computes_what_the_torch_definition_does(channels: int, integrate: bool, shape: Aperture) -> None:
    values, coc = (t.requires_grad_() for t in scene(2, channels, 70, 9))
    got = splat_spans(values, coc, shape.profile(), integrate=integrate)
    want = splat_spans(values.double(), coc.double(), shape.profile(), integrate=integrate)
    assert got.dtype == F32
    assert want.dtype == F64
    assert_close(got, want, 1e-6)
    seed = torch.randn(got.shape, generator=torch.Generator().manual_seed(0))
    for mine, theirs in zip(gradients(got, seed, values, coc), gradients(want, seed, values, coc), strict=True):
        assert_close(mine, theirs, 1e-6)


def test_a_part_of_a_lens_need_not_reach_its_centre() -> None:
    values, coc = (t.requires_grad_() for t in scene(1, 3, 20, 30, reach=60.0))
    for profile in subdivide(Disc().profile(), 3)[::4]:
        got = splat_spans(values, coc, profile, integrate=True)
        want = splat_spans(values.double(), coc.double(), profile, integrate=True)
        assert_close(got, want, 1e-6)
        assert_close(want, dense_spans(values, coc, profile), 1e-9)
        seed = torch.randn(got.shape, generator=torch.Generator().manual_seed(0))
        for mine, theirs in zip(gradients(got, seed, values, coc), gradients(want, seed, values, coc), strict=True):
            assert_close(mine, theirs, 1e-6)


def turned(blades: int) -> Any:
    return lambda angle: functional_call(Polygon(blades), {"rotation": angle}, ())


def curved(curvature: Tensor) -> Profile:
    return functional_call(Polygon(5, 0.3, 0.5), {"curvature": curvature}, ())


def ellipse(squeeze: Tensor, rotation: Tensor) -> Profile:
    return functional_call(Ellipse(2.0, 0.5), {"squeeze": squeeze, "rotation": rotation}, ())


@pytest.mark.parametrize("integrate", [True, False])
@pytest.mark.parametrize(
    ("build", "settings"),
    [(turned(6), [0.3]), (curved, [0.6]), (ellipse, [1.7, 0.4])],
    ids=["turn", "curve", "ellipse"],
)
def test_gradients_match_finite_differences(build: Any, settings: list[float], integrate: bool) -> None:
    values, _ = scene(1, 2, 4, 5, F64)
    coc = torch.empty(1, 1, 4, 5, dtype=F64).uniform_(0.6, 6.0, generator=torch.Generator().manual_seed(1))
    coc[..., ::2] *= -1
    coc[..., 0, :2] = torch.tensor([0.2, -0.3])
    inputs = (values, coc, *(torch.tensor(s, dtype=F64) for s in settings))

    def blur(values: Tensor, coc: Tensor, *settings: Tensor) -> Tensor:
        return splat_spans(values, coc, build(*settings), integrate=integrate)

    assert torch.autograd.gradcheck(blur, [t.requires_grad_() for t in inputs])


@pytest.mark.parametrize("side", [1, 2, 3])
@pytest.mark.parametrize("name", ["triangle", "square", "pentagon", "hexagon", "ellipse"])
def test_the_gradient_of_a_piece_of_a_lens_matches_finite_differences(name: str, side: int) -> None:
    """Where edges are level or upright, outlines have pieces of a height of rounding: they must not take the end of the
    shape with them, which moves with the radius."""
    seed, step = torch.Generator().manual_seed(0), 1e-6
    values, by_out, way = (torch.randn(1, 1, 9, 9, dtype=F64, generator=seed) for _ in range(3))
    coc = torch.empty(1, 1, 9, 9, dtype=F64).uniform_(0.7, 6.7, generator=seed)
    for piece in subdivide(PIECES[name].profile(), side):
        asked = coc.clone().requires_grad_()
        (splat_spans(values, asked, piece, integrate=True) * by_out).sum().backward()
        ahead, behind = (splat_spans(values, coc + s * way, piece, integrate=True) for s in (step, -step))
        want = float(((ahead - behind) * by_out).sum()) / (2 * step)
        assert float((asked.grad * way).sum()) == pytest.approx(want, rel=1e-6, abs=1e-6)


def test_the_gradient_holds_up_to_where_an_edge_leaves_a_pixel() -> None:
    """An almost level edge of a square comes to the border of a row at a radius of 6.36396."""
    piece = subdivide(Polygon(4, 0.7853981).profile(), 3)[2]
    values, by_out = torch.zeros(1, 1, 25, 25, dtype=F64), scene(1, 1, 25, 25, F64)[0]
    values[..., 12, 12] = 1
    slopes = []
    for radius in (6.3637, 6.3638, 6.36385, 6.3639):
        coc = torch.full_like(values, radius).requires_grad_()
        (splat_spans(values, coc, piece, integrate=True) * by_out).sum().backward()
        slopes.append(float(coc.grad.sum()))
    assert max(slopes) - min(slopes) < 1e-3


def test_a_trained_aperture_gets_its_gradient_in_float32() -> None:
    values, coc = scene(1, 3, 9, 11, reach=8.0)
    shapes = [Polygon(6, rotation=nn.Parameter(torch.tensor(0.3, dtype=t))) for t in (F32, F64)]
    slopes = []
    for shape, dtype in zip(shapes, (F32, F64), strict=True):
        out = splat_spans(values.to(dtype), coc.to(dtype), shape.profile(), integrate=True)
        (out * torch.linspace(0, 1, 11)).square().sum().backward()
        slopes.append(float(shape.rotation.grad))
    assert slopes[0] == pytest.approx(slopes[1], rel=1e-4)
    assert abs(slopes[1]) > 1e-4


@pytest.mark.parametrize("dtype", [F32, F64])
def test_operators_keep_the_rules_of_torch(dtype: torch.dtype) -> None:
    values, coc = (t.requires_grad_() for t in scene(1, 3, 6, 7, dtype))
    knots, bulge = Polygon(5).profile()
    for integrate in (True, False):
        torch.library.opcheck(torch.ops.torchbokeh.splat_spans.default, (values, coc, knots, bulge, integrate))
    args = (torch.rand_like(values), values.detach(), coc.detach(), knots, bulge)
    for shape in (True, False):
        torch.library.opcheck(torch.ops.torchbokeh.gather_spans.default, (*args, shape))


def test_compiles_to_one_graph_for_any_size(shape: Aperture) -> None:
    def blur(values: Tensor, coc: Tensor) -> Tensor:
        return splat_spans(values, coc, shape.profile(), integrate=True)

    compiled = torch.compile(blur, backend="aot_eager", fullgraph=True, dynamic=True)
    for size in ((5, 6), (7, 9)):
        values, coc = (t.requires_grad_() for t in scene(1, 3, *size, reach=6.0))
        results = [f(values, coc) for f in (blur, compiled)]
        assert_close(results[1], results[0], 1e-6)
        seed = torch.rand_like(values)
        for mine, theirs in zip(*(gradients(out, seed, values, coc) for out in results), strict=True):
            assert_close(mine, theirs, 1e-6)


def test_same_bits_for_any_number_of_threads(shape: Aperture) -> None:
    values, coc = (t.requires_grad_() for t in scene(2, 5, 150, 12))
    seed = torch.rand_like(values)
    results = []
    for count in (1, 2, 3):
        torch.set_num_threads(count)
        out = splat_spans(values, coc, shape.profile(), integrate=True)
        results.append((out, *gradients(out, seed, values, coc)))
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


class Blurred(Dataset[Tensor]):
    """Samples that are splatted where they are loaded."""

    def __len__(self) -> int:
        return 4

    def __getitem__(self, k: int) -> Tensor:
        values, coc = scene(1, 3, 20 + k, 16)
        index = (coc > 0).long()
        table = PointTable(torch.tensor([[0.0, 0.0], [1.5, -2.0]]), torch.ones(2), torch.tensor([0, 1, 2]))
        spans = splat_spans(values, coc, Disc().profile(), integrate=True)
        return torch.cat([spans.flatten(), splat_points(values, index, table, pad=2).flatten()])


@pytest.mark.filterwarnings("ignore:.*multi-threaded.*fork.*:DeprecationWarning")
def test_works_in_forked_workers_after_the_parent_has_used_it() -> None:
    torch.set_num_threads(2)
    data = Blurred()
    here = [data[k] for k in range(len(data))]
    loader = DataLoader(data, batch_size=None, num_workers=2, multiprocessing_context="fork", timeout=60)
    there = list(loader)
    assert len(there) == len(here)
    assert all(torch.equal(a, b) for a, b in zip(here, there, strict=True))


@pytest.mark.parametrize("dtype", [F32, F64])
def test_linear_in_the_values(shape: Aperture, dtype: torch.dtype) -> None:
    one, coc = scene(1, 2, 11, 13, dtype)
    other = one.flip(-1)

    def blur(values: Tensor) -> Tensor:
        return splat_spans(values, coc, shape.profile(), integrate=True)

    assert_close(blur(2 * one - 3 * other), 2 * blur(one) - 3 * blur(other), 1e-5)
    assert torch.equal(blur(torch.zeros_like(one)), torch.zeros_like(one))


@pytest.mark.parametrize("dtype", [F32, F64])
@pytest.mark.parametrize("integrate", [True, False])
def test_backward_is_the_adjoint(shape: Aperture, dtype: torch.dtype, integrate: bool) -> None:
    values, coc = scene(2, 3, 12, 14, dtype)
    seed = torch.randn(values.shape, generator=torch.Generator().manual_seed(5)).to(dtype)
    out = splat_spans(values.requires_grad_(), coc, shape.profile(), integrate=integrate)
    (back,) = gradients(out, seed, values)
    forwards, backwards = (out.detach().double() * seed).sum(), (values.detach().double() * back).sum()
    assert float(forwards) == pytest.approx(float(backwards), rel=1e-5)


@pytest.mark.parametrize("dtype", [F32, F64])
def test_a_batch_equals_its_images_one_by_one(dtype: torch.dtype) -> None:
    values, coc = scene(3, 5, 12, 14, dtype)
    profile = Polygon(7).profile()
    together = splat_spans(values, coc, profile)
    for n in range(3):
        assert torch.equal(together[n : n + 1], splat_spans(values[n : n + 1], coc[n : n + 1], profile))


@given(radius=st.floats(0, 13), name=st.sampled_from(list(SHAPES)), double=st.booleans(), front=st.booleans())
@few
def test_energy_is_conserved_within_the_image(radius: float, name: str, double: bool, front: bool) -> None:
    dot = torch.zeros(1, 1, 29, 29, dtype=F64 if double else F32)
    dot[..., 14, 14] = 3
    coc = torch.full_like(dot, -radius if front else radius)
    out = splat_spans(dot, coc, SHAPES[name].profile(), integrate=True)
    assert float(out.double().sum()) == pytest.approx(3, rel=1e-5)
    assert float(out.min()) > -1e-6


def test_a_psf_beyond_the_image_is_flat() -> None:
    dot = torch.zeros(1, 1, 8, 8)
    dot[..., 3, 4] = 1
    out = splat_spans(dot, torch.full_like(dot, 1e4), Disc().profile(), integrate=True)
    assert_close(out, torch.full_like(out, 1 / (math.pi * 1e8)), 1e-6)


@pytest.mark.parametrize("radius", [0.0, 3.3, 20.0])
def test_a_highlight_leaves_no_trace_on_its_rows(shape: Aperture, radius: float) -> None:
    dot = torch.zeros(1, 4, 9, 300)
    dot[..., 4, 40] = 1e6
    out = splat_spans(dot, torch.full((1, 1, 9, 300), radius), shape.profile(), integrate=True)
    assert float(out[..., 65:].abs().max()) < 1e-6 * float(out.max())
    # What is left is rounding of the row's own ends: it does not grow along the row.
    assert float((out[..., -1] - out[..., 65]).abs().max()) < 1e-7 * float(out.max())


def test_bad_input_is_named() -> None:
    values, coc = scene(2, 3, 4, 5)
    profile = Disc().profile()
    with pytest.raises(TypeError, match=r"values: expected a tensor of shape \(B, C, H, W\), got list"):
        splat_spans([1.0], coc, profile)
    with pytest.raises(ValueError, match=r"values: expected shape \(B, C, H, W\), got \(3, 4, 5\)"):
        splat_spans(values[0], coc, profile)
    with pytest.raises(TypeError, match=r"values: expected a floating-point tensor, got torch.int64"):
        splat_spans(values.long(), coc, profile)
    with pytest.raises(ValueError, match=r"coc: expected shape \(2, 1, 4, 5\), got \(2, 2, 4, 5\)"):
        splat_spans(values, coc.expand(2, 2, 4, 5), profile)
    with pytest.raises(ValueError, match=r"coc: expected device cpu, got meta"):
        splat_spans(values, coc.to("meta"), profile)
    with pytest.raises(ValueError, match=r"profile.knots: expected shape \(K, 3\), got \(2, 2\)"):
        splat_spans(values, coc, Profile(profile.knots[:, :2], profile.bulge))
    with pytest.raises(ValueError, match=r"profile.bulge: expected shape \(\), got \(1,\)"):
        splat_spans(values, coc, Profile(profile.knots, profile.bulge[None]))


@pytest.mark.parametrize(("dtype", "relative"), [(torch.float16, 1e-3), (torch.bfloat16, 1e-2)])
def test_half_precision_is_computed_in_float32(dtype: torch.dtype, relative: float) -> None:
    values, coc = scene(1, 3, 12, 14, dtype, reach=8.0)
    out = splat_spans(values.requires_grad_(), coc, Disc().profile(), integrate=True)
    assert out.dtype == dtype
    assert_close(out, splat_spans(values.float(), coc.float(), Disc().profile(), integrate=True), relative)
    out.float().sum().backward()
    assert values.grad is not None
    assert values.grad.dtype == dtype


@pytest.mark.parametrize("dtype", [F32, F64])
def test_the_memory_layout_does_not_matter(dtype: torch.dtype) -> None:
    values, coc = scene(2, 3, 12, 14, dtype, reach=8.0)
    want = splat_spans(values, coc, Disc().profile())
    strided = [t.permute(0, 2, 3, 1).contiguous().permute(0, 3, 1, 2) for t in (values, coc)]
    widened = [torch.stack([t, t + 1], -1)[..., 0] for t in (values, coc)]
    for v, r in (strided, widened):
        assert not v.is_contiguous()
        v.requires_grad_()
        out = splat_spans(v, r, Disc().profile())
        assert torch.equal(out, want)
        assert gradients(out, torch.ones_like(want).permute(0, 1, 3, 2).contiguous().mT, v)[0].isfinite().all()
    flat = torch.full((), 3.0, dtype=dtype).expand(2, 1, 12, 14)
    assert torch.equal(splat_spans(values, flat, Disc().profile()), splat_spans(values, flat.clone(), Disc().profile()))


def test_without_numba_the_torch_path_takes_over_and_says_so_once(monkeypatch: pytest.MonkeyPatch) -> None:
    values, coc = scene(1, 3, 12, 14)
    profile = Disc().profile()
    want = splat_spans(values, coc, profile)
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *a: None if name == "numba" else find(name, *a))
    monkeypatch.setattr(torchbokeh.ops.kernels, "splat", None)
    dispatch.numba_is_there.cache_clear()
    try:
        with pytest.warns(UserWarning, match=r"numba is not installed.*pip install torchbokeh\[cpu\]"):
            assert_close(splat_spans(values, coc, profile), want, 1e-6)
        splat_spans(values, coc, profile)  # a second warning would be an error
    finally:
        monkeypatch.undo()
        dispatch.numba_is_there.cache_clear()


def test_examples() -> None:
    assert doctest.testmod(torchbokeh.ops.splat).failed == 0
