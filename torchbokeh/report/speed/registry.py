"""All methods by name: a new one is a line here, or in a table that stands here."""

from torchbokeh.report.speed.autograd import gradient_methods
from torchbokeh.report.speed.baselines import baselines
from torchbokeh.report.speed.methods import Method, own_methods


def one_layer_methods() -> dict[str, Method]:
    """Everything that is compared on one layer: this package's operating points first."""
    return {**own_methods(), **baselines()}


def every_method() -> dict[str, Method]:
    """Those, and what is compared in forward and backward passes."""
    return {**one_layer_methods(), **gradient_methods()}
