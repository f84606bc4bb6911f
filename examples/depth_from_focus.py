"""Depth of every pixel, and focus distances that nobody wrote down, from one picture and its focal stack; no network.

What makes a sharp picture look like its photographs? A plane sweep makes the start: the picture is blurred evenly with
each of many radii, and compared with every photograph around every pixel. Then gradients through `LensBlur` find depth
and focus together. The photographs are means of many views through the lens (`AccumulationBuffer`), in register. They
would look the same with every distance moved by as many dioptres, so one focus distance, the nearest, is known.

The same descent, from the same start, through layers that are chosen by an argmax moves nothing: there is no gradient.
The picture: pinhole, the first photograph, `LensBlur` of what was found; depth: true, found, and found through argmax.
"""

import argparse
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from tqdm import trange

import torchbokeh as tb
from torchbokeh.io.pictures import write_image
from torchbokeh.ops.convolve import blur_uniform
from torchbokeh.psfs import Disc

FOCUS = (1.0, 1.5, 2.3, 4.0)  # metres, of the photographs
GUESS = (1.0, 1.3, 2.0, 3.3)  # what is known of them: the first, and their order
NEAREST = 1.3  # dioptres, of anything in the picture
BLOCKS = (32, 8, 2)  # px; depth is a sum of maps of such resolutions, so that large areas move as fast as small ones
Render = Callable[[Tensor, Tensor, Tensor], Tensor]  # picture, depth in dioptres, focus in dioptres


def photographs(seed: int, size: int, views: int) -> tuple[Tensor, Tensor, Tensor, float]:
    """The pinhole picture, its depth in dioptres, the photographs, and px of CoC for each dioptre out of focus."""
    scene, camera = tb.scenes.ramp(seed, (size, size), blur=0.1 * size)
    lens, taken = camera.lens, []
    for distance in FOCUS:
        # A lens that focuses nearer enlarges the picture; on a larger sensor it does not.
        sensor = lens.sensor_width * (1 - lens.focal_length / lens.focus_distance) / (1 - lens.focal_length / distance)
        refocused = tb.ThinLens(lens.focal_length, lens.f_number, distance, sensor)
        taken.append(tb.AccumulationBuffer(views=views)(scene, tb.scenes.Camera(refocused, camera.size, 0.0)))
    seen = scene.render(camera)
    strength = lens.aperture_radius.item() * camera.focal_px
    return seen["image"][None], 1 / seen["depth"][None], torch.cat(taken)[:, :3], strength


def shown(picture: Tensor) -> Tensor:
    """Linear radiance about as it is displayed."""
    return picture.clamp_min(1e-4).sqrt()


def around(values: Tensor, side: int = 9) -> Tensor:
    """The mean of a square around every pixel."""
    return F.avg_pool2d(values, side, 1, side // 2, count_include_pad=False)


def plane_sweep(image: Tensor, taken: Tensor, strength: float, step: float = 0.5) -> tuple[Tensor, Tensor]:
    """Depth and focus, in dioptres, by comparing the photographs with even blurs of the whole picture."""
    radii = torch.arange(0.0, strength * NEAREST + step, step).tolist()
    flat = [blur_uniform(image, radius, Disc().profile()) for radius in radii]
    # (radii, photographs, H, W): how far each photograph is from each blur, around each pixel
    errors = torch.stack([around((shown(f) - shown(taken)).abs().mean(1)) for f in flat])
    candidates = torch.linspace(0.02, NEAREST, max(24, round(6 * strength)))
    which = torch.arange(len(taken))

    def costs(focus: Tensor) -> Tensor:
        """Of every candidate depth at every pixel: the error at its radius, interpolated, in all photographs."""
        at = (strength / step * (focus - candidates[:, None]).abs()).clamp(max=len(radii) - 1.001)
        below = at.floor().long()
        share = (at - below)[..., None, None]
        return torch.lerp(errors[below, which], errors[below + 1, which], share).sum(1)

    focus, soft = 1 / torch.tensor(GUESS), 0.003
    unknown = nn.Parameter(focus[1:].clone())
    optimizer = torch.optim.Adam([unknown], lr=0.02)
    for _ in range(100):
        optimizer.zero_grad()
        (-soft * (-costs(torch.cat([focus[:1], unknown])) / soft).logsumexp(0)).mean().backward()
        optimizer.step()
    focus = torch.cat([focus[:1], unknown.detach()])
    weights = (-costs(focus) / soft).softmax(0)
    return (weights * candidates[:, None, None]).sum(0)[None, None], focus


def lens_blur(strength: float) -> Render:
    """The look of the lens by `LensBlur`, whose layers are soft."""
    return lambda image, depth, focus: tb.LensBlur(tb.DisparityLens(strength, focus), subapertures=1)(image, depth)


def argmax_layers(strength: float, count: int = 16) -> Render:
    """The look of the lens by layered convolution: every pixel lies in the layer that is nearest to its CoC."""

    def render(image: Tensor, depth: Tensor, focus: Tensor) -> Tensor:
        coc = strength * (focus - depth)
        radii = torch.linspace(coc.max().item(), coc.min().item(), count)  # back to front
        chosen = (-(coc - radii[:, None, None]).abs()).argmax(1, keepdim=True)
        out = torch.zeros_like(torch.cat([image, depth], 1))
        for k, radius in enumerate(radii.tolist()):
            inside = (chosen == k).to(image)
            layer = blur_uniform(torch.cat([image * inside, inside], 1), radius, Disc().profile())
            out = layer + (1 - layer[:, 3:]) * out
        return out[:, :3] / out[:, 3:].clamp_min(1e-6)

    return render


def misfit(render: Render, image: Tensor, taken: Tensor, depth: Tensor, focus: Tensor) -> Tensor:
    """How far the picture, blurred by this depth and focus, is from the photographs."""
    again = torch.cat([render(image, depth, f) for f in focus])
    return (shown(again) - shown(taken)).abs().mean()


def gradients(render: Render, image: Tensor, taken: Tensor, start: tuple[Tensor, Tensor]) -> str:
    """The sizes of the gradients of the misfit, in words."""
    given = {"picture": image, "depth": start[0], "focus": start[1]}
    leaves = [t.clone().requires_grad_() for t in given.values()]
    loss = misfit(render, leaves[0], taken, *leaves[1:])
    found = torch.autograd.grad(loss, leaves, allow_unused=True)
    sizes = ("none" if g is None else f"{g.norm():.1e}" for g in found)
    return "gradient to " + ", ".join(f"{name} {size}" for name, size in zip(given, sizes, strict=True))


def descend(
    render: Render, image: Tensor, taken: Tensor, start: tuple[Tensor, Tensor], steps: int, even: float
) -> tuple[Tensor, Tensor]:
    """Depth and focus, in dioptres, from a start; ``even``: how much depth is to be even where the picture is."""
    size = image.shape[2:]
    maps = [nn.Parameter(torch.zeros(1, 1, size[0] // b, size[1] // b)) for b in BLOCKS]
    unknown = nn.Parameter(start[1][1:].clone())
    optimizer = torch.optim.Adam([{"params": maps, "lr": 0.004}, {"params": [unknown], "lr": 0.006}])
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    edges = [(-10 * shown(image).mean(1, keepdim=True).diff(dim=axis).abs()).exp() for axis in (2, 3)]

    def found() -> tuple[Tensor, Tensor]:
        moved = torch.stack([F.interpolate(m, size, mode="bilinear") for m in maps]).sum(0)
        return (start[0] + moved).clamp(0.02, 2.0), torch.cat([start[1][:1], unknown])

    with trange(steps) as progress:
        for _ in progress:
            depth, focus = found()
            loss = misfit(render, image, taken, depth, focus)
            slopes = [(depth.diff(dim=axis).abs() * edge).mean() for axis, edge in zip((2, 3), edges, strict=True)]
            optimizer.zero_grad()
            (loss + even * (slopes[0] + slopes[1])).backward()
            optimizer.step()
            schedule.step()
            progress.set_postfix(misfit=f"{loss.item():.5f}")
    with torch.no_grad():
        return found()


def textured(image: Tensor) -> Tensor:
    """Where a picture has enough contrast for its blur to be seen, ``(1, 1, H, W)`` bool."""
    mean = around(image)
    spread = (around(image.square()) - mean.square()).clamp_min(0).sqrt()
    return (spread / mean.clamp_min(1e-3)).mean(1, keepdim=True) > 0.08


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("out/depth_from_focus.png"))
    parser.add_argument("--seed", type=int, default=1, help="of the scene")
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--tiny", action="store_true", help="small, for tests")
    args = parser.parse_args()
    size, views, steps = (32, 64, 3) if args.tiny else (128, 512, args.steps)

    image, truth, taken, strength = photographs(args.seed, size, views)
    start = plane_sweep(image, taken, strength)
    soft, hard = lens_blur(strength), argmax_layers(strength)
    print("LensBlur:", gradients(soft, image, taken, start))
    found = descend(soft, image, taken, start, steps, even=0.1)
    print("argmax layers:", gradients(hard, image, taken, start))
    stuck = descend(hard, image, taken, start, min(steps, 5), even=0.0)  # each step is like the one before

    seen = textured(image)
    print(f"\nRelative error of depth where there is texture ({seen.float().mean():.0%} of the picture), and focus:\n")
    print("| | median | mean | 90 % below |", " | ".join(f"{f:g} m" for f in FOCUS[1:]), "|")
    print("| --- " * (4 + len(FOCUS[1:])) + "|")
    for name, (depth, focus) in {"plane sweep": start, "LensBlur": found, "argmax layers": stuck}.items():
        error = (truth / depth - 1).abs()[seen]
        cells = [f"{e:.1%}" for e in (error.median(), error.mean(), error.quantile(0.9))]
        print(f"| {name} |", " | ".join([*cells, *(f"{1 / f:.2f} m" for f in focus[1:])]), "|")

    with torch.no_grad():
        again = soft(image, found[0], found[1][0])
    depths = torch.cat([truth, found[0], stuck[0]], 3).expand(-1, 3, -1, -1) / NEAREST
    args.out.parent.mkdir(parents=True, exist_ok=True)
    write_image(args.out, torch.cat([torch.cat([image, taken[:1], again], 3), depths], 2))
    print(args.out)


if __name__ == "__main__":
    main()
