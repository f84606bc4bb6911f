"""Defocus and motion in one pass: the pinhole picture, its blur, and the truth, side by side."""

import argparse
from pathlib import Path

import torch

import torchbokeh as tb
from torchbokeh.io.pictures import write_image
from torchbokeh.report.measure import errors


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recipe", nargs="?", choices=tb.scenes.RECIPES, default="gears")
    parser.add_argument("--out", type=Path, default=Path("out/motion.png"))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--tiny", action="store_true", help="small, for tests")
    args = parser.parse_args()

    size, views, border = ((32, 48), 64, 4) if args.tiny else ((384, 512), 1024, 40)
    scene, camera = tb.scenes.RECIPES[args.recipe](args.seed, size)
    seen = {name: t[None] for name, t in scene.render(camera).items()}
    blur = tb.LensBlur(camera.lens)
    print(blur.plan(seen["layers"], seen["layer_depth"], motion=seen["layer_motion"]))
    ours = blur(seen["layers"], seen["layer_depth"], motion=seen["layer_motion"])[:, :3]
    truth = tb.AccumulationBuffer(views=views)(scene, camera)[:, :3]
    print(f"{args.recipe}: SSIM {errors(ours, truth, border, flip=False)['ssim']:.3f}")
    args.out.parent.mkdir(parents=True, exist_ok=True)
    write_image(args.out, torch.cat([seen["image"], ours, truth], 3))
    print(args.out)


if __name__ == "__main__":
    main()
