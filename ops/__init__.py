"""Stateless tensor functions: splat, integrate, composite. They know tensors and nothing of lenses."""
