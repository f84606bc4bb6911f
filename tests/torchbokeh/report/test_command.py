import argparse
import json
import re

import pytest

pytest.importorskip("matplotlib")

from torchbokeh.report import command, experiments
from torchbokeh.report import run as run_module
from torchbokeh.report import settings as settings_module
from torchbokeh.report.command import add_report


def run(*flags):
    parser = argparse.ArgumentParser(exit_on_error=False)
    add_report(parser)
    args = parser.parse_args(flags)
    args.run(args)


def test_a_quick_report_is_written_whole(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(experiments, "peak_memory", lambda *args: None)
    run("--quick", "--scenes", "photo,rain", "--out", str(tmp_path / "new"), "--threads", "1")
    said = capsys.readouterr()
    written = said.out.split()
    assert {path.name for path in (tmp_path / "new").iterdir()} == {re.split(r"[/\\]", line)[-1] for line in written}
    found = json.loads((tmp_path / "new" / "report.json").read_text(encoding="utf-8"))
    assert found["settings"]["scenes"] == ["photo", "rain"]
    assert found["machine"]["threads"] == 1
    assert found["experiments"]["one_layer"]
    assert "error against run time: photo" in said.err


def test_flags_choose_scenes_and_settings(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(run_module, "run_experiments", lambda settings, say: asked.append(settings))
    monkeypatch.setattr("torchbokeh.report.write.write_report", lambda found, folder: [])
    run("--out", str(tmp_path))
    run("--out", str(tmp_path), "--scenes", "coins, photo,coins", "--quick")
    assert asked == [settings_module.Settings(), settings_module.quick(("coins", "photo"))]


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--scenes", "photo,nowhere"], "--scenes: expected some of photo, .* got 'nowhere'"),
        (["--out", "file"], "--out file"),
    ],
)
def test_bad_input_is_named(flags, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match=message):
        run(*flags)


@pytest.mark.parametrize("flags", [["--scenes", "photo,,"], ["--threads", "0"], ["--threads", "two"]])
def test_flags_that_cannot_be_read_are_refused(flags):
    with pytest.raises(argparse.ArgumentError, match=flags[0]):
        run(*flags)


def test_the_extra_is_asked_for_where_it_is_missing(monkeypatch):
    monkeypatch.setattr(command, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"torchbokeh\[report\]"):
        run()
