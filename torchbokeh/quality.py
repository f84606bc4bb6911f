"""The module `torchbokeh.plan.quality` under the name by which it has been documented from the first."""

from torchbokeh.plan.quality import QUALITIES, Quality

__all__ = ["QUALITIES", "Quality"]
