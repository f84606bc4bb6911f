"""Export for inference: a blur, or the integration network, as an ONNX file that runs without torch."""

import logging
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from copy import copy
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor, nn

from torchbokeh.learn.integration import FFTIntegrator, Integrator, PyramidIntegrator
from torchbokeh.lens import DisparityLens, ThinLens
from torchbokeh.ops.checks import check_image
from torchbokeh.ops.dispatch import definitions_only
from torchbokeh.ops.system.files import replacing
from torchbokeh.plan.plan import Plan, SplattingPlan
from torchbokeh.renderers.kernel_splatting import KernelSplatting
from torchbokeh.renderers.lens_blur import LensBlur
from torchbokeh.renderers.planned import AnyPlan, Planned

if TYPE_CHECKING:
    from onnx import ModelProto

OPSET = 18
"""Version of the standard operators in the file."""

INPUTS = {ThinLens: ("focus_distance", "f_number"), DisparityLens: ("strength", "focus_disparity")}
"""Parameters of a lens that stay inputs of the exported file."""

_SIZE = (3, 67, 83)
"""Batch, height and width that are traced: none is a multiple of anything, so that nothing of the kind is built in."""


def export_onnx(module: nn.Module, path: str | Path, *inputs: Tensor, plan: Plan | SplattingPlan | None = None) -> Path:
    """Write a module as an ONNX file of standard operators, for any batch, height and width.

    The inputs of the file have the names and the order of those of ``forward``; after them come the focus distance and
    the f-number of the lens (strength and focus disparity of a `DisparityLens`), so that one file serves for every
    focus. What the plan says is fixed: which surfaces there are, their bins, and how far pixels are merged. So give a
    scene like those to come, with something before and something behind the focus. Radii have no limit.

    Args:
        module: a `LensBlur`, a `KernelSplatting` without bank, a `PyramidIntegrator`, which gets the levels of the size
            of ``inputs`` where it has no number of its own, or a `ScanlineIntegrator`. Not an `FFTIntegrator`: other
            runtimes transform slowly, and one size only.
        path: of the file. It is there when it is whole.
        inputs: an example of what is passed to the module, float32: image and depth (image and CoC where there is no
            lens), or a buffer. Beside the plan, nothing depends on their values or size.
        plan: a plan made earlier, in place of the one for ``inputs``.

    Returns:
        The path.

    Raises:
        ImportError: the extra ``export`` is not installed.
        TypeError: ``module`` is none of these, or another argument is of the wrong kind.
        ValueError: an input does not fit, or the plan has what is not exported, dispersion, or leaves the blur out.
        OSError: the file cannot be written.

    Example:
        >>> import torch, torchbokeh as tb
        >>> blur = tb.LensBlur(tb.ThinLens(0.050, 1.8, focus_distance=2.0, sensor_width=0.036))
        >>> image, depth = torch.rand(1, 3, 64, 96), torch.linspace(1, 8, 96).expand(1, 1, 64, 96)
        >>> export_onnx(blur, "blur.onnx", image, depth)  # doctest: +SKIP
        PosixPath('blur.onnx')
    """
    for k, given in enumerate(inputs):
        if not isinstance(given, Tensor):
            raise TypeError(f"inputs[{k}]: expected a tensor, got {type(given).__name__}")
        if given.dtype != torch.float32:
            raise ValueError(f"inputs[{k}]: expected float32, got {given.dtype}")
    if isinstance(module, Integrator) and not isinstance(module, FFTIntegrator):
        traced = _integrator(module, inputs, plan)
    elif isinstance(module, LensBlur | KernelSplatting):
        traced = _renderer(module, inputs, plan)
    else:
        kinds = "a LensBlur, a KernelSplatting, a PyramidIntegrator or a ScanlineIntegrator"
        raise TypeError(f"module: expected {kinds}, got {type(module).__name__}")
    missing = [name for name in ("onnx", "onnxscript") if find_spec(name) is None]
    if missing:
        raise ImportError(f"exporting needs {' and '.join(missing)}: pip install torchbokeh[export]")
    model = _translated(traced)
    with replacing(path) as temporary:
        temporary.write_bytes(model.SerializeToString())
    return Path(path)


class _Traced(NamedTuple):
    """A module, what it is called with, how that and what it returns are named in the file, and px that it cuts off."""

    module: nn.Module
    inputs: tuple[Tensor, ...]
    names: tuple[str, ...]
    result: str
    margin: int = 0


class _Call(nn.Module):
    """A module as a function of its inputs and, after those, of parameters of its lens."""

    def __init__(self, module: nn.Module, names: Sequence[str] = (), map_name: str = "") -> None:
        super().__init__()
        self.module, self.names, self.map_name = module, names, map_name

    def forward(self, *given: Tensor) -> Tensor:
        count = len(given) - len(self.names)
        first, maps = given[:1], dict(zip([self.map_name], given[1:count], strict=False))
        lens = {f"renderer.lens.{name}": value for name, value in zip(self.names, given[count:], strict=True)}
        return torch.func.functional_call(self.module, lens, first, maps)


def _integrator(module: Integrator, inputs: tuple[Tensor, ...], plan: object) -> _Traced:
    if plan is not None:
        raise ValueError(f"plan: expected None for an integrator, got {type(plan).__name__}")
    if len(inputs) != 1:
        raise ValueError(f"inputs: expected a buffer, got {len(inputs)} tensors")
    check_image("inputs[0]", inputs[0], ("B", "C", "H", "W"))
    if isinstance(module, PyramidIntegrator) and module.levels is None:
        module = copy(module)
        module.levels = (max(*inputs[0].shape[-2:], 1) - 1).bit_length() + 1
    return _Traced(_Call(module), inputs, ("buffer",), "image")


def _renderer(module: LensBlur | KernelSplatting, inputs: tuple[Tensor, ...], plan: object) -> _Traced:
    if len(inputs) != 2:
        raise ValueError(f"inputs: expected an image and its depth or CoC, got {len(inputs)} tensors")
    if isinstance(module, KernelSplatting) and module.bank is not None:
        raise ValueError("module: expected a KernelSplatting without a bank, got one with a bank")
    lens, margin = (module.lens, module.margin) if isinstance(module, LensBlur) else (None, 0)
    name = "coc" if lens is None else "depth"
    request = module.request(inputs[0], **{name: inputs[1]})
    found: AnyPlan = module.decide(request)
    if plan is not None and not isinstance(plan, type(found)):
        raise TypeError(f"plan: expected a {type(found).__name__} or None, got {type(plan).__name__}")
    found = found if plan is None else plan
    if found.sharp or found.uniform is not None:
        raise ValueError("plan: expected one of a scene whose blur varies, got one that leaves the splatting out")
    if isinstance(found, Plan) and (found.colours or found.moves):
        raise ValueError("plan: expected one without dispersion and motion, which are not exported, got one with them")
    found.check(request)
    names = next((given for kind, given in INPUTS.items() if isinstance(lens, kind)), ())
    values = (getattr(lens, parameter).detach() for parameter in names)
    call = _Call(Planned(module, found), names, name)
    return _Traced(call, (*inputs, *values), ("image", name, *names), "blurred", margin)


def _translated(traced: _Traced) -> "ModelProto":
    """The module as a model, by way of `torch.export`."""
    import onnx
    from torch.export import Dim

    from torchbokeh.ops import onnx_functions as _onnx

    arguments, open_sizes = [], []
    for given in traced.inputs:
        # A map, the value of every picture in a batch, or one for all.
        dims = (0, given.dim() - 2, given.dim() - 1) if given.dim() > 1 else (0,) * given.dim()
        sizes = list(given.shape)
        for dim, size, cut in zip(dims, _SIZE, (0, traced.margin, traced.margin), strict=False):
            sizes[dim] = size + 2 * cut
        arguments.append(given.new_ones(sizes))
        open_sizes.append(dict.fromkeys(dims, Dim.DYNAMIC) or None)
    with _quiet(), torch.no_grad(), definitions_only():
        program = torch.export.export(
            traced.module, tuple(arguments), dynamic_shapes={"given": tuple(open_sizes)}, strict=False
        )
        exported = torch.onnx.export(
            program,
            dynamo=True,
            optimize=False,  # its optimizer takes longer than all the rest, and has dropped accumulations
            opset_version=OPSET,
            input_names=traced.names,
            output_names=[traced.result],
            custom_translation_table=_onnx.translations(),
            verbose=False,
        )
    if exported is None:
        raise RuntimeError("torch.onnx.export returned nothing")
    model = exported.model_proto
    model.functions.extend(_onnx.functions())
    _tidy(model)
    onnx.checker.check_model(model)
    return model


def _tidy(model: "ModelProto") -> None:
    """Leave out traces of where the operators come from, and name the open sizes."""
    del model.graph.value_info[:]
    for node in model.graph.node:
        del node.metadata_props[:]
    places = ("batch", "height", "width")
    names: dict[str, str] = {}
    for value in [*model.graph.input, *model.graph.output]:
        dims = [d for d in value.type.tensor_type.shape.dim if d.dim_param]
        for d, place in zip(dims, places, strict=False):
            d.dim_param = names.setdefault(d.dim_param, place)


@contextmanager
def _quiet() -> Iterator[None]:
    """Without the exporter's warnings about itself."""
    logger = logging.getLogger("torch.onnx")
    level = logger.level
    logger.setLevel(logging.ERROR)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            yield
        finally:
            logger.setLevel(level)
