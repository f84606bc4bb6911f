"""Numerical stability: cases and their bounds."""
