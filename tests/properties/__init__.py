"""Scenes drawn at random, and laws that every public renderer keeps for each of them."""
