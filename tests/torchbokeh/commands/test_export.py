from pathlib import Path

import numpy as np
import pytest
import torch

from torchbokeh.commands.main import main
from torchbokeh.io.pictures import write_image

onnxruntime = pytest.importorskip("onnxruntime")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    write_image(tmp_path / "a.png", torch.rand(1, 3, 16, 24, generator=torch.Generator().manual_seed(0)))
    np.save(tmp_path / "d.npy", np.linspace(1, 5, 16 * 24).reshape(16, 24))
    np.save(tmp_path / "flat.npy", np.full((16, 24), 2.0))
    monkeypatch.chdir(tmp_path)
    return tmp_path


SCENE = ["export", "blur", "a.png", "--focus", "2m", "--depth"]


@pytest.mark.slow
def test_blur(folder, capsys):
    assert main([*SCENE, "d.npy", "--f-number", "0.1", "--layers", "1", "-o", "blur.onnx"]) == 0
    assert "blur.onnx: " in capsys.readouterr().out
    names = [given.name for given in onnxruntime.InferenceSession("blur.onnx").get_inputs()]
    assert names == ["image", "depth", "focus_distance", "f_number"]


def test_pyramid(folder, capsys):
    assert main(["export", "pyramid", "--levels", "3", "--channels", "2", "-o", "pyramid.onnx"]) == 0
    assert "pyramid.onnx: " in capsys.readouterr().out
    session = onnxruntime.InferenceSession("pyramid.onnx")
    assert session.run(None, {"buffer": np.zeros((1, 2, 9, 11), np.float32)})[0].shape == (1, 2, 9, 11)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ([*SCENE, "d.npy", "-o", "blur.png"], "blur.png: expected a name that ends in .onnx"),
        ([*SCENE, "d.npy", "-o", "no/blur.onnx"], "no/blur.onnx: the folder no does not exist"),
        ([*SCENE, "no.npy", "-o", "blur.onnx"], "no.npy"),
        ([*SCENE, "flat.npy", "-o", "blur.onnx"], "plan: expected one of a scene whose blur varies"),
        ([*SCENE, "d.npy", "--motion", "m.npy", "-o", "blur.onnx"], "unrecognized arguments: --motion m.npy"),
        ([*SCENE, "d.npy", "--strength", "3", "-o", "blur.onnx"], "(see: torchbokeh export blur --help)"),
        (["export", "-o", "blur.onnx"], "KIND"),
        (["export", "pyramid", "--levels", "0", "-o", "pyramid.onnx"], "--levels"),
        (["export", "pyramid", "-o", "pyramid"], "expected a name that ends in .onnx"),
    ],
)
def test_bad_lines(folder, capsys, line, message):
    before = sorted(folder.iterdir())
    assert main(line) == 2
    said = capsys.readouterr()
    assert message in said.err
    assert said.err.count("\n") == 1
    assert sorted(folder.iterdir()) == before
