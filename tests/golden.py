"""Results of every route through the library: taken before the inside is rebuilt, compared bit by bit after each step.

``python -P tests/golden.py take FILE`` keeps them, ``compare FILE`` names what differs. They are
bits of one machine, so they are not kept in the repository. Only what `torchbokeh` promises to its users is called.
"""

import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from time import perf_counter
from typing import Any

import torch
from torch import Tensor

import torchbokeh as tb
from torchbokeh.augmentation import RandomLensBlur

QUALITIES = ("exact", "high", "balanced", "fast")

Result = Tensor | list[Tensor | None]
Case = tuple[str, Callable[[], Result]]


def lens(**settings: Any) -> tb.ThinLens:
    return tb.ThinLens(0.050, 1.8, settings.pop("focus", 2.0), sensor_width=0.004, **settings)


def scene(height: int, width: int, *, channels: int = 3, batch: int = 2, dtype: torch.dtype = torch.float32) -> Any:
    """Image, depth, motion, background and depth of that: a slope, a card in front, highlights."""
    g = torch.Generator().manual_seed(7)
    image = torch.rand(batch, channels, height, width, generator=g, dtype=torch.float64) ** 2
    image[:, :, height // 3, width // 4] = 300.0
    depth = torch.linspace(1.6, 9.0, width, dtype=torch.float64).expand(batch, 1, height, width).clone()
    depth[..., height // 4 : height // 2, width // 3 : width // 2] = 1.3
    motion = torch.randn(batch, 2, 1, 1, generator=g, dtype=torch.float64) * 4
    motion = motion.expand(-1, -1, height, width) * torch.linspace(0, 1, height, dtype=torch.float64)[:, None]
    behind = torch.rand(batch, channels, height, width, generator=g, dtype=torch.float64)
    return tuple(t.to(dtype) for t in (image, depth, motion, behind, depth.clamp_min(3.0)))


def layered(height: int, width: int) -> tuple[Tensor, Tensor, Tensor]:
    g = torch.Generator().manual_seed(8)
    layers = torch.rand(1, 3, 4, height, width, generator=g)
    layers[:, :2, 3:] *= torch.rand(1, 2, 1, height, width, generator=g) > 0.5
    layers[:, 2, 3:] = 1.0
    layers[:, :, :3] *= layers[:, :, 3:]
    depth = torch.tensor([1.4, 2.2, 7.0]).view(1, 3, 1, 1, 1).expand(1, 3, 1, height, width).contiguous()
    motion = torch.tensor([[6.0, 2.0], [0.0, 0.0], [-3.0, 1.0]]).view(1, 3, 2, 1, 1).expand(1, 3, 2, height, width)
    return layers, depth, motion.contiguous()


def with_gradients(module: torch.nn.Module, *inputs: Tensor, **maps: Any) -> list[Tensor | None]:
    """What a module returns, and the gradients of a weighted sum of it to its inputs and parameters."""
    asked = [t.clone().requires_grad_() for t in inputs]
    maps = {k: v.clone().requires_grad_() if isinstance(v, Tensor) else v for k, v in maps.items()}
    out = module(*asked, **maps)
    weights = torch.rand(out.shape, generator=torch.Generator().manual_seed(9), dtype=torch.float64).to(out.dtype)
    wanted = [*asked, *(v for v in maps.values() if isinstance(v, Tensor)), *module.parameters()]
    return [out.detach(), *torch.autograd.grad((out * weights).sum(), wanted, allow_unused=True)]


def blurs() -> Iterator[Case]:
    image, depth, motion, behind, behind_depth = scene(53, 76)
    layers, layer_depth, layer_motion = layered(44, 60)
    ends = torch.cat([depth * 0.8, depth * 1.1], 1)
    far = depth.clamp_min(2.5)
    for quality in QUALITIES:
        blur = tb.LensBlur(lens(), quality=quality)
        routes: dict[str, tuple[tb.LensBlur, tuple[Tensor, ...], dict[str, Any]]] = {
            "image": (blur, (image, depth), {}),
            "far": (blur, (image, far), {}),
            "one channel": (blur, (image[:, :1], depth), {}),
            "five channels": (blur, (torch.cat([image, behind[:, :2]], 1), depth), {}),
            "background": (blur, (image, depth), {"background": behind}),
            "background and depth": (blur, (image, depth), {"background": (behind, behind_depth)}),
            "motion": (blur, (image, depth), {"motion": motion}),
            "curved": (blur, (image, depth), {"motion": [motion, motion.flip(1)]}),
            "approach": (blur, (image, depth), {"shutter_depth": ends}),
            "approach and motion": (blur, (image, depth), {"shutter_depth": ends, "motion": motion}),
            "layers": (blur, (layers, layer_depth), {}),
            "layers, motion": (blur, (layers, layer_depth), {"motion": layer_motion}),
            "uniform": (blur, (image, torch.full_like(depth, 7.0)), {}),
            "pan": (blur, (image, torch.full_like(depth, 7.0)), {"motion": torch.full_like(motion, 3.0)}),
            "sharp": (blur, (image, torch.full_like(depth, 2.0)), {}),
            "hexagon": (tb.LensBlur(lens(), "6-gon", quality=quality), (image, depth), {}),
            "margin": (tb.LensBlur(lens(), quality=quality, margin=8), (image, depth), {}),
            "max_coc": (tb.LensBlur(lens(), quality=quality, max_coc=5.0), (image, depth), {}),
            "settings": (tb.LensBlur(lens(), quality=quality, layers=3, subapertures=2), (image, depth), {}),
            "shutter": (tb.LensBlur(lens(), quality=quality, shutter="start"), (image, depth), {"motion": motion}),
        }
        rgb = tb.Dispersion("BK7", axial=0.02, lateral=0.05)
        rainbow = tb.Dispersion("SF10", axial=0.02, lateral=0.02, spectrum="continuous")
        for name, dispersion in (("dispersion", rgb), ("continuous", rainbow)):
            coloured = tb.LensBlur(lens(dispersion=dispersion), quality=quality)
            routes[name] = coloured, (image, depth), {}
            routes[f"{name}, layers"] = coloured, (layers, layer_depth), {}
            routes[f"{name}, motion"] = coloured, (image, depth), {"motion": motion, "background": behind}
        for name, (module, inputs, maps) in routes.items():
            yield f"blur, {quality}: {name}", lambda m=module, i=inputs, k=maps: m(*i, **k)
            if name in ("image", "background", "motion", "layers", "layers, motion", "approach", "dispersion", "far"):
                yield f"gradients, {quality}: {name}", lambda m=module, i=inputs, k=maps: with_gradients(m, *i, **k)
    small = [t[..., :24, :30].contiguous() for t in scene(53, 76, batch=1, dtype=torch.float64)]
    for quality in ("exact", "balanced"):
        for shape in ("disc", "6-gon"):
            blur = tb.LensBlur(lens().double(), shape, quality=quality)
            yield f"double, {quality}, {shape}", lambda m=blur: with_gradients(m, small[0], small[1])
    learned = lens(focus=torch.nn.Parameter(torch.tensor(2.0)))
    yield "lens learned", lambda: with_gradients(tb.LensBlur(learned, quality="balanced"), image, depth)
    yield "disparity", lambda: tb.LensBlur(tb.DisparityLens(30.0, 0.4))(image, depth.reciprocal())
    yield "coc", lambda: tb.LensBlur(quality="balanced")(image, coc=4 * depth - 8)
    yield "half", lambda: tb.LensBlur(lens(), quality="balanced")(image.half(), depth.half())
    plan = tb.LensBlur(lens()).plan(image, depth)
    yield "given plan", lambda: tb.LensBlur(lens())(image[:1], depth[:1], plan=plan)


def splats() -> Iterator[Case]:
    image, depth, motion, *_ = scene(53, 76)
    coc = 5 * depth - 10
    for quality in QUALITIES:
        for shape in ("disc", "6-gon", tb.Ellipse(1.5, 0.3)):
            module = tb.KernelSplatting(shape, quality=quality)
            yield f"splat, {quality}, {shape}", lambda m=module: with_gradients(m, image, coc)
    for name, maps in (("combined", {"motion": motion}), ("stylized", {}), ("physical-lens", {}), ("volume", {})):
        bank = tb.PsfBank.load(name)
        for interpolate in (False, True):
            for quality in ("exact", "balanced"):
                module = tb.KernelSplatting(quality=quality, bank=bank, interpolate=interpolate)
                inputs = {"depth": depth} if name == "volume" else {"coc": coc, **maps}
                yield (
                    f"bank {name}, {quality}, interpolate={interpolate}",
                    lambda m=module, k=inputs: with_gradients(m, image, **k),
                )
    buffer = torch.randn(1, 3, 40, 50, generator=torch.Generator().manual_seed(3))
    for kind in (tb.FFTIntegrator, tb.PyramidIntegrator, tb.ScanlineIntegrator):
        yield kind.__name__, lambda k=kind: with_gradients(k(), buffer)
    yield "tolerance", lambda: tb.KernelSplatting(tolerance=0.02)(image, coc)


def references() -> Iterator[Case]:
    layers, layer_depth, layer_motion = layered(30, 40)
    for name in ("coins", "whirl", "ramp"):
        world, camera = getattr(tb.scenes, name)(seed=1, size=(40, 48), blur=6.0)
        seen = world.render(camera)
        yield f"scene {name}", lambda s=seen: [s[key] for key in sorted(s)]
        for settings in ({}, {"level_of_detail": "auto"}, {"reuse": 2}, {"subsamples": 3}, {"seed": 4, "first": 9}):
            buffer = tb.AccumulationBuffer(views=12, **settings)
            yield f"accumulation, {name}, {settings}", lambda b=buffer, w=world, c=camera: b(w, c)
        samples = tb.scenes.samples(world, camera, seed=2)
        yield f"reconstruct {name}", lambda s=samples: tb.reconstruct(s)
        chromatic = tb.scenes.Camera(lens=lens(dispersion=tb.Dispersion("BK7", 0.03, 0.02)), size=(40, 48))
        yield f"chromatic scene {name}", lambda w=world, c=chromatic: tb.ChromaticAccumulation(views=9)(w, c)
    for settings in ({}, {"level_of_detail": "auto", "reuse": 1}, {"subsamples": 3}):
        buffer = tb.AccumulationBuffer(lens(), views=10, **settings)
        yield f"accumulation, layers, {settings}", lambda b=buffer: b(layers, layer_depth, motion=layer_motion)
    yield (
        "gradients, accumulation of layers",
        lambda: with_gradients(tb.AccumulationBuffer(lens(), views=6), layers, layer_depth, motion=layer_motion),
    )
    for spectrum in ("rgb", "continuous"):
        dispersion = tb.Dispersion("BK7", axial=0.03, lateral=0.02, spectrum=spectrum)
        buffer = tb.ChromaticAccumulation(lens(dispersion=dispersion), views=9, level_of_detail="auto")
        yield f"chromatic accumulation, {spectrum}", lambda b=buffer: b(layers, layer_depth)
    sample = tb.scenes.ProceduralDataset(seed=3, resolution=(32, 40), views=8)
    yield "data set", lambda: [v for _, v in sorted(sample[1].items()) if isinstance(v, Tensor)]


def others() -> Iterator[Case]:
    image, depth, *_ = scene(64, 80, batch=1)
    for quality in QUALITIES:
        yield f"export, {quality}", lambda q=quality: exported(tb.LensBlur(lens(), quality=q), image, depth)
    yield "export, splat", lambda: exported(tb.KernelSplatting(quality="balanced"), image, 5 * depth - 10)
    torch.manual_seed(5)
    blur = RandomLensBlur(p=1.0)
    parameters = blur.forward_parameters(image.shape)
    yield "augmentation", lambda: blur(image.clamp(0, 1), depth=depth, params=parameters)


def exported(module: torch.nn.Module, *inputs: Tensor) -> Result:
    import onnxruntime

    with tempfile.TemporaryDirectory() as folder:
        path = tb.export_onnx(module, Path(folder) / "blur.onnx", *inputs)
        session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
        given = [*inputs]
        if isinstance(module, tb.LensBlur):
            assert isinstance(module.lens, tb.ThinLens)
            given += [module.lens.focus_distance, module.lens.f_number]
        names = [i.name for i in session.get_inputs()]
        found = session.run(None, {n: t.numpy() for n, t in zip(names, given, strict=True)})
    return [torch.from_numpy(f) for f in found]


Found = dict[str, tuple[list[Tensor | None], float]]


def results() -> Found:
    """What every case returns, and the seconds that it took."""
    found: Found = {}
    for cases in (blurs, splats, references, others):
        for name, case in cases():
            start = perf_counter()
            result = case()
            seconds = perf_counter() - start
            parts = [result] if isinstance(result, Tensor) else result
            found[name] = [None if t is None else t.detach().clone() for t in parts], seconds
    return found


def difference(kept: list[Tensor | None], found: list[Tensor | None]) -> float:
    """The largest difference of two results of a case, relative to the largest value: 0 for the same bits."""
    if [t is None for t in kept] != [t is None for t in found]:
        return float("inf")
    worst = 0.0
    for a, b in zip(kept, found, strict=True):
        if a is None or b is None or torch.equal(a, b):
            continue
        if (a.shape, a.dtype) != (b.shape, b.dtype):
            return float("inf")
        off = (a.double() - b.double()).abs().max() / a.double().abs().max()
        worst = max(worst, float(off.nan_to_num(float("inf"))))
    return worst


def main() -> int:
    what, file = sys.argv[1:]
    found = results()
    if what == "take":
        torch.save(found, file)
        print(f"{len(found)} results kept")
        return 0
    kept: Found = torch.load(file)
    missing = [f"{name}: is missing" for name in kept if name not in found]
    off = {name: difference(kept[name][0], found[name][0]) for name in kept if name in found}
    other = [f"{name}: {value:.2g}" for name, value in off.items() if value > 0]
    print(*missing, *other, f"{len(found)} results, {len(missing) + len(other)} differ", sep="\n")
    total = [sum(seconds for _, seconds in results.values()) for results in (kept, found)]
    print(f"{total[0]:.1f} s then, {total[1]:.1f} s now")
    return 1 if missing or other else 0


if __name__ == "__main__":
    sys.exit(main())
