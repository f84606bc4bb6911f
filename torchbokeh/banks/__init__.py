"""Splatting from banks of sparse point-spread functions."""
