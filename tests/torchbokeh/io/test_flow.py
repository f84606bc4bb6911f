"""Flow files: read as they were written, or refused."""

import struct
from pathlib import Path

import numpy as np
import pytest
import torch

from torchbokeh.commands.main import main
from torchbokeh.io.flow import MAGIC, read_flow
from torchbokeh.io.pictures import read_image, write_image

FLOW = np.random.default_rng(0).normal(size=(2, 5, 7)).astype(np.float32) * 9


def flo(path: Path, flow: np.ndarray, magic: float = MAGIC, extra: bytes = b"") -> Path:
    height, width = flow.shape[1:]
    pixels = flow.transpose(1, 2, 0).astype("<f4").tobytes()
    path.write_bytes(struct.pack("<fii", magic, width, height) + pixels + extra)
    return path


def test_flow_is_read_as_it_was_written(tmp_path: Path) -> None:
    want = torch.from_numpy(FLOW)[None]
    assert torch.equal(read_flow(flo(tmp_path / "a.flo", FLOW)), want)
    np.save(tmp_path / "b.npy", FLOW)
    np.save(tmp_path / "c.npy", FLOW.transpose(1, 2, 0).astype(np.float64))
    for name in ("b.npy", "c.npy"):
        assert torch.equal(read_flow(tmp_path / name), want)


def test_other_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.flo"
    with pytest.raises(ValueError, match="there is no such file"):
        read_flow(path)
    path.write_bytes(b"short")
    with pytest.raises(ValueError, match="is cut, or no flow file"):
        read_flow(path)
    with pytest.raises(ValueError, match="expected a Middlebury flow file"):
        read_flow(flo(path, FLOW, magic=1.0))
    with pytest.raises(ValueError, match="does not fit its header of 7 x 5 px"):
        read_flow(flo(path, FLOW, extra=b"1"))
    path.write_bytes(struct.pack("<fii", MAGIC, 1 << 30, 1 << 30))
    with pytest.raises(ValueError, match="does not fit its header"):
        read_flow(path)
    unknown = FLOW.copy()
    unknown[0, 1, 1], unknown[1, 2, 2] = 1e10, np.nan
    with pytest.raises(ValueError, match="2 displacements are unknown or not finite"):
        read_flow(flo(path, unknown))
    np.save(tmp_path / "flat.npy", FLOW[0])
    with pytest.raises(ValueError, match=r"expected shape \(2, H, W\) or \(H, W, 2\), got \(5, 7\)"):
        read_flow(tmp_path / "flat.npy")
    (tmp_path / "no.npy").write_bytes(b"nothing")
    with pytest.raises(ValueError, match="cannot be read as an array"):
        read_flow(tmp_path / "no.npy")
    np.save(tmp_path / "words.npy", np.full((2, 3, 3), "a"))
    with pytest.raises(ValueError, match="expected numbers, got <U1"):
        read_flow(tmp_path / "words.npy")
    (tmp_path / "a.png").write_bytes(b"")
    with pytest.raises(ValueError, match=r"cannot read \.png as motion; use \.flo or \.npy"):
        read_flow(tmp_path / "a.png")


def test_render_takes_motion(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    image, depth, out = (str(tmp_path / name) for name in ("a.png", "d.npy", "o.png"))
    write_image(image, torch.rand(1, 3, 24, 30, generator=torch.Generator().manual_seed(0)))
    np.save(depth, np.full((24, 30), 2.0))
    motion = np.zeros((2, 24, 30), np.float32)
    motion[0] = np.linspace(5, 9, 30)
    command = ["render", image, "--depth", depth, "--focus", "2m", "-o", out]
    assert main([*command, "--motion", str(flo(tmp_path / "m.flo", motion))]) == 0
    assert "Motion up to 9.0 px" in capsys.readouterr().out
    moved, still = read_image(out), read_image(image)
    assert float(moved.diff(dim=3).abs().mean()) < 0.4 * float(still.diff(dim=3).abs().mean())
    assert main([*command, "--motion", str(flo(tmp_path / "n.flo", FLOW))]) == 2
    assert "is 7 x 5, but" in capsys.readouterr().err
