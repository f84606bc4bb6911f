"""Image files: read pictures and depth maps as tensors, write pictures whole or not at all.

Integer samples are sRGB-encoded and are decoded to linear light; floating-point samples are linear already.
"""

import io
import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from torchbokeh.ops.checks import check_image, check_pixels
from torchbokeh.ops.system.files import check_place, replacing

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"

_DEFLATE = 1032
"""Bytes that one byte of a deflated file stands for, at most: a header that promises more is not to be believed."""


def read_image(path: str | Path) -> Tensor:
    """Read a picture as linear RGB.

    The extension decides: PNG, JPEG, TIFF (first page), EXR, NPY, PFM. 8- and 16-bit integers are sRGB and
    are decoded (IEC 61966-2-1); floating-point samples are taken as linear. Grey becomes three equal
    channels, the EXIF orientation is applied, and a fully opaque alpha channel is dropped.

    Args:
        path: an existing file.

    Returns:
        ``(1, 3, H, W)`` float32, linear radiance.

    Raises:
        ValueError: the file is missing, broken, of an unknown kind, transparent, or holds NaN or inf.

    Example:
        >>> image = read_image("photo.png")  # doctest: +SKIP
    """
    path = Path(path)
    pixels = _drop_opaque_alpha(path, _load(path))
    if pixels.shape[2] not in (1, 3):
        raise ValueError(f"{path}: has {pixels.shape[2]} channels; save it as grey or RGB")
    linear = _to_tensor(pixels)
    if pixels.dtype.kind == "u":
        from kornia.color import rgb_to_linear_rgb

        linear = rgb_to_linear_rgb(linear.expand(1, 3, -1, -1) / np.iinfo(pixels.dtype).max)
    elif pixels.dtype.kind != "f":
        raise ValueError(f"{path}: samples are {pixels.dtype}; save 8- or 16-bit unsigned integers or floats")
    if not torch.isfinite(linear).all():
        raise ValueError(f"{path}: has NaN or infinite pixels; repair them first")
    return linear.expand(1, 3, -1, -1).contiguous()


def read_map(path: str | Path, scale: float = 1.0) -> Tensor:
    """Read a depth or disparity map: the stored numbers, times ``scale``.

    Args:
        path: an existing PNG, JPEG, TIFF (first page), EXR (channel ``Z`` if there is one), NPY or PFM file.
            Several channels are accepted where all are equal.
        scale: factor on every sample, for example 0.001 for depth stored in millimetres.

    Returns:
        ``(1, 1, H, W)`` float32; NaN and inf are kept as they are.

    Raises:
        ValueError: the file is missing, broken, of an unknown kind, or its channels differ.

    Example:
        >>> depth = read_map("depth.png", scale=0.001)  # doctest: +SKIP
    """
    path = Path(path)
    values = _drop_opaque_alpha(path, _load(path, prefer="Z"))
    first = values[:, :, :1]
    if not np.array_equal(values, np.broadcast_to(first, values.shape), equal_nan=values.dtype.kind == "f"):
        raise ValueError(f"{path}: its {values.shape[2]} channels differ; save the map as one channel")
    # The product is taken in float64, so that a 32-bit integer does not lose digits before it is scaled.
    with np.errstate(over="ignore", invalid="ignore"):
        return _to_tensor(first.astype(np.float64) * scale)


def sample_map(values: Tensor, x: int, y: int) -> float:
    """What a depth or disparity map shows at a pixel: the median of the finite values in 5 x 5 pixels.

    Args:
        values: ``(1, 1, H, W)``.
        x: column, 0 at the left.
        y: row, 0 at the top.

    Returns:
        One number, in the map's unit.

    Raises:
        ValueError: the pixel lies outside the map, or nothing around it is finite.

    Example:
        >>> sample_map(torch.tensor([[[[2.0, 2.0, torch.inf]]]]), 2, 0)
        2.0
    """
    height, width = check_image("values", values, (1, 1, "H", "W")).shape[2:]
    if not (0 <= x < width and 0 <= y < height):
        raise ValueError(f"pixel {x},{y} lies outside the {width} x {height} map; x runs to the right, y down")
    window = values[0, 0, max(y - 2, 0) : y + 3, max(x - 2, 0) : x + 3]
    known = window[window.isfinite()]
    if not known.numel():
        raise ValueError(f"the map has no finite value around pixel {x},{y}; choose another pixel")
    return known.median().item()


def write_image(path: str | Path, image: Tensor) -> None:
    """Write a linear picture; the file appears complete or not at all.

    The extension decides: ``.png`` 8-bit sRGB and ``.tif``/``.tiff`` 16-bit sRGB, both clipped to [0, 1];
    ``.exr`` float32 linear, not clipped (needs the extra ``torchbokeh[exr]``).

    Args:
        path: where to write; its folder must exist.
        image: ``(1, 3, H, W)``, linear radiance, on any device.

    Raises:
        ValueError: unknown extension, a missing or read-only folder, a wrong shape, NaN or inf.

    Example:
        >>> write_image("grey.png", torch.full((1, 3, 4, 4), 0.18))  # doctest: +SKIP
    """
    path = Path(path)
    check_image("image", image, (1, 3, "H", "W"))
    if not torch.isfinite(image).all():
        raise ValueError("image: expected finite values, got NaN or inf")
    check_writable(path)
    linear = image.detach().to("cpu", torch.float32)
    with replacing(path) as temporary:
        _WRITERS[path.suffix.lower()](temporary, linear)


def check_writable(path: str | Path) -> None:
    """Check that :func:`write_image` can write ``path``, before the work is done.

    Args:
        path: the file to be written.

    Raises:
        ValueError: unknown extension, missing folder, no permission, or the extra for EXR is not installed.

    Example:
        >>> check_writable("picture.png")
    """
    path = Path(path)
    kind = path.suffix.lower()
    if kind not in _WRITERS:
        known = ", ".join(_WRITERS)
        raise ValueError(f"{path}: cannot write {kind or 'a file without extension'}; use one of {known}")
    if kind == ".exr":
        try:
            import OpenEXR  # noqa: F401
        except ImportError:
            raise ValueError(f"{path}: {_NEEDS_OPENEXR}") from None
    check_place(path)


def encode_srgb(image: Tensor, bits: int) -> np.ndarray:
    """Encode a linear picture as sRGB integers, clipped to [0, 1] and rounded to the nearest level.

    Args:
        image: ``(1, 3, H, W)`` linear radiance.
        bits: 8 or 16.

    Returns:
        ``(H, W, 3)`` uint8 or uint16.

    Example:
        >>> int(encode_srgb(torch.full((1, 3, 1, 1), 0.5), 8)[0, 0, 0])
        188
    """
    from kornia.color import linear_rgb_to_rgb

    top = 2**bits - 1
    levels = (linear_rgb_to_rgb(image.clamp(0, 1).double()) * top).round()[0].permute(1, 2, 0)
    return levels.cpu().numpy().astype(np.uint8 if bits == 8 else np.uint16)


def _to_tensor(pixels: np.ndarray) -> Tensor:
    """``(H, W, C)`` of any dtype and byte order -> ``(1, C, H, W)`` float32."""
    with np.errstate(over="ignore", invalid="ignore"):  # float64 beyond float32 becomes inf
        return torch.from_numpy(np.ascontiguousarray(pixels.transpose(2, 0, 1)[None], dtype=np.float32))


def _drop_opaque_alpha(path: Path, pixels: np.ndarray) -> np.ndarray:
    if pixels.shape[2] not in (2, 4):
        return pixels
    opaque = np.iinfo(pixels.dtype).max if pixels.dtype.kind in "ui" else 1
    if not (pixels[:, :, -1] >= opaque).all():
        raise ValueError(f"{path}: has transparent pixels; flatten it onto a background first")
    return pixels[:, :, :-1]


def read_npy(path: Path) -> np.ndarray:
    """The array in an NPY file, no element of which is a Python object.

    Raises:
        ValueError: the file is something else, or shorter than its header says.
    """
    found = np.load(path, mmap_mode="r", allow_pickle=False)  # mapped: a size that is a lie allocates nothing
    if not isinstance(found, np.ndarray):
        found.close()
        raise ValueError("it is an archive of arrays; save one array")
    return np.array(found)


def _check_claim(held: int, height: int, width: int, pixel_bits: int, expansion: int) -> None:
    """Refuse a header that promises more than ``held`` bytes can hold, before memory is asked for it."""
    check_pixels("size", height, width)
    if height * width * pixel_bits > 8 * held * expansion:
        raise ValueError(f"its header promises {width} x {height} pixels of {pixel_bits} bits, but it has {held} bytes")


def _load(path: Path, prefer: str = "") -> np.ndarray:
    """Decode a file into ``(H, W, C)`` samples as stored; ``prefer`` names an EXR channel to take alone."""
    kind = path.suffix.lower()
    if kind not in _READERS and kind != ".exr":
        known = ", ".join((*_READERS, ".exr"))
        raise ValueError(f"{path}: cannot read {kind or 'no extension'}; convert it to one of {known}")
    if not path.is_file():
        raise ValueError(f"{path}: {'is not a file' if path.exists() else 'does not exist'}; check the name")
    try:
        pixels = _read_exr(path, prefer) if kind == ".exr" else _READERS[kind](path)
    except Exception as error:  # decoders raise whatever they like on a broken file
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        hint = "" if isinstance(error, ValueError) else "; is the file whole, and what its name says?"
        raise ValueError(f"{path}: cannot read it as {kind[1:].upper()}: {reason}{hint}") from error
    if pixels.ndim == 2:
        pixels = pixels[:, :, None]
    if pixels.ndim != 3 or 0 in pixels.shape or pixels.dtype.kind not in "uif":
        expected = "save numbers of shape (H, W) or (H, W, C)"
        raise ValueError(f"{path}: holds {pixels.dtype} of shape {pixels.shape}; {expected}")
    return pixels


def _read_png_jpeg(path: Path) -> np.ndarray:
    from PIL import ImageOps
    from PIL.JpegImagePlugin import JpegImageFile
    from PIL.PngImagePlugin import PngImageFile

    data = path.read_bytes()  # a decoder that is told to read more than there is then gets no more
    is_png = data.startswith(_PNG_SIGNATURE)
    depth, colour = 8, 2
    if is_png and len(data) >= 26:
        width, height, depth, colour = struct.unpack_from(">IIBB", data, 16)
        _check_claim(len(data), height, width, depth * {2: 3, 4: 2, 6: 4}.get(colour, 1), _DEFLATE)
    if depth == 16 and colour in (2, 6):  # Pillow keeps 8 of the 16 bits of a colour PNG
        from kornia_rs.io import read_image_png_u16

        return np.asarray(read_image_png_u16(str(path), "rgb" if colour == 2 else "rgba"))
    # `Image.open` warns of pictures that `check_pixels` allows, and a filter of warnings is one of all threads.
    with PngImageFile(io.BytesIO(data)) if is_png else JpegImageFile(io.BytesIO(data)) as opened:
        if not is_png:  # a block of 8 x 8 samples takes at least a bit
            _check_claim(len(data), opened.height, opened.width, 8 * len(opened.getbands()), _DEFLATE)
        image = ImageOps.exif_transpose(opened)
        if depth == 16 and colour == 0:
            return np.asarray(image).astype(np.uint16)
        if depth == 16 or image.mode == "CMYK":
            what = "16-bit grey with alpha" if depth == 16 else "CMYK"
            raise ValueError(f"{what} is not supported; save it as RGB")
        if image.mode == "P" or "transparency" in image.info:
            image = image.convert("RGBA")
        elif image.mode == "1":
            image = image.convert("L")
        return np.asarray(image)


def _read_tiff(path: Path) -> np.ndarray:
    import tifffile

    with tifffile.TiffFile(path) as tiff:
        page = tiff.pages.first
        if page.photometric not in (tifffile.PHOTOMETRIC.MINISBLACK, tifffile.PHOTOMETRIC.RGB):
            raise ValueError(f"its colours are {page.photometric.name}; save it as grey or RGB")
        bits = page.bitspersample * page.samplesperpixel * page.imagedepth
        expansion = {1: 1, 8: _DEFLATE, 32946: _DEFLATE}.get(page.compression)  # of others only the number of pixels
        held = path.stat().st_size
        _check_claim(held, page.imagelength, page.imagewidth, bits if expansion else 0, expansion or 1)
        if sum(page.databytecounts) > held:
            raise ValueError(f"its header promises {sum(page.databytecounts)} bytes of data, but it has {held}")
        pixels = page.asarray()
        return np.moveaxis(pixels, 0, -1) if page.axes == "SYX" else pixels


_NEEDS_OPENEXR = "EXR files need the package OpenEXR 3.3 or newer; pip install 'torchbokeh[exr]'"


def _read_exr(path: Path, prefer: str) -> np.ndarray:
    try:
        import OpenEXR
    except ImportError:
        raise ValueError(_NEEDS_OPENEXR) from None
    with OpenEXR.File(str(path), header_only=True) as file:
        for part in file.parts:
            left, top, right, bottom = (int(n) for corner in part.header["dataWindow"] for n in corner)
            bits = 16 * len(part.header["channels"])
            _check_claim(path.stat().st_size, bottom - top + 1, right - left + 1, bits, _DEFLATE)
    with OpenEXR.File(str(path), separate_channels=True) as file:
        channels = {name: channel.pixels for name, channel in file.channels().items()}
    if prefer in channels:
        return channels[prefer]
    if {"R", "G", "B"} <= channels.keys():
        return np.stack([channels[name] for name in "RGBA" if name in channels], axis=-1)
    if len(channels) != 1:
        raise ValueError(f"it has the channels {', '.join(channels)}; save R, G, B or a single channel")
    return next(iter(channels.values()))


def _read_pfm(path: Path) -> np.ndarray:
    """Portable float map: three lines of header, then float32 rows from the bottom up."""
    with path.open("rb") as file:
        magic, size, scale = (file.readline(64).decode("ascii").strip() for _ in range(3))
        if magic not in ("Pf", "PF"):
            raise ValueError(f"it starts with {magic!r}, not with Pf or PF")
        width, height = (int(n) for n in size.split())
        order, channels = "<" if float(scale) < 0 else ">", 1 if magic == "Pf" else 3
        held = path.stat().st_size - file.tell()
        if width < 1 or height < 1 or held != 4 * height * width * channels:
            raise ValueError(f"its header promises {height * width * channels} samples, but it holds {held / 4:g}")
        check_pixels("size", height, width)
        return np.frombuffer(file.read(), f"{order}f4").reshape(height, width, channels)[::-1]


def _write_png(path: Path, linear: Tensor) -> None:
    from PIL import Image

    Image.fromarray(encode_srgb(linear, 8)).save(path)


def _write_tiff(path: Path, linear: Tensor) -> None:
    import tifffile

    tifffile.imwrite(path, encode_srgb(linear, 16), photometric="rgb", compression="zlib")


def _write_exr(path: Path, linear: Tensor) -> None:
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    rgb = np.ascontiguousarray(linear[0].permute(1, 2, 0).numpy())
    try:
        with OpenEXR.File(header, {"RGB": rgb}) as file:
            file.write(str(path))
    except RuntimeError as error:  # of a full disk too: 'Failed to ... "the file's name". No space left on device.'
        raise OSError(str(error).rpartition('". ')[2].rstrip(".")) from error


_READERS: dict[str, Callable[[Path], np.ndarray]] = {
    ".png": _read_png_jpeg,
    ".jpg": _read_png_jpeg,
    ".jpeg": _read_png_jpeg,
    ".tif": _read_tiff,
    ".tiff": _read_tiff,
    ".npy": read_npy,
    ".pfm": _read_pfm,
}
_WRITERS: dict[str, Callable[[Path, Tensor], None]] = {
    ".png": _write_png,
    ".tif": _write_tiff,
    ".tiff": _write_tiff,
    ".exr": _write_exr,
}
