"""Sheets of pictures at full size, each under its name."""

from collections.abc import Sequence
from pathlib import Path

from torch import Tensor

from torchbokeh.io.pictures import check_writable, encode_srgb, replacing


def write_sheet(path: Path, pictures: Sequence[tuple[str, Tensor]], columns: int = 4) -> None:
    """Write pictures of one size, captions above them.

    Args:
        path: of the sheet; its ending says the format.
        pictures: pairs of a caption and a picture ``(1, 3, H, W)``, linear.
        columns: pictures in a row.

    Raises:
        ValueError: there is no picture, their sizes differ, or the file cannot be written.

    Example:
        >>> import tempfile, torch
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_sheet(Path(folder) / "sheet.png", [("grey", torch.full((1, 3, 32, 48), 0.5))])
    """
    from PIL import Image, ImageDraw, ImageFont

    sizes = {tuple(picture.shape[2:]) for _, picture in pictures}
    if len(sizes) != 1:
        raise ValueError(f"pictures: expected some of one size, got sizes {sorted(sizes)}")
    check_writable(path)
    height, width = sizes.pop()
    text = max(8, width // 26)
    font = ImageFont.load_default(text)
    across, down = min(columns, len(pictures)), -(-len(pictures) // columns)
    sheet = Image.new("RGB", (across * width, down * (height + 2 * text)), "white")
    draw = ImageDraw.Draw(sheet)
    for number, (caption, picture) in enumerate(pictures):
        x, y = number % columns * width, number // columns * (height + 2 * text)
        draw.text((x + text // 2, y + text // 3), caption, "black", font)
        sheet.paste(Image.fromarray(encode_srgb(picture, 8)), (x, y + 2 * text))
    with replacing(path) as temporary:
        sheet.save(temporary)
