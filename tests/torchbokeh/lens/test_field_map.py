import doctest
import math
import pickle
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

import torchbokeh.lens.field_map
from torchbokeh.lens.field_map import BOUND, Field, FieldMap

F64 = torch.float64
T = torch.linspace(0.06, 0.94, 45, dtype=F64)
THETA = torch.linspace(-3.1, 3.1, 45, dtype=F64)

ATOMS: dict[str, Callable[[float, float], float]] = {
    "identity": lambda t, _: t,
    "square": lambda t, _: t * t,
    "cube": lambda t, _: t * t * t,
    "exp": lambda t, _: math.exp(t),
    "inversion": lambda t, _: 1 - t,
    "reciprocal": lambda t, _: 1 / t,
    "cosine": lambda t, _: math.cos(2 * math.pi * t),
    "angular": lambda t, theta: t * math.cos(theta),
}


def twice(t: Tensor, theta: Tensor) -> Tensor:
    return 2 * t + 0 * theta


def leaning(t: Tensor, theta: Tensor) -> Tensor:
    return t + theta


def by_hand(pre: str, post: str) -> Tensor:
    values = [ATOMS[post](ATOMS[pre](t, theta), theta) for t, theta in zip(T.tolist(), THETA.tolist(), strict=True)]
    return torch.tensor(values, dtype=F64)


@pytest.mark.parametrize("name", ATOMS)
def test_every_function_is_its_formula(name: str) -> None:
    want = by_hand(name, "identity")
    torch.testing.assert_close(FieldMap(name)(T, THETA), want, rtol=1e-13, atol=1e-15)
    torch.testing.assert_close(FieldMap("identity", name)(T, THETA), want, rtol=1e-13, atol=1e-15)
    assert FieldMap(name)(T.float().view(5, 9), THETA.float().view(5, 9)).shape == (5, 9)
    assert FieldMap(name)(T.float(), THETA.float()).dtype == torch.float32


@pytest.mark.parametrize("post", ATOMS)
@pytest.mark.parametrize("pre", ATOMS)
def test_a_composition_applies_the_first_and_then_the_second(pre: str, post: str) -> None:
    want = by_hand(pre, post)
    inside = want.abs() < 0.999 * BOUND if post == "reciprocal" else torch.ones_like(want, dtype=torch.bool)
    assert inside.sum() > 20
    torch.testing.assert_close(FieldMap(pre, post)(T, THETA)[inside], want[inside], rtol=1e-11, atol=1e-13)


def test_the_order_counts() -> None:
    t = torch.tensor([0.25], dtype=F64)
    zero = torch.zeros_like(t)
    assert FieldMap("inversion", "square")(t, zero).item() == pytest.approx(0.5625, rel=1e-14)
    assert FieldMap("square", "inversion")(t, zero).item() == pytest.approx(0.9375, rel=1e-14)
    assert FieldMap(twice, "exp")(t, zero).item() == pytest.approx(math.exp(0.5), rel=1e-14)
    assert FieldMap("exp", twice)(t, zero).item() == pytest.approx(2 * math.exp(0.25), rel=1e-14)
    # The angle is the same for both: (4.9).
    assert FieldMap("angular", leaning)(t, zero + 1).item() == pytest.approx(0.25 * math.cos(1) + 1, rel=1e-14)


def test_without_names_it_is_the_distance_itself() -> None:
    assert torch.equal(FieldMap()(T, THETA), T)


def test_reciprocals_stay_within_their_bound() -> None:
    t = torch.tensor([0.0, 0.01, 0.05, 0.0501, 0.1, 1.0, -0.01, -0.05, -0.5, -2.0], dtype=F64)
    want = [20, 20, 20, 1 / 0.0501, 10, 1, -20, -20, -2, -0.5]
    torch.testing.assert_close(FieldMap("reciprocal")(t, t), torch.tensor(want, dtype=F64), rtol=1e-12, atol=0)
    # The reciprocal of 1 - t: from 0.95 on; beyond the corners, in a margin, it is negative.
    t = torch.tensor([0.0, 0.5, 0.9, 0.95, 0.99, 1.0, 1.01, 1.5, 3.0], dtype=F64)
    want = [1, 2, 10, 20, 20, 20, -20, -2, -0.5]
    found = FieldMap("inversion", "reciprocal")(t, torch.zeros_like(t))
    torch.testing.assert_close(found, torch.tensor(want, dtype=F64), rtol=1e-12, atol=0)
    assert BOUND == 20


@pytest.mark.parametrize("post", ATOMS)
@pytest.mark.parametrize("pre", ATOMS)
def test_everything_is_finite_with_finite_slopes_all_over_the_picture(pre: str, post: str) -> None:
    t = torch.linspace(0, 1, 21, dtype=torch.float32).requires_grad_()
    theta = torch.linspace(-math.pi, math.pi, 21).requires_grad_()
    out = FieldMap(pre, post)(t, theta)
    assert out.isfinite().all()
    grads = torch.autograd.grad(out.sum(), (t, theta), allow_unused=True, materialize_grads=True)
    assert all(g.isfinite().all() for g in grads)


@pytest.mark.parametrize(
    ("given", "text"),
    [
        (FieldMap(), "FieldMap(t)"),
        (FieldMap("square"), "FieldMap(t**2)"),
        (FieldMap("inversion", "exp"), "FieldMap(exp(1 - t))"),
        (FieldMap("inversion", "reciprocal"), "FieldMap(1 / (1 - t))"),
        (FieldMap("cosine", "cube"), "FieldMap(cos(2 pi t)**3)"),
        (FieldMap("angular"), "FieldMap(t cos(theta))"),
        (FieldMap(twice, "exp"), "FieldMap(exp(twice(t, theta)))"),
        (FieldMap(post=twice), "FieldMap(twice(t, theta))"),
        (FieldMap(torch.nn.Bilinear(1, 1, 1)), "FieldMap(Bilinear(t, theta))"),
    ],
)
def test_it_prints_as_a_formula(given: FieldMap, text: str) -> None:
    assert repr(given) == text


def test_equal_maps_are_equal() -> None:
    assert FieldMap("exp", twice) == FieldMap("exp", twice)
    assert hash(FieldMap("exp", twice)) == hash(FieldMap("exp", twice))
    assert len({FieldMap("exp"), FieldMap("exp"), FieldMap(post="exp"), FieldMap(twice), FieldMap("cube")}) == 4
    assert FieldMap("exp") != FieldMap("cube")
    assert FieldMap("exp", "cube") != FieldMap("cube", "exp")
    assert FieldMap() != "identity"


@pytest.mark.parametrize(
    "given", [FieldMap(), FieldMap("inversion", "exp"), FieldMap(torch.add, torch.mul), FieldMap("cosine")]
)
def test_pickles(given: FieldMap) -> None:
    again = pickle.loads(pickle.dumps(given))
    assert again == given
    assert repr(again) == repr(given)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"pre": "sine"}, ValueError, "pre: expected one of identity, square, .*, angular or a callable, got 'sine'"),
        ({"post": ""}, ValueError, "post: expected one of identity, .* got ''"),
        ({"pre": 2.0}, TypeError, "pre: expected a name or a callable of two tensors, got float"),
        ({"post": None}, TypeError, "post: expected a name or a callable of two tensors, got NoneType"),
    ],
)
def test_what_does_not_fit_is_refused(arguments: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=f"^{message}$"):
        FieldMap(**arguments)


@pytest.mark.parametrize("size", [(24, 36), (25, 37), (1, 9), (40, 11)])
def test_the_distance_is_one_in_the_corners_of_the_sensor(size: tuple[int, int]) -> None:
    h, w = size
    x = torch.tensor([w / 2, -w / 2, w / 2, -w / 2, 0, w / 4], dtype=F64)
    y = torch.tensor([h / 2, h / 2, -h / 2, -h / 2, 0, h / 4], dtype=F64)
    t = Field(x, y, size).t
    torch.testing.assert_close(t, torch.tensor([1, 1, 1, 1, 0, 0.5], dtype=F64), rtol=1e-14, atol=0)
    field = Field.pixels(size, 0, torch.zeros((), dtype=F64))
    # The last pixel's centre is half a pixel nearer.
    assert field.t[-1, -1].item() == pytest.approx(math.hypot(h - 1, w - 1) / math.hypot(h, w), rel=1e-14)
    assert field.t.max() < 1
    assert torch.equal(field.t, field.t.flip(0, 1))


def test_places_and_angles_follow_the_picture() -> None:
    field = Field.pixels((5, 7), 0, torch.zeros(()))
    assert all(f.shape == (5, 7) for f in (field.x, field.y, field.t, field.theta))
    assert field.x[0].tolist() == [-3, -2, -1, 0, 1, 2, 3]
    assert field.y[:, 0].tolist() == [-2, -1, 0, 1, 2]
    middle = (2, 3)
    assert field.t[middle] == 0
    assert field.theta[middle] == 0
    right, down, left, up = (field.theta[p].item() for p in ((2, 5), (4, 3), (2, 0), (0, 3)))
    assert (right, down, abs(left), up) == pytest.approx((0, math.pi / 2, math.pi, -math.pi / 2), abs=1e-6)
    assert field.theta[3, 4].item() == pytest.approx(math.pi / 4)
    even = Field.pixels((4, 6), 0, torch.zeros(()))
    assert even.x[0].tolist() == [-2.5, -1.5, -0.5, 0.5, 1.5, 2.5]
    assert Field.pixels((4, 6), 0, torch.zeros((), dtype=F64)).t.dtype == F64


@pytest.mark.parametrize("margin", [1, 4])
def test_a_margin_lies_beyond_the_corners(margin: int) -> None:
    inner = Field.pixels((9, 14), 0, torch.zeros((), dtype=F64))
    outer = Field.pixels((9 + 2 * margin, 14 + 2 * margin), margin, torch.zeros((), dtype=F64))
    for name in ("x", "y", "t", "theta"):
        have, want = getattr(outer, name), getattr(inner, name)
        torch.testing.assert_close(have[margin:-margin, margin:-margin], want, rtol=1e-14, atol=1e-14)
    assert outer.t[0, 0] > 1


def test_gradients_are_finite_in_the_middle_of_an_odd_picture() -> None:
    pixels = Field.pixels((5, 7), 0, torch.zeros((), dtype=F64))
    x, y = (t.clone().requires_grad_() for t in (pixels.x, pixels.y))
    field = Field(x, y, (5, 7))
    slopes = [torch.autograd.grad(f.sum(), (x, y), retain_graph=True) for f in (field.t, field.theta)]
    assert all(g.isfinite().all() for pair in slopes for g in pair)
    (tx, ty), (ax, ay) = slopes
    assert (tx[2, 3], ty[2, 3], ax[2, 3], ay[2, 3]) == (0, 0, 0, 0)
    # Elsewhere they are the slopes of polar coordinates.
    scale, r = math.hypot(5, 7) / 2, 5**0.5
    assert (tx[3, 5].item(), ty[3, 5].item()) == pytest.approx((2 / r / scale, 1 / r / scale))
    assert (ax[3, 5].item(), ay[3, 5].item()) == pytest.approx((-1 / 5, 2 / 5))


def test_docstring_examples() -> None:
    result = doctest.testmod(torchbokeh.lens.field_map)
    assert result.attempted > 1
    assert result.failed == 0
