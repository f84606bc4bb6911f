import json

import pytest

pytest.importorskip("matplotlib")

from torchbokeh.report.write import prepare, write_report


def test_a_report_is_three_kinds_of_files(report, tmp_path):
    written = write_report(report, tmp_path)
    assert sorted(written) == sorted(tmp_path.iterdir())  # and no temporary ones
    assert [path.name for path in written[:2]] == ["report.md", "report.json"]
    for path in written[2:]:
        assert path.read_bytes().startswith(b"\x89PNG")
        assert path.stat().st_size < 300_000
        assert f"({path.name})" in written[0].read_text(encoding="utf-8")


def test_json_gives_back_what_was_found(report, tmp_path):
    write_report(report, tmp_path)
    found = json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))
    assert found == json.loads(json.dumps(report))
    assert found.keys() == {"format", "machine", "settings", "methods", "absent", "experiments", "seconds"}


def test_an_earlier_report_is_replaced(report, tmp_path):
    (tmp_path / "report.md").write_text("old")
    write_report(report, tmp_path)
    assert (tmp_path / "report.md").read_text(encoding="utf-8").startswith("# Error and run time")


def test_a_folder_is_made(tmp_path):
    prepare(tmp_path / "a" / "b")
    assert (tmp_path / "a" / "b").is_dir()


def test_a_folder_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match=r"--out .*file"):
        prepare(tmp_path / "file")
