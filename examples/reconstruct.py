"""A picture of one ray per pixel, its reconstruction, what non-local means make of it, and the truth, side by side."""

import argparse
from pathlib import Path

import torch

import torchbokeh as tb
from torchbokeh import reconstruct
from torchbokeh.io.pictures import write_image
from torchbokeh.report.measure import errors
from torchbokeh.report.motion.experiments import non_local_means
from torchbokeh.scenes import samples


def ssim(image: torch.Tensor, truth: torch.Tensor) -> float:
    """SSIM of displayed values."""
    found = errors(image, truth, flip=False)["ssim"]
    assert found is not None
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recipe", nargs="?", choices=tb.scenes.RECIPES, default="whirl")
    parser.add_argument("--out", type=Path, default=Path("out/reconstruct.png"))
    parser.add_argument("--samples", type=int, default=1, help="rays per pixel")
    parser.add_argument("--seed", type=int, default=2)
    parser.add_argument("--tiny", action="store_true", help="small, for tests")
    args = parser.parse_args()

    size, views = ((32, 48), 64) if args.tiny else ((256, 256), 2048)
    scene, camera = tb.scenes.RECIPES[args.recipe](args.seed, size)
    truth = tb.AccumulationBuffer(views=views)(scene, camera)[:, :3]
    noisy = samples(scene, camera, args.samples, args.seed)
    mean = noisy.colour.mean(1)
    pictures = {"input": mean, "ours": reconstruct(noisy), "non-local means": non_local_means(mean, truth)}
    for name, picture in pictures.items():
        print(f"{args.recipe}, {name}: SSIM {ssim(picture, truth):.3f}")
    args.out.parent.mkdir(parents=True, exist_ok=True)
    write_image(args.out, torch.cat([*pictures.values(), truth], 3))
    print(args.out)


if __name__ == "__main__":
    main()
