"""``torchbokeh dataset``: what its flags mean, and how it ends."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch
from torch.utils.data import Dataset

import torchbokeh.datasets
from torchbokeh.commands.main import main


class Fake(Dataset):
    """Has the interface of ProceduralDataset, and remembers how it was made."""

    seconds = 0.0

    def __init__(self, seed=0, **options):
        self.given = {"seed": seed, **options}
        if "fog" in options.get("recipes", ()):
            raise ValueError("recipes: expected some of grove, street, got 'fog'")

    def settings(self):
        return self.given

    def __getitem__(self, index):
        time.sleep(self.seconds)
        channels = {"image": (3,), "depth": (1,), "motion": (2,), "coc": (1,), "target": (3,)}
        channels |= {"layers": (1, 4), "layer_depth": (1, 1), "layer_motion": (1, 2)}
        maps = {name: torch.full((*shape, 2, 3), float(index)) for name, shape in channels.items()}
        return {**maps, "lens": {"f_number": torch.tensor(2.8)}, "recipe": "grove", "index": index}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setattr(torchbokeh.datasets, "ProceduralDataset", Fake)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def dataset(flags):
    return main(["dataset", "--out", "set", *flags.split()])


def settings(folder):
    return json.loads((folder / "set" / "dataset.json").read_text())


def test_defaults_are_those_of_the_data_set(folder, capsys):
    assert dataset("--count 5") == 0
    found = settings(folder)
    assert found["settings"] == {"seed": 0, "length": 5}
    assert (found["count"], found["per_shard"]) == (5, 100)
    said = capsys.readouterr()
    assert said.out.startswith("set: 5 samples in 1 files, ")
    assert said.out.endswith(" samples/s; 0 files were there already\n")
    assert said.err == ""


def test_every_flag_arrives(folder):
    flags = (
        "--count 5 --workers 2 --seed 7 --size 320x240 --recipes grove,street --blur 1,20.5 --views 64 --per-shard 2"
    )
    assert dataset(f"{flags} --shard 2/2") == 0
    found = settings(folder)
    expected = {"seed": 7, "length": 5, "resolution": [240, 320], "recipes": ["grove", "street"], "views": 64}
    assert found["settings"] == {**expected, "blur": [1, 20.5]}
    assert (found["count"], found["per_shard"]) == (5, 2)
    assert sorted(path.name for path in (folder / "set").glob("*.tar")) == ["shard-000001.tar"]


def test_it_goes_on(folder, capsys):
    assert dataset("--count 5 --per-shard 2 --shard 3/3") == 0
    assert "set: 1 samples in 1 files, " in capsys.readouterr().out
    assert dataset("--count 5 --per-shard 2") == 0
    said = capsys.readouterr().out
    assert "set: 4 samples in 2 files, " in said
    assert said.endswith("; 1 files were there already\n")
    assert dataset("--count 5 --per-shard 2") == 0
    assert "set: 0 samples in 0 files, " in capsys.readouterr().out


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ("", "required: --count"),
        ("--count 0", "argument --count: expected a whole number from 1 to 1000000000, got '0'"),
        ("--count many", "argument --count: expected a whole number"),
        ("--count 5 --per-shard 0", "argument --per-shard: expected a whole number from 1"),
        ("--count 5 --workers=-1", "argument --workers: expected a whole number from 0 to 1024, got '-1'"),
        ("--count 5 --seed 1.5", "argument --seed: expected a whole number from 0"),
        ("--count 5 --views 0", "argument --views: expected a whole number from 1"),
        ("--count 5 --shard 3/2", "argument --shard: expected K/M with K from 1 to M, such as 2/4, got '3/2'"),
        ("--count 5 --shard 0/2", "argument --shard: expected K/M"),
        ("--count 5 --shard 1", "argument --shard: expected K/M"),
        ("--count 5 --size 0x5", "argument --size: expected a size WxH such as 320x240, got '0x5'"),
        ("--count 5 --size 256", "argument --size: expected a size WxH"),
        ("--count 5 --recipes a,,b", "argument --recipes: expected names with commas between them, got 'a,,b'"),
        ("--count 5 --recipes fog", "recipes: expected some of grove, street, got 'fog'"),
        ("--count 5 --blur 3", "argument --blur: expected two numbers LO,HI such as 2,20, got '3'"),
        ("--count 5 --blur 1,nan", "argument --blur: expected two numbers"),
        ("--count 5 --blur 1,2,3", "argument --blur: expected two numbers"),
        ("--count 5 --out file", "file: cannot be made a folder (File exists); choose another"),
    ],
)
def test_wrong_flags(folder, capsys, flags, message):
    (folder / "file").touch()
    assert dataset(flags) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith("torchbokeh: ")
    assert said.err.count("\n") == 1
    assert message in said.err
    assert [path.name for path in folder.iterdir()] == ["file"]


def test_other_settings_are_refused(folder, capsys):
    assert dataset("--count 5") == 0
    assert dataset("--count 5 --seed 3") == 2
    message = "torchbokeh: set: was begun with seed 0, not 3; go on with the same settings or choose another folder\n"
    assert capsys.readouterr().err == message


def test_ctrl_c_leaves_whole_shards(folder):
    flags = ["dataset", "--out", "set", "--count", "40", "--per-shard", "4", "--workers", "2"]
    code = (
        f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r})\n"
        f"import torchbokeh.datasets, test_dataset\n"
        f"torchbokeh.datasets.ProceduralDataset = test_dataset.Fake\n"
        f"test_dataset.Fake.seconds = 0.2\n"
        f"sys.exit(test_dataset.main({flags}))"
    )
    with subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.PIPE, start_new_session=True) as process:
        deadline = time.monotonic() + 100
        while not (folder / "set" / "shard-000000.tar").exists():
            assert process.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.02)
        os.killpg(process.pid, signal.SIGINT)  # as a terminal does: to the workers too
        _, err = process.communicate(timeout=60)
    assert process.returncode == 130
    assert err == b"torchbokeh: interrupted\n"
    names = [path.name for path in (folder / "set").iterdir()]
    assert set(names) <= {"dataset.json", "shard-000000.tar", "shard-000001.tar"}
    assert dataset("--count 40 --per-shard 4") == 0
    assert len(list((folder / "set").iterdir())) == 11


def test_help(capsys):
    with pytest.raises(SystemExit) as caught:
        main(["dataset", "--help"])
    assert caught.value.code == 0
    assert "--shard K/M" in capsys.readouterr().out


def test_procedural_dataset(tmp_path, capsys):
    out = str(tmp_path / "set")
    assert main(["dataset", "--out", out, "--count", "2", "--size", "24x16", "--views", "4", "--blur", "1,4"]) == 0
    assert "2 samples in 1 files" in capsys.readouterr().out
    given = json.loads((tmp_path / "set" / "dataset.json").read_text())["settings"]
    assert given["resolution"] == [16, 24]
    assert main(["dataset", "--out", str(tmp_path / "other"), "--count", "2", "--recipes", "no-such-scene"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "other").exists()
