"""Every recipe of `torchbokeh.scenes` on one sheet: the pinhole picture, depth, motion, and the picture of the lens."""

import argparse
from pathlib import Path

import torch

import torchbokeh as tb
from torchbokeh.io.pictures import write_image

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--out", type=Path, default=Path("out/scenes.png"))
parser.add_argument("--seed", type=int, default=2)
parser.add_argument("--tiny", action="store_true", help="small and grainy, for tests")
args = parser.parse_args()

size, views = ((24, 32), 8) if args.tiny else ((192, 256), 1024)
columns = []
for name, recipe in tb.scenes.RECIPES.items():
    scene, camera = recipe(args.seed, size)
    seen = scene.render(camera)  # image, alpha, depth, motion and layers, all at the pinhole
    blurred = tb.AccumulationBuffer(views=views, level_of_detail="auto")(scene, camera)[0, :3]
    nearness = (1 / seen["depth"]).clamp(max=1).expand(3, -1, -1)  # white at a metre, black is the sky
    way = torch.cat([0.5 + seen["motion"] / (0.1 * size[1]), torch.full((1, *size), 0.5)]).clamp(0, 1)
    columns.append(torch.cat([seen["image"], nearness, way, blurred], 1))
    coc = camera.lens.coc(seen["depth"], size[1])
    print(f"{name}: {len(scene)} cards in {len(seen['layers'])} layers, CoC {coc.min():+.1f} to {coc.max():+.1f} px")
half = len(columns) // 2
rows = [torch.cat(columns[:half], 2), torch.cat(columns[half:], 2)]
args.out.parent.mkdir(parents=True, exist_ok=True)
write_image(args.out, torch.cat(rows, 1)[None])
print(args.out)
