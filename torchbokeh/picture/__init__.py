"""What a caller hands in: checked once, with depth turned into circles of confusion."""

from torchbokeh.picture.motion import Motion
from torchbokeh.picture.request import Optics, Request
from torchbokeh.picture.samples import Samples, pinhole_position
from torchbokeh.picture.sensor import Sensor

__all__ = ["Motion", "Optics", "Request", "Samples", "Sensor", "pinhole_position"]
