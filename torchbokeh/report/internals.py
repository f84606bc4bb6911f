# ruff: noqa: F401
"""What the report takes of the inside of the package, in one place: all else it knows by its public names.

What is renamed or moved inside the package is renamed here. ``torchbokeh.ops`` and ``torchbokeh.psfs`` count as public.
"""

from torchbokeh.banks import highlights as bank_highlights
from torchbokeh.banks import samples as bank_samples
from torchbokeh.banks import splat as bank_splatting
from torchbokeh.banks.highlights import BRIGHT, ordinary_light, share_of_others
from torchbokeh.banks.splat import bank_of_motion, splat_bank
from torchbokeh.compose.composition import CERTAIN
from torchbokeh.compose.surfaces import COARSE
from torchbokeh.learn.export import OPSET
from torchbokeh.lens.dispersion import FEWEST, SEEN, Spectrum
from torchbokeh.ops.splat import _splat_spans_torch as splat_definition
from torchbokeh.picture.motion import ADVANCE, Displacements
from torchbokeh.picture.request import WIDEST
from torchbokeh.picture.samples import pixel_positions
from torchbokeh.picture.sensor import STEPS as STEPS_OF_VIEWS
from torchbokeh.plan.bins import FOREGROUND, bin_centres
from torchbokeh.plan.quality import QUALITIES
from torchbokeh.renderers.reconstruction import KNOWN
from torchbokeh.views.points import Views

QUALITY_NAMES = tuple(quality.name for quality in QUALITIES)
