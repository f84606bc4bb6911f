"""Exported files: their size, their error and their run time in onnxruntime beside eager mode."""

import statistics
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import torch
from torch import Tensor

import torchbokeh
from torchbokeh.ops.dispatch import definitions_only
from torchbokeh.report.experiment import Experiment
from torchbokeh.report.internals import OPSET
from torchbokeh.report.markdown import row_table, section
from torchbokeh.report.measure import Work, by_turns, work_seconds
from torchbokeh.report.rows import Row, Say
from torchbokeh.report.scenes import photo
from torchbokeh.report.settings import Settings

NEEDED = ("onnx", "onnxscript", "onnxruntime")
PYRAMID = "PyramidIntegrator"


def can_export() -> bool:
    """Whether the extra ``export`` is installed."""
    return all(find_spec(name) is not None for name in NEEDED)


def exported(settings: Settings, say: Say) -> list[Row]:
    """Files of the whole `LensBlur` and of the integration network at several sizes, beside eager mode.

    Returns:
        Rows with ``method``, ``size``, ``opset``, ``bytes`` of the file, ``export_seconds``, ``error`` (the largest
        against eager mode with kernels, relative to the largest value), and medians of ``file_seconds``,
        ``torch_seconds`` (the torch definitions, which are what is exported) and ``kernel_seconds``. None without the
        extra ``export``.
    """
    if not can_export():
        return []
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for name in (*settings.export_qualities, PYRAMID):
            say(f"export: {name}")
            rows += _rows(name, Path(folder) / f"{name}.onnx", settings)
    return rows


def _rows(name: str, path: Path, settings: Settings) -> list[Row]:
    pictures = {size: photo(size, settings.sweep_radius) for size in settings.export_sizes}
    first = pictures[max(pictures)]
    inputs: dict[int, tuple[Tensor, ...]]
    start = time.perf_counter()
    if name == PYRAMID:
        label, pyramid = PYRAMID, torchbokeh.PyramidIntegrator(levels=13)
        inputs = {size: (pyramid.differentiate(seen.image),) for size, seen in pictures.items()}
        eager = {size: partial(pyramid, *given) for size, given in inputs.items()}
        torchbokeh.export_onnx(pyramid, path, *inputs[max(pictures)])
    else:
        label, blur = f"LensBlur {name}", torchbokeh.LensBlur(quality=name)
        plan = blur.plan(first.image, coc=first.coc)
        inputs = {size: (seen.image, seen.coc) for size, seen in pictures.items()}
        eager = {
            size: partial(blur, seen.image, coc=seen.coc, plan=replace(plan, size=(size, size)))
            for size, seen in pictures.items()
        }
        torchbokeh.export_onnx(blur, path, first.image, first.coc, plan=plan)
    about = {
        "method": label,
        "opset": OPSET,
        "bytes": path.stat().st_size,
        "export_seconds": time.perf_counter() - start,
    }
    return [
        {**about, "size": size, **_compare(_session(path, inputs[size]), eager[size], settings)} for size in pictures
    ]


def _compare(run: Work, eager: Work, settings: Settings) -> Row:
    works: dict[str, Work] = {"file": run, "torch": partial(_defined, eager), "kernel": eager}
    with torch.no_grad():
        found, _, wanted = (work() for work in works.values())
        error = ((found - wanted).abs().max() / wanted.abs().max()).item()
        times = by_turns(
            {key: partial(work_seconds, work) for key, work in works.items()}, settings.repeat, settings.budget
        )
    medians = {f"{key}_seconds": statistics.median(s for (s,) in runs) for key, runs in times.items()}
    return {"error": error, **medians}


def _session(path: Path, given: Sequence[Tensor]) -> Work:
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = torch.get_num_threads()
    options.log_severity_level = 3
    session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    feed = {at.name: value.numpy() for at, value in zip(session.get_inputs(), given, strict=True)}
    return lambda: torch.from_numpy(session.run(None, feed)[0])


def _defined(work: Work) -> Tensor:
    with definitions_only():
        return work()


def export_section(rows: list[Row], settings: Row, plots: Sequence[str]) -> str:
    """The rows of `exported` as a section of ``report.md``."""
    about = (
        f"photo with radii up to {settings['sweep_radius']:g} px, as a whole LensBlur, and its Laplacian through the "
        "integration network. One file runs at all sizes. *Error*: the largest against eager mode, relative to the "
        "largest value. Seconds in onnxruntime, in eager mode by the torch definitions, which are what is exported, "
        "and in eager mode as it comes, with kernels; *of torch*: onnxruntime over the torch definitions."
    )
    rows = [{**r, "kB": r["bytes"] / 1e3, "of_torch": r["file_seconds"] / r["torch_seconds"]} for r in rows]
    header = "method | opset | kB | size | error | onnxruntime | torch | kernels | of torch"
    cells = "{method} | {opset} | {kB:.0f} | {size} | {error:.1e} | {file_seconds:t} | {torch_seconds:t} | "
    cells += "{kernel_seconds:t} | {of_torch:.2f}"
    return section("Exported files", about, row_table(rows, header, cells))


EXPORT = Experiment("export", exported, export_section)
