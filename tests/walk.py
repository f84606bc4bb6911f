"""The walk from `LensBlur.forward` to a kernel: how many functions a reader passes through, and in how many files.

``python -P tests/walk.py`` prints it. A walk is a chain of calls that ends where a function of `torchbokeh.ops.kernels`
is entered from outside of it; comprehensions are part of the function that they stand in.
"""

import sys
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import NamedTuple

import torch

import torchbokeh as tb
from torchbokeh.ops import checks

QUALITIES = ("exact", "high", "balanced", "fast")

PARTS = {
    "torchbokeh": Path(tb.__file__).parent,
    "ops": Path(checks.__file__).parent,
    "psfs": Path(tb.psfs.__file__).parent,
}

KERNELS = str(PARTS["ops"] / "kernels")


class Walk(NamedTuple):
    """What a forward pass goes through.

    Attributes:
        chain: the functions of the longest chain of calls to a kernel, with their files.
        files: those of all chains.
        ran: all files of which any function ran.
    """

    chain: list[tuple[str, str]]
    files: set[str]
    ran: set[str]


def own(frame: FrameType) -> bool:
    name = frame.f_code.co_filename
    return any(name.startswith(f"{folder}/") for folder in PARTS.values()) and "/.venv/" not in name


def walk(call: Callable[[], object]) -> Walk:
    """Run ``call`` and follow it."""
    chain: list[tuple[str, str]] = []
    files: set[str] = set()
    ran: set[str] = set()

    def follow(frame: FrameType, event: str, arg: object) -> None:
        nonlocal chain
        if event != "call" or not own(frame):
            return
        name = frame.f_code.co_filename
        ran.add(name)
        if not name.startswith(KERNELS):
            return
        here: list[tuple[str, str]] = []
        at: FrameType | None = frame
        while at is not None:
            if own(at) and not at.f_code.co_name.startswith("<"):
                here.append((at.f_code.co_filename, at.f_code.co_name))
            at = at.f_back
        if len(here) == 1 or any(file.startswith(KERNELS) for file, _ in here[1:]):
            return  # within a kernel; compiled ones do not even know who called them
        files.update(file for file, _ in here)
        if len(here) > len(chain):
            chain = here[::-1]

    sys.setprofile(follow)
    try:
        call()
    finally:
        sys.setprofile(None)
    return Walk(chain, files, ran)


def walks(quality: str) -> dict[str, Walk]:
    """Those of a picture with a foreground, plain, with dispersion, with motion and with both."""
    g = torch.Generator().manual_seed(0)
    image = torch.rand(1, 3, 80, 120, generator=g)
    image[..., 40, 60] = 500.0
    depth = torch.linspace(1.4, 9, 120).expand(1, 1, 80, 120).contiguous()
    motion = 9 * torch.rand(1, 2, 80, 120, generator=g)
    plain = tb.ThinLens(0.05, 1.8, 2.0, 0.004)
    coloured = tb.ThinLens(0.05, 1.8, 2.0, 0.004, dispersion=tb.Dispersion("BK7", 0.05, 0.05))
    found = {}
    for name, lens, maps in (
        ("plain", plain, {}),
        ("dispersion", coloured, {}),
        ("motion", plain, {"motion": motion}),
        ("motion and dispersion", coloured, {"motion": motion}),
    ):
        blur = tb.LensBlur(lens, quality=quality)
        with torch.no_grad():
            blur(image, depth, **maps)  # banks are loaded once
            found[name] = walk(lambda blur=blur, maps=maps: blur(image, depth, **maps))
    return found


def main() -> None:
    for quality in QUALITIES:
        for name, found in walks(quality).items():
            print(
                f"{quality}, {name}: {len(found.chain)} functions, {len(found.files)} files on the way, "
                f"{len(found.ran)} in all"
            )
            print("   ", " -> ".join(f"{Path(file).stem}.{function}" for file, function in found.chain))


if __name__ == "__main__":
    main()
