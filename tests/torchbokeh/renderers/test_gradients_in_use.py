"""What gradients cost, whether those of the kernels are those of the definitions, and whether descent gets anywhere."""

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

import torchbokeh as tb
from torchbokeh.banks.splat import bank_of_motion

F32, F64 = torch.float32, torch.float64
PATHS = {
    "exact": {"layers": 1, "subapertures": 1},
    "filled": {"layers": 2, "subapertures": 2},
    "merged": {"quality": "balanced", "layers": 1},
    "merged, filled": {"quality": "balanced", "layers": 2, "subapertures": 1},
    "motion": {"layers": 1},
    "motion, highlights": {"layers": 1},
    "motion, merged": {"quality": "balanced", "layers": 1},
}


def noise(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=F64)


def smooth(channels: int, h: int, w: int, cells: int, seed: int = 0) -> Tensor:
    """In white noise all blur looks alike."""
    coarse = noise(1, channels, cells, cells * w // h, seed=seed)
    return F.interpolate(coarse, (h, w), mode="bicubic", align_corners=True).clamp_min(0)


def inputs(name: str, side: int, radius: float, dtype: torch.dtype) -> dict[str, Tensor]:
    image = smooth(3, side, side, side // 3)
    if "highlights" in name:
        image[..., 3::24, 3::24] = 1e5
    nearest = -radius if "filled" in name else 0.6
    maps = {"image": image, "coc": torch.linspace(nearest, radius, side).expand(1, 1, side, side).clone()}
    if "motion" in name:
        maps["motion"] = 16 * (smooth(2, side, side, 6, seed=3) - 0.5)
    return {name: t.to(dtype).requires_grad_() for name, t in maps.items()}


def nodes(out: Tensor) -> int:
    """How many nodes the graph behind a tensor has."""
    seen, open_ = set(), [out.grad_fn]
    while open_:
        node = open_.pop()
        if node is not None and node not in seen:
            seen.add(node)
            open_ += [other for other, _ in node.next_functions]
    return len(seen)


def graph(name: str, radius: float, dtype: torch.dtype, side: int = 80) -> tuple[int, float]:
    """Its number of nodes, and the bytes that it keeps, without the points of a bank, over those of a picture."""
    maps = inputs(name, side, radius, dtype)
    blur, image = tb.LensBlur(**PATHS[name]), maps.pop("image")  # type: ignore[arg-type]
    plan = replace(blur.plan(image, **maps), surrounded=0)  # or a small picture would be several times as large
    blur(image, **maps, plan=plan)
    tables = bank_of_motion(image.device)._tables.values()
    shared = {t.untyped_storage().data_ptr() for table in tables for t in table}
    kept: dict[int, Tensor] = {}

    def pack(t: Tensor) -> Tensor:
        place = t.untyped_storage().data_ptr()
        if place not in shared:
            kept[place] = t
        return t

    with torch.autograd.graph.saved_tensors_hooks(pack, lambda t: t):
        out = blur(image, **maps, plan=plan)
    kept_bytes = sum(t.untyped_storage().nbytes() for t in kept.values())
    return nodes(out), kept_bytes / (image.numel() * image.element_size())


@pytest.mark.parametrize("dtype", [F32, F64])
@pytest.mark.parametrize("name", PATHS)
def test_no_graph_grows_with_the_radius(name: str, dtype: torch.dtype) -> None:
    """Between radii of 8 and 40 px each of them has some levels; from none on, merging in torch adds those."""
    (few, light), (many, heavy) = (graph(name, radius, dtype) for radius in (8.0, 40.0))
    levels = 2 if "merged" in name else 0
    assert many <= few + 20 + 250 * levels
    # What is integrated by FFT is padded by the reach, so that a small picture is half as large again.
    assert heavy < (1.5 if "motion" in name else 1.05) * light + 8 * levels


@pytest.mark.parametrize(("name", "most"), [("exact", 4.0), ("merged", 10.0), ("motion", 80.0)])
@pytest.mark.parametrize("dtype", [F32, F64])
def test_one_surface_keeps_few_pictures(name: str, most: float, dtype: torch.dtype) -> None:
    assert graph(name, 40.0, dtype)[1] < most


@pytest.mark.parametrize("name", PATHS)
def test_gradients_in_single_are_those_in_double(name: str) -> None:
    found = []
    for dtype in (F32, F64):
        maps = inputs(name, 48, 14.0, dtype)
        out = tb.LensBlur(**PATHS[name])(**maps)  # type: ignore[arg-type]
        found.append(torch.autograd.grad((out * noise(*out.shape, seed=7).to(dtype)).sum(), list(maps.values())))
    for single, double in zip(*found, strict=True):
        assert float((single.double() - double).norm() / double.norm()) < 1e-3


def descend(loss: Callable[[], Tensor], learned: list[nn.Parameter], rate: float, steps: int) -> float:
    """What is left of a loss, as a share of it."""
    optimiser = torch.optim.Adam(learned, lr=rate)
    losses = []
    for _ in range(steps):
        optimiser.zero_grad()
        now = loss()
        now.backward()
        losses.append(now.item())
        optimiser.step()
    return loss().item() / losses[0]


@pytest.mark.parametrize("quality", ["exact", "balanced"])
@pytest.mark.parametrize("glare", [False, True])
def test_depth_is_learned_over_bins_levels_and_the_foreground(quality: str, glare: bool) -> None:
    """With new plans at each step: shares, rounding and the choice of highlights stay out of the gradient."""
    side = 64
    image = smooth(3, side, side, 20).float()
    if glare:
        image[..., 5::16, 5::16] = 40.0
    true = F.interpolate(18 * smooth(1, 4, 4, 4, seed=2).float() - 6, (side, side), mode="bicubic")
    blur = tb.LensBlur(quality=quality, subapertures=1)
    plan = blur.plan(image, coc=true)
    assert len(plan.bins) == 2
    assert (plan.highest > 0) == (quality == "balanced")
    with torch.no_grad():
        wanted = blur(image, coc=true)
    coarse = nn.Parameter(torch.full((1, 1, 8, 8), 4.0))

    def loss() -> Tensor:
        coc = F.interpolate(coarse, (side, side), mode="bicubic")
        return (blur(image, coc=coc) - wanted).clamp(-1, 1).square().mean()

    assert descend(loss, [coarse], 0.4, 40) < 0.4


@pytest.mark.parametrize("start", [1.75, 2.35])
def test_a_lens_is_learned_through_merged_levels(start: float) -> None:
    image = smooth(3, 32, 96, 10).float()
    depth = torch.tensor([1.2, 1.7, 2.4, 4.0]).repeat_interleave(24).expand(1, 1, 32, 96).clone()
    true = tb.LensBlur(tb.ThinLens(0.2, 1.8, 2.0, 0.036), quality="balanced")
    assert true.plan(image, depth).highest > 0
    with torch.no_grad():
        wanted = true(image, depth)
    focus, number = nn.Parameter(torch.tensor(start)), nn.Parameter(torch.tensor(2.2))
    blur = tb.LensBlur(tb.ThinLens(0.2, number, focus, 0.036), quality="balanced")
    assert descend(lambda: (blur(image, depth) - wanted).square().mean(), [focus, number], 0.05, 60) < 0.05
    assert focus.item() == pytest.approx(2.0, rel=0.05)


@pytest.mark.parametrize("quality", ["exact", "balanced"])
def test_a_field_of_motion_is_learned_over_the_samples_of_a_bank(quality: str) -> None:
    side = 40
    image = smooth(3, side, side, 13).float()
    coc = torch.where(torch.arange(side) < 20, 2.0, 10.0).expand(1, 1, side, side).contiguous()
    true = F.interpolate(24 * (smooth(2, 4, 4, 4, seed=6).float() - 0.5), (side, side), mode="bicubic")
    blur = tb.LensBlur(layers=1, quality=quality, shutter="start")
    with torch.no_grad():
        wanted = blur(image, coc=coc, motion=true)
    coarse = nn.Parameter(torch.full((1, 2, 6, 6), 2.0))

    def loss() -> Tensor:
        motion = F.interpolate(coarse, (side, side), mode="bicubic")
        return (blur(image, coc=coc, motion=motion) - wanted).square().mean()

    assert descend(loss, [coarse], 0.6, 25) < 0.4


def test_a_layer_is_learned_behind_a_wide_one() -> None:
    image = torch.cat([smooth(3, 40, 40, 10), torch.ones(1, 1, 40, 40)], 1)[:, None].float()
    front = torch.zeros_like(image)
    front[..., 10:30, 10:30] = torch.tensor([0.2, 0.3, 0.6, 1.0])[:, None, None]
    layers, coc = torch.cat([front, image], 1), torch.tensor([-10.0, 5.0]).view(1, 2, 1, 1, 1).expand(1, 2, 1, 40, 40)
    blur = tb.LensBlur(quality="balanced")
    with torch.no_grad():
        wanted = blur(layers, coc=coc)
    guess = nn.Parameter(torch.full((1, 1, 3, 40, 40), 0.5))
    opaque = torch.ones(1, 1, 1, 40, 40)

    def loss() -> Tensor:
        return (blur(torch.cat([front, torch.cat([guess, opaque], 2)], 1), coc=coc) - wanted).square().mean()

    assert descend(loss, [guess], 0.05, 30) < 0.2
