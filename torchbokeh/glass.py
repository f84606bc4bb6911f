"""The module `torchbokeh.lens.glass` under the name by which it has been documented from the first."""

from torchbokeh.lens.glass import GLASSES, abbe_number, refractive_index, relative_focal_length

__all__ = ["GLASSES", "abbe_number", "refractive_index", "relative_focal_length"]
