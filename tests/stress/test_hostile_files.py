"""Files that are broken or made to do harm: a reader returns what is valid or raises a ValueError, and nothing else.

Run as a script, it tries all readers in a process of its own, so that a crash in native code or a hang is seen as one.
"""

import io
import json
import re
import resource
import struct
import subprocess
import sys
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from torchbokeh.io.flow import MAGIC, read_flow
from torchbokeh.io.pictures import read_image, read_map
from torchbokeh.psfs import PsfBank, SimpleLens
from torchbokeh.psfs.bank import _DTYPES, _digest
from torchbokeh.psfs.refit import Sparse
from torchbokeh.psfs.represent import Represented
from torchbokeh.scenes import read_shards, write_shards

SPARE = 1 << 30
"""Bytes that a reader may ask for, whatever a file of a few kB says."""

EXTREME = (
    0,
    1,
    0x7F,
    0x80,
    0xFF,
    0x7FFF,
    0x8000,
    0xFFFF,
    1 << 20,
    (1 << 31) - 1,
    1 << 31,
    (1 << 32) - 1,
    (1 << 63) - 1,
)


# --- one sample of each kind


def _picture(folder: Path, name: str) -> bytes:
    from PIL import Image

    shade = np.arange(9 * 11 * 3, dtype=np.uint8).reshape(9, 11, 3)
    Image.fromarray(shade).save(folder / name)
    return (folder / name).read_bytes()


def _png16(folder: Path) -> bytes:
    rows = b"".join(b"\0" + struct.pack(">33H", *range(k, k + 33)) for k in range(9))
    chunks = ((b"IHDR", struct.pack(">IIBBBBB", 11, 9, 16, 2, 0, 0, 0)), (b"IDAT", zlib.compress(rows)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)) for kind, data in chunks
    )


def _tiff(compression: str | None) -> Callable[[Path], bytes]:
    def made(folder: Path) -> bytes:
        import tifffile

        file = io.BytesIO()
        tifffile.imwrite(
            file, np.arange(297, dtype=np.uint16).reshape(9, 11, 3), photometric="rgb", compression=compression
        )
        return file.getvalue()

    return made


def _exr(folder: Path) -> bytes:
    openexr = pytest.importorskip("OpenEXR")
    header = {"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage}
    with openexr.File(header, {"RGB": np.linspace(0, 2, 297, dtype=np.float32).reshape(9, 11, 3)}) as file:
        file.write(str(folder / "sample.exr"))
    return (folder / "sample.exr").read_bytes()


def _npy(values: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.save(file, values)
    return file.getvalue()


def _bank(folder: Path) -> bytes:
    model = SimpleLens(radius=3.0)
    one = Represented("direct", Sparse(np.array([[0, 0], [1, 2]]), np.array([[0.5], [0.5]])))
    PsfBank(model, [one] * len(model.grid), {"note": "small"}).save(folder / "sample.safetensors")
    return (folder / "sample.safetensors").read_bytes()


class Tiny(torch.utils.data.Dataset[dict[str, Any]]):
    """Two samples with all that a shard holds."""

    def __getitem__(self, index: int) -> dict[str, Any]:
        one = {"image": 3, "depth": 1, "motion": 2, "coc": 1, "target": 3}
        maps = {name: torch.full((channels, 4, 5), float(index)) for name, channels in one.items()}
        layers = {"layers": 4, "layer_depth": 1, "layer_motion": 2}
        maps |= {name: torch.full((2, channels, 4, 5), float(index)) for name, channels in layers.items()}
        return {**maps, "lens": {"f_number": torch.tensor(2.0)}, "recipe": "tiny", "index": index}


def _shard(folder: Path) -> bytes:
    (path,) = write_shards(Tiny(), folder / "set", 2, show_progress=False)
    return path.read_bytes()


def _manifest(folder: Path) -> bytes:
    write_shards(Tiny(), folder / "other", 2, show_progress=False)
    return (folder / "other" / "dataset.json").read_bytes()


# --- checksums: only with right ones is the rest looked at


def _plain(data: bytes) -> bytes:
    return data


def _png_repaired(data: bytes) -> bytes:
    out, at = bytearray(data), 8
    while at + 12 <= len(out):
        length = int.from_bytes(out[at : at + 4], "big")
        if at + 12 + length > len(out):
            break
        out[at + 8 + length : at + 12 + length] = zlib.crc32(out[at + 4 : at + 8 + length]).to_bytes(4, "big")
        at += 12 + length
    return bytes(out)


def _bank_repaired(data: bytes) -> bytes:
    from safetensors.torch import load, save

    try:
        size = int.from_bytes(data[:8], "little")
        head = json.loads(json.loads(data[8 : 8 + size])["__metadata__"]["torchbokeh"])
        tensors = load(data)
        head["digest"] = _digest({name: tensors[name] for name in _DTYPES})
        return save(tensors, {"torchbokeh": json.dumps(head)})
    except Exception:  # too broken to be repaired
        return data


def _tar_repaired(data: bytes) -> bytes:
    out = bytearray(data)
    for at in range(0, len(out) - 511, 512):
        if out[at + 257 : at + 262] == b"ustar":
            out[at + 148 : at + 156] = b" " * 8
            out[at + 148 : at + 156] = b"%06o\0 " % sum(out[at : at + 512])
    return bytes(out)


# --- the readers


def _read_shard(path: Path) -> list[torch.Tensor]:
    samples = list(read_shards(path))
    return [t for sample in samples for t in sample.values() if isinstance(t, torch.Tensor)]


def _read_folder(path: Path) -> list[torch.Tensor]:
    for name in ("shard-000000.tar", "shard-000001.tar"):
        (path.parent / name).touch()
    try:
        read_shards(path.parent)
        return []
    finally:
        for name in ("shard-000000.tar", "shard-000001.tar"):
            (path.parent / name).unlink()


def _read_bank(path: Path) -> list[torch.Tensor]:
    from torchbokeh import KernelSplatting

    bank = PsfBank.load(path)
    if len(bank.model.axes) == 1 and bank.model.name == "simple-lens":  # what is taken for good can be used
        channels = bank.values.shape[1]
        KernelSplatting(bank=bank, quality="exact")(torch.ones(1, channels, 4, 4), torch.full((1, 1, 4, 4), 2.0))
    return [bank.values]


class Kind:
    """A kind of file: its name, how a sample is made, how it is read and how its checksums are put right."""

    def __init__(
        self,
        name: str,
        made: Callable[[Path], bytes],
        read: Callable[[Path], Any],
        repaired: Callable[[bytes], bytes] = _plain,
    ) -> None:
        self.name, self.made, self.read, self.repaired = name, made, read, repaired


FLOW = np.linspace(-3, 3, 40, dtype=np.float32).reshape(2, 4, 5)

KINDS = {
    "png": Kind("a.png", lambda f: _picture(f, "sample.png"), read_image, _png_repaired),
    "png16": Kind("a.png", _png16, read_image, _png_repaired),
    "jpeg": Kind("a.jpg", lambda f: _picture(f, "sample.jpg"), read_image),
    "tiff": Kind("a.tif", _tiff("zlib"), read_image),
    "tiff, not compressed": Kind("a.tif", _tiff(None), read_image),
    "exr": Kind("a.exr", _exr, read_image),
    "npy": Kind("a.npy", lambda _: _npy(np.linspace(0, 1, 99, dtype=np.float32).reshape(9, 11)), read_map),
    "pfm": Kind("a.pfm", lambda _: b"PF\n5 4\n-1.0\n" + np.ones(60, "<f4").tobytes(), read_image),
    "flo": Kind("a.flo", lambda _: struct.pack("<fii", MAGIC, 5, 4) + FLOW.transpose(1, 2, 0).tobytes(), read_flow),
    "flow as npy": Kind("a.npy", lambda _: _npy(FLOW), read_flow),
    "bank": Kind("a.safetensors", _bank, _read_bank, _bank_repaired),
    "shard": Kind("shard-000000.tar", _shard, _read_shard, _tar_repaired),
    "manifest": Kind("dataset.json", _manifest, _read_folder),
}


# --- mutations


def mutated(data: bytes, draw: np.random.Generator) -> bytes:
    """The same file after one to three accidents."""
    out = bytearray(data)
    for _ in range(draw.integers(1, 4)):
        if not out:
            break
        # Half of them near the beginning, where headers are.
        at = int(draw.integers(min(len(out), 256) if draw.random() < 0.5 else len(out)))
        match draw.choice(["flip", "cut", "insert", "delete", "field", "digits", "repeat"]):
            case "flip":
                out[at] ^= 1 << int(draw.integers(8))
            case "cut":
                del out[at:]
            case "insert":
                out[at:at] = draw.bytes(int(draw.integers(1, 64)))
            case "delete":
                del out[at : at + int(draw.integers(1, 64))]
            case "field":
                width, order = int(draw.choice([1, 2, 4, 8])), str(draw.choice(["little", "big"]))
                value = EXTREME[draw.integers(len(EXTREME))] % (1 << 8 * width)
                out[at : at + width] = value.to_bytes(width, order)
            case "digits":
                numbers = list(re.finditer(rb"\d+", out))
                if numbers:
                    number = numbers[draw.integers(min(len(numbers), 40))]
                    wild = [b"0", b"-1", b"99999999999", b"1e999", b"NaN", b"4294967296", b"9" * 30]
                    out[number.start() : number.end()] = wild[draw.integers(len(wild))]
            case "repeat":
                part = out[at : at + int(draw.integers(1, 512))]
                out[at:at] = part
    return bytes(out)


@contextmanager
def bounded_memory() -> Iterator[None]:
    """Requests for more than `SPARE` fail meanwhile."""
    before = resource.getrlimit(resource.RLIMIT_AS)
    now = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (now + SPARE, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


def causes(error: BaseException | None) -> Iterator[BaseException]:
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


def attacked(kind: Kind, folder: Path, count: int, seed: int) -> Counter[str]:
    """Read ``count`` mutations of a sample; what came of them, by name."""
    folder.mkdir(parents=True, exist_ok=True)
    sample = kind.made(folder)
    place = folder / "here"
    place.mkdir()
    path, draw, found = place / kind.name, np.random.default_rng(seed), Counter[str]()
    path.write_bytes(sample)
    kind.read(path)
    with bounded_memory():
        for number in range(count):
            data = mutated(sample, draw)
            path.write_bytes(kind.repaired(data) if number % 2 else data)
            outcome = "read"
            try:
                found_in = kind.read(path)
                if kind.read in (read_image, read_flow) and not found_in.isfinite().all():
                    outcome = "not finite"
            except ValueError as error:
                outcome = "refused" if type(error) is ValueError else f"{type(error).__name__}: {error}"
                if any(isinstance(e, MemoryError) for e in causes(error)):
                    outcome = f"out of memory: {error}"
                elif str(place) not in str(error):
                    outcome = f"a message that does not name the file: {error}"
            except BaseException as error:  # a panic of Rust is no Exception
                outcome = f"{type(error).__name__}: {error}"
            found[outcome] += 1
            if outcome not in ("read", "refused"):
                (folder / f"bad-{number}-{kind.name}").write_bytes(path.read_bytes())
            left = {p.name for p in place.iterdir()} - {kind.name}
            if left:
                found[f"left behind: {left}"] += 1
    return found


@pytest.mark.skipif(sys.platform != "linux", reason="limits the address space by /proc")
@pytest.mark.parametrize("name", KINDS)
def test_mutations_are_read_or_refused(name: str, tmp_path: Path) -> None:
    found = attacked(KINDS[name], tmp_path, count=100, seed=0)
    assert set(found) <= {"read", "refused"}
    assert found["refused"] > 20  # the mutations do reach what is checked


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="limits the address space by /proc")
def test_many_mutations_in_a_process_of_their_own(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, __file__, str(tmp_path / "work"), "2000"], capture_output=True, text=True, timeout=3600
    )
    found = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
    assert done.returncode == 0, (found[-1:], done.stderr[-2000:])  # below 0: killed by a signal
    assert [one.pop("kind") for one in found] == [*KINDS]
    for one in found:
        assert set(one) <= {"read", "refused"}
        assert sum(one.values()) == 2000


if __name__ == "__main__":
    torch.set_num_threads(1)
    for number, (name, kind) in enumerate(KINDS.items()):
        folder = Path(sys.argv[1], str(number))
        print(json.dumps({"kind": name, **attacked(kind, folder, int(sys.argv[2]), seed=1)}), flush=True)
