import re

import pytest

from torchbokeh.report.chapter import draw, markdown


def test_a_report_has_every_section_and_whole_tables(report):
    text = markdown(report, ["radius.png", "truth.png", "one_layer_4.png"])
    sections = [s for s in re.findall("^## (.*)$", text, re.MULTILINE) if s != "Share of each stage"]
    assert sections == [
        "Error against run time",
        "LensBlur against the truth",
        "Run time against radius",
        "Run time and memory against pixels",
        "Run time against layers",
        "Run time against threads",
        "Forward and backward",
        "Exported files",
        "Defocus with motion",
        "Synthesis and reconstruction",
        "Dispersion against the truth",
        "Dispersion: run time against views",
        "Dispersion: bands of colour",
        "What a plan leaves out",
        "What the methods are",
    ]
    for picture in ("radius.png", "truth.png", "one_layer_4.png"):
        assert text.count(f"]({picture})") == 1
    for block in re.findall(r"(?:^\|.*\n)+", text, re.MULTILINE):
        assert len({len(re.findall(r"(?<!\\)\|", line)) for line in block.splitlines()}) == 1, block
    assert str(report["machine"]["processor"]) in text
    assert "nan" not in text.lower().replace("dominant", "")


def test_what_was_left_out_is_said(report):
    text = markdown(report, [])
    assert "takes one blur radius for the whole picture" in text
    for line in report["absent"]:
        assert line in text


def test_an_experiment_without_rows_has_no_section(report):
    short = {**report, "experiments": {name: [] for name in report["experiments"]}}
    text = markdown(short, [])
    assert re.findall("^## (.*)$", text, re.MULTILINE) == ["What the methods are"]


def test_stages_are_shown_where_there_are_any(report):
    row = {"quality": "exact", "radius": 25.0, "stage": "splat", "seconds": 0.1, "share": 0.8}
    found = {**report, "experiments": {**report["experiments"], "stages": [row]}}
    assert "| exact | 25 | splat | 0.100 | 80% |" in markdown(found, [])


def test_there_is_a_plot_for_every_experiment(report):
    pytest.importorskip("matplotlib")
    assert list(draw(report)) == [
        "one_layer_4.png",
        "one_layer_recipes.png",
        "truth.png",
        "radius.png",
        "pixels.png",
        "layers.png",
        "threads.png",
        "chromatic.png",
    ]


def test_nothing_measured_draws_nothing(report):
    pytest.importorskip("matplotlib")
    assert draw({"experiments": {name: [] for name in report["experiments"]}}) == {}


def test_axes_are_logarithmic_and_named(report):
    pytest.importorskip("matplotlib")
    axes = draw(report)["one_layer_4.png"].axes[0]
    assert (axes.get_xscale(), axes.get_yscale()) == ("log", "log")
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("seconds", "1 - SSIM")
