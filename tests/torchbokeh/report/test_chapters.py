import json

import pytest

pytest.importorskip("matplotlib")

from torchbokeh.report.chapters import REPORT, write_chapter


@pytest.fixture(scope="module")
def written(report, tmp_path_factory):
    """The files of a report, in the place of an earlier one."""
    folder = tmp_path_factory.mktemp("report")
    (folder / "report.md").write_text("old")
    return write_chapter(REPORT, report, folder)


def test_a_report_is_three_kinds_of_files(written):
    assert sorted(written) == sorted(written[0].parent.iterdir())  # and no temporary ones
    assert [path.name for path in written[:2]] == ["report.md", "report.json"]
    text = written[0].read_text(encoding="utf-8")
    assert text.startswith("# Error and run time")
    for path in written[2:]:
        assert path.read_bytes().startswith(b"\x89PNG")
        assert path.stat().st_size < 300_000
        assert f"({path.name})" in text


def test_json_gives_back_what_was_found(report, written):
    found = json.loads(written[1].read_text(encoding="utf-8"))
    assert found == json.loads(json.dumps(report))
    assert found.keys() == {"format", "machine", "settings", "methods", "absent", "experiments", "seconds"}
