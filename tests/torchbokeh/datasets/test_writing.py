"""Shards are whole or absent, and of the same bytes however they were made."""

import importlib.util
import io
import json
import os
import signal
import subprocess
import sys
import tarfile
import time
from itertools import chain
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.utils.data import Dataset

import torchbokeh.datasets.writing
from torchbokeh.datasets import read_shards, write_shards

# pytest puts no folder on the path: the helper beside this file is loaded by its place.
spec = importlib.util.spec_from_file_location("fake_dataset", Path(__file__).with_name("_fake.py"))
fake = importlib.util.module_from_spec(spec)
spec.loader.exec_module(fake)
Fake, write, content = fake.Fake, fake.write, fake.content
COUNT, PER_SHARD, H, W = fake.COUNT, fake.PER_SHARD, fake.H, fake.W


def test_what_is_in_a_shard(whole):
    assert sorted(content(whole)) == ["dataset.json", *(f"shard-{j:06d}.tar" for j in range(7))]
    with tarfile.open(whole / "shard-000006.tar") as tar:
        suffixes = ["image.npy", "depth.npy", "motion.npy", "coc.npy", "target.npy", "layers.npz", "meta.json"]
        assert tar.getnames() == [f"00000024.{suffix}" for suffix in suffixes]
        assert {(entry.mtime, entry.uid, entry.uname, entry.mode) for entry in tar} == {(0, 0, "", 0o644)}

        def read(suffix):
            return io.BytesIO(tar.extractfile(f"00000024.{suffix}").read())

        sample = Fake()[24]
        assert np.array_equal(np.load(read("motion.npy")), sample["motion"].numpy())
        with np.load(read("layers.npz")) as layers:
            assert sorted(layers) == ["depth", "layers", "motion"]
            assert np.array_equal(layers["depth"], sample["layer_depth"].numpy())
        meta = json.load(read("meta.json"))
    assert meta["recipe"] == "räcipe 0"
    assert meta["index"] == 24
    assert np.float32(meta["lens"]["f_number"]) == sample["lens"]["f_number"].numpy()
    manifest = json.loads((whole / "dataset.json").read_text())
    assert manifest["settings"] == {"seed": 0, "resolution": [H, W]}
    assert (manifest["count"], manifest["per_shard"]) == (COUNT, PER_SHARD)


@pytest.mark.parametrize("changes", [{"workers": 2}, {"shard": (1, 1), "show_progress": True}])
def test_bytes_do_not_depend_on_how(whole, tmp_path, changes):
    state = torch.get_rng_state()
    write(tmp_path, **changes)
    assert content(tmp_path) == content(whole)
    assert torch.equal(torch.get_rng_state(), state)


def test_three_machines_one_folder(whole, tmp_path):
    shares = [[path.name for path in write(tmp_path, shard=(k, 3))] for k in (2, 3, 1)]
    assert shares[0] == ["shard-000001.tar", "shard-000004.tar"]
    assert sorted(chain.from_iterable(shares)) == [f"shard-{j:06d}.tar" for j in range(7)]
    assert content(tmp_path) == content(whole)
    assert write(tmp_path) == []  # another number of machines goes on where those ended


def test_more_machines_than_shards(tmp_path):
    assert write(tmp_path, shard=(9, 9)) == []
    assert list(content(tmp_path)) == ["dataset.json"]


@pytest.mark.parametrize(("workers", "error"), [(0, KeyboardInterrupt), (2, RuntimeError)])
def test_an_error_leaves_whole_shards(whole, tmp_path, workers, error):
    with pytest.raises(error):
        write(tmp_path, Fake(fail_at=10), workers=workers)
    assert list(content(tmp_path)) == ["dataset.json", "shard-000000.tar", "shard-000001.tar"]
    assert [path.name for path in write(tmp_path)] == [f"shard-{j:06d}.tar" for j in range(2, 7)]
    assert content(tmp_path) == content(whole)


@pytest.mark.parametrize("workers", [0, 2])
def test_a_killed_run(whole, tmp_path, workers):
    out = tmp_path / "out"
    code = (
        f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r})\n"
        f"from _fake import Fake, write\nfrom pathlib import Path\n"
        f"write(Path({str(out)!r}), Fake(seconds=0.2), workers={workers})"
    )
    with subprocess.Popen([sys.executable, "-c", code], start_new_session=True) as process:
        deadline = time.monotonic() + 100
        while not ((out / "shard-000001.tar").exists() and list(out.glob(".*.tmp"))):
            assert process.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.02)
        os.killpg(process.pid, signal.SIGKILL)
    assert list(out.glob(".*.tmp"))
    before = (out / "shard-000001.tar").stat().st_mtime_ns
    write(out)
    assert content(out) == content(whole)  # and nothing else is left
    assert (out / "shard-000001.tar").stat().st_mtime_ns == before


def test_temporaries_that_may_be_in_use_stay(whole, tmp_path):
    write(tmp_path, shard=(1, 2))
    mine, others = tmp_path / ".shard-000002.tar.aa.tmp", tmp_path / ".shard-000001.tar.bb.tmp"
    for path in (mine, others):
        path.write_bytes(b"half")
    write(tmp_path, shard=(1, 2))
    assert not mine.exists()  # its shard is there
    assert others.exists()
    write(tmp_path, shard=(2, 2))
    assert content(tmp_path) == content(whole)


def test_two_runs_of_the_same_machine(whole, tmp_path):
    """The second run publishes, and removes what the first has not finished; the first takes that as done."""

    class Racing(Fake):
        def __getitem__(self, index):
            if index == 9:
                write(tmp_path)
            return super().__getitem__(index)

    write(tmp_path, Racing())
    assert content(tmp_path) == content(whole)


@pytest.mark.parametrize("damage", ["empty", "half", "end", "text", "other", "longer"])
def test_a_broken_shard_is_written_again(whole, tmp_path, damage):
    write(tmp_path)
    path = tmp_path / "shard-000002.tar"
    data = path.read_bytes()
    other = (tmp_path / "shard-000001.tar").read_bytes()
    broken = {"empty": b"", "half": data[: len(data) // 2], "end": data[:-10240], "text": b"hello" * 999}
    path.write_bytes({**broken, "other": other, "longer": data + bytes(512)}[damage])
    with pytest.warns(RuntimeWarning, match=r"shard-000002.tar: is broken, so it is written again") as caught:
        assert write(tmp_path) == [path]
    assert caught[0].filename == fake.__file__
    assert content(tmp_path) == content(whole)


class Later(Fake):
    def settings(self):
        return {**super().settings(), "views": 3}


@pytest.mark.parametrize(
    ("dataset", "changes", "message"),
    [
        (Fake(seed=1), {}, "was begun with seed 0, not 1; go on with the same settings or choose another folder"),
        (Fake(), {"count": 26}, "was begun with count 25, not 26;"),
        (Fake(), {"per_shard": 5}, "was begun with per_shard 4, not 5;"),
        (Later(seed=2), {}, "was begun with seed 0, not 2, views null, not 3;"),
    ],
)
def test_another_data_set_is_refused(whole, dataset, changes, message):
    before = content(whole)
    with pytest.raises(ValueError, match=message):
        write(whole, dataset, **changes)
    assert content(whole) == before


def test_another_version_is_refused(whole, monkeypatch):
    monkeypatch.setattr(torchbokeh.datasets.writing, "version", lambda name: "9.9")
    with pytest.raises(ValueError, match=r'was begun with torchbokeh "[0-9.]+", not "9.9"'):
        write(whole)


def test_folders_that_do_not_fit(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(ValueError, match="file: cannot be made a folder"):
        write(tmp_path / "file")
    (tmp_path / "shard-000000.tar").touch()
    with pytest.raises(ValueError, match=r"holds shards, but no dataset.json"):
        write(tmp_path)
    for text in ("no json", "{}", "[]", "3"):
        (tmp_path / "dataset.json").write_text(text)
        with pytest.raises(ValueError, match=r"dataset.json: is not the manifest of a data set"):
            write(tmp_path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"count": 0}, "count: expected at least 1, got 0"),
        ({"count": 1001}, "count: expected at most the 1000 samples of the dataset, got 1001"),
        ({"per_shard": 0}, "per_shard: expected at least 1"),
        ({"shard": (0, 2)}, r"shard: expected \(k, m\) with 1 <= k <= m, got \(0, 2\)"),
        ({"shard": (3, 2)}, "shard: expected"),
        ({"workers": -1}, "workers: expected at least 0"),
    ],
)
def test_arguments(tmp_path, changes, message):
    with pytest.raises(ValueError, match=message):
        write(tmp_path / "new", **changes)
    assert not (tmp_path / "new").exists()


def test_samples_without_the_expected_keys(tmp_path):
    class Strange(Fake):
        def __getitem__(self, index):
            return {**super().__getitem__(index), "extra": 1}

    with pytest.raises(ValueError, match="sample 0: expected the keys"):
        write(tmp_path, Strange())
    assert list(content(tmp_path)) == ["dataset.json"]


def test_a_dataset_without_length_and_settings(tmp_path):
    class Bare(Dataset):
        def __getitem__(self, index):
            return Fake()[index]

    assert len(write(tmp_path, Bare())) == 7
    assert len(list(read_shards(tmp_path))) == COUNT


def test_a_run_that_failed_before_its_first_file_holds_nobody_back(tmp_path):
    with pytest.raises(ValueError, match="sample 0: expected the keys"):
        write_shards([{"image": torch.zeros(3, 2, 2)}] * 4, tmp_path, 4)
    assert [path.name for path in tmp_path.iterdir()] == ["dataset.json"]
    assert len(write_shards(Fake(4), tmp_path, 4, per_shard=2)) == 2
