"""Any float as the number of a lens: it is refused by name, or what it makes is finite."""

import math
import re
from collections.abc import Callable
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

import torchbokeh as tb
from torchbokeh import psfs
from torchbokeh.learn.augmentation import RandomLensBlur, plausible_lenses

ANY = st.floats() | st.sampled_from([0.0, -0.0, 5e-324, 1e-45, 1e-38, 1e38, 3.5e38, 1e308, 0.05, 2.0])
DEPTH = torch.tensor([1e-3, 0.05, 1.0, 2.0, 1e4, torch.inf]).view(1, 1, 1, 6)
DISPARITY = torch.tensor([-10.0, -1e-3, 0.0, 0.5, 100.0]).view(1, 1, 1, 5)


def made(function: Callable[..., Any], **arguments: Any) -> Any:
    """What a call returns; None where it is refused as it should be."""
    try:
        return function(**arguments)
    except ValueError as error:
        message = str(error)
    assert re.match(rf"({'|'.join(arguments)}): expected ", message), message
    return None


@settings(deadline=None, max_examples=100)
@given(ANY, ANY, ANY, ANY)
def test_thin_lenses(focal_length: float, f_number: float, focus_distance: float, sensor_width: float) -> None:
    names = {"focal_length": focal_length, "f_number": f_number}
    lens = made(tb.ThinLens, **names, focus_distance=focus_distance, sensor_width=sensor_width)
    if lens is not None:
        coc = lens.coc(DEPTH, 640)
        assert coc.isfinite().all()
        assert not lens.depth(coc, 640).isnan().any()
        assert not lens.hyperfocal(0.5, 640).isnan()
        assert not lens.far_limit(0.5, 640).isnan()


@settings(deadline=None, max_examples=100)
@given(ANY, ANY)
def test_disparity_lenses(strength: float, focus_disparity: float) -> None:
    lens = made(tb.DisparityLens, strength=strength, focus_disparity=focus_disparity)
    assert lens is None or lens.coc(DISPARITY, 640).isfinite().all()


@settings(deadline=None, max_examples=100)
@given(ANY, ANY, ANY)
def test_dispersions(axial: float, lateral: float, reference: float) -> None:
    dispersion = made(tb.Dispersion, axial=axial, lateral=lateral, reference=reference)
    if dispersion is not None:
        field = tb.lens.Field.pixels((4, 6), 0, torch.zeros(()))
        lens = tb.ThinLens(0.05, 2.0, 2.0, 0.036, dispersion=dispersion)
        for wavelength in (475.0, 650.0):
            assert lens.coc_shift(wavelength, 640, field).isfinite().all()
            assert dispersion.enlargement(wavelength, field).isfinite().all()


@settings(deadline=None, max_examples=100)
@given(ANY, ANY, ANY, st.integers(-1, 70))
def test_apertures(squeeze: float, rotation: float, curvature: float, blades: int) -> None:
    for aperture in (
        made(psfs.Ellipse, squeeze=squeeze, rotation=rotation),
        made(psfs.Polygon, blades=blades, rotation=rotation, curvature=curvature),
    ):
        if aperture is not None:
            assert all(t.isfinite().all() for t in aperture.profile())


NAMES = st.sampled_from(["identity", "square", "cube", "exp", "inversion", "reciprocal", "cosine", "angular"])


@settings(deadline=None, max_examples=100)
@given(NAMES, NAMES, st.lists(st.floats(0, 1), min_size=1, max_size=4), st.floats(-math.pi, math.pi))
def test_field_maps(pre: str, post: str, t: list[float], theta: float) -> None:
    place = torch.tensor(t)
    assert tb.FieldMap(pre, post)(place, torch.full_like(place, theta)).isfinite().all()


@settings(deadline=None, max_examples=100)
@given(st.integers(0, 5), st.lists(st.floats(min_value=0, exclude_min=True) | ANY, min_size=4, max_size=4))
def test_plausible_lenses(count: int, values: list[float]) -> None:
    depth = torch.tensor(values, dtype=torch.float64).float().expand(count, 1, 1, 4)
    generator = torch.Generator().manual_seed(0)
    lenses = made(plausible_lenses, count=count, generator=generator, depth=depth)
    assert (lenses is None) == (count > 0 and not bool((depth > 0).all()))
    if lenses is not None:
        coc = tb.ThinLens(**lenses).coc(depth.clamp_min(1e-9), 640)
        assert coc.isfinite().all()


@settings(deadline=None, max_examples=100)
@given(ANY, ANY, ANY, ANY, ANY)
def test_random_lenses(focal_length: float, f_number: float, width: float, distance: float, quantile: float) -> None:
    ranges = {"focal_length": focal_length, "f_number": f_number, "sensor_width": width}
    made(RandomLensBlur, **ranges, focus_distance=distance, focus_quantile=quantile)


@pytest.mark.parametrize("name", ["focal_length", "f_number", "focus_distance", "sensor_width"])
@settings(deadline=None, max_examples=50)
@given(value=ANY)
def test_tensors_are_looked_at_as_numbers_are(name: str, value: float) -> None:
    good: dict[str, float | Tensor] = {
        "focal_length": 0.05,
        "f_number": 2.0,
        "focus_distance": 2.0,
        "sensor_width": 0.036,
    }
    for dtype in (torch.float32, torch.float64):
        lens = made(tb.ThinLens, **{**good, name: torch.tensor([value, value], dtype=dtype)})
        if lens is not None:
            assert lens.coc(DEPTH.expand(2, 1, 1, 6).to(dtype), 640).isfinite().all()
