"""Lenses: what turns depth into circles of confusion, and what they do to colours."""

from torchbokeh.lens.base import NEAREST, RANGES, DisparityLens, Lens, ThinLens

__all__ = ["NEAREST", "RANGES", "DisparityLens", "Lens", "ThinLens"]
