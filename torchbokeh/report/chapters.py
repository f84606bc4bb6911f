"""The chapters that commands write: what each is run, written and drawn with."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from torchbokeh.report import chapter as report
from torchbokeh.report.experiment import Figures
from torchbokeh.report.psfs import chapter as psfs
from torchbokeh.report.settings import Settings, Sizes
from torchbokeh.report.stability import chapter as stability
from torchbokeh.report.write import write_together


class Chapter(NamedTuple):
    """A text with its numbers and plots.

    Attributes:
        name: of the text and the numbers, without extension.
        settings: how large it is.
        run: finds what goes into JSON; it is given the settings, and what is told in a line what comes next.
        markdown: writes that, given the names of the plots.
        draw: draws it: figures by the names of their files.
    """

    name: str
    settings: type[Sizes]
    run: Callable[..., dict[str, Any]]
    markdown: Callable[[dict[str, Any], Sequence[str]], str]
    draw: Callable[[dict[str, Any]], Figures]


REPORT = Chapter("report", Settings, report.run_experiments, report.markdown, report.draw)
PSFS = Chapter("psfs", psfs.PsfSettings, psfs.analyse, psfs.markdown, psfs.draw)
STABILITY = Chapter(
    "stability", stability.StabilitySettings, stability.run_stability, stability.markdown, stability.draw
)


def write_chapter(chapter: Chapter, found: dict[str, Any], folder: Path) -> list[Path]:
    """Write the text, the numbers and the plots of a chapter, all of them or none.

    Args:
        chapter: which.
        found: what its ``run`` returned.
        folder: an existing folder; files of an earlier report are replaced.

    Returns:
        The files written, the text first.
    """
    figures = chapter.draw(found)
    return write_together(folder, chapter.name, chapter.markdown(found, list(figures)), found, figures)
