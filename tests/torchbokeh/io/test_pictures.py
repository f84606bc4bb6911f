"""Image files: what is written comes back in each format and bit depth; bad files are named in one line."""

import builtins
import os
import struct
import warnings
import zlib
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import tifffile
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image, JpegImagePlugin, PngImagePlugin

from torchbokeh.io.pictures import (
    check_writable,
    encode_srgb,
    read_image,
    read_map,
    replacing,
    sample_map,
    write_image,
)


def srgb_to_linear(v):
    """IEC 61966-2-1, in float64."""
    v = np.asarray(v, dtype=np.float64)
    return np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(v):
    v = np.asarray(v, dtype=np.float64)
    return np.where(v <= 0.0031308, v * 12.92, 1.055 * v ** (1 / 2.4) - 0.055)


def png16(path, samples):
    """A 16-bit PNG, which Pillow cannot write in colour."""
    height, width, channels = samples.shape

    def chunk(tag, data):
        return struct.pack(">I", len(data)) + tag + data + struct.pack(">I", zlib.crc32(tag + data))

    colour = {1: 0, 2: 4, 3: 2, 4: 6}[channels]
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in samples)
    header = struct.pack(">IIBBBBB", width, height, 16, colour, 0, 0, 0)
    body = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + body)


def write_pfm(path, values, order):
    """Rows bottom up; the sign of the third line is the byte order."""
    magic, shape = ("PF" if values.ndim == 3 else "Pf"), f"{values.shape[1]} {values.shape[0]}"
    header = f"{magic}\n{shape}\n{-1.0 if order == '<' else 1.0}\n".encode()
    path.write_bytes(header + values[::-1].astype(f"{order}f4").tobytes())


def samples(dtype, channels=3, seed=0):
    rng = np.random.default_rng(seed)
    shape = (5, 7, channels)
    if np.dtype(dtype).kind == "f":
        return (rng.random(shape) * 40 - 1).astype(dtype)
    return rng.integers(0, np.iinfo(dtype).max, shape, dtype=dtype, endpoint=True)


def to_hwc(image):
    return image[0].permute(1, 2, 0).double().numpy()


def write_samples(path, values):
    """Store the samples as they are, in the format that the name says."""
    squeezed = values[:, :, 0] if values.shape[2] == 1 else values
    if path.suffix == ".png" and values.dtype == np.uint16:
        png16(path, values)
    elif path.suffix == ".png":
        Image.fromarray(squeezed).save(path)
    elif path.suffix == ".tif":
        tifffile.imwrite(path, squeezed, photometric="rgb" if values.shape[2] > 2 else "minisblack")
    elif path.suffix == ".npy":
        np.save(path, squeezed)
    else:
        write_pfm(path, squeezed, "<")


STORED = [
    *[(suffix, dtype) for suffix in (".png", ".tif", ".npy") for dtype in (np.uint8, np.uint16)],
    *[(".tif", dtype) for dtype in (np.float16, np.float32, np.float64)],
    *[(".npy", dtype) for dtype in (np.float32, np.float64)],
    (".pfm", np.float32),
]


@pytest.mark.parametrize(("suffix", "dtype"), STORED)
@pytest.mark.parametrize("channels", [1, 3])
def test_read_image_decodes_integers_and_keeps_floats(tmp_path, suffix, dtype, channels):
    stored = samples(dtype, channels)
    write_samples(tmp_path / f"a{suffix}", stored)
    expected = stored.astype(np.float64)
    if stored.dtype.kind == "u":
        expected = srgb_to_linear(expected / np.iinfo(dtype).max)
    image = read_image(tmp_path / f"a{suffix}")
    assert image.shape == (1, 3, 5, 7)
    assert image.dtype == torch.float32
    np.testing.assert_allclose(to_hwc(image), np.broadcast_to(expected, (5, 7, 3)), rtol=2e-6, atol=1e-7)


@pytest.mark.parametrize(("suffix", "dtype"), STORED)
@pytest.mark.parametrize("channels", [1, 3])
def test_read_map_keeps_the_numbers_and_scales(tmp_path, suffix, dtype, channels):
    stored = np.repeat(samples(dtype, 1), channels, axis=2)
    write_samples(tmp_path / f"a{suffix}", stored)
    read = read_map(tmp_path / f"a{suffix}", scale=0.001)
    assert read.shape == (1, 1, 5, 7)
    assert read.dtype == torch.float32
    expected = stored[:, :, 0].astype(np.float64) * 0.001
    np.testing.assert_allclose(read[0, 0].double().numpy(), expected, rtol=1e-7)


def test_read_map_keeps_nan_and_infinity_and_big_integers(tmp_path):
    np.save(tmp_path / "a.npy", np.array([[np.nan, np.inf, 2.0]]))
    torch.testing.assert_close(read_map(tmp_path / "a.npy"), torch.tensor([[[[np.nan, np.inf, 2.0]]]]), equal_nan=True)
    np.save(tmp_path / "b.npy", np.array([[2**24 + 1]], dtype=np.int32))
    assert read_map(tmp_path / "b.npy", scale=1000.0).item() == np.float32((2**24 + 1) * 1000.0)


def test_read_map_refuses_colours(tmp_path):
    write_samples(tmp_path / "a.png", samples(np.uint8))
    with pytest.raises(ValueError, match=r"a\.png: its 3 channels differ; save the map as one channel"):
        read_map(tmp_path / "a.png")


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("shape", [(2, 3), (2, 3, 3)])
def test_pfm_in_both_byte_orders(tmp_path, order, shape):
    stored = np.arange(np.prod(shape), dtype=np.float32).reshape(shape) + 0.25
    write_pfm(tmp_path / "a.pfm", stored, order)
    expected = stored if stored.ndim == 3 else np.repeat(stored[:, :, None], 3, axis=2)
    np.testing.assert_array_equal(to_hwc(read_image(tmp_path / "a.pfm")), expected)


def test_jpeg_is_decoded_and_turned_upright(tmp_path):
    upright = np.zeros((16, 32, 3), np.uint8)
    upright[:, 16:] = 255
    exif = Image.Exif()
    exif[0x0112] = 6  # stored turned left, to be shown turned right by 90 degrees
    Image.fromarray(np.rot90(upright)).save(tmp_path / "a.jpg", exif=exif, quality=100, subsampling=0)
    np.testing.assert_allclose(to_hwc(read_image(tmp_path / "a.jpg")), upright / 255, atol=0.01)


def test_threads_that_read_leave_the_filters_of_warnings_alone(tmp_path, monkeypatch):
    """And pictures that Pillow finds large are read without a word."""
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 20)
    before, seen = warnings.filters, set()
    for kind, plugin in ((".png", PngImagePlugin.PngImageFile), (".jpg", JpegImagePlugin.JpegImageFile)):
        Image.fromarray(samples(np.uint8)).save(tmp_path / f"a{kind}")

        def watch(image, decode=plugin._open):
            seen.add(warnings.filters is before)
            decode(image)

        monkeypatch.setattr(plugin, "_open", watch)
    with ThreadPoolExecutor(16) as pool:
        list(pool.map(read_image, 16 * [tmp_path / "a.png", tmp_path / "a.jpg"]))
    assert seen == {True}
    assert warnings.filters is before


def test_one_bit_and_palette_png(tmp_path):
    bits = np.array([[True, False]])
    Image.fromarray(bits).save(tmp_path / "bits.png")
    np.testing.assert_allclose(to_hwc(read_image(tmp_path / "bits.png"))[:, :, 1], bits, rtol=1e-6)
    palette = Image.fromarray(np.array([[[255, 0, 0], [0, 0, 255]]], np.uint8)).quantize(2)
    palette.save(tmp_path / "palette.png")
    expected = np.array([[[1, 0, 0], [0, 0, 1]]])
    np.testing.assert_allclose(to_hwc(read_image(tmp_path / "palette.png")), expected, rtol=1e-6)


def test_tiff_with_separate_planes(tmp_path):
    stored = samples(np.float32)
    planes = np.moveaxis(stored, -1, 0)
    tifffile.imwrite(tmp_path / "a.tif", planes, photometric="rgb", planarconfig="separate")
    np.testing.assert_array_equal(to_hwc(read_image(tmp_path / "a.tif")), stored)


@pytest.mark.parametrize(
    ("suffix", "dtype"), [(".png", np.uint8), (".png", np.uint16), (".tif", np.float32), (".npy", np.uint16)]
)
def test_alpha_is_dropped_only_where_opaque(tmp_path, suffix, dtype):
    stored = samples(dtype, 4)
    stored[:, :, 3] = 1 if np.dtype(dtype).kind == "f" else np.iinfo(dtype).max
    path = tmp_path / f"a{suffix}"
    write_samples(path, stored)
    opaque = read_image(path)
    write_samples(tmp_path / f"b{suffix}", stored[:, :, :3].copy())
    torch.testing.assert_close(opaque, read_image(tmp_path / f"b{suffix}"), rtol=0, atol=0)
    stored[2, 3, 3] = 0
    write_samples(path, stored)
    with pytest.raises(ValueError, match="has transparent pixels; flatten it onto a background first"):
        read_image(path)


def test_transparent_palette_png_is_refused(tmp_path):
    Image.fromarray(np.array([[0, 1]], np.uint8)).convert("P").save(tmp_path / "a.png", transparency=0)
    with pytest.raises(ValueError, match="transparent pixels"):
        read_image(tmp_path / "a.png")


@pytest.mark.parametrize(("suffix", "levels"), [(".png", 255), (".tif", 65535), (".tiff", 65535)])
def test_written_integers_are_rounded_srgb_and_come_back(tmp_path, suffix, levels):
    image = torch.rand(1, 3, 9, 11, generator=torch.Generator().manual_seed(0)) * 1.2 - 0.1  # to be clipped
    path = tmp_path / f"a{suffix}"
    write_image(path, image)
    raw = np.asarray(Image.open(path)) if suffix == ".png" else tifffile.imread(path)
    assert raw.dtype == (np.uint8 if levels == 255 else np.uint16)
    clipped = np.clip(to_hwc(image), 0, 1)
    assert np.abs(raw / levels - linear_to_srgb(clipped)).max() <= 0.5001 / levels
    np.testing.assert_allclose(linear_to_srgb(to_hwc(read_image(path))), raw / levels, atol=2e-6)


@settings(deadline=None, max_examples=20)
@given(bits=st.sampled_from([8, 16]), start=st.integers(0, 2**16 - 256))
def test_every_srgb_level_survives_decoding_and_encoding(bits, start):
    levels = np.arange(256) if bits == 8 else np.arange(start, start + 256)
    linear = torch.from_numpy(srgb_to_linear(levels / (2**bits - 1))).float()
    encoded = encode_srgb(linear.expand(1, 3, 1, 256), bits)
    np.testing.assert_array_equal(encoded[0, :, 1], levels)


def test_exr_keeps_values_beyond_one(tmp_path):
    pytest.importorskip("OpenEXR")
    image = torch.randn(1, 3, 6, 5, generator=torch.Generator().manual_seed(0)) * 1e4
    write_image(tmp_path / "a.exr", image)
    torch.testing.assert_close(read_image(tmp_path / "a.exr"), image, rtol=0, atol=0)


def exr(path, **channels):
    openexr = pytest.importorskip("OpenEXR")
    header = {"compression": openexr.ZIP_COMPRESSION, "type": openexr.scanlineimage}
    with openexr.File(header, channels) as file:
        file.write(str(path))


def test_exr_channels(tmp_path):
    planes = {name: np.full((2, 3), i + 0.5, np.float32) for i, name in enumerate("RGBZY")}
    ones, path = np.ones((2, 3), np.float16), tmp_path / "a.exr"
    exr(path, **{name: planes[name] for name in "RGBZ"}, A=ones)
    assert read_image(path)[0, :, 0, 0].tolist() == [0.5, 1.5, 2.5]
    assert read_map(path, scale=2).unique().tolist() == [7.0]
    exr(path, Y=planes["Y"])
    assert read_image(path)[0, :, 0, 0].tolist() == [4.5, 4.5, 4.5]
    assert read_map(path).unique().tolist() == [4.5]
    exr(path, R=planes["R"], Y=planes["Y"])
    with pytest.raises(ValueError, match=r"channels R, Y; save R, G, B or a single channel"):
        read_image(path)
    exr(path, **{name: planes[name] for name in "RGB"}, A=ones * 0)
    with pytest.raises(ValueError, match="transparent"):
        read_image(path)


def test_without_openexr_the_extra_is_named(tmp_path, monkeypatch):
    real = builtins.__import__

    def fake(name, *args, **kwargs):
        if name == "OpenEXR":
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", fake)
    (tmp_path / "a.exr").write_bytes(b"")
    with pytest.raises(ValueError, match=r"a\.exr.*pip install 'torchbokeh\[exr\]'"):
        read_image(tmp_path / "a.exr")
    with pytest.raises(ValueError, match=r"b\.exr.*pip install 'torchbokeh\[exr\]'"):
        write_image(tmp_path / "b.exr", torch.zeros(1, 3, 2, 2))


def write_cmyk(path):
    Image.new("CMYK", (4, 4)).save(path)


def write_truncated(path):
    write_samples(path, samples(np.uint8 if path.stem == "eight" else np.uint16))
    path.write_bytes(path.read_bytes()[:70])


def write_inverted(path):
    tifffile.imwrite(path, np.zeros((2, 2), np.uint8), photometric="miniswhite")


BAD = [
    ("missing.png", None, "does not exist"),
    ("a.gif", lambda p: p.write_bytes(b"GIF89a"), r"cannot read \.gif; convert it to one of \.png"),
    ("noext", lambda p: p.write_bytes(b""), "cannot read no extension"),
    ("folder.png", lambda p: p.mkdir(), "is not a file"),
    ("a.png", lambda p: p.write_bytes(b"not a picture"), "cannot read it as PNG"),
    ("eight.png", write_truncated, "cannot read it as PNG"),
    ("sixteen.png", write_truncated, "cannot read it as PNG"),
    ("a.tif", lambda p: p.write_bytes(b"II*\0"), "cannot read it as TIF"),
    ("a.exr", lambda p: p.write_bytes(b"nope"), "cannot read it as EXR"),
    ("a.npy", lambda p: p.write_bytes(b"\x93NUMPY"), "cannot read it as NPY"),
    ("a.npy", lambda p: np.save(p, np.array([{}])), "cannot read it as NPY"),
    ("a.npy", lambda p: np.save(p, np.zeros((1, 1, 4, 4))), r"shape \(1, 1, 4, 4\); save numbers of shape"),
    ("a.npy", lambda p: np.save(p, np.zeros((0, 4))), r"shape \(0, 4, 1\); save numbers of shape"),
    ("a.npy", lambda p: np.save(p, np.zeros((4, 4), complex)), "holds complex128"),
    ("a.npy", lambda p: np.save(p, np.zeros((4, 4, 5))), "has 5 channels"),
    ("a.npy", lambda p: np.save(p, np.zeros((4, 4), np.int64)), "samples are int64"),
    ("a.npy", lambda p: np.save(p, np.full((4, 4), np.nan)), "NaN or infinite"),
    ("a.npy", lambda p: np.save(p, np.full((4, 4), 1e300)), "NaN or infinite"),
    ("a.pfm", lambda p: p.write_bytes(b"P5\n1 1\n1\n0"), "starts with 'P5'"),
    ("a.pfm", lambda p: p.write_bytes(b"Pf\n2 2\n-1\n" + b"\0" * 12), "promises 4 samples, but it holds 3"),
    ("a.pfm", lambda p: p.write_bytes(b"Pf\ntwo 2\n-1\n"), "cannot read it as PFM"),
    ("a.jpg", write_cmyk, "CMYK is not supported; save it as RGB"),
    ("a.png", lambda p: png16(p, samples(np.uint16, 2)), "16-bit grey with alpha is not supported"),
    ("a.tif", write_inverted, "its colours are MINISWHITE; save it as grey or RGB"),
]


@pytest.mark.parametrize(("name", "make", "message"), BAD)
def test_bad_files_are_named_in_one_line(tmp_path, name, make, message):
    if name.endswith(".exr"):
        pytest.importorskip("OpenEXR")
    path = tmp_path / name
    if make:
        make(path)
    with pytest.raises(ValueError, match=message) as caught:
        read_image(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("a.jpg", r"cannot write \.jpg; use one of \.png, \.tif, \.tiff, \.exr"),
        ("a", "cannot write a file without extension"),
        ("nowhere/a.png", "nowhere does not exist; create it first"),
        ("folder.png", "is a folder"),
    ],
)
def test_bad_outputs_are_named(tmp_path, name, message):
    (tmp_path / "folder.png").mkdir()
    with pytest.raises(ValueError, match=message):
        check_writable(tmp_path / name)
    with pytest.raises(ValueError, match=message):
        write_image(tmp_path / name, torch.zeros(1, 3, 2, 2))
    assert [p.name for p in tmp_path.iterdir()] == ["folder.png"]


def test_check_writable_tries_the_folder(tmp_path, monkeypatch):
    check_writable(tmp_path / "a.png")
    assert not list(tmp_path.iterdir())

    def refuse(*args, **kwargs):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("torchbokeh.ops.system.files.tempfile.TemporaryFile", refuse)
    with pytest.raises(ValueError, match=r"a\.png: cannot write there \(Permission denied\); choose another"):
        check_writable(tmp_path / "a.png")


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch):
    path = tmp_path / "a.png"
    write_image(path, torch.ones(1, 3, 2, 2))
    before = path.read_bytes()

    def fail(image, target):
        target.write_bytes(b"half")
        raise OSError("disk full")

    monkeypatch.setattr(Image.Image, "save", fail)
    with pytest.raises(OSError, match="disk full"):
        write_image(path, torch.zeros(1, 3, 2, 2))
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["a.png"]


def test_replacing_keeps_folder_and_extension(tmp_path):
    with replacing(tmp_path / "a.gif") as temporary:
        assert temporary.parent == tmp_path
        assert temporary.suffix == ".gif"
        temporary.write_text("new")
        assert not (tmp_path / "a.gif").exists()
    assert (tmp_path / "a.gif").read_text() == "new"
    assert os.listdir(tmp_path) == ["a.gif"]


@pytest.mark.parametrize(
    ("image", "error", "message"),
    [
        (torch.zeros(3, 2, 2), ValueError, r"image: expected shape \(1, 3, H, W\)"),
        (torch.zeros(1, 3, 2, 2, dtype=torch.uint8), TypeError, "image: expected a floating-point tensor"),
        (torch.full((1, 3, 2, 2), torch.nan), ValueError, "image: expected finite values"),
    ],
)
def test_write_image_checks_the_picture(tmp_path, image, error, message):
    with pytest.raises(error, match=message):
        write_image(tmp_path / "a.png", image)
    assert not list(tmp_path.iterdir())


def test_sample_map_is_the_median_of_what_is_finite():
    values = torch.arange(35.0).view(1, 1, 5, 7)
    assert sample_map(values, 3, 2) == 17.0
    values[0, 0, 2, 3] = torch.inf
    values[0, 0, 1, 1] = torch.nan
    known = [v for row in range(5) for v in values[0, 0, row, 1:6].tolist() if np.isfinite(v)]
    assert sample_map(values, 3, 2) == sorted(known)[(len(known) - 1) // 2]
    assert sample_map(values, 0, 0) == 8.0 - 1.0  # 0 1 2 7 9 14 15 16: the lower of the middle two
    for x, y in ((7, 0), (0, 5)):
        with pytest.raises(ValueError, match="lies outside the 7 x 5 map"):
            sample_map(values, x, y)
    with pytest.raises(ValueError, match="no finite value around pixel 1,0"):
        sample_map(torch.full((1, 1, 3, 3), torch.inf), 1, 0)
