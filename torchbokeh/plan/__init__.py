"""What a scene needs, decided once."""

from torchbokeh.plan.plan import Plan

__all__ = ["Plan"]
