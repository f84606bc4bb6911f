"""Gradients of `LensBlur` and `KernelSplatting` to all that can be passed: their values, and where descent leads.

`gradcheck` runs in float64, at a fixed plan and away from kinks. Merged radii are rounded; there it runs without that.
"""

import dataclasses
from collections.abc import Callable

import pytest
import torch
from torch import Tensor, nn
from torch.func import functional_call

import torchbokeh as tb
import torchbokeh.ops.merge
from torchbokeh.plan.plan import Plan
from torchbokeh.psfs import PsfBank

F64 = torch.float64
H, W = 6, 7
LENS = {"focal_length": 0.2, "f_number": 2.0, "focus_distance": 2.0, "sensor_width": 0.01}
DISPARITY = {"strength": 3.0, "focus_disparity": 0.2}
GLASS = {"axial": 0.5, "lateral": 0.0213}
SHAPES = {"pentagon": tb.Polygon(5, 0.3, 0.4), "ellipse": tb.Ellipse(1.6, 0.3)}
FREE = (-4.0, -0.9), (-2.1, 4.0)  # bins that end beyond all radii, where their weights bend


def noise(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=F64)


def numbers(values: dict[str, float]) -> dict[str, Tensor]:
    return {name: torch.tensor(v, dtype=F64) for name, v in values.items()}


def radii(foreground: bool = True) -> Tensor:
    """0.6 to 3.6 px of either sign: nothing within half a pixel of sharp, and nothing halfway to the foreground."""
    far = 0.6 + 3 * noise(1, 1, H, W, seed=5)
    return torch.where(noise(1, 1, H, W, seed=4) < 0.4, -far.clamp_min(1.05), far) if foreground else far


def depths(foreground: bool = True) -> Tensor:
    return tb.ThinLens(**numbers(LENS)).depth(radii(foreground), W)


def wide(foreground: bool = True) -> dict[str, Tensor]:
    """A picture with radii of two levels of merging, away from the passage between them."""
    size = (1, 1, 6, 36)
    far = torch.where(noise(*size, seed=6) < 0.5, 1 + 6.5 * noise(*size, seed=5), 9.3 + 6 * noise(*size, seed=5))
    near = torch.arange(36).expand(size) < (14 if foreground else 0)
    return {"image": noise(1, 3, 6, 36, seed=3), "coc": torch.where(near, -far - 1.5, far)}


def layers() -> dict[str, Tensor]:
    coc = torch.tensor([-2.6, 1.9], dtype=F64).view(1, 2, 1, 1, 1) + noise(1, 2, 1, H, W, seed=1)
    return {"image": 0.2 + 0.6 * noise(1, 2, 4, H, W, seed=3), "coc": coc}


def merged_layers() -> dict[str, Tensor]:
    maps = wide(False)
    image = 0.2 + 0.6 * noise(1, 2, 4, 6, 36, seed=3)
    return {"image": image, "coc": torch.stack([-maps["coc"].flip(3) - 1.5, maps["coc"]], 1)}


def motion(*shape: int) -> Tensor:
    return 8 * (noise(*shape, seed=7) - 0.5)


class Scene:
    """Inputs of a `LensBlur`, among them numbers of the lens and of the aperture, at a plan that stays."""

    def __init__(
        self, inputs: dict[str, Tensor], bins: tuple[tuple[float, ...], ...] = FREE, **settings: object
    ) -> None:
        self.settings = {"subapertures": 1} | settings
        self.names = list(inputs)
        self.inputs = list(inputs.values())
        self.plan = self.with_bins(self(*self.inputs, planned=False), bins)

    @staticmethod
    def with_bins(plan: Plan, bins: tuple[tuple[float, ...], ...]) -> Plan:
        colours = [c._replace(plan=dataclasses.replace(c.plan, bins=bins)) for c in plan.colours]
        return dataclasses.replace(plan, bins=bins, colours=tuple(colours))

    def __call__(self, *inputs: Tensor, planned: bool = True) -> Tensor:
        given = dict(zip(self.names, inputs, strict=True))
        image = given.pop("image")
        own = {name: given.pop(name) for name in (*LENS, *DISPARITY, *GLASS) if name in given}
        shape = {f"aperture.{k}": given.pop(k) for k in ("rotation", "curvature", "squeeze") if k in given}
        glass = {name: own.pop(name) for name in GLASS if name in own}
        if "strength" in own:
            lens: tb.ThinLens | tb.DisparityLens = tb.DisparityLens(**own)
        else:
            of_glass = tb.Dispersion("SF10", **glass) if glass else None
            lens = tb.ThinLens(**(numbers(LENS) | own), dispersion=of_glass)
        blur = tb.LensBlur(lens, **self.settings)  # type: ignore[arg-type]
        if "colour" in given:
            given["background"] = (given.pop("colour"), given.pop("behind"))  # type: ignore[assignment]
        if not planned:
            return blur.plan(image, **given)
        return functional_call(blur, shape, (image,), given | {"plan": self.plan})


def background() -> dict[str, Tensor]:
    return {"colour": noise(1, 3, H, W, seed=8), "behind": 0.7 + 2 * noise(1, 1, H, W, seed=9)}


def plain(foreground: bool = True) -> dict[str, Tensor]:
    return {"image": noise(1, 3, H, W, seed=3), "coc": radii(foreground)}


def shape(name: str) -> dict[str, Tensor]:
    return {k: v.double() for k, v in SHAPES[name].state_dict().items()}


def glare() -> dict[str, Tensor]:
    image = noise(1, 3, H, W, seed=3)
    image[0, :, 2, 3] *= 3e3
    return {"image": image, "coc": radii(False), "motion": motion(1, 2, H, W)}


ONE, FAR, LAYERS, WIDE = ((1.0,),), ((0.4, 2.0, 4.0),), ((-2.7, -1.5), (1.8, 3.0)), ((-9.0,), (-2.1, 15.9))
MERGED_LAYERS = ((-17.5, -2.0), (0.7, 15.9))
PENTAGON, START = {"aperture": SHAPES["pentagon"]}, {"shutter": "start"}

EXACT: dict[str, Callable[[], Scene]] = {
    "one bin, thin lens": lambda: Scene({"image": noise(1, 3, H, W), "depth": depths(False)} | numbers(LENS), ONE),
    "bins": lambda: Scene(plain(False) | shape("ellipse"), FAR, aperture=SHAPES["ellipse"]),
    "filled, thin lens": lambda: Scene({"image": noise(1, 3, H, W), "depth": depths()} | numbers(LENS)),
    "filled, disparity": lambda: Scene({"image": noise(1, 3, H, W), "depth": 0.2 - radii() / 3} | numbers(DISPARITY)),
    "given": lambda: Scene(plain() | background() | shape("pentagon"), **PENTAGON),
    "layers": lambda: Scene(layers() | shape("pentagon"), LAYERS, **PENTAGON),
    "one bin, cut": lambda: Scene(plain(False) | shape("ellipse"), ONE, subapertures=2, aperture=SHAPES["ellipse"]),
    "one shape for all": lambda: Scene(
        {"image": noise(1, 3, 9, 9), "coc": torch.full((1, 1, 9, 9), 8.3, dtype=F64)} | shape("pentagon"),
        ONE,
        **PENTAGON,
    ),
    "cut to a radius": lambda: Scene(plain(False), FAR, max_coc=2.4),
    "with a margin": lambda: Scene(plain(False), FAR, margin=1),
}
SLOW: dict[str, Callable[[], Scene]] = {
    "filled, cut": lambda: Scene(plain() | shape("pentagon"), subapertures=2, **PENTAGON),
    "given, cut": lambda: Scene(plain() | background(), subapertures=2),
    "layers, cut": lambda: Scene(layers(), LAYERS, subapertures=2),
    "dispersion": lambda: Scene(
        {"image": noise(1, 3, H, W), "depth": depths()} | numbers(LENS) | numbers(GLASS), ((-6.0, 0.5), (-2.1, 7.0))
    ),
}
MERGED: dict[str, Callable[[], Scene]] = {
    "one bin": lambda: Scene(wide(False), ONE, quality="balanced"),
    "bins": lambda: Scene(wide(False), ((0.7, 15.9),), quality="balanced"),
    "filled": lambda: Scene(wide() | shape("pentagon"), WIDE, quality="balanced", **PENTAGON),
    "layers": lambda: Scene(merged_layers(), MERGED_LAYERS, quality="balanced"),
}
MOVING: dict[str, Callable[[], Scene]] = {
    "one bin": lambda: Scene(plain(False) | {"motion": motion(1, 2, H, W)}, ONE),
    "filled, from the start": lambda: Scene(plain() | {"motion": motion(1, 2, H, W)}, **START),
    "layers": lambda: Scene(layers() | {"motion": motion(1, 2, 2, H, W)}, LAYERS),
    "nearing": lambda: Scene(
        plain(False) | {"motion": motion(1, 2, H, W), "shutter_depth": torch.cat([radii(False), radii(False) + 3], 1)},
        FAR,
    ),
    "highlight": lambda: Scene(glare(), ONE),
    "merged": lambda: Scene(wide(False) | {"motion": motion(1, 2, 6, 36)}, ONE, quality="balanced"),
}


def check(scene: Scene) -> None:
    """The numbers of lens and aperture are asked by factors of them, so that one step of differences suits all."""
    scales = [t if name in LENS else torch.ones_like(t) for name, t in zip(scene.names, scene.inputs, strict=True)]
    leaves = [(t / s).requires_grad_() for t, s in zip(scene.inputs, scales, strict=True)]

    def paint(*given: Tensor) -> Tensor:
        return scene(*(t * s for t, s in zip(given, scales, strict=True)))

    assert torch.autograd.gradcheck(paint, leaves, fast_mode=True)
    grads = torch.autograd.grad(paint(*leaves).square().sum(), leaves)
    for name, grad in zip(scene.names, grads, strict=True):
        if name != "coc" or "shutter_depth" not in scene.names:  # radii are then those of the shutter
            assert float(grad.abs().max()) > 1e-3


@pytest.mark.parametrize("name", EXACT)
def test_exact(name: str) -> None:
    check(EXACT[name]())


@pytest.mark.slow
@pytest.mark.parametrize("name", SLOW)
def test_exact_in_pieces_and_in_colours(name: str) -> None:
    check(SLOW[name]())


@pytest.mark.parametrize("name", MERGED)
def test_merged(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torchbokeh.ops.merge, "STEPS", 2.0**40)
    scene = MERGED[name]()
    assert scene.plan.highest == 1
    check(scene)


@pytest.mark.parametrize("name", MOVING)
def test_moving(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the samples of the bank that were chosen."""
    monkeypatch.setattr(torchbokeh.ops.merge, "STEPS", 2.0**40)
    scene = MOVING[name]()
    assert scene.plan.moves
    check(scene)


def test_every_entry_of_a_part_of_the_gradient() -> None:
    scene = Scene({"image": noise(1, 1, H, W), "coc": radii()})
    image, coc = scene.inputs
    some, rest = coc.split([1, H - 1], 2)

    def top(some: Tensor) -> Tensor:
        return scene(image, torch.cat([some, rest], 2))[..., :2, :]

    assert torch.autograd.gradcheck(top, (some.clone().requires_grad_(),))


def test_a_layer_is_learned_where_it_is() -> None:
    maps = layers()
    there = (noise(1, 2, 1, H, W, seed=12) > 0.3).double()
    scene = Scene({"image": maps["image"] * there, "coc": maps["coc"]}, LAYERS)
    leaves = [t.requires_grad_() for t in scene.inputs]
    assert torch.autograd.gradcheck(lambda i, c: scene(i * there, c), leaves, fast_mode=True)
    (slope,) = torch.autograd.grad(scene(*leaves).sum(), leaves[0])
    assert slope.isfinite().all()


BANKS = [("combined", "motion"), ("stylized", ""), ("volume", "depth"), ("simple-lens", ""), ("physical-lens", "")]


@pytest.mark.parametrize(("name", "map_"), BANKS)
def test_banks_with_interpolation(name: str, map_: str) -> None:
    extra = {"": {}, "motion": {"motion": motion(1, 2, H, W)}, "depth": {"depth": 1 + 4 * noise(1, 1, H, W, seed=11)}}
    maps = extra[map_] if map_ == "depth" else {"coc": radii(False)} | extra[map_]
    splatting = tb.KernelSplatting(bank=PsfBank.load(name), interpolate=True, quality="exact")
    image, names = noise(1, 3, H, W, seed=3), list(maps)
    plan = splatting.plan(image, **maps)
    leaves = [t.requires_grad_() for t in (image, *maps.values())]

    def blur(image: Tensor, *given: Tensor) -> Tensor:
        return splatting(image, **dict(zip(names, given, strict=True)), plan=plan)  # type: ignore[arg-type]

    assert torch.autograd.gradcheck(blur, leaves, fast_mode=True)


@pytest.mark.parametrize("quality", ["exact", "balanced"])
def test_sharp_pixels_leave_the_gradients_of_a_bank_finite(quality: str) -> None:
    coc = torch.where(torch.arange(40) < 20, 0.0, 12.0).expand(1, 1, 8, 40).clone().requires_grad_()
    way = torch.full((1, 2, 8, 40), 3.0, requires_grad=True)
    splatting = tb.KernelSplatting(bank=PsfBank.load("combined"), interpolate=True, quality=quality)
    image = noise(1, 3, 8, 40).float().requires_grad_()
    grads = torch.autograd.grad(splatting(image, coc, motion=way).square().sum(), (image, coc, way))
    assert all(g.isfinite().all() and g.any() for g in grads)


@pytest.mark.parametrize("name", ["still", "sharp", "hardly nearing", "nearing", "empty"])
def test_what_is_left_out_gets_a_gradient_of_zero(name: str) -> None:
    """A training must not stop at a scene that needs none of what is learned."""
    image, coc = noise(1, 3, H, W), radii(False)
    blur, asked = tb.LensBlur(), torch.full((1, 2, H, W), 0.1, dtype=F64, requires_grad=True)
    if name == "still":
        out = blur(image, coc=coc, motion=asked)
    elif name == "sharp":
        asked = nn.Parameter(torch.tensor(0.3))  # type: ignore[assignment]
        out = tb.LensBlur(aperture=tb.Polygon(5, asked))(image, coc=0 * coc)
        assert not tb.KernelSplatting(tb.Polygon(5, asked))(image, 0 * coc).sum().backward()
    elif name == "hardly nearing":
        out = blur(image, coc=coc, shutter_depth=asked)
    elif name == "nearing":
        asked = coc.requires_grad_()
        out = tb.LensBlur(layers=1)(image, coc=asked, shutter_depth=torch.cat([radii(False), radii(False) + 3], 1))
    else:
        asked = torch.zeros(1, 1, 4, H, W, dtype=F64, requires_grad=True)
        out = blur(asked, coc=coc[:, None])
    out.sum().backward()
    assert asked.grad is not None
    assert float(asked.grad.abs().max()) < 1e-12
