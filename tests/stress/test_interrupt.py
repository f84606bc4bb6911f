"""Ctrl-C, SIGTERM and SIGKILL: one line, no worker left, nothing half-written that looks whole."""

import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from torchbokeh.commands.signals import Terminated, stoppable
from torchbokeh.io.pictures import read_image, write_image
from torchbokeh.ops.system.threads import run_all

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="signals, limits and /proc as Linux has them")

PATIENCE = 240.0  # seconds until something counts as hanging

# Commands of the package, but with work that a test can wait for: a small bank, and data whose samples take a while.
SMALL = """
import sys
from functools import partial
sys.argv[0] = "torchbokeh"
from torchbokeh.commands.entry import main
from torchbokeh.commands.signals import end_while_importing
end_while_importing()  # as `main` does, for the two that follow are long to import on a busy machine
from torchbokeh.psfs import SimpleLens
from torchbokeh.psfs.models import MODELS
MODELS["simple-lens"] = partial(SimpleLens, radius=3.0)
sys.exit(main())
"""

RENDER = ("render", "image.tif", "--depth", "depth.npy", "--focus", "2m", "--f-number", "0.1", "-o", "out.tif")
SHARP = (*RENDER, "--f-number", "16")
DATASET = ("dataset", "--out", "set", "--count", "8", "--per-shard", "2", "--size", "64x48", "--views", "512")
BUILD = ("psfs", "build", "simple-lens", "--out", "bank.safetensors")
COMMANDS = {
    "render": RENDER,
    "export": ("export", "blur", *RENDER[1:-1], "out.onnx"),
    "demo": ("demo", "--out", "out"),
    "report": ("report", "--quick", "--out", "out"),
    "dataset": DATASET,
    "dataset, workers": (*DATASET, "--workers", "2"),
    "build": (*BUILD, "--workers", "2"),
    "show": ("psfs", "show", "combined"),
    "table": ("psfs", "table", "combined"),
    "analyse": ("psfs", "analyse", "--out", "out"),
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Holds a picture and its depth, large enough that rendering takes a moment."""
    write_image(tmp_path / "image.tif", torch.rand(1, 3, 600, 800))
    np.save(tmp_path / "depth.npy", np.tile(np.linspace(1, 9, 800, dtype=np.float32), (600, 1)))
    return tmp_path


def start(folder: Path, *command: str, **options: Any) -> subprocess.Popen[str]:
    """Run a command in a session of its own, as a terminal does."""
    return subprocess.Popen(
        [sys.executable, "-c", SMALL, *command],
        cwd=folder,
        env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONUNBUFFERED": ""},
        **{"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, **options},
        start_new_session=True,
    )


def ended(process: subprocess.Popen[str]) -> list[str]:
    """The lines of stderr, but for what a progress bar leaves; its whole session is gone."""
    _, err = process.communicate(timeout=PATIENCE)
    deadline = time.monotonic() + PATIENCE
    while session(process.pid):
        assert time.monotonic() < deadline, f"left behind: {session(process.pid)}"
        time.sleep(0.05)
    return [line for line in err.splitlines() if line and "%|" not in line and not line.startswith("[")]


def session(number: int) -> list[int]:
    """The processes of a session, without those that have ended and wait to be noticed."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = path.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[3]) == number and fields[0] != "Z":
            found.append(int(path.parent.name))
    return found


def wait_for(process: subprocess.Popen[str], there: Callable[[], object]) -> None:
    deadline = time.monotonic() + PATIENCE
    while not there():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.01)


def written(folder: Path) -> dict[str, bytes]:
    """Every file of a folder and those below, hidden ones too, but for the two inputs."""
    files = [path for path in folder.rglob("*") if path.is_file() and path.name not in ("image.tif", "depth.npy")]
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def at_work(folder: Path) -> bool:
    """Whether the first shard, or the first samples of a bank, are there."""
    return (folder / "set/shard-000000.tar").exists() or any(folder.glob("*.parts/*.npz"))


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """What the data set and the bank are that nobody interrupts."""
    folder = tmp_path_factory.mktemp("whole")
    for command in (DATASET, BUILD):
        process = start(folder, *command)
        assert (ended(process), process.returncode) == ([], 0)
    return written(folder)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "seconds"),
    [(name, seconds) for name in COMMANDS for seconds in ((2.5,) if name in ("show", "table") else (2.5, 6.0))],
)
def test_ctrl_c_at_any_moment(folder: Path, command: str, seconds: float) -> None:
    """While the package is imported, and after that: these commands take longer, but for two."""
    process = start(folder, *COMMANDS[command])
    time.sleep(seconds)
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGINT)
    began = time.monotonic()
    lines = ended(process)
    if process.returncode in (0, -signal.SIGINT) and lines == []:  # its work was done: at most Python was tidying up
        return
    assert (lines, process.returncode) == (["torchbokeh: interrupted"], 130)
    assert time.monotonic() - began < PATIENCE / 8
    for name in written(folder):
        assert "/." not in name
        if not name.startswith(("bank.safetensors.parts/", "set/")):
            assert command == "demo"  # which writes several pictures
            read_image(folder / name)


def test_ctrl_c_while_importing(tmp_path: Path) -> None:
    """A traceback into torch would be the answer otherwise; as a console script and by ``-m``."""
    scripts = (["-m", "torchbokeh"], ["-c", "from torchbokeh.commands.entry import main; main()"])
    for script in scripts:
        process = subprocess.Popen(
            [sys.executable, "-X", "importtime", *script, "--help"],
            cwd=tmp_path,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert process.stderr is not None
        while not re.search(r"\| +torch\.", process.stderr.readline()):
            assert process.poll() is None
        process.send_signal(signal.SIGINT)
        lines = [line for line in process.communicate(timeout=PATIENCE)[1].splitlines() if "import time:" not in line]
        assert (lines, process.returncode) == (["torchbokeh: interrupted"], 130), script


ENDS = [
    (True, signal.SIGINT, 130, ["torchbokeh: interrupted"]),
    (False, signal.SIGINT, 130, ["torchbokeh: interrupted"]),
    (False, signal.SIGTERM, 143, ["torchbokeh: terminated"]),
    (True, signal.SIGKILL, -9, None),
    (False, signal.SIGKILL, -9, None),
]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "to_all", "number", "status", "line"),
    [
        *((DATASET, *end) for end in ENDS if not end[0]),  # without workers there is nobody else
        *(((*command, "--workers", "2"), *end) for command in (DATASET, BUILD) for end in ENDS),
    ],
)
def test_a_second_run_goes_on(
    tmp_path: Path,
    whole: dict[str, bytes],
    command: tuple[str, ...],
    to_all: bool,
    number: int,
    status: int,
    line: list[str] | None,
) -> None:
    process = start(tmp_path, *command)
    wait_for(process, lambda: at_work(tmp_path))
    (os.killpg if to_all else os.kill)(process.pid, number)
    lines = ended(process)
    assert process.returncode == status
    if line is not None:
        assert lines == line
        assert not [name for name in written(tmp_path) if "/." in name]
    for name, content in written(tmp_path).items():
        if "/." not in name and ".parts/" not in name:
            assert content == whole[name]  # what looks whole is
    again = start(tmp_path, *command)
    assert (ended(again), again.returncode) == ([], 0)
    mine = "set" if command[0] == "dataset" else "bank"
    assert written(tmp_path) == {name: content for name, content in whole.items() if name.startswith(mine)}


@pytest.mark.slow
@pytest.mark.parametrize("command", [(*DATASET, "--workers", "2"), (*BUILD, "--workers", "2")])
def test_a_killed_worker(tmp_path: Path, command: tuple[str, ...]) -> None:
    """As by the kernel where memory runs out: an error in one line, not a wait without end."""
    process = start(tmp_path, *command)
    wait_for(process, lambda: at_work(tmp_path))
    os.kill(max(session(process.pid)), signal.SIGKILL)
    lines = ended(process)
    assert process.returncode == 2
    assert len(lines) == 1
    assert "perhaps for want of memory" in lines[0]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "target", "status", "line"),
    [
        (("--help",), "/dev/full", 2, ["torchbokeh: standard output: cannot be written (No space left on device)"]),
        (SHARP, "/dev/full", 2, ["torchbokeh: standard output: cannot be written (No space left on device)"]),
        (SHARP, "a pipe that nobody reads", 141, []),
        (SHARP, "closed", 0, []),
    ],
)
def test_standard_output(folder: Path, command: tuple[str, ...], target: str, status: int, line: list[str]) -> None:
    """The interpreter has nothing to add at its end."""
    if target == "closed":
        process = start(folder, *command, stdout=None, preexec_fn=partial(os.close, 1))
    else:
        read, write = (0, os.open(target, os.O_WRONLY)) if target == "/dev/full" else os.pipe()
        if read:
            os.close(read)
        process = start(folder, *command, stdout=write)
        os.close(write)
    assert (ended(process), process.returncode) == (line, status)
    if command == SHARP:
        read_image(folder / "out.tif")


def test_ctrl_c_leaves_no_thread_at_work() -> None:
    torch.set_num_threads(3)
    done: list[int] = []

    def work(k: int) -> None:
        if k == 4:
            os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.02)
        done.append(k)

    before = threading.active_count()
    with pytest.raises(KeyboardInterrupt):
        run_all(work, [(k,) for k in range(100)])
    assert threading.active_count() == before
    assert 4 <= len(done) < 100


def test_a_system_without_more_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    torch.set_num_threads(4)
    monkeypatch.setattr(threading.Thread, "start", refuse)
    done: list[int] = []
    run_all(done.append, [(k,) for k in range(9)])
    assert done == [*range(9)]


def spoiled(number: int) -> None:
    """Get a signal, and make another error of it."""
    with stoppable():
        try:
            os.kill(os.getpid(), number)
            time.sleep(PATIENCE)
        except BaseException:
            raise RuntimeError("of its own") from None


@pytest.mark.parametrize(("number", "error"), [(signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, Terminated)])
def test_what_a_signal_becomes_is_still_a_signal(number: int, error: type[BaseException]) -> None:
    """Compiled code may answer a signal in the middle of it with an error of its own."""
    with pytest.raises(error):
        spoiled(number)


def test_errors_without_a_signal_stay_what_they_are() -> None:
    with pytest.raises(RuntimeError, match="of its own"), stoppable():
        raise RuntimeError("of its own")
