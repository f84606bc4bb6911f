"""torchbokeh: the look of a real camera, for PyTorch.

An image and its depth go in, the picture a lens would take comes out. `LensBlur` is the front door.
"""

from importlib.util import find_spec as _find_spec

from torchbokeh.commands.signals import end_while_importing as _end_while_importing
from torchbokeh.commands.signals import is_command as _is_command

if _is_command():
    _end_while_importing()
if _find_spec("torchbokeh.ops") is None or _find_spec("torchbokeh.psfs") is None:
    raise ImportError(
        "torchbokeh was imported from a source folder without its parts torchbokeh.ops and torchbokeh.psfs; "
        "install it with `pip install -e .`, start Python in another folder, or use the command `torchbokeh`"
    )

from torchbokeh import scenes
from torchbokeh.learn.export import export_onnx
from torchbokeh.learn.integration import FFTIntegrator, PyramidIntegrator, ScanlineIntegrator
from torchbokeh.lens import DisparityLens, Lens, ThinLens
from torchbokeh.lens.dispersion import Dispersion
from torchbokeh.lens.field_map import FieldMap
from torchbokeh.plan.plan import Plan
from torchbokeh.psfs import Aperture, Disc, Ellipse, Polygon, PsfBank
from torchbokeh.renderers.accumulation import AccumulationBuffer
from torchbokeh.renderers.chromatic import ChromaticAccumulation
from torchbokeh.renderers.kernel_splatting import KernelSplatting, SplattingPlan
from torchbokeh.renderers.lens_blur import LensBlur
from torchbokeh.renderers.reconstruction import Samples, pinhole_position, reconstruct

__version__ = "0.1.0"

__all__ = [
    "AccumulationBuffer",
    "Aperture",
    "ChromaticAccumulation",
    "Disc",
    "DisparityLens",
    "Dispersion",
    "Ellipse",
    "FFTIntegrator",
    "FieldMap",
    "KernelSplatting",
    "Lens",
    "LensBlur",
    "Plan",
    "Polygon",
    "PsfBank",
    "PyramidIntegrator",
    "Samples",
    "ScanlineIntegrator",
    "SplattingPlan",
    "ThinLens",
    "export_onnx",
    "pinhole_position",
    "reconstruct",
    "scenes",
]
