"""Scenes with ground truth to train on, drawn on the fly or written as shards."""

from torchbokeh.datasets.dataset import ProceduralDataset
from torchbokeh.datasets.reading import read_shards
from torchbokeh.datasets.writing import write_shards

__all__ = ["ProceduralDataset", "read_shards", "write_shards"]
