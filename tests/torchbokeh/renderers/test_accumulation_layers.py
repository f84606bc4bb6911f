import math
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

import torchbokeh as tb
from torchbokeh.ops.dense import dense_spans
from torchbokeh.picture.sensor import STEPS
from torchbokeh.psfs import Ellipse
from torchbokeh.views.layers import Layer, accumulate_layers
from torchbokeh.views.points import Views, shared_views
from torchbokeh.views.setup import ViewSettings

F32, F64 = torch.float32, torch.float64
TECHNIQUES: list[dict[str, Any]] = [{}, {"level_of_detail": 0.5}, {"reuse": 1}, {"reuse": 2}, {"subsamples": 4}]


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=F64)


def smooth(*shape: int, seed: int = 0, texel: int = 6) -> Tensor:
    """Numbers from 0 to 1 that change slowly over the picture."""
    *first, h, w = shape
    coarse = random(math.prod(first), 1, h // texel + 2, w // texel + 2, seed=seed)
    return F.interpolate(coarse, (h, w), mode="bicubic", align_corners=True).reshape(shape).clamp(0, 1)


def layered(b: int, count: int, h: int, w: int, seed: int = 0) -> Tensor:
    """Discs of colour before an opaque last layer, premultiplied."""
    y, x = torch.meshgrid(torch.arange(h, dtype=F64), torch.arange(w, dtype=F64), indexing="ij")
    middle = random(b, count, 2, 1, 1, seed=seed) * torch.tensor([h, w], dtype=F64)[:, None, None]
    alpha = (0.3 * min(h, w) - ((y - middle[:, :, 0]) ** 2 + (x - middle[:, :, 1]) ** 2).sqrt() + 0.5).clamp(0, 1)
    alpha[:, -1] = 1
    return torch.cat([smooth(b, count, 3, h, w, seed=seed), torch.ones(b, count, 1, h, w)], 2) * alpha[:, :, None]


def even(*values: float, h: int, w: int, b: int = 1) -> Tensor:
    """One value per layer: ``(B, L, 1, H, W)``."""
    return torch.tensor(values, dtype=F64)[None, :, None, None, None].expand(b, -1, 1, h, w).clone()


def flattened(layers: Tensor) -> Tensor:
    out, left = torch.zeros_like(layers[:, 0]), torch.ones_like(layers[:, 0, 3:])
    for k in range(layers.shape[1]):
        out, left = out + left * layers[:, k], left * (1 - layers[:, k, 3:])
    return out


def spread(views: int) -> Views:
    return Views.spread(views, tb.AccumulationBuffer().aperture.profile())


def bilinear(image: Tensor, x: float, y: float) -> Tensor:
    """``(C,)`` at (x, y), counted from the middle of the first pixel; the border goes on."""
    h, w = image.shape[1:]
    x, y = min(max(x, 0.0), w - 1.0), min(max(y, 0.0), h - 1.0)
    i, j = min(int(x), max(w - 2, 0)), min(int(y), max(h - 2, 0))
    right, down = min(i + 1, w - 1), min(j + 1, h - 1)
    top = torch.lerp(image[:, j, i], image[:, j, right], x - i)
    return torch.lerp(top, torch.lerp(image[:, down, i], image[:, down, right], x - i), y - j)


@pytest.mark.parametrize("settings", TECHNIQUES)
@pytest.mark.parametrize("scale", [0.5, 8.0, 1e4])
def test_constant_in_constant_out(settings: dict[str, Any], scale: float) -> None:
    h, w = 21, 26
    for alpha in (1.0, 0.25):
        layers = torch.tensor([0.7, 2.0, 0.0, 1.0])[:, None, None].expand(2, 1, 4, h, w) * alpha
        coc = ((random(2, 1, 1, h, w, seed=1) - 0.5) * scale).float()
        motion = ((random(2, 1, 2, h, w, seed=2) - 0.5) * scale).float()
        for moved in (None, motion):
            out = tb.AccumulationBuffer(views=8, **settings)(layers, coc=coc, motion=moved)
            assert torch.allclose(out, layers[:, 0], atol=1e-5)


@pytest.mark.parametrize("settings", TECHNIQUES)
@pytest.mark.parametrize(("dtype", "close"), [(F32, 1e-5), (F64, 1e-12)])
def test_in_focus_and_at_rest_the_layers_are_flattened(
    dtype: torch.dtype, close: float, settings: dict[str, Any]
) -> None:
    layers = layered(2, 3, 19, 40).to(dtype)
    zero = torch.zeros(2, 3, 2, 19, 40, dtype=dtype)
    for motion in (None, zero):
        out = tb.AccumulationBuffer(views=5, **settings)(layers, coc=zero[:, :, :1], motion=motion)
        assert out.dtype == dtype
        assert torch.allclose(out, flattened(layers), atol=close)


@pytest.mark.parametrize("aperture", ["disc", "5-gon", Ellipse(1.6, 0.5)], ids=str)
@pytest.mark.parametrize(("coc", "most", "mean"), [(5.3, 6e-3, 1.2e-3), (-5.3, 6e-3, 1.2e-3), (2.0, 3e-2, 6e-3)])
def test_many_views_are_the_dense_blur(aperture: Any, coc: float, most: float, mean: float) -> None:
    h = w = 44
    layers = torch.cat([smooth(1, 1, 3, h, w, texel=4), torch.ones(1, 1, 1, h, w)], 2)
    buffer = tb.AccumulationBuffer(aperture=aperture, views=1024)
    out = buffer(layers, coc=even(coc, h=h, w=w))[..., 7:-7, 7:-7]  # there the border is out of sight
    radius = torch.full((1, 1, h, w), coc, dtype=F64)
    want, other = (dense_spans(layers[:, 0], r, buffer.aperture.profile())[..., 7:-7, 7:-7] for r in (radius, -radius))
    # Look-ups between pixels blur by half a pixel, which counts more where the blur is small.
    assert (out - want).abs().max() < most
    assert (out - want).abs().mean() < mean
    if aperture == "5-gon" and abs(coc) > 3:  # a foreground is blurred by the mirrored shape
        assert (out - other).abs().mean() > 3 * (out - want).abs().mean()


@pytest.mark.parametrize("way", [(8.0, 0.0), (0.0, -6.0), (6.0, 3.0), (-5.0, 5.0)])
def test_a_moving_dot_draws_an_even_line(way: tuple[float, float]) -> None:
    h, w = 31, 33
    layers = torch.zeros(1, 1, 4, h, w, dtype=F64)
    layers[..., 15, 16] = 1
    motion = torch.tensor(way, dtype=F64)[None, None, :, None, None].expand(1, 1, 2, h, w)
    still = torch.zeros(1, 1, 1, h, w, dtype=F64)
    line = tb.AccumulationBuffer(views=240)(layers, coc=still, motion=motion)[0, 3]
    y, x = torch.meshgrid(torch.arange(h, dtype=F64) - 15, torch.arange(w, dtype=F64) - 16, indexing="ij")
    assert float(line.sum()) == pytest.approx(1)
    assert float((line * x).sum()) == pytest.approx(0, abs=1e-9)  # half of the way before, half behind
    assert float((line * y).sum()) == pytest.approx(0, abs=1e-9)
    # An even line has the square of its length over 12 for its second moment; a look-up adds 1/4 at most.
    assert way[0] ** 2 / 12 - 0.01 <= float((line * x * x).sum()) <= way[0] ** 2 / 12 + 0.25
    assert way[1] ** 2 / 12 - 0.01 <= float((line * y * y).sum()) <= way[1] ** 2 / 12 + 0.25
    assert float((line * x * y).sum()) == pytest.approx(way[0] * way[1] / 12, abs=0.01)
    if way[1] == 0:
        assert torch.allclose(line[15, 13:20], torch.full((7,), 1 / 8, dtype=F64), atol=1e-3)
        assert line[15, 11] == line[15, 21] == 0
    if way == (-5.0, 5.0):  # from pixel to pixel along the diagonal
        along = torch.stack([line[15 + n, 16 - n] for n in (-1, 0, 1)])
        assert torch.allclose(along, along[:1].expand(3), atol=2e-3)


@pytest.mark.parametrize("moved", [False, True])
def test_layers_are_shifted_and_put_over_one_another(moved: bool) -> None:
    """Against explicit loops over views, layers and pixels."""
    h, w, count = 9, 11, 6
    layers, cocs, ways = layered(1, 3, h, w, seed=2), [-2.3, 0.4, 3.0], [(4.0, -1.5), (0.0, 0.0), (-2.0, 6.0)]
    motion = torch.tensor(ways, dtype=F64)[None, :, :, None, None].expand(1, 3, 2, h, w) if moved else None
    out = tb.AccumulationBuffer(views=count)(layers, coc=even(*cocs, h=h, w=w), motion=motion)
    views = spread(count)
    want = torch.zeros(4, h, w, dtype=F64)
    for (u, v), time in zip(views.lens.tolist(), views.time.tolist(), strict=True):
        for y in range(h):
            for x in range(w):
                left = torch.ones(1, dtype=F64)
                for k in range(3):
                    dx, dy = cocs[k] * u, cocs[k] * v
                    if moved:
                        dx, dy = dx + ways[k][0] * time, dy + ways[k][1] * time
                    rgba = bilinear(layers[0, k], x - dx, y - dy)
                    want[:, y, x] += left * rgba / count
                    left = left * (1 - rgba[3])
    assert torch.allclose(out[0], want, atol=1e-12)


@pytest.mark.parametrize("slope", [(0.05, 0.0), (0.2, 0.0), (-0.15, 0.1)])
def test_a_sloped_layer_is_looked_up_where_it_comes_from(slope: tuple[float, float]) -> None:
    """What is at x comes to lie on ``x + coc(x) u``, which is linear and so inverted by hand."""
    h, w = 40, 48
    y, x = torch.meshgrid(torch.arange(h, dtype=F64), torch.arange(w, dtype=F64), indexing="ij")
    coc = 1.5 + slope[0] * (x - 24) + slope[1] * (y - 20)
    layers = torch.stack([2 * x, 3 * y, x - y, torch.full_like(x, 100)])[None, None] / 100
    out = tb.AccumulationBuffer(views=32)(layers, coc=coc[None, None, None])[0]
    want = torch.zeros_like(out)
    for u, v in spread(32).lens.tolist():
        radius = coc / (1 + slope[0] * u + slope[1] * v)  # the CoC at the point that is seen
        i, j = x - radius * u, y - radius * v
        want += torch.stack([2 * i, 3 * j, i - j, torch.full_like(i, 100)]) / 100 / 32
    inner = (slice(None), slice(8, -8), slice(8, -8))
    left_over = float(coc.abs().max()) * math.hypot(*slope) ** STEPS
    assert (out - want)[inner].abs().max() < 0.03 * left_over + 1e-12
    plain = sum(torch.stack([2 * (x - coc * u), 3 * (y - coc * v)]) / 100 / 32 for u, v in spread(32).lens.tolist())
    assert (plain - want[:2])[:, 8:-8, 8:-8].abs().max() > 10 * 0.03 * left_over


def test_depth_and_a_lens_are_the_same_as_coc() -> None:
    lens = tb.ThinLens(0.05, 1.2, 2.0, sensor_width=0.036)
    layers, depth = layered(2, 2, 18, 24).float(), (1 + 4 * random(2, 2, 1, 18, 24)).float()
    depth[:, 1, :, :5] = math.inf
    buffer = tb.AccumulationBuffer(lens, views=9)
    out = buffer(layers, depth)
    assert torch.equal(out, buffer(layers, coc=lens.coc(depth, 24)))
    assert torch.equal(out, tb.AccumulationBuffer(views=9)(layers, coc=lens.coc(depth, 24)))
    disparity = tb.DisparityLens(strength=12.0, focus_disparity=0.4)
    out = tb.AccumulationBuffer(disparity, views=9)(layers, depth.reciprocal())
    assert torch.equal(out, buffer(layers, coc=12 * (0.4 - depth.reciprocal())))


def picture() -> tuple[Tensor, Tensor]:
    """A sharp layer of much detail between a blurred foreground and a blurred background."""
    h, w = 48, 64
    layers = layered(1, 3, h, w, seed=4)
    layers[:, 1, :3] = random(1, 3, h, w, seed=9) * layers[:, 1, 3:]
    return layers.float(), even(-7.0, 0.6, 9.0, h=h, w=w).float()


@pytest.mark.parametrize(
    ("settings", "least", "most"),
    [
        ({"level_of_detail": 0.01}, 1e-4, 0.01),
        ({"level_of_detail": 0.1}, 1e-3, 0.03),
        ({"reuse": 1}, 1e-3, 0.03),
        ({"reuse": 2}, 1e-3, 0.015),
        ({"reuse": 8}, 1e-4, 0.005),
    ],
    ids=str,
)
def test_each_technique_stays_close_to_brute_force(settings: dict[str, Any], least: float, most: float) -> None:
    layers, coc = picture()
    plain = tb.AccumulationBuffer(views=64)(layers, coc=coc)
    quick = tb.AccumulationBuffer(views=64, **settings)(layers, coc=coc)
    assert least < (quick - plain).square().mean().sqrt() < most


@pytest.mark.parametrize("scene", ["a background", "a dot in front of nothing", "a sharp subject before a background"])
def test_sub_samples_make_up_for_views(scene: str) -> None:
    h, w = 40, 48
    layers, coc = layered(1, 2, h, w, seed=4).float(), even(0.0, 9.0, h=h, w=w).float()
    layers[:, 1, :3] = random(1, 3, h, w, seed=9).float()
    if scene == "a background":
        layers[:, 0] = 0
    elif scene == "a dot in front of nothing":
        layers[:], coc[:] = 0, -9
        layers[:, 0, :, 20, 24] = 1
    truth = tb.AccumulationBuffer(views=1024)(layers, coc=coc)
    plain, many, sub = (
        (tb.AccumulationBuffer(views=n, subsamples=s)(layers, coc=coc) - truth).square().mean().sqrt()
        for n, s in ((8, 0), (40, 0), (8, 4))
    )
    assert sub < 0.5 * plain
    assert sub < 1.4 * many  # as many points of the lens


def test_sub_samples_do_not_widen_the_blur() -> None:
    layers, coc = torch.zeros(1, 1, 4, 41, 41), torch.full((1, 1, 1, 41, 41), 12.0)
    layers[..., 20, 20] = 1
    away = (torch.arange(41) - 20.0).square()
    spreads = []
    for count in (0, 6):
        dot = tb.AccumulationBuffer(views=8, subsamples=count)(layers, coc=coc)[0, 3]
        assert float(dot.sum()) == pytest.approx(1, abs=1e-4)
        spreads.append(float((dot * (away + away[:, None])).sum()))
    assert spreads[1] == pytest.approx(spreads[0], rel=0.01)


def test_techniques_that_are_off_change_no_bit() -> None:
    layers, coc = picture()
    plain = tb.AccumulationBuffer(views=12)(layers, coc=coc)
    off = tb.AccumulationBuffer(views=12, level_of_detail=0, reuse=0, subsamples=0, seed=None, first=0)
    assert torch.equal(off(layers, coc=coc), plain)
    assert not torch.equal(tb.AccumulationBuffer(views=12, seed=1)(layers, coc=coc), plain)
    assert not torch.equal(tb.AccumulationBuffer(views=12, first=12)(layers, coc=coc), plain)
    auto, share = (tb.AccumulationBuffer(views=12, level_of_detail=v)(layers, coc=coc) for v in ("auto", 2 / 12))
    assert torch.equal(auto, share)


def test_two_buffers_go_on_where_the_other_ended() -> None:
    layers, coc = picture()
    halves = [tb.AccumulationBuffer(views=32, first=n)(layers, coc=coc) for n in (0, 32)]
    whole = tb.AccumulationBuffer(views=64)(layers, coc=coc)
    assert torch.allclose((halves[0] + halves[1]) / 2, whole, atol=1e-5)


@pytest.mark.parametrize("grid", [1, 2])
def test_reuse_is_the_parents_view_rendered_once(grid: int, monkeypatch: pytest.MonkeyPatch) -> None:
    h, w, n = 20, 22, 40
    layers, coc = layered(1, 1, h, w).float(), even(-1.7, h=h, w=w).float()
    motion = torch.full((1, 1, 2, h, w), 1.1)
    views = spread(n)
    views = Views(views.lens, views.time, torch.zeros_like(views.shift))
    way = torch.tensor([1.1 * 2**0.5], dtype=F64)
    level = torch.zeros(n, 1, dtype=torch.long)
    parents = shared_views(views, torch.tensor([-1.7], dtype=F32).double(), way, grid, level)[:, 0]
    assert 4 < len(parents.unique()) < n
    own = Views(views.lens[parents], views.time[parents], views.shift)
    want = accumulate_layers(layers, coc, motion, own, None, ViewSettings())
    calls, original = [], Layer.view

    def counted(self: Layer, *rest: Any) -> tuple[Tensor, Tensor]:
        calls.append(rest)
        return original(self, *rest)

    monkeypatch.setattr(Layer, "view", counted)
    got = tb.AccumulationBuffer(views=n, reuse=grid)(layers, coc=coc, motion=motion)
    assert torch.equal(got, want)
    assert len(calls) == len(parents.unique())


@pytest.mark.parametrize("sloped", [False, True])
@pytest.mark.parametrize("settings", [{}, {"reuse": 1}, {"level_of_detail": 1.0}])
def test_gradients_match_finite_differences(settings: dict[str, Any], sloped: bool) -> None:
    h, w = 4, 5
    layers = (0.2 + 0.6 * random(1, 2, 4, h, w)).requires_grad_()
    coc = even(-1.7, 1.3, h=h, w=w) + sloped * 0.3 * smooth(1, 2, 1, h, w, seed=3)
    motion = 1.2 + sloped * 0.3 * smooth(1, 2, 2, h, w, seed=4)
    motion = motion * torch.ones(1, 2, 2, h, w, dtype=F64)
    buffer = tb.AccumulationBuffer(views=3, **settings)

    def render(layers: Tensor, coc: Tensor, motion: Tensor) -> Tensor:
        return buffer(layers, coc=coc, motion=motion)

    inputs = (layers, coc.requires_grad_(), motion.requires_grad_())
    assert torch.autograd.gradcheck(render, inputs, fast_mode=bool(settings))
    render(*inputs).square().sum().backward()
    assert all(t.grad is not None and t.grad.abs().sum() > 1e-3 for t in inputs)


def test_gradients_reach_the_lens_and_the_aperture() -> None:
    layers = layered(1, 2, 12, 14, seed=3)
    depth = torch.cat([1 + 0.2 * smooth(1, 1, 1, 12, 14), torch.full((1, 1, 1, 12, 14), math.inf)], 1)
    values = {"focal_length": 0.05, "f_number": 8.0, "focus_distance": 1.4}

    def loss(squeeze: float | nn.Parameter, lens: dict[str, Any], depth: Tensor) -> Tensor:
        made = {
            name: torch.as_tensor(value, dtype=F64) for name, value in lens.items() if not isinstance(value, Tensor)
        }
        thin = tb.ThinLens(**{**lens, **made}, sensor_width=0.036)
        aperture = Ellipse(squeeze if isinstance(squeeze, Tensor) else nn.Parameter(torch.tensor(squeeze, dtype=F64)))
        return tb.AccumulationBuffer(thin, aperture, views=7)(layers, depth).square().mean()

    held: dict[str, Any] = {name: nn.Parameter(torch.tensor(value, dtype=F64)) for name, value in values.items()}
    squeeze, leaf = nn.Parameter(torch.tensor(1.5, dtype=F64)), depth.clone().requires_grad_()
    loss(squeeze, held, leaf).backward()
    assert leaf.grad is not None
    assert leaf.grad.isfinite().all()
    assert (leaf.grad[:, 0] != 0).any()
    assert (leaf.grad[:, 1] == 0).all()  # at infinity nothing moves
    plain = {name: parameter.detach() for name, parameter in held.items()}
    for name, value in values.items():
        step = 1e-6 * value
        ends = [loss(1.5, {**plain, name: plain[name] + s}, depth).item() for s in (-step, step)]
        assert held[name].grad.item() == pytest.approx((ends[1] - ends[0]) / (2 * step), rel=1e-4)
    ends = [loss(1.5 + s, plain, depth).item() for s in (-1e-6, 1e-6)]
    assert squeeze.grad.item() == pytest.approx((ends[1] - ends[0]) / 2e-6, rel=1e-4)


def test_a_batch_is_its_items_one_by_one() -> None:
    layers, coc = layered(3, 2, 15, 17).float(), (random(3, 2, 1, 15, 17) * 6 - 3).float()
    motion = (random(3, 2, 2, 15, 17, seed=1) * 4).float()
    buffer = tb.AccumulationBuffer(views=6)
    items = [buffer(layers[n, None], coc=coc[n, None], motion=motion[n, None]) for n in range(3)]
    assert torch.allclose(buffer(layers, coc=coc, motion=motion), torch.cat(items), atol=1e-6)
    focus = [1.0, 2.0, 5.0]
    depth = 1 + coc.abs()
    lens = tb.ThinLens(0.05, 0.8, torch.tensor(focus), sensor_width=0.036)
    out = tb.AccumulationBuffer(lens, views=6)(layers, depth)
    for n, distance in enumerate(focus):
        one = tb.AccumulationBuffer(tb.ThinLens(0.05, 0.8, distance, sensor_width=0.036), views=6)
        assert torch.allclose(out[n, None], one(layers[n, None], depth[n, None]), atol=1e-6)


@pytest.mark.parametrize(("dtype", "close"), [(torch.float16, 2e-3), (torch.bfloat16, 1e-2), (F32, 1e-5)])
@pytest.mark.parametrize("settings", [{}, {"subsamples": 3}])
def test_dtypes(dtype: torch.dtype, close: float, settings: dict[str, Any]) -> None:
    layers, coc = layered(1, 2, 15, 17).to(dtype), even(-2.0, 3.0, h=15, w=17).to(dtype)
    motion = torch.full((1, 2, 2, 15, 17), 2.5, dtype=dtype)
    buffer = tb.AccumulationBuffer(views=6, **settings)
    out = buffer(layers, coc=coc, motion=motion)
    want = buffer(layers.double(), coc=coc.double(), motion=motion.double())
    assert (out.dtype, want.dtype) == (dtype, F64)
    assert torch.allclose(out.double(), want, atol=close)


@pytest.mark.parametrize("settings", [*TECHNIQUES, {"level_of_detail": 1.0, "reuse": 1, "subsamples": 3}])
def test_same_bits_for_any_number_of_threads(settings: dict[str, Any]) -> None:
    layers, coc = layered(2, 3, 70, 90).float(), (random(2, 3, 1, 70, 90) * 6 - 3).float()
    buffer, results = tb.AccumulationBuffer(views=4, **settings), []
    for count in (1, 2, 3):
        torch.set_num_threads(count)
        results.append(buffer(layers, coc=coc))
    assert torch.equal(results[0], results[1])
    assert torch.equal(results[0], results[2])


@pytest.mark.parametrize("settings", TECHNIQUES)
def test_stiff_scenes_stay_within_the_colours(settings: dict[str, Any]) -> None:
    layers = layered(1, 3, 14, 16).float()
    for scale in (1e-6, 30.0, 1e4, 1e20):
        coc = ((random(1, 3, 1, 14, 16) * 2 - 1) * scale).float()
        motion = ((random(1, 3, 2, 14, 16) * 2 - 1) * scale).float()
        out = tb.AccumulationBuffer(views=5, **settings)(layers, coc=coc, motion=motion)
        assert out.isfinite().all()
        assert out.min() >= -1e-6
        assert out.max() <= 1 + 1e-5
        assert torch.allclose(out[:, 3], torch.ones(1, 14, 16), atol=1e-5)


@pytest.mark.parametrize("settings", TECHNIQUES)
def test_layers_without_content(settings: dict[str, Any]) -> None:
    buffer = tb.AccumulationBuffer(views=4, **settings)
    nothing = torch.zeros(2, 3, 4, 9, 8)
    assert torch.equal(buffer(nothing, coc=torch.full((2, 3, 1, 9, 8), 4.0)), nothing[:, 0])
    for shape in ((2, 0, 4, 9, 8), (0, 2, 4, 9, 8)):
        out = buffer(torch.zeros(shape), coc=torch.zeros(*shape[:2], 1, 9, 8))
        assert torch.equal(out, torch.zeros(shape[0], 4, 9, 8))
    # An empty layer before or behind changes nothing, whatever its CoC.
    layers, coc = layered(2, 1, 9, 8).float(), torch.full((2, 1, 1, 9, 8), 2.0)
    more = torch.cat([nothing[:, :1], layers, nothing[:, :1]], 1)
    assert torch.equal(buffer(more, coc=torch.cat([coc * 1e3, coc, -coc], 1)), buffer(layers, coc=coc))


@pytest.mark.parametrize("settings", TECHNIQUES)
def test_small_pictures(settings: dict[str, Any]) -> None:
    buffer = tb.AccumulationBuffer(views=4, **settings)
    for h, w in ((1, 1), (1, 7), (7, 1)):
        layers = layered(2, 2, h, w).float()
        out = buffer(layers, coc=even(-3.0, 2.0, h=h, w=w, b=2).float(), motion=torch.full((2, 2, 2, h, w), 3.0))
        assert out.shape == (2, 4, h, w)
        if h == w == 1:
            assert torch.allclose(out, flattened(layers), atol=1e-6)


@pytest.mark.parametrize("settings", [{"level_of_detail": 1.0}, {"reuse": 1}, {"level_of_detail": 0.5, "reuse": 2}])
def test_techniques_treat_every_item_of_a_batch_by_itself(settings):
    layers, coc = (
        torch.rand(2, 2, 4, 12, 16, generator=torch.Generator().manual_seed(0)).clamp(0.1, 1),
        torch.tensor([9.0, 0.0]).view(2, 1, 1, 1, 1),
    )
    coc = coc.expand(2, 2, 1, 12, 16).contiguous()
    buffer = tb.AccumulationBuffer(views=8, **settings)
    alone = torch.cat([buffer(layers[n : n + 1], coc=coc[n : n + 1]) for n in (0, 1)])
    assert torch.equal(buffer(layers, coc=coc), alone)
