import doctest
import importlib.util
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

import torchbokeh.ops.planes
from torchbokeh.ops import dispatch
from torchbokeh.ops.kernels import planes as kernels
from torchbokeh.ops.planes import Plates, _render_planes_torch, render_planes

F32, F64 = torch.float32, torch.float64
few = settings(deadline=None, max_examples=60)


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=F64).float().double()


def texture(h: int, w: int, seed: int = 0, opaque: bool = False) -> Tensor:
    rgba = random(4, h, w, seed=seed)
    rgba[3] = 1 if opaque else (rgba[3] * 1.6 - 0.2).clamp(0, 1)
    rgba[:3] *= 2 * rgba[3:]
    return rgba.float()


def flat(red: float, alpha: float, h: int = 8, w: int = 8) -> Tensor:
    return (torch.tensor([red, 0.0, 1.0, 1.0]) * alpha)[:, None, None].expand(4, h, w).clone()


def same(plates: Plates, dtype: torch.dtype) -> Plates:
    return Plates(tuple(tuple(t.to(dtype) for t in p) for p in plates.levels), plates.mirror, plates.infinite)


def facing(x: float, y: float, *, scale: float = 1.0, depth: float = 1.0) -> Tensor:
    """A card that faces the lens, its corner at (x, y) and its texels ``scale`` px wide."""
    return torch.tensor([[1 / scale, 0, -x / scale], [0, 1 / scale, -y / scale], [0, 0, 1]], dtype=F64) / depth


def look(
    plates: Plates, *homographies: Tensor, level: int = 0, size: tuple[int, int] = (20, 24), **more: Any
) -> Tensor:
    """One view of cards."""
    inverse = torch.stack(homographies)[None]
    chosen = torch.full((1, len(homographies)), level)
    return render_planes(plates, inverse, chosen, size, **more)[0][0]


def tilted(views: int, count: int, size: tuple[int, int], extent: list[tuple[int, int]], seed: int) -> Tensor:
    """Homographies of cards anywhere: in the picture, beside it, through the plane of the lens and behind it."""
    g = torch.Generator().manual_seed(seed)
    corner = torch.randn(views, count, 3, generator=g, dtype=F64)
    corner[..., 2] += 2
    axes = torch.randn(views, count, 2, 3, generator=g, dtype=F64)
    axes[..., 2] *= 0.7
    wide = torch.tensor([(w, h) for h, w in extent], dtype=F64).reshape(1, count, 2, 1)
    corner = corner - 0.5 * axes.sum(2)
    to_space = torch.cat([axes / wide, corner[:, :, None]], 2).mT
    focal = float(max(size))
    camera = torch.tensor([[focal, 0, size[1] / 2], [0, focal, size[0] / 2], [0, 0, 1]], dtype=F64)
    return torch.linalg.inv(camera @ to_space)


def scene(views: int, count: int, size: tuple[int, int], seed: int) -> tuple[Plates, Tensor, Tensor]:
    """Textures of all sizes and kinds, homographies, some of them singular, and levels."""
    sizes = torch.randint(1, 14, (count, 2), generator=torch.Generator().manual_seed(seed)).tolist()
    kinds = (random(3, count, seed=seed) < torch.tensor([[0.25], [0.2], [0.3]])).tolist()
    textures = [texture(h, w, seed + k, kinds[2][k]) for k, (h, w) in enumerate(sizes)]
    plates = Plates.build(textures, kinds[0], kinds[1], count=5)
    inverse = tilted(views, count, size, sizes, seed)
    inverse[random(views, count, seed=seed + 7) < 0.1] = 0
    levels = torch.tensor([len(p) for p in plates.levels])
    return plates, inverse, (random(views, count, seed=seed + 5) * levels).long()


@few
@given(
    h=st.integers(1, 37),
    w=st.integers(1, 37),
    count=st.sampled_from([0, 1, 2, 3, 7]),
    views=st.integers(1, 4),
    seed=st.integers(0, 9999),
)
def test_the_kernel_computes_what_the_torch_definition_does(h: int, w: int, count: int, views: int, seed: int) -> None:
    plates, inverse, level = scene(views, count, (h, w), seed)
    for frames in (False, True):
        got = render_planes(plates, inverse, level, (h, w), frames=frames)
        want = _render_planes_torch(same(plates, F64), inverse, level, (h, w), None, frames)
        assert got[0].dtype == got[1].dtype == F32
        assert torch.allclose(got[0].double(), want[0].double(), atol=4e-6)
        assert got[1].shape == want[1].shape
        # Two that are seen equally much but for rounding may change places, in one pixel at most.
        off = (got[1].double() - want[1]).abs() > 1e-5 * want[1].abs() + 1e-6
        assert off.sum() <= 1


def test_the_random_scenes_show_something() -> None:
    shown, partly, hidden = 0, 0, 0
    for seed in range(30):
        plates, inverse, level = scene(2, 5, (30, 31), seed)
        frames, nearest = render_planes(plates, inverse, level, (30, 31), frames=True)
        shown += int((nearest > 0).sum())
        partly += int(((frames[:, 3] > 0.05) & (frames[:, 3] < 0.95)).sum())
        hidden += int((frames[:, 3] == 0).sum())
    assert min(shown, partly, hidden) > 2000


@pytest.mark.parametrize("memory", [0, 5000, 1 << 26])
@pytest.mark.parametrize("frames", [False, True])
@pytest.mark.parametrize("dtype", [F32, F64])
def test_parents_stand_for_their_children(
    memory: int, frames: bool, dtype: torch.dtype, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same bits as without copies, whether they fit into memory or not."""
    monkeypatch.setattr(kernels, "MEMORY", memory)
    size = (35, 29)
    for seed in range(12 if dtype == F32 else 3):
        plates, inverse, level = scene(24, 5, size, seed)
        plates = same(plates, dtype)
        parents = (random(24, 5, seed=seed) * torch.tensor([1, 2, 6, 24, 24])).long()
        own = inverse.gather(0, parents[..., None, None].expand_as(inverse)), level.gather(0, parents)
        want = render_planes(plates, *own, size, frames=frames)
        got = render_planes(plates, inverse, level, size, parents=parents, frames=frames)
        assert torch.equal(got[0], want[0])
        assert torch.equal(got[1], want[1])
        assert not torch.equal(got[0], render_planes(plates, inverse, level, size, frames=frames)[0])


def test_what_is_shared_is_rendered_once(monkeypatch: pytest.MonkeyPatch) -> None:
    plates, inverse, level = scene(8, 3, (9, 9), 3)
    parents = torch.tensor([[0, 0, 4]] * 3 + [[3, 0, 4]] * 5)
    seen, original = [], torchbokeh.ops.planes._look_up

    def counted(plates: Plates, k: int, *rest: Any) -> Any:
        seen.append(k)
        return original(plates, k, *rest)

    monkeypatch.setattr(torchbokeh.ops.planes, "_look_up", counted)
    render_planes(same(plates, F64), inverse, level, (9, 9), parents=parents)
    assert sorted(seen) == [0, 0, 1, 2]


def test_copies_take_no_more_memory_than_allowed(monkeypatch: pytest.MonkeyPatch) -> None:
    plates = Plates.build([texture(6, 6, k) for k in range(3)], [False] * 3, [False] * 3, 1)
    inverse, level = facing(5, 5).expand(12, 3, 3, 3), torch.zeros(12, 3, dtype=torch.long)
    sizes = np.full((3, 1, 2), 6)
    parents = torch.tensor([[0, n // 6, n // 2] for n in range(12)])  # of 12, 6 and 2 children
    for strips, kept in ((0, []), (1, [12]), (2, [12, 6]), (4, [12, 6, 6, 2]), (99, [12, 6, 6, *[2] * 6])):
        strip = 9 * kernels.BAND * 16  # columns 4 to 12, of 16 bytes each pixel
        monkeypatch.setattr(kernels, "MEMORY", strips * strip)
        copy, columns = kernels._copies(plates, sizes, inverse.numpy(), level, (20, 24), parents)
        assert [int((copy == c).sum()) for c in range(len(columns))] == kept
        assert (columns == [4, 9]).all()


def test_copies_of_cards_seen_all_but_edge_on_stay_in_their_place() -> None:
    """Where such a card lies in the picture is known but roughly."""
    size, views = (20, 64), 6
    plates = Plates.build([texture(6, 6, 1, True), texture(6, 6, 2, True)], [False] * 2, [False] * 2, 1)
    level, parents = torch.zeros(views, 2, dtype=torch.long), torch.zeros(views, 2, dtype=torch.long)
    for tilt in (1e-3, 1e-6, 1e-8, 1e-9, 1e-10):
        axes = torch.tensor([[tilt * 7 / 32, 0, 7 * 0.3], [0, 1, 0.3 * tilt], [0.137, -0.4, 2.0]], dtype=F64).mT
        camera = torch.tensor([[64, 0, 32], [0, 64, 10], [0, 0, 1]], dtype=F64)
        inverse = torch.linalg.inv(camera @ axes).expand(views, 2, 3, 3).clone()
        inverse[:, 1] = facing(30.0, 4.0, depth=3.0)
        want = render_planes(plates, inverse, level, size, frames=True)[0]
        got = render_planes(plates, inverse, level, size, frames=True, parents=parents)[0]
        assert torch.equal(got, want)


@pytest.mark.parametrize("dtype", [F32, F64])
def test_the_mean_is_that_of_the_frames(dtype: torch.dtype) -> None:
    plates, inverse, level = scene(9, 6, (33, 21), 5)
    plates = same(plates, dtype)
    mean, nothing = render_planes(plates, inverse, level, (33, 21))
    frames, nearest = render_planes(plates, inverse, level, (33, 21), frames=True)
    assert (mean.shape, frames.shape, nearest.shape) == ((1, 4, 33, 21), (9, 4, 33, 21), (9, 1, 33, 21))
    assert nothing.numel() == 0
    assert mean.dtype == frames.dtype == nearest.dtype == dtype
    assert torch.allclose(frames.mean(0), mean[0], atol=1e-6)


def test_same_bits_for_any_number_of_threads() -> None:
    plates, inverse, level = scene(7, 6, (90, 40), 11)
    parents = (random(7, 6, seed=2) * 7).long()
    results = []
    for count in (1, 2, 3):
        torch.set_num_threads(count)
        for frames in (False, True):
            results.append(render_planes(plates, inverse, level, (90, 40), parents=parents, frames=frames))
    for k in (2, 4):
        assert torch.equal(results[0][0], results[k][0])
        assert torch.equal(results[1][0], results[k + 1][0])
        assert torch.equal(results[1][1], results[k + 1][1])


def test_without_numba_the_definition_takes_over(monkeypatch: pytest.MonkeyPatch) -> None:
    plates, inverse, level = scene(3, 4, (15, 17), 2)
    fast = render_planes(plates, inverse, level, (15, 17))[0]
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "numba" else find_spec(name))
    dispatch.numba_is_there.cache_clear()
    try:
        with pytest.warns(UserWarning, match="numba is not installed"):
            slow = render_planes(plates, inverse, level, (15, 17))[0]
    finally:
        dispatch.numba_is_there.cache_clear()
    assert torch.allclose(fast, slow, atol=2e-5)


@pytest.mark.parametrize("dtype", [F32, F64])
def test_a_card_at_scale_one_shows_its_texels(dtype: torch.dtype) -> None:
    rgba = texture(7, 9).to(dtype)
    plates = Plates.build([rgba], [False], [False], 1)
    want = torch.zeros(4, 20, 24, dtype=dtype)
    want[:, 5:12, 3:12] = rgba
    for depth in (0.25, 1.0, 3.0):
        assert torch.allclose(look(plates, facing(3, 5, depth=depth)), want, atol=3e-6)  # its rim ends 1e-6 early
    # Beside the picture only the part within is seen.
    beside = torch.zeros_like(want)
    beside[:, :3, 20:] = rgba[:, 4:, :4]
    assert torch.allclose(look(plates, facing(20, -4)), beside, atol=1e-6)
    # At scale 3 every third pixel lies on the middle of a texel.
    large = look(plates, facing(-3, -6, scale=3))
    assert torch.allclose(large[:, 1::3, 1::3], torch.nn.functional.pad(rgba[:, 2:, 1:], (0, 0, 0, 2)), atol=1e-6)


@pytest.mark.parametrize("dtype", [F32, F64])
def test_between_texels_it_shows_their_mean(dtype: torch.dtype) -> None:
    rgba = texture(7, 9).to(dtype)
    plates = Plates.build([rgba], [False], [False], 1)
    padded = torch.zeros(4, 20, 24, dtype=dtype)
    padded[:, 5:12, 3:12] = rgba
    aside, down = padded.roll(1, 2), padded.roll(1, 1)
    assert torch.allclose(look(plates, facing(3.5, 5)), (padded + aside) / 2, atol=1e-6)
    assert torch.allclose(look(plates, facing(3, 5.25)), 0.75 * padded + 0.25 * down, atol=1e-6)
    both = (padded + aside + down + aside.roll(1, 1)) / 4
    assert torch.allclose(look(plates, facing(3.5, 5.5)), both, atol=1e-6)


@few
@given(x=st.floats(6, 8), y=st.floats(6, 8), level=st.integers(0, 3), h=st.integers(1, 9), w=st.integers(1, 9))
def test_a_shift_keeps_the_energy_of_a_card(x: float, y: float, level: int, h: int, w: int) -> None:
    plates = Plates.build([texture(h, w, opaque=True)], [False], [False], 9)
    level = min(level, len(plates.levels[0]) - 1)
    for dtype in (F32, F64):
        seen = look(same(plates, dtype), facing(x, y), level=level, size=(36, 36))
        want = plates.levels[0][0].sum((1, 2)).to(dtype)
        assert torch.allclose(seen.sum((1, 2)), want, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("dtype", [F32, F64])
@pytest.mark.parametrize("infinite", [False, True])
def test_a_constant_backdrop_stays_constant(infinite: bool, dtype: torch.dtype) -> None:
    backdrop = torch.tensor([0.3, 0.5, 1e4, 1.0]).to(dtype)[:, None, None].expand(4, 5, 7)
    plates = Plates.build([backdrop], [True], [infinite], 9)
    for level, homography in (
        (0, facing(3, 5)),
        (1, facing(-1e6, 1e6, depth=7.0)),
        (2, facing(0.3, 0.7, scale=1e-3)),
        (3, torch.tensor([[3.0, -2, 1], [5, 1, 9], [0.02, -0.01, 0.6]], dtype=F64)),
    ):
        out = look(plates, homography, level=level)
        assert torch.allclose(out, backdrop[:, :1, :1].expand_as(out), rtol=1e-6)


@pytest.mark.parametrize("dtype", [F32, F64])
def test_a_mirrored_texture_goes_on_mirrored(dtype: torch.dtype) -> None:
    rgba = texture(3, 4, opaque=True).to(dtype)
    plates = Plates.build([rgba], [True], [False], 1)
    both = torch.cat([rgba, rgba.flip(2)], 2)
    both = torch.cat([both, both.flip(1)], 1)  # 6 x 8, periodic
    want = both.repeat(1, 4, 3).roll((-2, 3), (1, 2))[:, :20, :24]
    assert torch.allclose(look(plates, facing(3, -2)), want, atol=1e-6)


@pytest.mark.parametrize("dtype", [F32, F64])
def test_the_nearer_card_is_over_the_farther(dtype: torch.dtype) -> None:
    red, blue = flat(1.0, 0.5), flat(0.0, 0.25)
    near, far = facing(2, 2, depth=1.0), facing(2, 2, depth=2.0)
    for first, second, want in (
        (near, far, [0.5, 0, 0.5 + 0.125, 0.625]),
        (far, near, [0.375, 0, 0.25 + 0.375, 0.625]),
        (near, near, [0.5, 0, 0.625, 0.625]),  # of equals the first one
        (near, -near, [0.5, 0, 0.5, 0.5]),  # what is behind the lens is not seen
        (near, torch.zeros(3, 3, dtype=F64), [0.5, 0, 0.5, 0.5]),
    ):
        plates = same(Plates.build([red, blue], [False] * 2, [False] * 2, 1), dtype)
        out = look(plates, first, second)
        assert torch.allclose(out[:, 5, 5], torch.tensor(want, dtype=dtype), atol=1e-6)
        swapped = Plates.build([blue, red], [False] * 2, [False] * 2, 1)
        if not torch.equal(first, second):
            assert torch.allclose(look(same(swapped, dtype), second, first), out, atol=1e-6)
    # A rectangle at infinity is behind all others, however its homography is scaled.
    plates = same(Plates.build([red, blue], [False] * 2, [True, False], 1), dtype)
    out = look(plates, near, far)[:, 5, 5]
    assert torch.allclose(out, torch.tensor([0.375, 0, 0.625, 0.625], dtype=dtype), atol=1e-6)


@pytest.mark.parametrize("dtype", [F32, F64])
def test_cards_that_cut_through_each_other_change_places(dtype: torch.dtype) -> None:
    red, blue = flat(1.0, 1.0), flat(0.0, 1.0)
    plates = same(Plates.build([red, blue], [True] * 2, [False] * 2, 1), dtype)
    upright = facing(0, 0, depth=2.0)
    leaning = upright.clone()
    leaning[2] = torch.tensor([0.05, 0, 0.5 - 0.05 * 9.75], dtype=F64)  # nearer from x = 9.75 on
    inverse, level = torch.stack([upright, leaning])[None], torch.zeros(1, 2, dtype=torch.long)
    out, nearest = render_planes(plates, inverse, level, (6, 24), frames=True)
    assert torch.equal(out[0, 0, 0], (torch.arange(24) + 0.5 < 9.75).to(dtype))
    x = torch.arange(24, dtype=F64) + 0.5
    want = torch.maximum(torch.full_like(x, 0.5), 0.5 + 0.05 * (x - 9.75))
    assert torch.allclose(nearest[0, 0, 3].double(), want, atol=1e-6)


@pytest.mark.parametrize("dtype", [F32, F64])
def test_the_depth_is_that_of_what_is_seen_most_of(dtype: torch.dtype) -> None:
    def depth(alphas: list[float], infinite: bool = False) -> float:
        plates = Plates.build([flat(1.0, a) for a in alphas], [False] * 2, [False, infinite], 1)
        inverse = torch.stack([facing(0, 0, depth=2.0), facing(0, 0, depth=5.0)])[None]
        level = torch.zeros(1, 2, dtype=torch.long)
        return float(render_planes(same(plates, dtype), inverse, level, (4, 4), frames=True)[1][0, 0, 2, 2])

    assert depth([0.6, 1.0]) == pytest.approx(1 / 2)
    assert depth([0.4, 1.0]) == pytest.approx(1 / 5)
    assert depth([0.4, 1.0], infinite=True) == 0
    assert depth([0.3, 0.2]) == 0  # nothing is seen most of
    assert depth([0.45, 0.5]) == pytest.approx(1 / 2)
    assert depth([0.0, 0.0]) == 0


@pytest.mark.parametrize("endless", [False, True])
def test_levels_are_means(endless: bool) -> None:
    rgba = texture(5, 9)
    pyramid = Plates.build([rgba], [endless], [False], 9).levels[0]
    assert [tuple(t.shape[1:]) for t in pyramid] == [(5, 9), (3, 5), (2, 3), (1, 2), (1, 1)]
    assert torch.equal(pyramid[0], rgba)
    for fine, coarse in pairwise(pyramid):
        h, w = fine.shape[1:]
        for j in range(coarse.shape[1]):
            for i in range(coarse.shape[2]):
                four = [(2 * j + b, 2 * i + a) for b in (0, 1) for a in (0, 1)]
                if endless:  # the texel beside it, once more
                    values = [fine[:, min(y, h - 1), min(x, w - 1)] for y, x in four]
                else:  # transparent
                    values = [fine[:, y, x] if y < h and x < w else torch.zeros(4) for y, x in four]
                assert torch.allclose(coarse[:, j, i], torch.stack(values).mean(0), atol=1e-6)
    assert len(Plates.build([rgba], [endless], [False], 3).levels[0]) == 3
    assert len(Plates.build([rgba[:, :1, :1]], [endless], [False], 3).levels[0]) == 1


@pytest.mark.parametrize(("dtype", "close"), [(torch.float16, 2e-3), (torch.bfloat16, 1.5e-2)])
def test_half_precision_looks_at_the_right_texels(dtype: torch.dtype, close: float) -> None:
    rgba = texture(16, 700).to(dtype)
    seen = look(Plates.build([rgba], [False], [False], 1), facing(-3.25, 0), size=(16, 600))
    want = look(Plates.build([rgba.float()], [False], [False], 1), facing(-3.25, 0), size=(16, 600))
    assert seen.dtype == dtype
    assert (seen.float() - want).abs().max() < close


def test_gradients_match_finite_differences() -> None:
    textures = [texture(3, 2, k).double().requires_grad_() for k in range(3)]
    inverse = torch.stack([facing(0.3, 0.6, depth=2.0), facing(1.1, -0.4, scale=1.3), facing(-0.7, 0.2, depth=3.0)])
    inverse = (inverse + 0.01 * random(3, 3, seed=4)).expand(2, 3, 3, 3).clone().requires_grad_()
    level = torch.tensor([[0, 1, 0], [1, 0, 0]])

    def render(inverse: Tensor, *textures: Tensor) -> Tensor:
        plates = Plates.build(textures, [False, False, True], [False, False, True], 2)
        return render_planes(plates, inverse, level, (4, 3), parents=torch.tensor([[0, 0, 0], [0, 1, 1]]))[0]

    assert torch.autograd.gradcheck(render, (inverse, *textures))


def test_float32_gradients_are_those_of_float64() -> None:
    plates, inverse, level = scene(3, 4, (15, 17), 2)
    grads = []
    for dtype in (F32, F64):
        leaves = [p[0].detach().to(dtype).requires_grad_() for p in plates.levels]
        place = inverse.clone().requires_grad_()
        built = Plates.build(leaves, plates.mirror, plates.infinite, 5)
        out = render_planes(built, place, level, (15, 17))[0]
        (out.square().sum()).backward()
        assert all(leaf.grad is not None for leaf in (*leaves, place))
        grads.append(torch.cat([leaf.grad.double().flatten() for leaf in leaves]))
        # Where no gradient is asked for, the kernel takes over again.
        with torch.no_grad():
            quick = render_planes(built, place, level, (15, 17))[0]
        assert not quick.requires_grad
        if dtype == F32:
            assert torch.equal(quick, render_planes(plates, inverse, level, (15, 17))[0])
    assert grads[1].abs().max() > 0.1
    assert torch.allclose(*grads, atol=1e-4)


def test_stiff_scenes_stay_finite() -> None:
    """Cards far away, huge and tiny, and close to the lens."""
    plates = Plates.build([texture(4, 5, k) for k in range(4)], [False, False, True, False], [False] * 4, 3)
    for scale in (1e-9, 1e-3, 1e5, 1e12):
        for depth in (1e-12, 1.0, 1e15):
            views = [facing(3, 2, scale=scale, depth=depth), facing(1e9, 0, scale=scale), facing(-1e15, 1, depth=depth)]
            out = look(plates, *views, facing(0, 0), level=1)
            assert out.isfinite().all()
            assert out.min() >= 0
            assert out[3].max() <= 1 + 1e-6


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"inverse": None}, TypeError, r"inverse: expected a tensor of shape \(V, 2, 3, 3\), got NoneType"),
        ({"inverse": torch.zeros(3, 1, 3, 3)}, ValueError, r"inverse: expected shape \(V, 2, 3, 3\), got"),
        ({"inverse": torch.zeros(3, 2, 3, 3).long()}, TypeError, "inverse: expected a floating-point tensor"),
        ({"inverse": torch.zeros(0, 2, 3, 3)}, ValueError, "inverse: expected at least one view, got none"),
        ({"level": torch.zeros(3, 2)}, TypeError, "level: expected an integer tensor, got torch.float32"),
        ({"level": torch.zeros(2, 2).long()}, ValueError, r"level: expected shape \(3, 2\), got \(2, 2\)"),
        ({"level": torch.full((3, 2), 2)}, ValueError, "level: expected 0 to 1 for rectangle 0, got"),
        ({"level": torch.full((3, 2), -1)}, ValueError, "level: expected 0 to 1 for rectangle 0, got"),
        ({"parents": torch.zeros(3, 2)}, TypeError, "parents: expected an integer tensor"),
        ({"parents": torch.zeros(3, 1).long()}, ValueError, r"parents: expected shape \(3, 2\), got \(3, 1\)"),
        ({"parents": torch.full((3, 2), 3)}, ValueError, "parents: expected indices of 3 views, got 3 to 3"),
        ({"parents": torch.full((3, 2), -1)}, ValueError, "parents: expected indices of 3 views, got -1 to -1"),
    ],
)
def test_render_planes_refuses(change: dict[str, Any], error: type[Exception], message: str) -> None:
    plates = Plates.build([texture(2, 2), texture(3, 4)], [False] * 2, [False] * 2, 2)
    inverse, level = facing(0, 0).expand(3, 2, 3, 3), torch.zeros(3, 2, dtype=torch.long)
    given_: dict[str, Any] = {"inverse": inverse, "level": level, "size": (4, 4)}
    with pytest.raises(error, match=message):
        render_planes(plates, **{**given_, **change})


@pytest.mark.parametrize(
    ("textures", "mirror", "infinite", "error", "message"),
    [
        ([torch.ones(3, 2, 2)], [False], [False], ValueError, r"textures: expected shape \(4, h, w\), got \(3, 2, 2\)"),
        ([torch.ones(4, 2, 2).int()], [False], [False], TypeError, "textures: expected a floating-point tensor"),
        ([torch.ones(4, 0, 2)], [True], [False], ValueError, r"textures: expected at least one texel, got .*\(4, 0, 2"),
        ([torch.ones(4, 2, 2)], [], [False], ValueError, "mirror: expected one for each of 1 textures, got 0"),
        ([torch.ones(4, 2, 2)], [True], [True] * 2, ValueError, "infinite: expected one for each of 1 textures, got 2"),
    ],
)
def test_plates_refuse(textures: Any, mirror: Any, infinite: Any, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        Plates.build(textures, mirror, infinite, 2)


def test_examples_in_the_docstrings() -> None:
    result = doctest.testmod(torchbokeh.ops.planes)
    assert result.attempted > 0
    assert result.failed == 0
