# ruff: noqa: F401
"""What the report takes of the inside of the package, in one place: all else it knows by its public names.

What is renamed or moved inside the package is renamed here. ``torchbokeh.ops`` and ``torchbokeh.psfs`` count as public.
"""

from torchbokeh.banks.highlights import BRIGHT
from torchbokeh.banks.splat import bank_of_motion, splat_bank
from torchbokeh.learn.export import OPSET
from torchbokeh.ops.splat import _splat_spans_torch as splat_definition
from torchbokeh.picture.samples import pixel_positions
from torchbokeh.picture.sensor import STEPS as STEPS_OF_VIEWS
from torchbokeh.plan.bins import FOREGROUND, bin_centres
from torchbokeh.plan.quality import QUALITIES

QUALITY_NAMES = tuple(quality.name for quality in QUALITIES)
