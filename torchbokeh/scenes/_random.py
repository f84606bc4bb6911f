"""Seeds: the same key gives the same numbers in every process, and settings are given or drawn."""

import hashlib

import numpy as np

from torchbokeh.ops.checks import check_count, check_number, is_whole


def rng(seed: int, *keys: int | str) -> np.random.Generator:
    """A generator of its own for a seed and any further keys.

    Streams of different keys are independent, so that a setting drawn from one never shifts the next, and
    nothing depends on the process, the thread or Python's randomised ``hash``.

    Args:
        seed: an integer >= 0, however large.
        keys: integers or strings that name what is drawn.

    Returns:
        A ``numpy.random.Generator``. Its bits are the same everywhere; NumPy promises the numbers made of
        them for one version of NumPy.

    Raises:
        TypeError: ``seed`` is not an integer, or a key is neither an integer nor a string.
        ValueError: ``seed`` is negative.

    Example:
        >>> rng(7, "noise").integers(100) == rng(7, "noise").integers(100)
        np.True_
    """
    if not is_whole(seed):
        raise TypeError(f"seed: expected an int, got {type(seed).__name__}")
    if seed < 0:
        raise ValueError(f"seed: expected 0 or more, got {seed}")
    for key in keys:
        if not is_whole(key) and not isinstance(key, str):
            raise TypeError(f"keys: expected ints and strings, got {type(key).__name__}")
    # A digest of the written key: `SeedSequence` alone takes (1, 2) and (1 + 2 * 2**32,) for the same.
    written = ascii([str(key) if isinstance(key, str) else int(key) for key in (seed, *keys)])
    digest = hashlib.blake2b(written.encode(), digest_size=16).digest()
    return np.random.Generator(np.random.Philox(key=int.from_bytes(digest, "little")))


def setting(name: str, value: float | None, drawn: float, low: float, high: float) -> float:
    """The setting ``value`` that the caller gave, checked as by `check_number`, or ``drawn`` where it is None.

    Example:
        >>> setting("warp", None, 0.5, 0, 2), setting("warp", 1, 0.5, 0, 2)
        (0.5, 1.0)
    """
    return float(drawn) if value is None else check_number(name, value, low, high)


def count_setting(name: str, value: int | None, drawn: int | np.integer, low: int, high: int) -> int:
    """As :func:`setting`, for a whole number, checked as by `check_count`.

    Example:
        >>> count_setting("teeth", None, 12, 3, 64)
        12
    """
    return int(drawn) if value is None else check_count(name, value, low, high)
