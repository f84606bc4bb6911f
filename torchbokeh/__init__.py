"""torchbokeh: the look of a real camera, for PyTorch.

An image and its depth go in, the picture a lens would take comes out. `LensBlur` is the front door.

Names are imported when they are first used: ``import torchbokeh`` by itself does nothing.
"""

from importlib.util import find_spec as _find_spec

if _find_spec("torchbokeh.ops") is None or _find_spec("torchbokeh.psfs") is None:
    raise ImportError(
        "torchbokeh was imported from a source folder without its parts torchbokeh.ops and torchbokeh.psfs; "
        "install it with `pip install -e .`, start Python in another folder, or use the command `torchbokeh`"
    )

import lazy_loader as _lazy

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = _lazy.attach_stub(__name__, __file__)
