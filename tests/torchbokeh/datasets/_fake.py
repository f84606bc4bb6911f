"""A data set of random numbers, and the folder that it is written to."""

import time

import torch
from torch.utils.data import Dataset, get_worker_info

from torchbokeh.datasets import write_shards

H, W, L = 6, 8, 2


class Fake(Dataset):
    """The interface of ProceduralDataset with random numbers for pictures."""

    def __init__(self, seed=0, fail_at=None, seconds=0.0):
        self.seed, self.fail_at, self.seconds = seed, fail_at, seconds

    def settings(self):
        return {"seed": self.seed, "resolution": (H, W)}

    def __len__(self):
        return 1000

    def __getitem__(self, index):
        time.sleep(self.seconds)
        if index == self.fail_at:
            raise KeyboardInterrupt if get_worker_info() is None else RuntimeError("broken")
        generator = torch.Generator().manual_seed(self.seed * 1000 + index)

        def rand(*shape):
            return torch.rand(*shape, generator=generator)

        depth = rand(1, H, W)
        depth[:, 0] = torch.inf
        return {
            "image": rand(3, H, W),
            "depth": depth,
            "motion": rand(H, W, 2).permute(2, 0, 1),  # not contiguous
            "coc": rand(1, H, W),
            "target": rand(3, H, W),
            "layers": rand(L, 4, H, W),
            "layer_depth": rand(L, 1, H, W),
            "layer_motion": rand(L, 2, H, W),
            "lens": {"focal_length": rand(()), "f_number": rand(()), "focus_distance": torch.tensor(torch.inf)},
            "recipe": f"räcipe {index % 3}",
            "index": index,
        }


COUNT, PER_SHARD = 25, 4  # six files of four samples and one of a single one


def write(out, dataset=None, **changes):
    options = {"per_shard": PER_SHARD, "show_progress": False, **changes}
    return write_shards(dataset or Fake(), out, options.pop("count", COUNT), **options)


def content(out):
    return {path.name: path.read_bytes() for path in sorted(out.iterdir())}


def assert_same(sample, other):
    assert list(sample) == list(other)
    for key, value in other.items():
        if key == "lens":
            assert_same(sample[key], value)
        elif isinstance(value, torch.Tensor):
            assert sample[key].dtype == torch.float32
            assert torch.equal(sample[key], value)
        else:
            assert sample[key] == value
