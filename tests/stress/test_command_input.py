"""Bad command lines: status 2 and one line on stderr that says what is wrong, and nothing on the disk that is new."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from torchbokeh.commands.main import main
from torchbokeh.io.pictures import write_image

H, W = 12, 16


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder to work in, with a picture, its depth and files that are none."""
    write_image(tmp_path / "a.png", torch.rand(1, 3, H, W, generator=torch.Generator().manual_seed(0)))
    np.save(tmp_path / "d.npy", np.linspace(1, 5, H * W).reshape(H, W))
    np.save(tmp_path / "nan.npy", np.full((H, W), np.nan))
    np.save(tmp_path / "small.npy", np.ones((3, 4)))
    np.save(tmp_path / "pickle.npy", np.array([{}]), allow_pickle=True)
    for name in ("no.png", "no.exr", "no.tif", "no.npy", "no.flo", "no.safetensors"):
        (tmp_path / name).write_bytes(b"nothing of the kind")
    (tmp_path / "cut.png").write_bytes((tmp_path / "a.png").read_bytes()[:60])
    (tmp_path / "is a folder").mkdir()
    monkeypatch.chdir(tmp_path)
    return tmp_path


RENDER = ["render", "a.png", "--depth", "d.npy", "--focus", "2m", "-o", "out.png"]


def render(**changed: str) -> list[str]:
    """The good command with other values, or with flags added."""
    line = list(RENDER)
    for name, value in changed.items():
        if name == "image":
            line[1] = value
        elif name == "o":
            line[line.index("-o") + 1] = value
        elif f"--{name}" in line:
            line[line.index(f"--{name}") + 1] = value
        else:
            line += [f"--{name.replace('_', '-')}={value}"]
    return line


NUMBERS = ("", "x", "nan", "inf", "-inf", "-1", "0", "1e999", "1_0x", "0x10", "½", "1" * 5000)
COUNTS = ("", "x", "nan", "-1", "0", "1.5", "1e3", "²", "999999999999", "1" * 5000)
NAMES = ("", ".", "/", "no such file", "no/such/folder/x.png", "is a folder", "-", "--", "a\0b", "x" * 300, "no.xyz")

LINES = {
    **{
        f"render, {flag} {value[:20]!r}": render(**{flag: value})
        for value in NUMBERS
        for flag in ("f_number", "depth_scale", "max_coc", "tolerance")
    },
    **{
        f"render, {flag} {value[:20]!r}": render(**{flag: value})
        for value in ("", "x", "nan", "-1", "0", "0mm", "-inf", "2 km", "1" * 5000 + "x")
        for flag in ("focus", "focal_length", "sensor_width")
    },
    **{
        f"render, {flag} {value[:20]!r}": render(**{flag: value})
        for value in ("", "x", "nan", "inf", "1e999")
        for flag in ("dispersion", "lateral", "exposure")
    },
    **{f"render, {flag} {value[:20]!r}": render(**{flag: value}) for value in COUNTS for flag in ("threads", "layers")},
    **{f"render, image {name[:20]!r}": render(image=name) for name in NAMES if not name.startswith("-")},
    **{
        f"render, depth {name[:20]!r}": render(depth=name)
        for name in (*NAMES, "nan.npy", "small.npy", "pickle.npy", "no.npy")
    },
    **{
        f"render, motion {name[:20]!r}": render(motion=name)
        for name in (*NAMES, "small.npy", "pickle.npy", "no.npy", "no.flo")
    },
    **{f"render, output {name[:20]!r}": render(o=name) for name in (*NAMES, "a.png", "./a.png", "d.npy", "x.jpg")},
    **{f"render, image {name}": render(image=name) for name in ("cut.png", "no.png", "no.exr", "no.tif", "nan.npy")},
    **{
        f"render, {flag} {value!r}": render(**{flag: value})
        for flag in ("aperture", "quality", "glass", "device", "spectrum")
        for value in ("", "x", "0-gon", "99999-gon", "-1")
    },
    **{
        f"render, focus-at {value!r}": ["render", "a.png", "--depth", "d.npy", "--focus-at", value, "-o", "o.png"]
        for value in ("", "1", "a,b", "-1,0", "16,0", "0,12", "9" * 30 + ",0", "1,2,3", "1.5,2")
    },
    "render, nothing": ["render"],
    "render, a flag of nobody": [*RENDER, "--no-such"],
    "render, two kinds of map": [*RENDER, "--disparity", "d.npy"],
    "render, near focus": render(focus="10mm"),
    "nothing": [],
    "no such command": ["nonsense"],
    **{
        f"dataset, {flag} {value[:20]!r}": [
            "dataset",
            "--out",
            "set",
            "--count",
            "2",
            "--size",
            "12x8",
            "--views",
            "1",
            f"--{flag}={value}",
        ]
        for flag, values in {
            "count": COUNTS,
            "workers": ("", "x", "-1", "1.5", "99999"),
            "seed": ("", "x", "-1", "1.5", "1" * 30),
            "views": (*COUNTS, "100000000"),
            "per-shard": COUNTS,
            "size": ("", "x", "0x5", "5x0", "5", "5x5x5", "-5x5", "99999x99999", "100000x1", "1e3x5"),
            "shard": ("", "x", "0/1", "2/1", "1/0", "-1/2", "1", "1/2/3"),
            "recipes": ("", "x", "coins,", ",", "coins,x"),
            "blur": ("", "x", "1", "2,1", "-1,2", "nan,1", "1,inf", "1,2,3"),
        }.items()
        for value in values
    },
    "dataset, more files than there are names for": [
        "dataset",
        "--out",
        "set",
        "--count",
        "100000000",
        "--per-shard",
        "1",
    ],
    "dataset, out is a file": ["dataset", "--out", "a.png", "--count", "1"],
    "dataset, out in a file": ["dataset", "--out", "a.png/x", "--count", "1"],
    "dataset, nothing": ["dataset"],
    "demo, out is a file": ["demo", "--out", "a.png"],
    "report, out is a file": ["report", "--quick", "--out", "a.png"],
    "report, no such scene": ["report", "--quick", "--scenes", "nonsense"],
    "report, scenes": ["report", "--quick", "--scenes", ","],
    **{f"report, threads {value[:20]!r}": ["report", "--quick", f"--threads={value}"] for value in COUNTS},
    "psfs, nothing": ["psfs"],
    "psfs, no such action": ["psfs", "nonsense"],
    "psfs build, no such model": ["psfs", "build", "nonsense"],
    "psfs build, out in no folder": ["psfs", "build", "simple-lens", "--out", "no/such/x.safetensors"],
    "psfs build, out is a folder": ["psfs", "build", "simple-lens", "--out", "is a folder"],
    "psfs build, out is the folder": ["psfs", "build", "simple-lens", "--out", "."],
    **{
        f"psfs build, workers {value[:20]!r}": ["psfs", "build", "simple-lens", f"--workers={value}"]
        for value in COUNTS
    },
    **{
        f"psfs build, ssim {value[:20]!r}": ["psfs", "build", "simple-lens", f"--ssim={value}"]
        for value in ("", "x", "nan", "inf", "-1", "0", "1", "2")
    },
    **{
        f"psfs show, {name[:20]!r}": ["psfs", "show", name]
        for name in ("", ".", "/", "no such", "a.png", "no.safetensors", "a\0b", "x" * 300)
    },
    "psfs show, output": ["psfs", "show", "simple-lens", "-o", "no/such/x.png"],
    "psfs show, output is a folder": ["psfs", "show", "simple-lens", "-o", "is a folder"],
    "psfs table, no.safetensors": ["psfs", "table", "no.safetensors"],
    **{f"psfs table, held-out {value[:20]!r}": ["psfs", "table", f"--held-out={value}"] for value in COUNTS},
    "psfs analyse, out is a file": ["psfs", "analyse", "--quick", "--out", "a.png"],
}


def state(folder: Path) -> dict[str, bytes | None]:
    return {str(p.relative_to(folder)): p.read_bytes() if p.is_file() else None for p in folder.rglob("*")}


def test_bad_command_lines_are_one_line_on_stderr(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before, wrong = state(folder), []
    for name, line in LINES.items():
        try:
            status = main(line)
        except BaseException as error:
            wrong.append(f"{name}: {type(error).__name__}: {error}"[:200])
            continue
        err = capsys.readouterr().err
        if status != 2 or not err.startswith("torchbokeh: ") or err.count("\n") != 1 or len(err) > 6000:
            wrong.append(f"{name}: status {status}, {err[:200]!r}")
        if state(folder) != before:
            wrong.append(f"{name}: leaves {sorted(state(folder).items() ^ before.items())}"[:200])
            before = state(folder)
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("name", ["-a.png", "a b.png", "ü.png", "$(touch x).png", "a;b.png", "a\nb.png"])
def test_strange_names_are_names(name: str, folder: Path) -> None:
    os.rename("a.png", name)
    before = {*state(folder)}
    out = f"out {name}"
    given = ["--", name] if name.startswith("-") else [name]
    assert main(["render", "--depth", "d.npy", "--focus", "2m", "-o", out, *given]) == 0
    assert {*state(folder)} - before == {out}


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="other systems allow no such names")
def test_names_that_are_no_text(folder: Path) -> None:
    command = [sys.executable, "-m", "torchbokeh"]
    name = os.fsencode("out") + b"\xff.png"
    done = subprocess.run([*command, *RENDER[:-1], name], capture_output=True, env={**os.environ, "PYTHONUTF8": "1"})
    assert done.returncode == 0, done.stderr
    assert name in os.listdir(os.fsencode(folder))
    done = subprocess.run([*command, "psfs", "show", b"no\xff"], capture_output=True)
    assert done.returncode == 2
    assert done.stderr.count(b"\n") == 1


def test_what_is_wrong_with_a_tiff_is_said_once(folder: Path, capfd: pytest.CaptureFixture[str]) -> None:
    write_image("a.tif", torch.rand(1, 3, H, W))
    whole = Path("a.tif").read_bytes()
    for cut in (8, 60, 150, 190, len(whole) - 5):
        Path("b.tif").write_bytes(whole[:cut] + whole[cut + 1 :])
        assert main(render(image="b.tif")) in (0, 2)
        assert capfd.readouterr().err.count("\n") <= 1


@pytest.mark.skipif(sys.platform != "linux", reason="needs a folder that not even root may write")
def test_folders_that_cannot_be_written(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for line in (
        render(o="/proc/o.png"),
        ["dataset", "--out", "/proc/x", "--count", "1"],
        ["demo", "--out", "/proc/x"],
        ["psfs", "show", "simple-lens", "-o", "/proc/s.png"],
        ["psfs", "build", "simple-lens", "--out", "/proc/s"],
        ["report", "--quick", "--out", "/proc/x"],
        ["psfs", "analyse", "--quick", "--out", "/proc/x"],
    ):
        assert main(line) == 2
        assert capsys.readouterr().err.count("\n") == 1
