"""Point-spread functions: the shapes a point of light takes on the sensor."""

from torchbokeh.psfs.aperture import Aperture, Disc, Ellipse, Polygon, parse_aperture, polygon_profile
from torchbokeh.psfs.bank import PsfBank
from torchbokeh.psfs.build import build
from torchbokeh.psfs.combined import Combined
from torchbokeh.psfs.model import Axis, Labels, Place, PsfModel
from torchbokeh.psfs.physical_lens import PhysicalLens
from torchbokeh.psfs.simple_lens import SimpleLens
from torchbokeh.psfs.stylized import Stylized
from torchbokeh.psfs.volume import Volume

__all__ = [
    "Aperture",
    "Axis",
    "Combined",
    "Disc",
    "Ellipse",
    "Labels",
    "PhysicalLens",
    "Place",
    "Polygon",
    "PsfBank",
    "PsfModel",
    "SimpleLens",
    "Stylized",
    "Volume",
    "build",
    "parse_aperture",
    "polygon_profile",
]
