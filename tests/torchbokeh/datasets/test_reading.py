"""Shards give the same tensors back, each once, in any number of processes."""

import importlib.util
import pickle
import sys
import tarfile
from itertools import chain
from pathlib import Path

import pytest
from torch.utils.data import DataLoader

from torchbokeh.datasets import read_shards

# pytest puts no folder on the path: the helper beside this file is loaded by its place.
spec = importlib.util.spec_from_file_location("fake_dataset", Path(__file__).with_name("_fake.py"))
fake = importlib.util.module_from_spec(spec)
spec.loader.exec_module(fake)
Fake, write, content, assert_same = fake.Fake, fake.write, fake.content, fake.assert_same
COUNT, H, W, L = fake.COUNT, fake.H, fake.W, fake.L


@pytest.mark.parametrize("workers", [0, 2])
def test_round_trip(whole, workers):
    samples = list(DataLoader(read_shards(whole), batch_size=None, num_workers=workers))
    assert sorted(sample["index"] for sample in samples) == list(range(COUNT))
    for sample in samples:
        assert_same(sample, Fake()[sample["index"]])
    if not workers:
        assert [sample["index"] for sample in samples] == list(range(COUNT))


def test_batches(whole):
    batch = next(iter(DataLoader(read_shards(whole), batch_size=4)))
    assert batch["layers"].shape == (4, L, 4, H, W)
    assert batch["lens"]["f_number"].shape == (4,)
    assert batch["index"].tolist() == [0, 1, 2, 3]


def test_only_some_keys(whole):
    sample = next(iter(read_shards(whole, keys=("target", "lens", "layer_depth"))))
    assert_same(sample, {key: Fake()[0][key] for key in ("target", "lens", "layer_depth")})
    with pytest.raises(ValueError, match=r"keys: expected some of image, depth, .*, index, got 'mask'"):
        read_shards(whole, keys=("image", "mask"))


def indices(pipeline):
    return [sample["index"] for sample in pipeline]


def test_processes_share_the_files(whole, monkeypatch):
    monkeypatch.setenv("WORLD_SIZE", "2")
    shares = []
    for rank in "01":
        monkeypatch.setenv("RANK", rank)
        shares.append([int(i) for i in indices(DataLoader(read_shards(whole, shuffle=5), batch_size=None))])
    assert sorted(chain.from_iterable(shares)) == list(range(COUNT))
    assert min(map(len, shares)) >= 9
    monkeypatch.setenv("WORLD_SIZE", "8")
    with pytest.raises(ValueError, match="at least one file for each of 8 processes, got 7"):
        next(iter(read_shards(whole)))


def test_shuffle(whole):
    first = indices(read_shards(whole, shuffle=10, seed=1))
    assert sorted(first) == list(range(COUNT))
    assert first != list(range(COUNT))
    assert indices(read_shards(whole, shuffle=10, seed=1)) == first
    assert indices(read_shards(whole, shuffle=10, seed=2)) != first
    twice = indices(read_shards(whole, shuffle=10, seed=1).repeat(2))
    assert twice[:COUNT] == first
    assert sorted(twice[COUNT:]) == list(range(COUNT))
    assert twice[COUNT:] != first


def test_pipelines_can_be_sent_to_spawned_workers(whole):
    assert len(indices(pickle.loads(pickle.dumps(read_shards(whole, shuffle=3))))) == COUNT


def test_an_abandoned_pass_leaves_no_file_open(whole):
    stream = iter(read_shards(whole))
    next(stream)
    del stream  # a ResourceWarning would be an error


def test_sources(whole, tmp_path):
    names = [whole / "shard-000003.tar", str(whole / "shard-000001.tar")]
    assert indices(read_shards(names)) == [12, 13, 14, 15, 4, 5, 6, 7]
    assert indices(read_shards(names[0])) == [12, 13, 14, 15]
    assert indices(read_shards(str(whole / "shard-{000000..000001}.tar"))) == list(range(8))
    with pytest.raises(ValueError, match=r"shard-000007.tar: does not exist"):
        read_shards(str(whole / "shard-{000000..000009}.tar"))
    with pytest.raises(ValueError, match="elsewhere: does not exist"):
        read_shards(tmp_path / "elsewhere")
    with pytest.raises(ValueError, match="holds no shards"):
        read_shards(tmp_path)
    with pytest.raises(ValueError, match="at least one file"):
        read_shards([])
    with pytest.raises(ValueError, match="shuffle: expected at least 0"):
        read_shards(whole, shuffle=-1)


def test_a_set_that_is_not_finished(tmp_path):
    write(tmp_path, shard=(2, 3))
    with pytest.raises(ValueError, match=r"5 of 7 shards are missing, the first is shard-000000.tar"):
        read_shards(tmp_path)
    assert len(indices(read_shards(tmp_path, partial=True))) == 8


def test_a_tar_of_something_else(tmp_path):
    path = tmp_path / "other.tar"
    with tarfile.open(path, "w") as tar:
        tar.addfile(tarfile.TarInfo("a.image.npy"))
    with pytest.raises(ValueError, match=r"other.tar: sample a has no entry depth.npy; was it written by write_shards"):
        next(iter(read_shards(path)))


def test_webdataset_is_optional(whole, monkeypatch):
    monkeypatch.setitem(sys.modules, "webdataset", None)
    with pytest.raises(ImportError, match=r"pip install torchbokeh\[data\]"):
        read_shards(whole)


def test_procedural_dataset(tmp_path):
    from torchbokeh.scenes import ProceduralDataset

    dataset = ProceduralDataset(seed=3, resolution=(16, 24), length=3, views=4)
    write(tmp_path / "once", dataset, count=3, per_shard=2)
    samples = list(read_shards(tmp_path / "once"))
    assert len(samples) == 3
    for index, sample in enumerate(samples):
        assert sample.keys() == dataset[index].keys()
        assert_same(sample, {key: dataset[index][key] for key in sample})
    write(tmp_path / "again", dataset, count=3, per_shard=2, workers=2)
    assert content(tmp_path / "again") == content(tmp_path / "once")
