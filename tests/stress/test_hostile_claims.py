"""Files that claim more than they hold, or hold what nobody asked for: refused before memory is, and never executed."""

import gzip
import io
import json
import pickle
import struct
import tarfile
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from torchbokeh.datasets.layout import shard_indices
from torchbokeh.io.flow import MAGIC, read_flow
from torchbokeh.io.pictures import read_image, read_map
from torchbokeh.psfs import PsfBank, SimpleLens
from torchbokeh.psfs.bank import FARTHEST
from torchbokeh.psfs.refit import Sparse
from torchbokeh.psfs.represent import Represented
from torchbokeh.scenes import read_shards, write_shards


class Bomb:
    """Leaves a file behind when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return Path.touch, (self.path,)


def png(width: int, height: int, depth: int = 8, colour: int = 2) -> bytes:
    """A picture that is nothing but its header and a few bytes."""
    head = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    chunks = ((b"IHDR", head), (b"IDAT", zlib.compress(b"\0" * 1000)), (b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)) for kind, data in chunks
    )


def jpeg(width: int, height: int) -> bytes:
    from PIL import Image

    file = io.BytesIO()
    Image.new("RGB", (8, 8)).save(file, "JPEG")
    data = bytearray(file.getvalue())
    frame = data.index(b"\xff\xc0")
    data[frame + 5 : frame + 9] = struct.pack(">HH", height, width)
    return bytes(data)


def tiff(width: int, height: int, compression: str | None) -> bytes:
    import tifffile

    file = io.BytesIO()
    tifffile.imwrite(file, np.zeros((9, 11, 3), np.uint8), photometric="rgb", compression=compression)
    data = bytearray(file.getvalue())
    for tag, value in ((256, width), (257, height), (278, height)):
        at = data.index(struct.pack("<HHI", tag, 4, 1)) if struct.pack("<HHI", tag, 4, 1) in data else 0
        at = at or data.index(struct.pack("<HHI", tag, 3, 1))
        data[at : at + 12] = struct.pack("<HHII", tag, 4, 1, value)
    return bytes(data)


def exr(width: int, height: int, folder: Path) -> bytes:
    openexr = pytest.importorskip("OpenEXR")
    header = {"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage}
    with openexr.File(header, {"Y": np.zeros((2, 3), np.float32)}) as file:
        file.write(str(folder / "small.exr"))
    data = (folder / "small.exr").read_bytes()
    return data.replace(struct.pack("<4i", 0, 0, 2, 1), struct.pack("<4i", 0, 0, width - 1, height - 1))


def npy(shape: str, descr: str = "<f4", data: bytes = b"\0" * 64) -> bytes:
    head = f"{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(head)) + head + data


CLAIMS: dict[str, tuple[str, Callable[[Path], bytes], Callable[[Path], object], str]] = {
    "png, too many pixels": ("a.png", lambda _: png(60_000, 60_000), read_image, "size: .*got 60000 x 60000"),
    "png, a bomb": ("a.png", lambda _: png(10_000, 10_000), read_image, "promises 10000 x 10000 pixels of 24 bits"),
    "png, 16 bits": ("a.png", lambda _: png(10_000, 10_000, 16), read_image, "promises 10000 x 10000 pixels of 48"),
    "jpeg, too many pixels": ("a.jpg", lambda _: jpeg(65_000, 65_000), read_image, "65000|4225000000"),
    "jpeg, a bomb": ("a.jpg", lambda _: jpeg(11_000, 11_000), read_image, "promises 11000 x 11000 pixels"),
    "tiff": ("a.tif", lambda _: tiff(10_000, 10_000, None), read_image, "promises 10000 x 10000 pixels of 24 bits"),
    "tiff, a bomb": ("a.tif", lambda _: tiff(11_000, 11_000, "zlib"), read_image, "promises 11000 x 11000 pixels"),
    "tiff, too many pixels": ("a.tif", lambda _: tiff(1 << 30, 1 << 30, "zlib"), read_image, "size: expected at most"),
    "exr, too many pixels": ("a.exr", lambda f: exr(60_000, 60_000, f), read_map, "size: .*got 60000 x 60000"),
    "exr, a bomb": ("a.exr", lambda f: exr(10_000, 10_000, f), read_map, "promises 10000 x 10000 pixels"),
    "pfm": ("a.pfm", lambda _: b"PF\n100000 100000\n-1\n" + b"\0" * 48, read_map, "promises 30000000000 samples"),
    "pfm, negative": ("a.pfm", lambda _: b"Pf\n-2 -2\n-1\n" + b"\0" * 16, read_map, "promises 4 samples, but"),
    "flo": ("a.flo", lambda _: struct.pack("<fii", MAGIC, 1 << 30, 1 << 30), read_flow, "1073741824 x 1073741824 px"),
    "npy": ("a.npy", lambda _: npy("(100000, 100000)"), read_map, "cannot read it as NPY"),
    "npy, negative": ("a.npy", lambda _: npy("(-4, -4)"), read_map, "cannot read it as NPY"),
    "npy, wraps around": ("a.npy", lambda _: npy(f"({1 << 62}, 4)"), read_map, "cannot read it as NPY"),
    "npy, objects": ("a.npy", lambda _: npy("(1,)", "|O"), read_map, "cannot read it as NPY"),
    "npy, flow": ("a.npy", lambda _: npy("(2, 100000, 100000)"), read_flow, "cannot be read as an array"),
}


@pytest.mark.parametrize("name", CLAIMS)
def test_a_header_that_claims_too_much_is_not_believed(name: str, tmp_path: Path) -> None:
    file, made, read, message = CLAIMS[name]
    (tmp_path / file).write_bytes(made(tmp_path))
    with pytest.raises(ValueError, match=message):
        read(tmp_path / file)


def test_pictures_that_compress_well_are_read(tmp_path: Path) -> None:
    from PIL import Image

    for name, mode in (("a.png", "1"), ("b.png", "L"), ("c.jpg", "L")):
        Image.new(mode, (2000, 2000)).save(tmp_path / name, optimize=True)
        assert read_map(tmp_path / name).shape == (1, 1, 2000, 2000)


def test_pickles_are_never_executed(tmp_path: Path) -> None:
    mark, names = tmp_path / "executed", ("a.npy", "a.safetensors", "a.png", "a.pfm", "a.tif", "a.exr", "a.flo")
    payload = pickle.dumps(Bomb(mark))
    for content in (payload, npy("(1,)", "|O", payload), b"\x93NUMPY\x01\x00" + payload):
        for name in names:
            (tmp_path / name).write_bytes(content)
            for read in (read_image, read_map, read_flow, PsfBank.load):
                with pytest.raises(ValueError, match=name):
                    read(tmp_path / name)
    assert not mark.exists()
    pickle.loads(payload)
    assert mark.exists()  # it would have been seen


class Tiny(torch.utils.data.Dataset[dict[str, Any]]):
    """A sample with all that a shard holds."""

    def __getitem__(self, index: int) -> dict[str, Any]:
        one = {"image": 3, "depth": 1, "motion": 2, "coc": 1, "target": 3}
        maps = {name: torch.zeros(channels, 2, 3) for name, channels in one.items()}
        layers = {"layers": 4, "layer_depth": 1, "layer_motion": 2}
        maps |= {name: torch.zeros(2, channels, 2, 3) for name, channels in layers.items()}
        return {**maps, "lens": {"f_number": torch.tensor(2.0)}, "recipe": "tiny", "index": index}


def entries(folder: Path) -> dict[str, bytes]:
    (path,) = write_shards(Tiny(), folder, 1, show_progress=False)
    with tarfile.open(path) as tar:
        return {entry.name: tar.extractfile(entry).read() for entry in tar}  # type: ignore[union-attr]


def shard(path: Path, parts: list[tuple[str | tarfile.TarInfo, bytes]]) -> Path:
    with tarfile.open(path, "w") as tar:
        for name, data in parts:
            entry = tarfile.TarInfo(name) if isinstance(name, str) else name
            entry.size = len(data)
            tar.addfile(entry, io.BytesIO(data))
    return path


def link(kind: bytes) -> tarfile.TarInfo:
    entry = tarfile.TarInfo("00000000.image.npy")
    entry.type, entry.linkname = kind, "/etc/passwd"
    return entry


def zipped(name: str, data: bytes) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name, data)
    return file.getvalue()


DEEP = b"[" * 100_000

PARTS: dict[str, tuple[str, bytes]] = {
    "json": ("meta.json", b"not json"),
    "json, deep": ("meta.json", DEEP),
    "json, of another kind": ("meta.json", b"[1, 2]"),
    "json, a lens of another kind": ("meta.json", b'{"lens": {"f_number": "x"}, "index": 0, "recipe": "x"}'),
    "an array that claims more": ("image.npy", npy("(3, 100000, 100000)")),
    "a negative size": ("image.npy", npy("(-1, 16)")),
    "objects": ("image.npy", npy("(1,)", "|O")),
    "numbers of another kind": ("image.npy", npy("(16,)", "<i4")),
    "no archive": ("layers.npz", b"PK nothing"),
    "an archive without an array": ("layers.npz", zipped("other.npy", b"")),
    "an array in an archive that claims more": ("layers.npz", zipped("layers.npy", npy("(9, 4, 100000, 100000)"))),
}


@pytest.mark.parametrize("name", PARTS)
def test_shards_with_a_hostile_entry_are_refused(name: str, tmp_path: Path) -> None:
    pytest.importorskip("webdataset")
    suffix, data = PARTS[name]
    parts = {**entries(tmp_path / "good"), f"00000000.{suffix}": data}
    path = shard(tmp_path / "bad.tar", list(parts.items()))
    with pytest.raises(ValueError, match=r"bad\.tar: sample 00000000 cannot be read"):
        list(read_shards(path))


def test_what_a_shard_says_of_files_does_no_harm(tmp_path: Path) -> None:
    pytest.importorskip("webdataset")
    good = list(entries(tmp_path / "good").items())
    inside = tmp_path / "inside"
    inside.mkdir()
    name = good[0][0]
    for change, message in (
        ([(f"../../{n}", d) for n, d in good], None),
        ([(f"/tmp/{n}", d) for n, d in good], None),
        ([*good, (name, b"twice")], "there twice"),
        ([*good[1:], (link(tarfile.SYMTYPE), b"")], "is a link"),
        ([*good[1:], (link(tarfile.LNKTYPE), b"")], "is a link"),
        ([*good[1:], (link(tarfile.FIFOTYPE), b"")], "is a link"),
        (good[1:], "has no entry image.npy"),
    ):
        path = shard(inside / "shard-000000.tar", change)  # type: ignore[arg-type]
        if message is None:
            assert len(list(read_shards(path))) == 1
        else:
            with pytest.raises(ValueError, match=message):
                list(read_shards(path))
        assert [p.name for p in inside.iterdir()] == [path.name]
    packed = tmp_path / "packed.tar"
    packed.write_bytes(gzip.compress(path.read_bytes()))
    with pytest.raises(ValueError, match="cannot be read as a shard"):
        list(read_shards(packed))


@pytest.mark.parametrize(
    "numbers",
    [
        {"count": 10**18},
        {"count": 10**18, "per_shard": 10**17},
        {"count": "5"},
        {"count": True},
        {"count": -1},
        {"per_shard": 0},
        {"per_shard": 1.5},
        {"settings": [1]},
    ],
)
def test_a_manifest_of_wild_numbers(numbers: dict[str, Any], tmp_path: Path) -> None:
    pytest.importorskip("webdataset")
    (path,) = write_shards(Tiny(), tmp_path, 1, show_progress=False)
    manifest = json.loads((tmp_path / "dataset.json").read_text())
    (tmp_path / "dataset.json").write_text(json.dumps(manifest | numbers))
    with pytest.raises(ValueError, match=r"is not the manifest of a data set|shards are missing"):
        read_shards(path.parent)


def test_more_shards_than_there_are_names_for() -> None:
    with pytest.raises(ValueError, match="per_shard: expected at least 1000 for 1000000000 samples, got 100"):
        shard_indices(10**9)


def test_banks_that_do_not_fit_their_model(tmp_path: Path) -> None:
    from safetensors.torch import load, save

    model, path = SimpleLens(radius=3.0), tmp_path / "a.safetensors"
    one = Represented("direct", Sparse(np.array([[0, 0]]), np.array([[1.0]])))
    far = Represented("direct", Sparse(np.array([[FARTHEST + 1, 0]]), np.array([[1.0]])))
    PsfBank(model, [far] * len(model.grid)).save(path)
    with pytest.raises(ValueError, match="its tensors do not fit each other"):
        PsfBank.load(path)
    PsfBank(model, [one] * len(model.grid)).save(path)
    data = path.read_bytes()
    size = int.from_bytes(data[:8], "little")
    head = json.loads(json.loads(data[8 : 8 + size])["__metadata__"]["torchbokeh"])
    for change in (
        {"model": ["simple-lens"]},
        {"model": "volume"},
        {"model": None},
        {"settings": {"radius": 1e308}},
        {"settings": {"radius": "x"}},
        {"settings": {"no such": 1}},
        {"settings": []},
        {"grid": None},
        {"info": 3},
        {"model": "stylized", "settings": {"mask": "x"}},
        {"settings": {"radius": 4.0}},
        {"version": [1]},
    ):
        path.write_bytes(save(load(data), {"torchbokeh": json.dumps(head | change)}))
        with pytest.raises(ValueError, match=r"a\.safetensors: "):
            PsfBank.load(path)
    path.write_bytes(save(load(data), {"torchbokeh": DEEP.decode()}))
    with pytest.raises(ValueError, match="its header cannot be read"):
        PsfBank.load(path)
