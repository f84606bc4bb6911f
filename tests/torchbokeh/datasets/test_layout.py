"""Which files hold which samples."""

import doctest

import torchbokeh.datasets.layout
from torchbokeh.datasets.layout import shard_indices

COUNT, PER_SHARD = 25, 4


def test_shard_indices_cover_all_once():
    for machines in (1, 2, 3, 10):
        shares = [shard_indices(COUNT, PER_SHARD, (k + 1, machines)) for k in range(machines)]
        assert sorted(i for share in shares for indices in share.values() for i in indices) == list(range(COUNT))


def test_examples():
    assert doctest.testmod(torchbokeh.datasets.layout).failed == 0
