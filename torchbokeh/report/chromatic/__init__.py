"""Dispersion against its reference."""
