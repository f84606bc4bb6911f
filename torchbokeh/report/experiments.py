"""The experiments of ``torchbokeh report``: nothing else names them. A new one is a file, and a line here."""

from torchbokeh.report.chromatic.experiments import DISPERSION_BANDS, DISPERSION_TRUTH, DISPERSION_VIEWS
from torchbokeh.report.experiment import Experiment
from torchbokeh.report.motion.experiments import LIKE_LKS, MOTION
from torchbokeh.report.speed.blur import LAYERS, LEFT_OUT, TRUTH
from torchbokeh.report.speed.exported import EXPORT
from torchbokeh.report.speed.gradients import GRADIENTS
from torchbokeh.report.speed.one_layer import ONE_LAYER
from torchbokeh.report.speed.stages import STAGES
from torchbokeh.report.speed.sweeps import PIXELS, RADIUS, THREADS

EXPERIMENTS: list[Experiment] = [
    ONE_LAYER,
    TRUTH,
    RADIUS,
    PIXELS,
    LAYERS,
    THREADS,
    GRADIENTS,
    EXPORT,
    MOTION,
    LIKE_LKS,
    DISPERSION_TRUTH,
    DISPERSION_VIEWS,
    DISPERSION_BANDS,
    LEFT_OUT,
    STAGES,
]
"""In the order in which they are run, and in which their sections stand."""
