import pytest

from torchbokeh.psfs import Aperture, Disc, Ellipse, Polygon

SHAPES = {
    "disc": Disc(),
    "ellipse": Ellipse(1.8, 0.5),
    "hexagon": Polygon(6, 0.3),
    "round blades": Polygon(5, 0.4, 0.7),
}


@pytest.fixture(params=SHAPES)
def shape(request: pytest.FixtureRequest) -> Aperture:
    return SHAPES[request.param]
