from dataclasses import replace

import pytest

from torchbokeh.report.speed import exported as module
from torchbokeh.report.speed.exported import export_section, exported

pytest.importorskip("onnxruntime")


@pytest.mark.parametrize("qualities", [(), pytest.param(("fast",), marks=pytest.mark.slow)])
def test_files_are_compared_at_all_sizes(tiny, report, qualities):
    settings = replace(tiny, export_qualities=qualities)
    rows = exported(settings, lambda line: None) if qualities else report["experiments"]["export"]
    names = [*(f"LensBlur {name}" for name in qualities), module.PYRAMID]
    assert [(row["method"], row["size"]) for row in rows] == [(n, s) for n in names for s in settings.export_sizes]
    assert all(row["file_seconds"] > 0 and row["torch_seconds"] > 0 and row["kernel_seconds"] > 0 for row in rows)
    assert all(row["error"] < 1e-4 for row in rows)
    text = export_section(rows, settings.row(), [])
    assert text.startswith("## Exported files")
    assert text.count("\n| ") == len(rows) + 2


def test_without_the_extra_there_are_no_rows(tiny, monkeypatch):
    monkeypatch.setattr(module, "NEEDED", ("no_such_package",))
    assert exported(tiny, lambda line: None) == []
