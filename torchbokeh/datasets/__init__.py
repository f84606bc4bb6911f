"""Scenes with ground truth to train on, drawn on the fly or written as shards."""

from torchbokeh.datasets.dataset import ProceduralDataset
from torchbokeh.datasets.shards import read_shards, write_shards

__all__ = ["ProceduralDataset", "read_shards", "write_shards"]
