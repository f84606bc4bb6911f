"""Learn the strength of a blur from pictures, in as many processes as you like, each with its own shards.

    torchrun --standalone --nproc-per-node 2 examples/train_distributed.py

It also runs without torchrun, as one process. Needs the extra torchbokeh[data].
"""

import argparse
import os
from pathlib import Path

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel
from torch.utils.data import DataLoader

import torchbokeh as tb
from torchbokeh.datasets import read_shards, write_shards
from torchbokeh.scenes import ProceduralDataset


class Blur(nn.Module):
    """Depth of field where all that is known of the circles of confusion is how they relate to each other."""

    def __init__(self) -> None:
        super().__init__()
        self.strength = nn.Parameter(torch.tensor(0.4))  # 1 is the truth
        self.blur = tb.LensBlur()

    def forward(self, image: Tensor, coc: Tensor) -> Tensor:
        """Blur a batch."""
        return self.blur(image, coc=self.strength * coc)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("out/train"))
    parser.add_argument("--steps", type=int, default=30)
    parser.add_argument("--tiny", action="store_true", help="a few steps on small pictures, for tests")
    args = parser.parse_args()
    count, size, views, steps = (8, (24, 32), 16, 10) if args.tiny else (64, (64, 96), 128, args.steps)
    # torchrun says in the environment who we are.
    alone: dict = {} if "RANK" in os.environ else {"store": dist.HashStore(), "rank": 0, "world_size": 1}
    dist.init_process_group("gloo", **alone)
    rank, processes = dist.get_rank(), dist.get_world_size()

    # Every process writes its share of the files, and waits until all are there.
    dataset = ProceduralDataset(seed=0, resolution=size, length=count, blur=(3, 6), views=views)
    write_shards(dataset, args.out, count, per_shard=2, shard=(rank + 1, processes), show_progress=rank == 0)
    dist.barrier()
    # Shares of the files may differ in size; an endless stream lets all processes take the same number of steps.
    stream = read_shards(args.out, keys=("image", "coc", "target"), shuffle=16).repeat()
    batches = iter(DataLoader(stream, batch_size=2, num_workers=1))
    test = next(batches)  # looked at before and after
    model = DistributedDataParallel(Blur())
    optimizer = torch.optim.Adam(model.parameters(), lr=0.1)

    def loss_of(batch: dict[str, Tensor]) -> Tensor:
        return (model(batch["image"], batch["coc"]) - batch["target"]).abs().mean()

    @torch.no_grad()
    def report(when: str) -> None:
        loss = loss_of(test)
        dist.all_reduce(loss)
        if rank == 0:
            print(f"{when}: strength {model.module.strength.item():.2f}, loss {loss.item() / processes:.4f}")

    report(f"before, {processes} processes")
    for _ in range(steps):
        loss = loss_of(next(batches))
        optimizer.zero_grad()
        loss.backward()  # averages the gradients of all processes
        optimizer.step()
    report("after")
    dist.destroy_process_group()


if __name__ == "__main__":
    main()
