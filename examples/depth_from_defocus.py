"""Train a network to see depth in two photographs of different focus. No depth is ever shown to it.

The blur is the teacher: `LensBlur` blurs the sharp picture by the depth that the network finds, and what comes out has
to look like the two photographs, which are means of many views through the lens (`AccumulationBuffer`).

Depth is measured from the far focus plane (0) to the near one (1), evenly in dioptres. So the network needs to know
nothing of the lens but how much it blurs the one plane when it is focused on the other. For the photograph at the end
the stack is made by `LensBlur`, from its measured depth. The plot of the loss needs the extra torchbokeh[report].
"""

import argparse
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.utils.data import DataLoader, Dataset
from tqdm import tqdm

import torchbokeh as tb
from torchbokeh.commands.demo import motorcycle
from torchbokeh.io.pictures import replacing, write_image

PLANES = (1.0, 0.1)  # where the two photographs of a scene are in focus, in dioptres: at 1 m and at 10 m
BLUR = 7.0  # px: CoC radius of the one plane where the lens is focused on the other
LENSES = tb.DisparityLens(BLUR, 1.0), tb.DisparityLens(BLUR, 0.0)  # focused on the near plane, and on the far one
RECIPES = ("ramp", "sky", "whirl")


def between(metres: Tensor, planes: tuple[float, float] = PLANES) -> Tensor:
    """Where a depth lies between the far focus plane (0) and the near one (1), in dioptres."""
    return (1 / metres - planes[1]) / (planes[0] - planes[1])


class FocalStacks(Dataset[dict[str, Tensor]]):
    """Procedural scenes: ``image`` and ``depth``, sharp, and ``stack (6, H, W)``, the two photographs."""

    def __init__(self, seed: int, size: int, count: int, views: int) -> None:
        self.scenes = tb.scenes.ProceduralDataset(seed, (size, size), length=count, recipes=RECIPES, views=1)
        self.views = views

    def __len__(self) -> int:
        return len(self.scenes)

    def __getitem__(self, index: int) -> dict[str, Tensor]:
        sample = self.scenes[index]
        layers, depth = sample["layers"][None], between(sample["layer_depth"])[None]
        with torch.no_grad():
            taken = [tb.AccumulationBuffer(lens, views=self.views)(layers, depth)[0, :3] for lens in LENSES]
        return {"image": sample["image"], "depth": between(sample["depth"]), "stack": torch.cat(taken)}

    def load(self, workers: int) -> dict[str, Tensor]:
        """All of them, made once, as one batch."""
        samples = list(tqdm(DataLoader(self, num_workers=workers), desc="photographs"))
        return {name: torch.cat([s[name] for s in samples]) for name in samples[0]}


class UNet(nn.Module):
    """Stack ``(B, 6, H, W)`` to depth ``(B, 1, H, W)``; sides are multiples of 8."""

    def __init__(self, widths: tuple[int, ...] = (16, 32, 48, 64)) -> None:
        super().__init__()
        self.down = nn.ModuleList(self.block(a, b) for a, b in pairwise((6, *widths)))
        self.up = nn.ModuleList(self.block(a + b, a) for a, b in pairwise(widths))
        self.last = nn.Conv2d(widths[0], 1, 1)

    @staticmethod
    def block(a: int, b: int) -> nn.Sequential:
        """Two convolutions."""
        pair = [(nn.Conv2d(n, b, 3, padding=1), nn.GroupNorm(4, b), nn.SiLU()) for n in (a, b)]
        return nn.Sequential(*pair[0], *pair[1])

    def forward(self, stack: Tensor) -> Tensor:
        """Depth between the focus planes."""
        x, skipped = self.down[0](shown(stack)), []
        for block in self.down[1:]:
            skipped.append(x)
            x = block(F.max_pool2d(x, 2))
        for block, skip in zip(reversed(self.up), reversed(skipped), strict=True):
            x = block(torch.cat([skip, F.interpolate(x, scale_factor=2, mode="bilinear")], 1))
        return 0.5 + self.last(x)


def shown(picture: Tensor) -> Tensor:
    """Linear radiance as it is displayed, but with highlights compressed, not clipped."""
    return (picture / (1 + 0.2 * picture)).clamp_min(1e-4).sqrt()


def physics(depth: Tensor, image: Tensor, stack: Tensor) -> Tensor:
    """How far the sharp picture, blurred by this depth, is from the photographs; and how uneven depth is."""
    blurred = [tb.LensBlur(lens, subapertures=1, quality="balanced")(image, depth) for lens in LENSES]
    loss = (shown(torch.cat(blurred, 1)) - shown(stack)).abs().mean()
    grey = shown(image).mean(1, keepdim=True)
    for axis in (2, 3):
        loss = loss + 0.02 * (depth.diff(dim=axis).abs() * (-10 * grey.diff(dim=axis).abs()).exp()).mean()
    return loss


def train(network: UNet, data: dict[str, Tensor], steps: int, batch: int = 8) -> Iterator[float]:
    """Yield the loss of every step."""
    optimizer = torch.optim.AdamW(network.parameters(), lr=3e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 3e-3, total_steps=steps)
    for _ in range(steps):
        chosen = torch.randint(len(data["image"]), (batch,))
        both = torch.cat([data["image"], data["stack"]], 1)[chosen]
        for axis in (2, 3):
            both = both.flip(axis) if torch.rand(()) < 0.5 else both
        image, stack = (both.mT if torch.rand(()) < 0.5 else both).contiguous().split((3, 6), 1)
        loss = physics(network(stack), image, stack)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        yield loss.item()


def error(found: Tensor, truth: Tensor, image: Tensor, planes: tuple[float, float] = PLANES) -> str:
    """Relative error of depth within the planes, where there is texture."""
    metres = [1 / (planes[1] + (planes[0] - planes[1]) * t).clamp_min(0.02) for t in (found, truth)]
    grey = shown(image).mean(1, keepdim=True)
    squares = [F.avg_pool2d(g, 9, 1, 4, count_include_pad=False) for g in (grey, grey.square())]
    seen = (squares[1] - squares[0].square() > 0.05**2) & (truth >= 0)
    off = (metres[0] / metres[1] - 1).abs()[seen]
    return f"median {off.median():.3f}, mean {off.mean():.3f}"


def row(stack: Tensor, *depths: Tensor) -> Tensor:
    """A near and a far photograph, and depth in grey, side by side."""
    greys = [(0.1 + 0.7 * t).clamp(0, 1).expand(-1, 3, -1, -1) for t in depths]
    return torch.cat([*stack.split(3, 1), *greys], 3)


def plot_losses(path: Path, losses: list[float]) -> None:
    """Write the loss of every step as a picture."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5, 3), layout="constrained")
    axes = figure.subplots()
    axes.plot(losses, linewidth=0.8)
    axes.set(yscale="log", xlabel="step", ylabel="loss")
    with replacing(path) as temporary:
        figure.savefig(temporary)
    print(path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("out/depth_from_defocus.png"))
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument("--tiny", action="store_true", help="a few steps on small pictures, for tests")
    args = parser.parse_args()
    size, count, unseen, views, steps, workers = (32, 6, 4, 8, 8, 0) if args.tiny else (96, 256, 32, 64, args.steps, 2)

    torch.manual_seed(0)
    data, test = (FocalStacks(s, size, n, views).load(workers) for s, n in enumerate((count, unseen)))
    image, metres = (t[..., : size * 4 // 3 // 8 * 8, : 2 * size] for t in motorcycle(scale=2 * size / 741 + 0.005))
    planes = 1 / metres.min().item(), 1 / metres.max().item()
    depth = between(metres, planes)
    stack = torch.cat([tb.LensBlur(lens)(image, depth) for lens in LENSES], 1)

    network, losses = UNet(), []
    with torch.no_grad():
        before = network(test["stack"]), network(stack)
    with tqdm(train(network, data, steps), total=steps) as progress:
        for loss in progress:
            losses.append(loss)
            progress.set_postfix(loss=f"{loss:.4f}")
    with torch.no_grad():
        after = network(test["stack"]), network(stack)

    first, last = (torch.tensor(losses).tensor_split(4)[k].mean() for k in (0, -1))
    print(f"loss: {first:.4f} in the first quarter, {last:.4f} in the last")
    print("Relative error of depth where there is texture:")
    for when, (scenes, photograph) in {"before": before, "after": after}.items():
        print(f"  {when}: unseen scenes {error(scenes, test['depth'], test['image'])};", end=" ")
        print(f"photograph {error(photograph, depth, image, planes)}")

    a, b, c, d = row(test["stack"], test["depth"], before[0], after[0])[:4]
    photograph = row(stack, depth, before[1], after[1])[0]
    args.out.parent.mkdir(parents=True, exist_ok=True)
    write_image(args.out, torch.cat([torch.cat([a, b], 2), torch.cat([c, d], 2), photograph], 1)[None])
    print(args.out)
    plot_losses(args.out.with_name(f"{args.out.stem}_loss.png"), losses)


if __name__ == "__main__":
    main()
