import doctest
import importlib.util
import itertools
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

import torchbokeh.ops.points
from torchbokeh.ops import dispatch
from torchbokeh.ops.dense import dense_points
from torchbokeh.ops.points import PointTable, splat_points

F32, F64 = torch.float32, torch.float64
FRAMES = list(itertools.product([False, True], repeat=2))


def table(psfs: int = 4, reach: int = 3, whole: bool = True, dtype: torch.dtype = F32, seed: int = 0) -> PointTable:
    """PSFs of 0, 1, 2, ... random points."""
    draw = torch.Generator().manual_seed(seed)
    counts = torch.arange(psfs).cumsum(0)
    counts = torch.cat([torch.zeros(1, dtype=torch.int64), counts])
    offsets = torch.rand(int(counts[-1]), 2, generator=draw, dtype=F64) * 2 * reach - reach
    weights = torch.randn(len(offsets), generator=draw, dtype=F64)
    return PointTable((offsets.round() if whole else offsets.float()).to(dtype), weights.float().to(dtype), counts)


def scene(
    b: int, c: int, h: int, w: int, dtype: torch.dtype = F32, rotated: bool = False, moved: bool = False, psfs: int = 4
) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
    """Values, index and keywords, the same numbers in either dtype."""
    draw = torch.Generator().manual_seed(100 * c + h)
    values = torch.rand(b, c, h, w, generator=draw)
    values[..., 0, 0] = 0
    index = torch.randint(0, psfs, (b, 1, h, w), generator=draw)
    frame = {}
    if rotated:
        frame["rotation"] = torch.randn(b, 2, 2, h, w, generator=draw).to(dtype)
    if moved:
        frame["position"] = (torch.rand(b, 2, h, w, generator=draw) * (max(h, w) + 6) - 3).to(dtype)
    return values.to(dtype), index, frame


def assert_close(got: Tensor, want: Tensor, relative: float) -> None:
    got, want = got.detach().double(), want.detach().double()
    torch.testing.assert_close(got, want, rtol=0, atol=relative * float(want.abs().max()))


@pytest.mark.parametrize(("rotated", "moved"), FRAMES)
@pytest.mark.parametrize("whole", [True, False])
@pytest.mark.parametrize("pad", [0, 2, 3])
@pytest.mark.parametrize(("dtype", "relative"), [(F32, 2e-6), (F64, 1e-12)])
def test_equals_adding_point_by_point(
    rotated: bool, moved: bool, whole: bool, pad: int, dtype: torch.dtype, relative: float
) -> None:
    values, index, frame = scene(2, 3, 5, 6, dtype, rotated, moved)
    points = table(whole=whole, dtype=dtype)
    out = splat_points(values, index, points, pad=pad, **frame)
    assert out.dtype == dtype
    assert_close(out, dense_points(values, index, points, pad, **frame), relative)


@pytest.mark.parametrize("channels", [1, 2, 3, 4, 5])
@pytest.mark.parametrize(("rotated", "moved"), FRAMES)
@pytest.mark.parametrize("pad", [1, 3])
def test_the_kernel_computes_what_the_torch_definition_does(
    channels: int, rotated: bool, moved: bool, pad: int
) -> None:
    points = table(psfs=8)
    values, index, frame = scene(2, channels, 33, 9, rotated=rotated, moved=moved, psfs=8)
    values.requires_grad_()
    got = splat_points(values, index, points, pad=pad, **frame)
    want = splat_points(values.double(), index, points, pad=pad, **frame)
    assert (got.dtype, want.dtype) == (F32, F64)
    assert_close(got, want, 1e-6)
    seed = torch.randn(got.shape, generator=torch.Generator().manual_seed(0))
    (mine,) = torch.autograd.grad(got, values, seed)
    (theirs,) = torch.autograd.grad(want, values, seed.double())
    assert_close(mine, theirs, 1e-6)


@pytest.mark.parametrize(("rotated", "moved"), FRAMES)
def test_gradients_match_finite_differences(rotated: bool, moved: bool) -> None:
    values, index, frame = scene(2, 2, 3, 4, F64, rotated, moved)
    points = table(reach=2, whole=False, dtype=F64)
    inputs = [values, points.offsets, points.weights, *frame.values()]

    def splat(values: Tensor, offsets: Tensor, weights: Tensor, *given: Tensor) -> Tensor:
        moved_table = PointTable(offsets, weights, points.counts)
        return splat_points(values, index, moved_table, pad=1, **dict(zip(frame, given, strict=True)))

    assert torch.autograd.gradcheck(splat, [t.requires_grad_() for t in inputs])


def test_float32_gradients_of_the_geometry_are_those_of_float64() -> None:
    slopes: list[list[Tensor]] = []
    for dtype in (F32, F64):
        values, index, frame = scene(1, 3, 4, 5, dtype, rotated=True, moved=True)
        points = table(whole=False, dtype=dtype)
        inputs = [t.requires_grad_() for t in (values, points.offsets, points.weights, *frame.values())]
        out = splat_points(values, index, points, pad=2, **frame)
        out.square().sum().backward()
        slopes.append([t.grad for t in inputs if t.grad is not None])
    assert len(slopes[0]) == len(slopes[1]) == 5
    for single, double in zip(*slopes, strict=True):
        assert single.dtype == F32
        assert_close(single, double, 1e-5)


def test_only_what_is_asked_for_gets_a_gradient() -> None:
    values, index, frame = scene(1, 1, 3, 4, F64, moved=True)
    frame["position"].requires_grad_()
    splat_points(values, index, table(whole=False), pad=2, **frame).square().sum().backward()
    assert frame["position"].grad is not None
    assert frame["position"].grad.abs().sum() > 0


def test_the_torch_path_works_in_pieces_of_any_size(monkeypatch: pytest.MonkeyPatch) -> None:
    values, index, frame = scene(2, 2, 5, 6, F64, rotated=True)
    points = table(psfs=6, whole=False, dtype=F64)
    inputs = [t.requires_grad_() for t in (values, points.offsets, points.weights, frame["rotation"])]

    def run() -> tuple[Tensor, ...]:
        out = splat_points(values, index, points, pad=2, **frame)
        return (out, *torch.autograd.grad(out.square().sum(), inputs))

    whole = run()
    for chunk in (1, 7, 40):
        monkeypatch.setattr(torchbokeh.ops.points, "CHUNK", chunk)
        sizes = [len(p) for p, _ in torchbokeh.ops.points._expand(index, points.counts, torch.ones(60) > 0)]
        assert max(sizes) <= max(chunk, 5)
        assert sum(sizes) == int(index.sum())
        for got, want in zip(run(), whole, strict=True):
            assert_close(got, want, 1e-12)


@pytest.mark.parametrize("dtype", [F32, F64])
def test_a_whole_step_is_exact(dtype: torch.dtype) -> None:
    values, index, _ = scene(1, 3, 5, 6, dtype, psfs=1)
    step = PointTable(torch.tensor([[2.0, -1.0]]), torch.ones(1), torch.tensor([0, 1]))
    out = splat_points(values, index, step, pad=3)
    assert torch.equal(out[..., 2:7, 5:11], values)
    assert float(out.sum()) == pytest.approx(float(values.sum()))


@pytest.mark.parametrize("dtype", [F32, F64])
def test_the_default_position_is_the_pixel_itself(dtype: torch.dtype) -> None:
    values, index, _ = scene(2, 3, 20, 6, dtype)
    y, x = torch.meshgrid(torch.arange(20), torch.arange(6), indexing="ij")
    position = torch.stack([x, y]).to(dtype).expand(2, 2, 20, 6)
    straight = torch.eye(2, dtype=dtype).reshape(1, 2, 2, 1, 1).expand(2, 2, 2, 20, 6)
    want = splat_points(values, index, table(), pad=3)
    for frame in ({"position": position}, {"rotation": straight}, {"rotation": straight, "position": position}):
        assert torch.equal(splat_points(values, index, table(), pad=3, **frame), want)


@pytest.mark.parametrize("dtype", [F32, F64])
def test_a_rotated_psf_is_the_psf_of_rotated_points(dtype: torch.dtype) -> None:
    values, index, _ = scene(1, 3, 5, 6, dtype)
    points = table()
    quarter = torch.tensor([[0.0, -1.0], [1.0, 0.0]], dtype=dtype)
    rotation = quarter.reshape(1, 2, 2, 1, 1).expand(1, 2, 2, 5, 6)
    turned = points._replace(offsets=points.offsets @ quarter.T.float())
    want = splat_points(values, index, turned, pad=3)
    assert torch.equal(splat_points(values, index, points, pad=3, rotation=rotation), want)


@pytest.mark.parametrize("dtype", [F32, F64])
def test_what_lands_outside_is_dropped(dtype: torch.dtype) -> None:
    values, index, _ = scene(1, 2, 4, 5, dtype, psfs=1)
    far = torch.tensor([[1e9, 0.0], [0.0, -1e9], [0.0, 7.0], [-8.0, 0.0]])
    points = PointTable(far, torch.ones(4), torch.tensor([0, 4]))
    position = torch.full((1, 2, 4, 5), 1e12, dtype=dtype)
    values.requires_grad_()
    for frame in ({}, {"position": position}):
        out = splat_points(values, index, points, pad=2, **frame)
        assert torch.equal(out, torch.zeros(1, 2, 8, 9, dtype=dtype))
        assert torch.equal(torch.autograd.grad(out.sum(), values)[0], torch.zeros_like(values))


@pytest.mark.parametrize("dtype", [F32, F64])
def test_half_of_a_point_on_the_border_stays(dtype: torch.dtype) -> None:
    values, index = torch.ones(1, 1, 1, 1, dtype=dtype), torch.zeros(1, 1, 1, 1, dtype=torch.int64)
    for dx, dy in ((-0.25, 0.0), (0.25, 0.0), (0.0, -0.25), (0.0, 0.25)):
        points = PointTable(torch.tensor([[dx, dy]]), torch.ones(1), torch.tensor([0, 1]))
        assert splat_points(values, index, points, pad=0).tolist() == [[[[0.75]]]]


@given(
    reach=st.integers(0, 5),
    whole=st.booleans(),
    double=st.booleans(),
    size=st.tuples(st.integers(1, 20), st.integers(1, 9)),
)
@settings(deadline=None, max_examples=25)
def test_energy_is_conserved_if_padded_by_the_reach(
    reach: int, whole: bool, double: bool, size: tuple[int, int]
) -> None:
    dtype = F64 if double else F32
    values, index, _ = scene(1, 2, *size, dtype)
    points = table(reach=reach, whole=whole, dtype=dtype)
    gain = torch.stack([w.sum() for w in points.weights.double().split(points.counts.diff().tolist())])
    out = splat_points(values, index, points, pad=reach)
    assert_close(out.double().sum((2, 3)), (values.double() * gain[index]).sum((2, 3)), 1e-5)


@pytest.mark.parametrize(("rotated", "moved"), FRAMES)
@pytest.mark.parametrize("dtype", [F32, F64])
def test_linear_with_the_backward_pass_as_its_adjoint(rotated: bool, moved: bool, dtype: torch.dtype) -> None:
    one, index, frame = scene(2, 3, 9, 7, dtype, rotated, moved)
    other = one.flip(-1).contiguous().requires_grad_()

    def splat(values: Tensor) -> Tensor:
        return splat_points(values, index, table(), pad=2, **frame)

    assert_close(splat(2 * one - 3 * other), 2 * splat(one) - 3 * splat(other), 1e-5)
    out = splat(other)
    seed = torch.randn(out.shape, generator=torch.Generator().manual_seed(3), dtype=F64).to(dtype)
    (back,) = torch.autograd.grad(out, other, seed)
    forwards = (out.detach().double() * seed).sum()
    assert float(forwards) == pytest.approx(float((other.detach().double() * back).sum()), rel=1e-4)


@pytest.mark.parametrize("dtype", [F32, F64])
def test_a_batch_equals_its_images_one_by_one(dtype: torch.dtype) -> None:
    values, index, frame = scene(3, 5, 20, 6, dtype, rotated=True, moved=True)
    together = splat_points(values, index, table(), pad=2, **frame)
    for n in range(3):
        one = {name: t[n : n + 1] for name, t in frame.items()}
        assert torch.equal(
            together[n : n + 1], splat_points(values[n : n + 1], index[n : n + 1], table(), pad=2, **one)
        )


@pytest.mark.parametrize("rotated", [True, False])
def test_same_bits_for_any_number_of_threads(rotated: bool) -> None:
    values, index, frame = scene(2, 5, 60, 12, rotated=rotated, psfs=8)
    values.requires_grad_()
    results = []
    for count in (1, 2, 3):
        torch.set_num_threads(count)
        out = splat_points(values, index, table(psfs=8), pad=3, **frame)
        results.append((out, torch.autograd.grad(out.square().sum(), values)[0]))
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


@pytest.mark.parametrize(("rotated", "moved"), [(False, False), (True, True)])
@pytest.mark.parametrize("dtype", [F32, F64])
def test_operators_keep_the_rules_of_torch(dtype: torch.dtype, rotated: bool, moved: bool) -> None:
    values, index, frame = scene(1, 3, 4, 5, dtype, rotated, moved)
    points = table(whole=False, dtype=F64)
    rotation, position = (frame[k].double() if k in frame else None for k in ("rotation", "position"))
    args = (index, [*points], rotation, position, 2)
    op = torch.ops.torchbokeh
    torch.library.opcheck(op.splat_points.default, (values.requires_grad_(), *args, (4, 5)))
    grad = torch.rand(1, 3, 8, 9, dtype=dtype)
    for geometry in (True, False):
        torch.library.opcheck(op.gather_points.default, (grad, values.detach(), *args, geometry))


def test_compiles_to_one_graph_for_any_size() -> None:
    points = table(whole=False)

    def splat(values: Tensor, index: Tensor, rotation: Tensor) -> Tensor:
        return splat_points(values, index, points, pad=2, rotation=rotation)

    compiled = torch.compile(splat, backend="aot_eager", fullgraph=True, dynamic=True)
    for size in ((5, 6), (7, 9)):
        values, index, frame = scene(1, 3, *size, rotated=True)
        inputs = values.requires_grad_(), frame["rotation"].requires_grad_()
        results = [f(values, index, frame["rotation"]) for f in (splat, compiled)]
        assert_close(results[1], results[0], 1e-6)
        for mine, theirs in zip(*(torch.autograd.grad(r.square().sum(), inputs) for r in results), strict=True):
            assert_close(mine, theirs, 1e-6)
    with pytest.raises(ValueError, match="index: expected 0 to 3"):
        compiled(values, index + 9, frame["rotation"])


@pytest.mark.parametrize("dtype", [F32, F64])
def test_nothing_to_splat(dtype: torch.dtype) -> None:
    empty = PointTable(torch.zeros(0, 2), torch.zeros(0), torch.zeros(3, dtype=torch.int64))
    values, index, _ = scene(1, 3, 4, 5, dtype, psfs=2)
    for v, i, t in ((values, index, empty), (values[:0], index[:0], table()), (0 * values, index, table())):
        v = v.clone().requires_grad_()
        out = splat_points(v, i, t, pad=1)
        assert torch.equal(out, torch.zeros(len(v), 3, 6, 7, dtype=dtype))
        out.sum().backward()
        assert v.grad is not None
    none = PointTable(torch.zeros(0, 2), torch.zeros(0), torch.zeros(1, dtype=torch.int64))
    assert splat_points(values[:0], index[:0], none, pad=1).shape == (0, 3, 6, 7)


@pytest.mark.parametrize("dtype", [F32, F64])
@pytest.mark.parametrize("size", [(1, 1), (1, 9), (9, 1)])
def test_tiny_images(dtype: torch.dtype, size: tuple[int, int]) -> None:
    values, index, frame = scene(2, 3, *size, dtype, rotated=True)
    assert_close(
        splat_points(values, index, table(), pad=2, **frame), dense_points(values, index, table(), 2, **frame), 1e-6
    )


def test_bad_input_is_named() -> None:
    values, index, frame = scene(2, 3, 4, 5, rotated=True, moved=True)
    points = table()

    def expect(error: type[Exception], message: str, **changes: Any) -> None:
        inputs: dict[str, Any] = {"values": values, "index": index, "table": points, "pad": 2, **changes}
        with pytest.raises(error, match=message):
            splat_points(**inputs)

    expect(ValueError, r"values: expected shape \(B, C, H, W\), got \(3, 4, 5\)", values=values[0])
    expect(TypeError, "values: expected a floating-point tensor, got torch.int64", values=values.long())
    expect(TypeError, "index: expected an integer tensor, got torch.float32", index=index.float())
    expect(ValueError, r"index: expected shape \(2, 1, 4, 5\), got \(2, 4, 5\)", index=index[:, 0])
    expect(ValueError, r"index: expected 0 to 3, a PSF of the table, got 0 to 4", index=(index == 3) * 4)
    expect(ValueError, r"index: expected 0 to 3, a PSF of the table, got -1 to 2", index=index - 1)
    expect(ValueError, "table.offsets: expected shape", table=points._replace(offsets=points.offsets[:, 0]))
    expect(
        ValueError,
        r"table.weights: expected shape \(6\), got \(5,\)",
        table=points._replace(weights=points.weights[1:]),
    )
    expect(TypeError, "table.counts: expected an integer", table=points._replace(counts=points.counts.float()))
    expect(ValueError, "table.counts: expected at least", table=points._replace(counts=points.counts[:0]))
    for wrong in ([1, 0, 1, 3, 6], [0, 0, 1, 3, 5], [0, 3, 1, 3, 6], [0, 0, 1, 3, 7]):
        counts = torch.tensor(wrong)
        expect(ValueError, "table.counts: expected ascending numbers from 0 to 6", table=points._replace(counts=counts))
    expect(TypeError, "pad: expected an int, got float", pad=1.0)
    expect(ValueError, "pad: expected 0 or more, got -1", pad=-1)
    expect(ValueError, r"rotation: expected shape \(2, 2, 2, 4, 5\)", rotation=frame["rotation"][:, 0])
    expect(ValueError, r"position: expected shape \(2, 2, 4, 5\)", position=frame["position"][:, :1])
    expect(ValueError, "position: expected device cpu, got meta", position=frame["position"].to("meta"))


@pytest.mark.parametrize(("dtype", "relative"), [(torch.float16, 1e-3), (torch.bfloat16, 1e-2)])
def test_half_precision_is_computed_in_float32(dtype: torch.dtype, relative: float) -> None:
    values, index, _ = scene(1, 3, 6, 7, dtype)
    out = splat_points(values.requires_grad_(), index, table(dtype=dtype), pad=3)
    assert out.dtype == dtype
    assert_close(out, splat_points(values.float(), index, table(dtype=dtype), pad=3), relative)
    out.float().sum().backward()
    assert values.grad is not None
    assert values.grad.dtype == dtype


@pytest.mark.parametrize("dtype", [F32, F64])
def test_the_memory_layout_and_the_kind_of_integer_do_not_matter(dtype: torch.dtype) -> None:
    values, index, frame = scene(2, 3, 12, 7, dtype, rotated=True)
    want = splat_points(values, index, table(), pad=3, **frame)
    strided = values.permute(0, 2, 3, 1).contiguous().permute(0, 3, 1, 2)
    wide = torch.stack([index, index], -1)[..., 0].to(torch.uint8)
    rotation = frame["rotation"].permute(3, 4, 1, 2, 0).contiguous().permute(4, 2, 3, 0, 1)
    points = table()
    points = PointTable(points.offsets.T.contiguous().T, points.weights, points.counts.int())
    assert not strided.is_contiguous()
    assert torch.equal(splat_points(strided, wide, points, pad=3, rotation=rotation), want)
    one = index[:, :, :1, :1].expand(index.shape)
    assert torch.equal(splat_points(values, one, points, pad=3), splat_points(values, one.contiguous(), points, pad=3))


def test_without_numba_the_torch_path_takes_over_and_says_so_once(monkeypatch: pytest.MonkeyPatch) -> None:
    values, index, frame = scene(1, 3, 6, 7, rotated=True)
    want = splat_points(values, index, table(), pad=3, **frame)
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *a: None if name == "numba" else find(name, *a))
    monkeypatch.setattr(torchbokeh.ops.kernels, "points", None)
    dispatch.numba_is_there.cache_clear()
    try:
        with pytest.warns(UserWarning, match="numba is not installed"):
            assert_close(splat_points(values, index, table(), pad=3, **frame), want, 1e-6)
        splat_points(values, index, table(), pad=3)  # a second warning would be an error
    finally:
        monkeypatch.undo()
        dispatch.numba_is_there.cache_clear()


def test_examples() -> None:
    assert doctest.testmod(torchbokeh.ops.points).failed == 0


@pytest.mark.parametrize("dtype", [F32, F64])
@pytest.mark.parametrize("rotated", [False, True])
def test_a_list_of_pixels_is_the_picture_that_they_are_of(dtype: torch.dtype, rotated: bool) -> None:
    values, index, frame = scene(2, 3, 5, 6, dtype, rotated)
    points = table(whole=False, dtype=dtype)
    aim = torch.rand(2, 3, 9, 10, dtype=dtype)

    def listed(t: Tensor) -> Tensor:
        return t.flatten(-2).flip(-1).unflatten(-1, (10, 3))

    place = torch.stack(torch.meshgrid(torch.arange(6), torch.arange(5), indexing="xy")).to(dtype).expand(2, -1, -1, -1)
    grads = []
    for change in (lambda t: t, listed):
        given = change(values).clone().requires_grad_()
        turn = {name: change(t) for name, t in frame.items()}
        out = splat_points(given, change(index), points, pad=2, position=change(place), size=(5, 6), **turn)
        assert_close(out, splat_points(values, index, points, pad=2, **frame), 1e-6)
        grads.append(torch.autograd.grad((aim * out).sum(), given)[0])
    assert_close(grads[1], listed(grads[0]), 1e-6)
    with pytest.raises(ValueError, match="position: expected one beside size, got None"):
        splat_points(values, index, points, pad=2, size=(5, 6))
