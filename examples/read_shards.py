"""Write a small data set as shards and read it back through a DataLoader, comparing LensBlur with the truth.

Run it again and nothing is written anew. Needs the extra torchbokeh[data].
"""

import argparse
from pathlib import Path

import torch
from torch import Tensor
from torch.utils.data import DataLoader

import torchbokeh as tb
from torchbokeh.datasets import read_shards, write_shards
from torchbokeh.scenes import ProceduralDataset


def psnr(picture: Tensor, truth: Tensor) -> float:
    """In decibels, of pictures encoded for the screen."""
    difference = picture.clamp(0, 1) ** (1 / 2.2) - truth.clamp(0, 1) ** (1 / 2.2)
    return -10 * difference.square().mean().log10().item()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("out/shards"))
    parser.add_argument("--count", type=int, default=16)
    parser.add_argument("--tiny", action="store_true", help="3 small samples, for tests")
    args = parser.parse_args()
    out = args.out / "tiny" if args.tiny else args.out
    count, size, views = (3, (24, 32), 16) if args.tiny else (args.count, (192, 256), 256)

    dataset = ProceduralDataset(seed=0, resolution=size, length=count, views=views)
    written = write_shards(dataset, out, count, per_shard=2, workers=0 if args.tiny else 2)
    print(f"{out}: {len(written)} files written")
    # Each sample has a lens of its own, so they come one by one.
    for sample in DataLoader(read_shards(out), batch_size=None, num_workers=2):
        if sample["index"] == 0:
            print(*(f"{key} {tuple(value.shape)}" for key, value in sample.items() if isinstance(value, Tensor)))
        blur = tb.LensBlur(tb.ThinLens(**sample["lens"]))
        with torch.no_grad():
            blurred = blur(sample["layers"][None], sample["layer_depth"][None])[0, :3]
        print(
            f"sample {sample['index']}, {sample['recipe']}: PSNR {psnr(sample['image'], sample['target']):.1f} dB "
            f"as it came through the pinhole, {psnr(blurred, sample['target']):.1f} dB blurred"
        )


if __name__ == "__main__":
    main()
