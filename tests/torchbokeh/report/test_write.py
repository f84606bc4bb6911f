import json

import pytest

from torchbokeh.report.write import prepare, write_together


def test_numbers_that_json_cannot_hold_are_text(tmp_path):
    found = {"rows": [{"bound": float("inf"), "kept": True}, {"bound": 1.5}], "side": (1, 2)}
    write_together(tmp_path, "name", "text", found, {})
    again = json.loads((tmp_path / "name.json").read_text(encoding="utf-8"))
    assert again == {"rows": [{"bound": "inf", "kept": True}, {"bound": 1.5}], "side": [1, 2]}


def test_a_folder_is_made(tmp_path):
    prepare(tmp_path / "a" / "b")
    assert (tmp_path / "a" / "b").is_dir()


def test_a_folder_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ValueError, match=r"--out .*file"):
        prepare(tmp_path / "file")
