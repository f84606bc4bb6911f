"""Lenses: what turns depth into circles of confusion, and what they do to colours."""

from torchbokeh.lens.base import Lens
from torchbokeh.lens.disparity import DisparityLens
from torchbokeh.lens.dispersion import Dispersion
from torchbokeh.lens.field_map import Field, FieldMap
from torchbokeh.lens.thin import NEAREST, RANGES, ThinLens

__all__ = ["NEAREST", "RANGES", "DisparityLens", "Dispersion", "Field", "FieldMap", "Lens", "ThinLens"]
