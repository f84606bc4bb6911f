"""The module `torchbokeh.learn.augmentation` under the name by which it has been documented from the first."""

from torchbokeh.learn.augmentation import RandomLensBlur, plausible_lenses

__all__ = ["RandomLensBlur", "plausible_lenses"]
