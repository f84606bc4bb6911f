"""Scenes with ground truth to train on, drawn on the fly or written as shards."""
