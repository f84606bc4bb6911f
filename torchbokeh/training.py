"""The module `torchbokeh.learn.training` under the name by which it has been documented from the first."""

from torchbokeh.learn.training import fit_integrator, laplacian_pictures, relative_errors

__all__ = ["fit_integrator", "laplacian_pictures", "relative_errors"]
