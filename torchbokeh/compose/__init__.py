"""Surfaces, what they hide, and how they are put over one another."""
