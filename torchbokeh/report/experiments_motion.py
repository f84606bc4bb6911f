"""Defocus with motion on one layer: splats from the bank beside a dense scatter of every capsule."""

from functools import partial

import torch
from torch import Tensor

import torchbokeh
from torchbokeh.ops._dispatch import numba_is_there
from torchbokeh.psfs import PsfBank
from torchbokeh.report.experiments import Row, Say
from torchbokeh.report.measure import Work, errors, measure
from torchbokeh.report.methods import QUALITIES
from torchbokeh.report.scenes import photo
from torchbokeh.report.settings import Settings

DENSE = "dense scatter of capsules"


def spinning(size: int, longest: float) -> Tensor:
    """Motion ``(1, 2, size, size)`` about a place beside the centre, up to a length in px at the farthest corner."""
    at = torch.linspace(-1, 1, size)
    y, x = torch.meshgrid(at - 0.2, at + 0.1, indexing="ij")
    motion = torch.stack([-y, x])[None]
    return motion * (longest / motion.norm(dim=1).max())


def with_motion(settings: Settings, say: Say) -> list[Row]:
    """Error and run time of `KernelSplatting` with the bank of `Combined`, for every quality.

    The photograph turns about a place beside its centre. The reference is the dense scatter itself, which draws every
    pixel's own capsule. Nothing without numba, with which that is compiled.
    """
    if not numba_is_there():
        return []
    from torchbokeh.report.capsules import dense_capsules

    bank = PsfBank.load("combined")
    rows: list[Row] = []
    for radius, longest in settings.motions:
        say(f"defocus with motion: radius {radius:g} px, motion {longest:g} px")
        seen, motion = photo(settings.motion_size, radius), spinning(settings.motion_size, longest)
        works: dict[str, Work] = {DENSE: partial(dense_capsules, seen.image, seen.coc, motion)}
        for quality in QUALITIES:
            for interpolate in (False, True) if quality == "exact" else (False,):
                name = f"bank, {quality}" + (", interpolated" if interpolate else "")
                blur = torchbokeh.KernelSplatting(bank=bank, quality=quality, interpolate=interpolate)
                works[name] = partial(blur, seen.image, seen.coc, motion=motion)
        timings = measure(works, settings.repeat, settings.sweep_budget)
        dense = timings[DENSE]
        for name, timing in timings.items():
            row = {"radius": radius, "longest": longest, "size": settings.motion_size, "method": name, **timing.row}
            row["times_dense"] = dense.row["seconds"] / timing.row["seconds"]
            rows.append(row | errors(timing.result, dense.result))
    return rows
