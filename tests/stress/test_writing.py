"""Full disks, and signals while files are written: nothing half-written, nothing that speaks of what is not there."""

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from torchbokeh.commands.main import main

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="signals and limits as Linux has them")


WRITERS = """
import resource, sys, warnings
from pathlib import Path
import matplotlib; matplotlib.use("agg")
import torch
from matplotlib.figure import Figure
import torchbokeh as tb
from torchbokeh.io.pictures import write_image
from torchbokeh.report.sheets import write_sheet
from torchbokeh.report.write import write_together
from torchbokeh.datasets import write_shards

image, bank = torch.rand(1, 3, 40, 50), tb.PsfBank.load("combined")
dataset = tb.scenes.ProceduralDataset(resolution=(16, 24), length=2, views=4)
writers = {
    "a.png": lambda path: write_image(path, image),
    "a.tif": lambda path: write_image(path, image),
    "a.exr": lambda path: write_image(path, image),
    "sheet.png": lambda path: write_sheet(path, [("grey", image)]),
    "bank.safetensors": bank.save,
    "shard-000000.tar": lambda path: write_shards(dataset, path.parent, 2, show_progress=False),
    "report.md": lambda path: write_together(path.parent, "report", 10**6 * "x", {}, {"plot.png": Figure()}),
}
for name, write in writers.items():
    path = Path(name)
    write(path)
    size = path.stat().st_size
    for limit in (0, 1, size // 2, size - 1):
        path.unlink(missing_ok=True)
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
        if limit < 500 and "shard" in name:  # not even what says of what the set is
            Path("dataset.json").unlink()
        try:
            write(path)
            found = "NO ERROR"
        except OSError as error:
            found = str(error)
        resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
        print(name, limit, found, sorted(p.name for p in Path().iterdir()), sep="|")
        write_shards(dataset, ".", 2, show_progress=False) if "shard" in name and limit < 500 else None
    path.unlink(missing_ok=True)
    Path("dataset.json").unlink(missing_ok=True)
"""


@pytest.mark.slow
def test_a_full_disk(tmp_path: Path) -> None:
    """The limit on the size of a file stands for the disk: writing fails with an error in the middle of a file."""
    done = subprocess.run([sys.executable, "-c", WRITERS], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    lines = [line.split("|") for line in done.stdout.splitlines()]
    assert len(lines) == 4 * 7
    for name, limit, error, files in lines:
        where = "dataset.json" if name.startswith("shard") and int(limit) < 2 else name
        where = "." if name == "report.md" else where
        assert error == f"{where}: cannot be written (File too large)", (name, limit)
        assert files in ("[]", "['dataset.json']", "['plot.png', 'report.json']"), (name, limit)


WRITING = {"report": "REPORT", "report --stability": "STABILITY", "psfs analyse": "PSFS"}


@pytest.fixture(params=WRITING)
def reporting(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Callable[[Path, str], int]:
    """A command that has a text, numbers and two plots to write as soon as it starts."""
    figure = pytest.importorskip("matplotlib.figure").Figure
    from torchbokeh.report import chapters

    name = WRITING[request.param]

    def run(folder: Path, text: str) -> int:
        plots = {f"{name}_{k}.png": figure((len(text), 1)) for k in range(2)}
        found = {"run": lambda *_: {"rows": text}, "markdown": lambda *_: text, "draw": lambda _: plots}
        monkeypatch.setattr(chapters, name, getattr(chapters, name)._replace(**found))
        return main([*request.param.split(), "--quick", "--out", str(folder)])

    return run


def held(folder: Path) -> dict[str, bytes]:
    """Every file of a folder and those below, hidden ones too."""
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_amid_several_files(
    tmp_path: Path,
    reporting: Callable[[Path, str], int],
    number: int,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """In the middle of each, and between any two that take their places: never a text beside the plots of another."""
    assert reporting(tmp_path / "old", "before") == 0
    assert reporting(tmp_path / "new", "afterwards") == 0
    old, new = held(tmp_path / "old"), held(tmp_path / "new")
    assert len(new) == 4
    assert all(content != new[name] for name, content in old.items())
    steps: list[str] = []

    def interrupt(patch: pytest.MonkeyPatch, owner: Any, name: str, step: int) -> None:
        real = getattr(owner, name)

        def interrupted(*given: Any, **options: Any) -> Any:
            steps.append(name)
            if len(steps) == step and owner is os:
                signal.raise_signal(number)
            found = real(*given, **options)
            if len(steps) == step:
                path = next(Path(one) for one in given if isinstance(one, str | Path))
                os.truncate(path, path.stat().st_size // 2)
                signal.raise_signal(number)
            return found

        patch.setattr(owner, name, interrupted)

    figure = pytest.importorskip("matplotlib.figure").Figure
    for step in range(1, 9):
        folder = tmp_path / f"{step}"
        shutil.copytree(tmp_path / "old", folder)
        steps.clear()
        capsys.readouterr()
        with monkeypatch.context() as patch:
            for owner, name in ((figure, "savefig"), (Path, "write_text"), (os, "replace")):
                interrupt(patch, owner, name, step)
            assert reporting(folder, "afterwards") == 128 + number
        said = capsys.readouterr()
        assert said.out == ""
        line = "interrupted" if number == signal.SIGINT else "terminated"
        assert said.err.removeprefix("[   0 s] writing\n") == f"torchbokeh: {line}\n"
        found = held(folder)
        if step <= 5:  # amid the four, or before the first moves
            assert found == (old if step <= 4 else {k: v for k, v in old.items() if not k.endswith(".md")})
        else:
            assert found.keys() == {name for name in new if not name.endswith(".md")}
            assert sum(content == new[name] for name, content in found.items()) == step - 5
            assert all(content in (old[name], new[name]) for name, content in found.items())
    assert steps == ["savefig", "savefig", "write_text", "write_text", "replace", "replace", "replace", "replace"]
