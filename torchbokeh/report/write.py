"""Write a report: its text, its numbers and its plots, all of them or none."""

import json
from pathlib import Path
from typing import Any

from torchbokeh.io.pictures import check_writable
from torchbokeh.ops.system.files import replacing_together
from torchbokeh.report.experiment import Figures

DPI = 110


def prepare(folder: Path) -> None:
    """Make the folder of a report, before the work is done.

    Args:
        folder: made where it is missing.

    Raises:
        ValueError: it cannot be made or written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"--out {folder}: cannot be made a folder ({error.strerror}); choose another") from None
    check_writable(folder / "plot.png")


def write_together(folder: Path, name: str, text: str, found: Any, figures: Figures) -> list[Path]:
    """Write a text, the numbers it speaks of and its plots, all of them or none.

    Args:
        folder: an existing folder; files of the same names are replaced.
        name: of the text and the numbers, without extension.
        text: Markdown.
        found: what JSON can hold; numbers that it cannot hold become text.
        figures: plots by the names of their files.

    Returns:
        The files written, the text first.
    """
    with replacing_together(folder, f"{name}.md") as temporary:
        for plot, figure in figures.items():
            figure.savefig(temporary / plot, dpi=DPI)
        numbers = json.dumps(_plain(found), indent=1, allow_nan=False) + "\n"
        (temporary / f"{name}.json").write_text(numbers, encoding="utf-8")
        (temporary / f"{name}.md").write_text(text, encoding="utf-8")
    return [folder / file for file in (f"{name}.md", f"{name}.json", *figures)]


def _plain(value: Any) -> Any:
    """The same without numbers that JSON cannot hold: as text."""
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    return str(value) if isinstance(value, float) and not abs(value) < float("inf") else value
