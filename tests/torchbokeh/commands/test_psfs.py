"""``torchbokeh psfs``: what it writes, and what it says where it cannot."""

import doctest
from functools import partial
from pathlib import Path

import pytest

import torchbokeh.commands.psfs
from torchbokeh.commands.main import main
from torchbokeh.io.pictures import read_image
from torchbokeh.psfs import PsfBank, SimpleLens
from torchbokeh.psfs.models import MODELS


@pytest.fixture(autouse=True)
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(MODELS, "simple-lens", partial(SimpleLens, radius=3.0))  # type: ignore[arg-type]


@pytest.mark.slow
def test_a_bank_is_built_shown_and_tabulated(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bank, sheet = tmp_path / "bank.safetensors", tmp_path / "sheet.png"
    assert main(["psfs", "build", "simple-lens", "--out", str(bank), "--workers", "2", "--ssim", "0.9"]) == 0
    assert "100 samples" in capsys.readouterr().out
    assert PsfBank.load(bank).info["target"]["ssim"] == 0.9
    assert main(["psfs", "show", str(bank), "-o", str(sheet)]) == 0
    assert read_image(sheet).shape == (1, 3, 8 * 164, 5 * 164)
    capsys.readouterr()
    assert main(["psfs", "table", str(bank), "--held-out", "10"]) == 0
    head, _, row = capsys.readouterr().out.strip().split("\n")
    assert head.startswith("| model | beta | samples | LKS |")
    cells = [cell.strip() for cell in row.strip("|").split("|")]
    assert cells[:4] == ["`simple-lens`", "2", "100", "100"]
    assert 0.5 < float(cells[8]) <= float(cells[9]) <= 1
    assert sorted(f.name for f in tmp_path.iterdir()) == ["bank.safetensors", "sheet.png"]


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["build", "nonsense"], "argument MODEL: invalid choice: 'nonsense'"),
        (["build", "simple-lens", "--workers", "0"], "expected a whole number from 1 to 100000, got '0'"),
        (["build", "simple-lens", "--ssim", "1"], "expected a number between 0 and 1, got '1'"),
        (["build", "simple-lens", "--ssim", "x"], "expected a number between 0 and 1, got 'x'"),
        (["build", "simple-lens", "--out", "no/such/folder/bank"], "no/such/folder"),
        (["show", "none"], "source: expected a file or one of"),
        (["show", "combined", "-o", "sheet.xyz"], "sheet.xyz"),
        (["table", "none"], "source: expected a file or one of"),
        ([], "the following arguments are required: ACTION"),
    ],
)
def test_wrong_arguments_end_in_one_line(
    args: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["psfs", *args]) == 2
    said = capsys.readouterr().err
    assert message in said
    assert said.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_examples() -> None:
    assert doctest.testmod(torchbokeh.commands.psfs).failed == 0
