import doctest
import os
import subprocess
import sys

import numpy as np
import pytest

import torchbokeh.scenes._random
from torchbokeh.scenes._random import count_setting, rng, setting


def test_the_numbers_of_a_key_never_change() -> None:
    # Written down once: a data set must be the same on every machine. Raw bits, which no version of NumPy changes.
    assert rng(0).bit_generator.random_raw(2).tolist() == [17514667841123299542, 2580431761963045723]
    assert rng(7, "noise", 3).bit_generator.random_raw(2).tolist() == [2545937310135975126, 8864520319147797140]


def test_a_fresh_process_draws_the_same() -> None:
    code = "from torchbokeh.scenes._random import rng; print(rng(7, 'noise', 3).uniform())"
    outputs = [
        subprocess.run(
            [sys.executable, "-c", code],
            env={**os.environ, "PYTHONHASHSEED": h},
            capture_output=True,
            text=True,
            check=True,
        )
        for h in ("1", "2")
    ]
    assert {float(out.stdout) for out in outputs} == {rng(7, "noise", 3).uniform()}


def test_every_key_has_its_own_stream() -> None:
    keys: list[tuple[int | str, ...]] = [
        (1,),
        (1, 2),
        (12,),
        (1 + 2 * 2**32,),
        (2**70,),
        (1, "2"),
        (1, "a", "b"),
        (1, "ab"),
        (1, "a', 'b"),
        (1, ""),
        (1, "ä"),
        (1, "\ud800"),
        (1, -2),
    ]
    assert len({rng(int(key[0]), *key[1:]).bit_generator.random_raw() for key in keys}) == len(keys)


def test_numpy_integers_and_strings_are_the_same_keys() -> None:
    assert rng(np.int64(5), np.str_("a"), np.uint8(2)).uniform() == rng(5, "a", 2).uniform()


def test_bad_keys_are_named() -> None:
    with pytest.raises(TypeError, match="seed: expected an int, got float"):
        rng(1.0)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="seed: expected an int, got bool"):
        rng(True)
    with pytest.raises(ValueError, match="seed: expected 0 or more, got -1"):
        rng(-1)
    with pytest.raises(TypeError, match="keys: expected ints and strings, got NoneType"):
        rng(1, None)  # type: ignore[arg-type]


def test_settings() -> None:
    assert setting("warp", None, 9.0, 0, 1) == 9.0
    assert setting("warp", np.float32(0.5), 9.0, 0, 1) == 0.5
    assert count_setting("teeth", None, 5, 0, 1) == 5
    assert count_setting("teeth", np.int64(1), 5, 0, 1) == 1
    for bad in (2.0, float("nan"), -1):
        with pytest.raises(ValueError, match="warp: expected a number from 0 to 1, got"):
            setting("warp", bad, 0.0, 0, 1)
    for wrong in ("1", True):
        with pytest.raises(TypeError, match="warp: expected a number, got"):
            setting("warp", wrong, 0.0, 0, 1)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="teeth: expected 3 to 64, got 2"):
        count_setting("teeth", 2, 5, 3, 64)
    with pytest.raises(TypeError, match="teeth: expected an int, got float"):
        count_setting("teeth", 5.0, 5, 3, 64)  # type: ignore[arg-type]


def test_examples() -> None:
    assert doctest.testmod(torchbokeh.scenes._random).failed == 0
