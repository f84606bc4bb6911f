"""Reading motion: optical flow files."""

import struct
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from torchbokeh.io.pictures import read_npy
from torchbokeh.ops.checks import check_pixels

MAGIC = 202021.25
"""Begins every Middlebury flow file."""


def read_flow(path: str | Path) -> Tensor:
    """Read a motion map: displacements (dx, dy) in px.

    Args:
        path: an existing Middlebury ``.flo`` file, or an ``.npy`` array of shape ``(2, H, W)`` or ``(H, W, 2)``.

    Returns:
        ``(1, 2, H, W)`` float32.

    Raises:
        ValueError: the file is missing, broken or of an unknown kind, or a displacement is not finite or unknown.

    Example:
        >>> motion = read_flow("motion.flo")  # doctest: +SKIP
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"{path}: there is no such file")
    if path.suffix.lower() == ".flo":
        flow = _read_flo(path)
    elif path.suffix.lower() == ".npy":
        flow = _read_npy(path)
    else:
        raise ValueError(f"{path}: cannot read {path.suffix or 'a file without extension'} as motion; use .flo or .npy")
    bad = int((~np.isfinite(flow) | (np.abs(flow) > 1e9)).sum())  # 1e9 and more stands for "unknown" in .flo
    if bad:
        raise ValueError(f"{path}: {bad} displacements are unknown or not finite; fill them first")
    return torch.from_numpy(np.ascontiguousarray(flow, dtype=np.float32))[None]


def _read_flo(path: Path) -> np.ndarray:
    """``(2, H, W)``; the header is the magic number, then width and height."""
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(12)
        if len(head) < 12:
            raise ValueError(f"{path}: is cut, or no flow file")
        magic, width, height = struct.unpack("<fii", head)
        if magic != MAGIC:
            raise ValueError(f"{path}: expected a Middlebury flow file, but it begins with {head[:4]!r}")
        if not (width > 0 and height > 0) or size != 12 + 8 * width * height:
            raise ValueError(f"{path}: is {size} bytes long, which does not fit its header of {width} x {height} px")
        check_pixels("size", height, width)
        return np.frombuffer(file.read(), "<f4").reshape(height, width, 2).transpose(2, 0, 1)


def _read_npy(path: Path) -> np.ndarray:
    try:
        flow = read_npy(path)
    except Exception as error:  # NumPy raises whatever it likes on a broken file
        raise ValueError(f"{path}: cannot be read as an array ({error})") from error
    if flow.ndim != 3 or 2 not in (flow.shape[0], flow.shape[2]) or 0 in flow.shape:
        raise ValueError(f"{path}: expected shape (2, H, W) or (H, W, 2), got {flow.shape}")
    if flow.dtype.kind not in "fiu":
        raise ValueError(f"{path}: expected numbers, got {flow.dtype}")
    return flow if flow.shape[0] == 2 else flow.transpose(2, 0, 1)
