"""torchbokeh: the look of a real camera, for PyTorch."""

from importlib.util import find_spec as _find_spec

if _find_spec("torchbokeh.ops") is None or _find_spec("torchbokeh.psfs") is None:
    raise ImportError(
        "torchbokeh was imported from a source folder without its parts torchbokeh.ops and torchbokeh.psfs; "
        "install it with `pip install -e .`, start Python in another folder, or use the command `torchbokeh`"
    )
