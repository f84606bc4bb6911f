import copy
import doctest
import pickle
import re
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor, nn

import torchbokeh.lens
from torchbokeh.lens import DisparityLens, Lens, ThinLens

INF, NAN = torch.inf, torch.nan
CAMERA = {"focal_length": 0.05, "f_number": 1.8, "focus_distance": 2.0, "sensor_width": 0.036}
PLAIN = {"strength": 30.0, "focus_disparity": 0.4}
WIDTH = 1920
few = settings(deadline=None, max_examples=40)


def f64(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def thin(**changes: Any) -> ThinLens:
    """A lens held in float64, so that tests see the formula and not float32's rounding."""
    camera = {k: torch.as_tensor(v, dtype=torch.float64) for k, v in {**CAMERA, **changes}.items()}
    return ThinLens(**camera)


def row(*values: float) -> Tensor:
    return f64(*values).view(1, 1, 1, -1)


def traced_coc(d: float, f: float, n: float, df: float, sensor: float, width: int, height: float) -> float:
    """Signed blur radius in pixels of a point ``height`` off the axis, from rays through the lens's rim."""
    angle = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    rim = f / (2 * n) * np.stack([np.cos(angle), np.sin(angle)])
    v, screen = 1 / (1 / f - 1 / d), 1 / (1 / f - 1 / df)
    image = np.array([[0.0], [-height * v / d]])  # every ray that leaves the lens heads for the image point
    hits = rim + (image - rim) * (screen / v)
    blur = hits - hits.mean(axis=1, keepdims=True)
    radius = np.linalg.norm(blur, axis=0)
    assert np.allclose(radius, radius[0], rtol=1e-9, atol=1e-12)
    # Behind the focus plane the rays have crossed before the sensor: the spot is upside down.
    return -np.sign((blur * rim).sum()) * radius[0] * width / sensor


@few
@given(st.floats(1e-3, 1e4), st.floats(0.004, 0.4), st.floats(0.7, 32), st.floats(1.05, 1e4), st.floats(-3, 3))
def test_coc_is_what_a_ray_trace_measures(d: float, f: float, n: float, focus: float, height: float) -> None:
    df, sensor, width = f * focus, 0.7 * f, 1000
    if abs(d - f) < 1e-6 * f:
        d = 2 * f  # the image of the focal plane is at infinity
    want = traced_coc(d, f, n, df, sensor, width, height)
    lens = thin(focal_length=f, f_number=n, focus_distance=df, sensor_width=sensor)
    # The blur is a difference of 1/df and 1/d: its rounding error scales with the larger of the two.
    scale = abs(lens.coc(row(1e-3), width).item()) + abs(lens.coc(row(INF), width).item())
    assert lens.coc(row(d), width).item() == pytest.approx(want, rel=1e-6, abs=1e-9 * scale)


def test_only_ratios_of_lengths_count_and_width_is_a_factor() -> None:
    depth = row(0.001, 0.3, 1.7, 2.0, 55.0, INF)
    coc = thin().coc(depth, WIDTH)
    twice = {k: v if k == "f_number" else 2 * v for k, v in CAMERA.items()}
    assert torch.equal(thin(**twice).coc(2 * depth, WIDTH), coc)
    assert torch.equal(thin().coc(depth, 2 * WIDTH), 2 * coc)
    assert torch.equal(thin()(depth, width=WIDTH), coc)


def test_infinite_depth_value_and_gradients() -> None:
    leaves = {k: nn.Parameter(f64(v)[0]) for k, v in CAMERA.items()}
    depth = row(1.0, INF).requires_grad_()
    far = ThinLens(**leaves).coc(depth, WIDTH)[..., 1].sum()
    n, f, df, sensor = 1.8, 0.05, 2.0, 0.036
    k = f * f / (2 * n) / (df - f) * WIDTH / sensor
    assert far.item() == pytest.approx(k, rel=1e-12)
    first, *grads = torch.autograd.grad(far, [depth, *leaves.values()], create_graph=True)
    by_hand = [k * (2 / f + 1 / (df - f)), -k / n, -k / (df - f), -k / sensor]
    assert [g.item() for g in grads] == pytest.approx(by_hand, rel=1e-12)
    assert not first.any()
    (second,) = torch.autograd.grad(first.sum(), depth)
    assert not second.any()


def test_focus_at_infinity() -> None:
    df = nn.Parameter(f64(INF)[0])
    lens = ThinLens(0.05, 1.8, df, 0.036).double()
    depth = row(0.5, 20.0, INF).requires_grad_()
    coc = lens.coc(depth, WIDTH)
    k = 0.05**2 / 3.6 * WIDTH / 0.036
    assert coc.flatten().tolist() == pytest.approx([-k / 0.5, -k / 20, 0.0], rel=1e-6)
    d_depth, d_focus = torch.autograd.grad(coc.sum(), [depth, df])
    assert d_depth.flatten().tolist() == pytest.approx([k / 0.25, k / 400, 0.0], rel=1e-6)
    assert d_focus.item() == 0.0
    assert lens.depth(coc, WIDTH).flatten().tolist() == pytest.approx([0.5, 20.0, INF])
    near_focus = thin(focus_distance=1e9).coc(row(0.5, 20.0), WIDTH)
    torch.testing.assert_close(coc[..., :2], near_focus, rtol=1e-6, atol=0)


def test_disparity_lens_describes_the_same_camera() -> None:
    a = 0.37  # disparity = a / depth
    strength = 0.05**2 / 3.6 / (1 - 0.05 / 2.0) * WIDTH / 0.036 / a
    twin = DisparityLens(f64(strength)[0], f64(a / 2.0)[0])
    depth = row(0.2, 1.0, 2.0, 9.0, INF)
    coc = thin().coc(depth, WIDTH)
    torch.testing.assert_close(twin.coc(a / depth, WIDTH), coc)
    torch.testing.assert_close(a / twin.depth(coc, WIDTH)[..., :-1], depth[..., :-1])


def test_disparity_lens_takes_any_finite_disparity_and_ignores_the_width() -> None:
    lens = DisparityLens(**PLAIN)
    disparity, want = torch.tensor([[-2.0, 0.0, 0.4, 5.0]]), torch.tensor([[72.0, 12.0, 0.0, -138.0]])
    torch.testing.assert_close(lens.coc(disparity, 10), want)
    torch.testing.assert_close(lens(disparity, 4000), want)
    torch.testing.assert_close(lens.depth(want, 10), disparity)


@few
@given(d=st.floats(0.02, 1e5), df=st.floats(0.06, 1e5), n=st.floats(0.7, 32))
def test_depth_inverts_coc(d: float, df: float, n: float) -> None:
    lens = thin(focus_distance=df, f_number=n)
    back = lens.depth(lens.coc(row(d), WIDTH), WIDTH).item()
    # A relative error eps of the largest reciprocal is eps * d of that in the depth.
    assert back == pytest.approx(d, rel=1e-14 * max(1.0, d / df) + 1e-13)
    plain = DisparityLens(f64(n)[0], f64(df)[0])
    assert plain.depth(plain.coc(row(d), WIDTH), WIDTH).item() == pytest.approx(d, rel=1e-12, abs=1e-15 * df)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("df", [0.06, 2.0, 37.0, INF])
def test_depth_at_and_beyond_the_limit_is_infinite_without_gradient(df: float, dtype: torch.dtype) -> None:
    lens = ThinLens(**{**CAMERA, "focus_distance": df})
    limit = lens.coc(torch.full((1, 1, 1, 1), INF, dtype=dtype), WIDTH)
    coc = torch.cat([limit, limit + 1, torch.full_like(limit, INF), limit - 1], -1).requires_grad_()
    depth = lens.depth(coc, WIDTH)
    assert depth.flatten().tolist()[:3] == [INF] * 3
    assert 0 < depth[..., 3].item() < INF
    (grad,) = torch.autograd.grad(depth.sum(), coc)
    assert grad.flatten().tolist()[:3] == [0.0] * 3
    assert 0 < grad[..., 3].item() < INF
    assert lens.depth(torch.full_like(coc, NAN), WIDTH).isnan().all()


@few
@given(n=st.floats(0.7, 32), df=st.floats(0.06, 100), c=st.floats(0.05, 20))
def test_near_far_and_hyperfocal(n: float, df: float, c: float) -> None:
    lens = thin(f_number=n, focus_distance=df)
    near, far = lens.near_limit(c, WIDTH), lens.far_limit(c, WIDTH)
    assert near.item() < df < far.item()
    assert lens.coc(near.view(1, 1), WIDTH).item() == pytest.approx(-c, rel=1e-9)
    h = lens.hyperfocal(c, WIDTH).item()
    at_far = lens.coc(far.view(1, 1), WIDTH).item()
    if far.isinf():
        assert at_far <= c * (1 + 1e-9)
        assert df >= h * (1 - 1e-9)
    else:
        assert at_far == pytest.approx(c, rel=1e-9)
        assert df <= h * (1 + 1e-9)

    diameter = 2 * c * 0.036 / WIDTH  # the photographers' H = F^2 / (N * C) + F, C in metres
    assert h == pytest.approx(0.05**2 / (n * diameter) + 0.05, rel=1e-12)
    lens = thin(f_number=n, focus_distance=h)
    assert lens.coc(row(INF), WIDTH).item() == pytest.approx(c, rel=1e-9)
    assert lens.near_limit(c, WIDTH).item() == pytest.approx(h / 2, rel=1e-9)
    assert thin(f_number=n, focus_distance=h * (1 + 1e-9)).far_limit(c, WIDTH).item() == INF
    assert thin(f_number=n, focus_distance=h * (1 - 1e-6)).far_limit(c, WIDTH).item() < INF


def test_batched_parameters_equal_one_by_one() -> None:
    batch = {k: v * f64(1.0, 0.6, INF if k == "focus_distance" else 4.0) for k, v in CAMERA.items()}
    depth = 0.5 + torch.rand(3, 1, 4, 5, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    layers = depth.unsqueeze(1).expand(3, 2, 1, 4, 5)
    together, mixed = ThinLens(**batch), thin(focus_distance=batch["focus_distance"])
    plain = DisparityLens(batch["focal_length"], batch["f_number"])
    for i in range(3):
        one = thin(**{k: v[i] for k, v in batch.items()})
        want = one.coc(depth[i], WIDTH)
        assert torch.equal(together.coc(depth, WIDTH)[i], want)
        assert torch.equal(together.coc(layers, WIDTH)[i, 1], want)
        assert torch.equal(together.coc(depth[:, 0], WIDTH)[i], want[0])
        assert torch.equal(together.depth(depth, WIDTH)[i], one.depth(depth[i], WIDTH))
        assert together.aperture_radius[i] == one.aperture_radius
        for helper in ("hyperfocal", "near_limit", "far_limit"):
            assert getattr(together, helper)(0.5, WIDTH)[i] == getattr(one, helper)(0.5, WIDTH)
        lone = thin(focus_distance=batch["focus_distance"][i])
        assert torch.equal(mixed.coc(depth, WIDTH)[i], lone.coc(depth[i], WIDTH))
        twin = DisparityLens(batch["focal_length"][i], batch["f_number"][i])
        assert torch.equal(plain.coc(depth, WIDTH)[i], twin.coc(depth[i], WIDTH))
    for any_map in (depth, depth[0, 0], depth[:0]):  # a batch of one lens serves every map
        assert torch.equal(thin(focus_distance=f64(2.0)).coc(any_map, WIDTH), thin().coc(any_map, WIDTH))


def test_gradcheck() -> None:
    camera = [f64(v, 1.1 * v).requires_grad_() for v in CAMERA.values()]
    depth = f64(0.3, 2.0, 40.0, 1.0, 2.2, 3.0).view(2, 1, 1, 3).requires_grad_()
    coc = f64(-20, 0, 10, -3, 1, 12).view(2, 1, 1, 3).requires_grad_()

    def run(depth: Tensor, coc: Tensor, *camera: Tensor) -> tuple[Tensor, ...]:
        lens, plain = ThinLens(*camera), DisparityLens(*camera[1:3])
        limits = lens.hyperfocal(1.5, 640), lens.near_limit(1.5, 640), lens.far_limit(1.5, 640)
        maps = [(x.coc(depth, WIDTH), x.depth(coc, WIDTH)) for x in (lens, plain)]
        return *limits, *maps[0], *maps[1], lens.aperture_radius

    assert torch.autograd.gradcheck(run, (depth, coc, *camera))


def test_a_parameter_stays_the_same_object_and_learns() -> None:
    focus, strength = nn.Parameter(torch.tensor(2.0)), nn.Parameter(torch.tensor([30.0]))
    lens, plain = ThinLens(0.05, 1.8, focus, 0.036), DisparityLens(strength, 0.4)
    assert lens.focus_distance is focus
    assert dict(lens.named_parameters()) == {"focus_distance": focus}
    assert plain.strength is strength
    assert dict(plain.named_parameters()) == {"strength": strength}
    (lens.coc(torch.ones(1, 1, 2, 2), WIDTH) + plain.coc(torch.ones(1, 1, 2, 2), WIDTH)).sum().backward()
    assert focus.grad is not None
    assert focus.grad.item() < 0  # focusing farther makes what is in front more negative
    assert strength.grad is not None
    assert strength.grad.item() == pytest.approx(4 * (0.4 - 1.0))
    focus.data.fill_(1.0)
    assert not lens.coc(torch.ones(1, 1, 2, 2), WIDTH).any()


def test_tensors_become_buffers_and_carry_a_gradient_through() -> None:
    focus = f64(2.0, 3.0).requires_grad_()
    lens = ThinLens(0.05, 1.8, 2 * focus, 0.036)
    assert list(dict(lens.named_buffers())) == list(CAMERA)
    assert (lens.focus_distance.dtype, lens.f_number.dtype) == (torch.float64, torch.float32)
    lens.coc(torch.ones(2, 1, 1, 1, dtype=torch.float64), WIDTH).sum().backward()
    assert focus.grad is not None
    assert (focus.grad < 0).all()
    lens.keep(f_number=torch.ones(2, device="meta"), sensor_width=1.0)
    assert lens.sensor_width.device.type == "meta"  # numbers go where the tensors are


def test_deepcopy_pickle_state_dict_and_to() -> None:
    lens = ThinLens(0.05, 1.8, nn.Parameter(torch.tensor([2.0, 3.0])), 0.036)
    depth = torch.rand(2, 1, 3, 3, generator=torch.Generator().manual_seed(1)) + 0.5
    want = lens.coc(depth, WIDTH)
    other = ThinLens(0.02, 4.0, nn.Parameter(torch.tensor([5.0, 6.0])), 0.01)
    other.load_state_dict(lens.state_dict())
    for twin in (copy.deepcopy(lens), pickle.loads(pickle.dumps(lens)), other):
        assert torch.equal(twin.coc(depth, WIDTH), want)
        assert repr(twin) == repr(lens)
        assert twin.focus_distance is not lens.focus_distance
        assert isinstance(twin.focus_distance, nn.Parameter)
        assert {v.dtype for v in twin.to(torch.float64).state_dict().values()} == {torch.float64}
        assert twin.hyperfocal(0.5, WIDTH).dtype == torch.float64


@pytest.mark.parametrize("held", [torch.float32, torch.float64])
@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
def test_result_has_the_dtype_of_the_map_and_at_least_float32(dtype: torch.dtype, held: torch.dtype) -> None:
    want = torch.float64 if dtype == torch.float64 else torch.float32
    depth = torch.tensor([[0.5, 1.75, 2.0, 64.0, INF]])
    coc = thin().to(held).coc(depth.to(dtype), WIDTH)  # the depths are exact in every dtype
    assert coc.dtype == want
    assert thin().to(held).depth(coc.to(dtype), WIDTH).dtype == want
    torch.testing.assert_close(coc.double(), thin().coc(depth.double(), WIDTH), rtol=1e-6, atol=1e-5)
    plain = DisparityLens(torch.tensor(2.0, dtype=held), 1)
    assert plain.coc(depth[:, :4].to(dtype), WIDTH).dtype == want


def test_float32_is_accurate_from_a_millimetre_to_beyond_any_scene() -> None:
    depth = torch.logspace(-3, 30, 100).view(1, 1, 10, 10)
    coc = ThinLens(**CAMERA).coc(depth, WIDTH)
    torch.testing.assert_close(coc.double(), thin().coc(depth.double(), WIDTH), rtol=1e-6, atol=1e-5)


class Blurred(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.lens = ThinLens(**CAMERA)

    def forward(self, depth: Tensor) -> Tensor:
        return self.lens(depth, depth.shape[-1])


@pytest.mark.parametrize("strict", [False, True])
def test_exports_and_compiles_without_a_look_at_the_values(strict: bool) -> None:
    model, wide = Blurred(), torch.linspace(0.1, 9, 96).view(2, 1, 4, 12)
    shapes = {"depth": {3: torch.export.Dim("width", min=2, max=64)}}
    program = torch.export.export(model, (wide,), dynamic_shapes=shapes, strict=strict)
    narrow = wide[..., :7].contiguous()
    assert torch.equal(program.module()(narrow), model(narrow))
    assert not any("item" in str(node.target) for node in program.graph.nodes)
    assert torch.equal(torch.compile(model, backend="eager", fullgraph=True)(wide), model(wide))


def test_repr() -> None:
    lens = ThinLens(0.05, 1.8, torch.tensor([2.0, INF]), 0.036)
    assert repr(lens) == "ThinLens(focal_length=0.05, f_number=1.8, focus_distance=(2, inf), sensor_width=0.036)"
    long = DisparityLens(nn.Parameter(torch.arange(5.0)), -1)
    assert repr(long) == "DisparityLens(strength=(0, 1, 2, 3, ...), focus_disparity=-1)"


def test_docstring_examples() -> None:
    tried = [doctest.testmod(module) for module in (torchbokeh.lens.thin, torchbokeh.lens.disparity)]
    assert sum(result.attempted for result in tried) > 8
    assert not any(result.failed for result in tried)


POSITIVE, SCALAR = "expected a positive finite value, got", "expected a scalar or shape"
BEYOND = "expected more than the focal length"
BAD_LENS: list[tuple[dict[str, Any], type[Exception], str]] = [  # the last name is the one to blame
    ({"focal_length": 0.0}, ValueError, f"{POSITIVE} 0"),
    ({"f_number": -2}, ValueError, f"{POSITIVE} -2"),
    ({"f_number": f64(1, INF)}, ValueError, f"{POSITIVE} inf"),
    ({"sensor_width": INF}, ValueError, f"{POSITIVE} inf"),
    ({"focus_distance": 0.04}, ValueError, f"{BEYOND} (0.05 m), got 0.04"),
    ({"focus_distance": 0.05}, ValueError, f"{BEYOND} (0.05 m), got 0.05"),
    ({"focus_distance": NAN}, ValueError, f"{BEYOND} (0.05 m), got nan"),
    ({"focal_length": f64(0.1, 3), "focus_distance": 2}, ValueError, f"{BEYOND} (3 m), got 2"),
    ({"f_number": "1.8"}, TypeError, "expected a number or a tensor, got str"),
    ({"f_number": True}, TypeError, "expected a number or a tensor, got bool"),
    ({"f_number": torch.tensor(2)}, TypeError, "expected a floating-point tensor, got torch.int64"),
    ({"f_number": torch.ones(2, 1)}, ValueError, f"{SCALAR} (B,), got (2, 1)"),
    ({"f_number": f64(1, 2), "sensor_width": f64(1)}, ValueError, f"{SCALAR} (2,) like f_number, got (1,)"),
    ({"f_number": f64(1), "sensor_width": f64(1).to("meta")}, ValueError, "expected device cpu, got meta"),
    ({"strength": -INF}, ValueError, "expected a finite value, got -inf"),
    ({"focus_disparity": NAN}, ValueError, "expected a finite value, got nan"),
    ({"focus_disparity": None}, TypeError, "expected a number or a tensor, got NoneType"),
]


def raises(error: type[Exception], message: str) -> Any:
    return pytest.raises(error, match=f"^{re.escape(message)}$")


@pytest.mark.parametrize(("changes", "error", "message"), BAD_LENS)
def test_bad_lens(changes: dict[str, Any], error: type[Exception], message: str) -> None:
    make, good = (ThinLens, CAMERA) if set(changes) <= set(CAMERA) else (DisparityLens, PLAIN)
    with raises(error, f"{list(changes)[-1]}: {message}"):
        make(**{**good, **changes})


ABOVE, FINITE = "values above 0 (inf is sky)", "finite disparities"
BAD_VALUES: list[tuple[Lens, list[float], str]] = [
    (thin(), [1.0, 0.0, INF, 3.0], f"{ABOVE}, got 1 bad of 4, the smallest 0"),
    (thin(), [-1.0, NAN, -2.5, 3.0], f"{ABOVE}, got 3 bad of 4, the smallest -2.5"),
    (thin(), [1.0, NAN], f"{ABOVE}, got 1 bad of 2, the smallest nan"),
    (DisparityLens(1, 1), [-1.0, 0.0, INF], f"{FINITE}, got 1 bad of 3, the smallest inf"),
    (DisparityLens(1, 1), [NAN, -INF], f"{FINITE}, got 2 bad of 2, the smallest -inf"),
]


@pytest.mark.parametrize(("lens", "values", "message"), BAD_VALUES)
def test_bad_values(lens: Lens, values: list[float], message: str) -> None:
    with raises(ValueError, f"depth: expected {message}"):
        lens.coc(row(*values), WIDTH)


BATCH = "expected a batch of 2 like the lens, got shape"
BAD_MAP: list[tuple[Any, type[Exception], str]] = [
    ([1.0], TypeError, "expected a tensor of shape (..., H, W), got list"),
    (torch.ones(2, 2).int(), TypeError, "expected a floating-point tensor, got torch.int32"),
    (torch.ones(2, 2) * 1j, TypeError, "expected a floating-point tensor, got torch.complex64"),
    (torch.ones(3), ValueError, "expected shape (..., H, W), got (3,)"),
    (torch.ones(3, 1, 2, 2), ValueError, f"{BATCH} (3, 1, 2, 2)"),
    (torch.ones(1, 1, 2, 2), ValueError, f"{BATCH} (1, 1, 2, 2)"),
    (torch.ones(2, 2), ValueError, f"{BATCH} (2, 2)"),
    (torch.ones(2, 1, 2, 2, device="meta"), ValueError, "expected the lens's device cpu, got meta"),
]
LENSES: list[Lens] = [ThinLens(0.05, torch.tensor([1.8, 2.8]), 2.0, 0.036), DisparityLens(torch.ones(2), 0.0)]


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize(("bad", "error", "message"), BAD_MAP)
def test_bad_map(lens: Lens, bad: Any, error: type[Exception], message: str) -> None:
    with raises(error, f"depth: {message}"):
        lens.coc(bad, WIDTH)
    with raises(error, f"coc: {message}"):
        lens.depth(bad, WIDTH)


BAD_ARGUMENTS: list[tuple[dict[str, Any], type[Exception], str]] = [
    ({"width": 0}, ValueError, "width: expected at least 1, got 0"),
    ({"width": 640.0}, TypeError, "width: expected an integer, got float"),
    ({"width": True}, TypeError, "width: expected an integer, got bool"),
    ({"max_coc": 0}, ValueError, "max_coc: expected a positive finite number of pixels, got 0"),
    ({"max_coc": INF}, ValueError, "max_coc: expected a positive finite number of pixels, got inf"),
    ({"max_coc": "1"}, TypeError, "max_coc: expected a number, got '1'"),
]


@pytest.mark.parametrize(("bad", "error", "message"), BAD_ARGUMENTS)
def test_bad_width_and_max_coc(bad: dict[str, Any], error: type[Exception], message: str) -> None:
    for helper in (thin().hyperfocal, thin().near_limit, thin().far_limit):
        with raises(error, message):
            helper(**{"max_coc": 1.0, "width": WIDTH, **bad})
    for lens in LENSES if "width" in bad else []:
        for method in (lens.coc, lens.depth):
            with raises(error, message):
                method(torch.ones(2, 1, 2, 2), **bad)
