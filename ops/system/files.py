"""Files that are there whole, or not at all."""

import os
import secrets
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Yield a temporary name beside ``path`` that becomes ``path`` when the block ends without an error.

    Args:
        path: the file to be written or replaced.

    Yields:
        A path in the same folder with the same extension; on an error it is removed and ``path`` kept.

    Raises:
        OSError: the block raised one; the message names ``path``, which what writers of formats raise does not.

    Example:
        >>> with replacing("notes.txt") as temporary:  # doctest: +SKIP
        ...     temporary.write_text("whole or not at all")
    """
    path = Path(path)
    temporary = path.with_name(f".torchbokeh-{secrets.token_hex(6)}{path.suffix}")
    try:
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        raise OSError(f"{path}: cannot be written ({error.strerror or error})") from error
    finally:
        temporary.unlink(missing_ok=True)


@contextmanager
def replacing_together(folder: Path, last: str) -> Iterator[Path]:
    """Yield a temporary folder whose files move into ``folder`` when the block ends without an error.

    Args:
        folder: an existing folder; files of the same names are replaced.
        last: the one of the files that speaks of the others. It moves last, and while others move there is none of
            this name: whenever it is there, so is what it speaks of.

    Raises:
        OSError: the block raised one, or a file cannot be moved; the message names ``folder``.

    Example:
        >>> with replacing_together(Path("."), "all.md") as temporary:  # doctest: +SKIP
        ...     (temporary / "plot.png").write_bytes(b"...")
        ...     (temporary / "all.md").write_text("![plot](plot.png)")
    """
    try:
        with tempfile.TemporaryDirectory(prefix=".torchbokeh-", dir=folder) as made:
            yield Path(made)
            (folder / last).unlink(missing_ok=True)
            for name in sorted(os.listdir(made), key=last.__eq__):
                os.replace(Path(made, name), folder / name)
    except OSError as error:
        raise OSError(f"{folder}: cannot be written ({error.strerror or error})") from error


def check_place(path: Path) -> None:
    """Raise a ValueError where no file can be written under a name, before there is anything to write."""
    if path.is_dir():
        raise ValueError(f"{path}: is a folder; name a file in it")
    if not path.parent.is_dir():
        raise ValueError(f"{path}: the folder {path.parent} does not exist; create it first")
    try:  # a real file: permission bits say nothing of read-only file systems
        tempfile.TemporaryFile(dir=path.parent).close()
    except OSError as error:
        raise ValueError(f"{path}: cannot write there ({error.strerror}); choose another folder") from None


def make_folder(path: Path) -> None:
    """Make a folder where it is missing, and those that it lies in; raise a ValueError where that cannot be done."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"{path}: cannot be made a folder ({error.strerror}); choose another") from None
