"""Point-spread functions: the shapes a point of light takes on the sensor."""

from torchbokeh.psfs.aperture import Aperture, Disc, Ellipse, Polygon, parse_aperture, polygon_profile

__all__ = ["Aperture", "Disc", "Ellipse", "Polygon", "parse_aperture", "polygon_profile"]
