"""Numerical stability: cases, bounds and oracles."""
