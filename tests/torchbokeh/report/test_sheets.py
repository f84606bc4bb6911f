from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from torchbokeh.io.pictures import encode_srgb
from torchbokeh.report.sheets import write_sheet


def test_every_picture_is_there_at_full_size(tmp_path: Path) -> None:
    pictures = [(f"{k}", torch.rand(1, 3, 20, 30)) for k in range(5)]
    write_sheet(tmp_path / "sheet.png", pictures, columns=3)
    sheet = np.asarray(Image.open(tmp_path / "sheet.png"))
    high = sheet.shape[0] // 2
    assert sheet.shape == (2 * high, 3 * 30, 3)
    assert high > 20
    for k, (_, picture) in enumerate(pictures):
        y, x = k // 3 * high + high - 20, k % 3 * 30
        assert np.array_equal(sheet[y : y + 20, x : x + 30], encode_srgb(picture, 8))
    assert (sheet[high:, 60:] == 255).all()


def test_what_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"pictures: expected some of one size, got sizes \[\]"):
        write_sheet(tmp_path / "sheet.png", [])
    two = [("a", torch.rand(1, 3, 8, 8)), ("b", torch.rand(1, 3, 8, 9))]
    with pytest.raises(ValueError, match="pictures: expected some of one size"):
        write_sheet(tmp_path / "sheet.png", two)
    assert not list(tmp_path.iterdir())
