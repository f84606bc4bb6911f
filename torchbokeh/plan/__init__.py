"""What a scene needs, decided once."""

from torchbokeh.plan.plan import Plan, SplattingPlan

__all__ = ["Plan", "SplattingPlan"]
