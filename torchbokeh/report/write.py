"""Write a report: ``report.md``, ``report.json`` and plots, each whole or not at all."""

import json
from pathlib import Path
from typing import Any

from torchbokeh.image_io import check_writable, replacing
from torchbokeh.report.plots import draw
from torchbokeh.report.tables import markdown

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


def write_report(found: dict[str, Any], folder: Path) -> list[Path]:
    """Write the files of a report.

    Args:
        found: what `torchbokeh.report.run.run_experiments` returns.
        folder: an existing folder; files of an earlier report are replaced.

    Returns:
        The files written, ``report.md`` first.
    """
    figures = draw(found)
    for name, figure in figures.items():
        with replacing(folder / name) as temporary:
            figure.savefig(temporary, dpi=DPI)
    with replacing(folder / "report.json") as temporary:
        temporary.write_text(json.dumps(found, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    with replacing(folder / "report.md") as temporary:
        temporary.write_text(markdown(found, list(figures)), encoding="utf-8")
    return [folder / "report.md", folder / "report.json", *(folder / name for name in figures)]
