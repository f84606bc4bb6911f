import argparse
import json
import re

import pytest

pytest.importorskip("matplotlib")

from torchbokeh.report import chapters, command
from torchbokeh.report.command import add_report
from torchbokeh.report.experiments import EXPERIMENTS
from torchbokeh.report.settings import Settings
from torchbokeh.report.speed import gradients, sweeps
from torchbokeh.report.stability.chapter import StabilitySettings


def run(*flags):
    parser = argparse.ArgumentParser(exit_on_error=False)
    add_report(parser)
    args = parser.parse_args(flags)
    args.run(args)


@pytest.mark.slow
def test_a_quick_report_is_written_whole(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(sweeps, "peak_memory", lambda *args: None)
    monkeypatch.setattr(gradients, "peak_memory", lambda *args, **kwargs: None)
    run("--quick", "--scenes", "photo,rain", "--out", str(tmp_path / "new"), "--threads", "1")
    said = capsys.readouterr()
    written = said.out.split()
    assert {path.name for path in (tmp_path / "new").iterdir()} == {re.split(r"[/\\]", line)[-1] for line in written}
    found = json.loads((tmp_path / "new" / "report.json").read_text(encoding="utf-8"))
    assert found["settings"]["scenes"] == ["photo", "rain"]
    assert found["machine"]["threads"] == 1
    assert found["experiments"]["one_layer"]
    assert "error against run time: photo" in said.err


def test_only_some_experiments_are_run(tmp_path, monkeypatch):
    monkeypatch.setattr(gradients, "peak_memory", lambda *args, **kwargs: None)
    run("--quick", "--only", "gradients", "--out", str(tmp_path))
    found = json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))
    assert found["experiments"].keys() == {experiment.name for experiment in EXPERIMENTS}
    assert [name for name, rows in found["experiments"].items() if rows] == ["gradients"]
    headings = re.findall("^## (.*)$", (tmp_path / "report.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert headings == ["Forward and backward", "What the methods are"]


@pytest.fixture
def asked(monkeypatch):
    """What chapters are asked for, none of which is run."""
    found = []

    def replace(name):
        chapter = getattr(chapters, name)
        run = lambda settings, say, **only: found.append((settings, only))  # noqa: E731
        written = {"draw": lambda found: {}, "markdown": lambda found, plots: ""}
        monkeypatch.setattr(chapters, name, chapter._replace(run=run, **written))

    for name in ("REPORT", "STABILITY"):
        replace(name)
    return found


def test_flags_choose_scenes_and_settings(tmp_path, asked):
    run("--out", str(tmp_path))
    run("--out", str(tmp_path), "--scenes", "coins, photo,coins", "--quick")
    run("--out", str(tmp_path), "--only", "threads,radius")
    assert asked == [
        (Settings(), {}),
        (Settings.quick(scenes=("coins", "photo")), {}),
        (Settings(), {"only": ("threads", "radius")}),
    ]


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--scenes", "photo,nowhere"], "--scenes: expected some of photo, .* got 'nowhere'"),
        (["--only", "speed"], "--only: expected some of one_layer, .* got 'speed'"),
        (["--out", "file"], "--out file"),
    ],
)
def test_bad_input_is_named(flags, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match=message):
        run(*flags)


def test_stability_is_a_chapter_of_its_own(tmp_path, asked, capsys):
    run("--stability", "--out", str(tmp_path))
    run("--stability", "--quick", "--out", str(tmp_path))
    assert asked == [(StabilitySettings(), {}), (StabilitySettings.quick(), {})]
    files = [str(tmp_path / f"stability.{ending}") for ending in ("md", "json")]
    assert capsys.readouterr().out.split() == files * 2
    with pytest.raises(ValueError, match="--stability: expected no --scenes"):
        run("--stability", "--scenes", "photo", "--out", str(tmp_path))


@pytest.mark.parametrize("flags", [["--scenes", "photo,,"], ["--threads", "0"], ["--threads", "two"]])
def test_flags_that_cannot_be_read_are_refused(flags):
    with pytest.raises(argparse.ArgumentError, match=flags[0]):
        run(*flags)


def test_the_extra_is_asked_for_where_it_is_missing(monkeypatch):
    monkeypatch.setattr(command, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"torchbokeh\[report\]"):
        run()
