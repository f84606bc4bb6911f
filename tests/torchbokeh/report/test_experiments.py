"""A new experiment is one line of the table: it is run, told, drawn and written without another word."""

import argparse
import json

import pytest

pytest.importorskip("matplotlib")

from torchbokeh.report.command import add_report
from torchbokeh.report.experiment import Experiment
from torchbokeh.report.experiments import EXPERIMENTS
from torchbokeh.report.figures import one_panel
from torchbokeh.report.markdown import pictures, row_table, section


def test_names_are_unique():
    names = [experiment.name for experiment in EXPERIMENTS]
    assert len(set(names)) == len(names)


def test_an_experiment_of_ones_own(tmp_path, capsys):
    def run(settings, say):
        say("counting sheep")
        return [{"sheep": settings.repeat}]

    def write(rows, settings, plots):
        return section(
            "Sheep", *pictures(plots, "sheep"), row_table(rows, "sheep | of", f"{{sheep}} | {settings['repeat']}")
        )

    def draw(rows):
        figure, axes = one_panel(3, 2)
        axes.plot([row["sheep"] for row in rows], "o")
        return {"sheep.png": figure}

    EXPERIMENTS.append(Experiment("sheep", run, write, draw))
    try:
        parser = argparse.ArgumentParser()
        add_report(parser)
        args = parser.parse_args(["--quick", "--only", "sheep", "--out", str(tmp_path)])
        args.run(args)
    finally:
        EXPERIMENTS.pop()
    assert "counting sheep" in capsys.readouterr().err
    found = json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))
    assert found["experiments"]["sheep"] == [{"sheep": 2}]
    assert [name for name, rows in found["experiments"].items() if rows] == ["sheep"]
    text = (tmp_path / "report.md").read_text(encoding="utf-8")
    assert "## Sheep\n\n![sheep](sheep.png)\n\n| sheep | of |\n| --- | --- |\n| 2 | 2 |" in text
    assert (tmp_path / "sheep.png").exists()
