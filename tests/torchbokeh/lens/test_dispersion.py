import copy
import doctest
import math
import pickle
from typing import Any

import pytest
import torch
from torch import Tensor, nn

import torchbokeh as tb
import torchbokeh.lens.dispersion
from torchbokeh.lens.dispersion import FEWEST, MOST, RGB, SEEN, Dispersion
from torchbokeh.lens.field_map import Field, FieldMap
from torchbokeh.lens.glass import relative_focal_length
from torchbokeh.ops.sellmeier import refractive_index

F64 = torch.float64
WIDTH = 1920
FOCAL, F_NUMBER, FOCUS, SENSOR = 0.05, 1.8, 2.0, 0.036
LIGHT = (380.0, 475.0, 510.0, 587.0, 650.0, 700.0, 780.0)


def double(value: float) -> Tensor:
    return torch.tensor(value, dtype=F64)


def lens(dispersion: Dispersion | None, focus: float = FOCUS) -> tb.ThinLens:
    return tb.ThinLens(*map(double, (FOCAL, F_NUMBER, focus, SENSOR)), dispersion=dispersion)


def exact(glass: str = "BK7", axial: float = 1.0, lateral: float = 0.0, **rest: Any) -> Dispersion:
    return Dispersion(glass, double(axial), double(lateral), **rest)


def focal_length(glass: str, wavelength: float, axial: float, reference: float = 650.0) -> float:
    """(4.3) and the strength of it: the surfaces are fixed, so only the indices count."""
    ratio = (refractive_index(glass, reference) - 1) / (refractive_index(glass, wavelength) - 1)
    return FOCAL + axial * (FOCAL * ratio - FOCAL)


def focus_by_text(focal: float, focus: float = FOCUS) -> float:
    """(4.5) as the dissertation has it."""
    return FOCAL * focus * focal / (FOCAL * focus - focal * focus + focal * FOCAL)


def coc_on_sensor(focal: float, depth: float, focus: float = FOCUS) -> float:
    """From the cone of light behind the lens: its radius where the sensor stands, that is (4.1) for the reference."""
    sensor = FOCAL * focus / (focus - FOCAL)
    crossing = 1 / (1 / focal - 1 / depth)
    return FOCAL / (2 * F_NUMBER) * (sensor - crossing) / crossing * WIDTH / SENSOR


@pytest.mark.parametrize("glass", ["BK7", "SF10", "N-FK51A"])
@pytest.mark.parametrize("axial", [0.4, 1.0, -0.7])
@pytest.mark.parametrize("wavelength", LIGHT)
def test_focal_lengths_are_those_of_the_lens_maker(wavelength: float, axial: float, glass: str) -> None:
    dispersion = exact(glass, axial)
    want = focal_length(glass, wavelength, axial) / FOCAL
    assert dispersion.relative_focal_length(wavelength).item() == pytest.approx(want, rel=1e-13)
    assert dispersion.power(wavelength).item() == pytest.approx(1 / want - 1, rel=1e-9, abs=1e-15)


@pytest.mark.parametrize("axial_map", [None, FieldMap(), FieldMap("square"), FieldMap("inversion", "exp")])
def test_the_axial_part_changes_over_the_picture_as_its_map_says(axial_map: FieldMap | None) -> None:
    dispersion, field = exact("SF10", 0.8, axial_map=axial_map), Field.pixels((9, 13), 0, double(0))
    power = dispersion.power(475.0, field)
    focal = focal_length("SF10", 475.0, 0.8) / FOCAL
    share = torch.zeros(9, 13, dtype=F64) if axial_map is None else axial_map(field.t, field.theta)
    want = 1 / (focal * (1 - share) + share) - 1  # lerp of (4.7)
    torch.testing.assert_close(power.expand(9, 13), want, rtol=1e-10, atol=1e-14)
    middle = dispersion.power(475.0)
    assert middle.shape == ()
    if axial_map == FieldMap():
        assert power[4, 6].item() == pytest.approx(middle.item(), rel=1e-13)
        assert power[0, 0].abs() < 0.15 * middle


@pytest.mark.parametrize("wavelength", [380.0, 475.0, 510.0, 650.0])
@pytest.mark.parametrize("axial", [0.25, 1.0, 3.0])
def test_the_focus_distance_solves_the_thin_lens_with_the_sensor_where_it_is(axial: float, wavelength: float) -> None:
    found = lens(exact(axial=axial)).focus_at(wavelength).item()
    focal, sensor = focal_length("BK7", wavelength, axial), FOCAL * FOCUS / (FOCUS - FOCAL)
    assert 1 / focal == pytest.approx(1 / found + 1 / sensor, rel=1e-11)
    assert found == pytest.approx(focus_by_text(focal), rel=1e-10)
    assert found <= FOCUS * (1 + 1e-12)  # short waves are focused nearer


def test_a_focus_beyond_infinity_is_refused() -> None:
    dispersion = exact("BK7", 1.0, reference=475.0)
    # (4.6), solved for the focus distance: F(reference) F(l) / (F(l) - F(reference)).
    focal = focal_length("BK7", 650.0, 1.0, 475.0)
    limit = FOCAL * focal / (focal - FOCAL)
    assert lens(dispersion, 0.999 * limit).focus_at(650.0).item() > 100 * limit
    with pytest.raises(
        ValueError,
        match=f"^wavelength: expected one that is in focus at a finite distance, got 650 nm, .* than {limit:g} m, ",
    ):
        lens(dispersion, 1.001 * limit).focus_at(650.0)
    # It is blurred all the same.
    shift = lens(dispersion, 1.001 * limit).coc_shift(650.0, WIDTH)
    assert shift.item() == pytest.approx(
        coc_on_sensor(focal, 3.0, 1.001 * limit) - coc_on_sensor(FOCAL, 3.0, 1.001 * limit), rel=1e-9
    )


@pytest.mark.parametrize("depth", [0.3, 1.9, 2.0, 7.0, math.inf])
@pytest.mark.parametrize("wavelength", LIGHT)
@pytest.mark.parametrize("axial", [0.3, 1.0, -0.5])
def test_the_radius_of_a_wavelength_is_that_of_its_cone_of_light(axial: float, wavelength: float, depth: float) -> None:
    camera = lens(exact("F2", axial))
    reference = camera.coc(torch.full((1, 1), depth, dtype=F64), WIDTH).item()
    found = reference + camera.coc_shift(wavelength, WIDTH).item()
    assert reference == pytest.approx(coc_on_sensor(FOCAL, depth), abs=1e-10)
    assert found == pytest.approx(coc_on_sensor(focal_length("F2", wavelength, axial), depth), abs=1e-9)


def test_the_shift_is_that_of_a_lens_focused_nearer_with_the_same_gain() -> None:
    camera = lens(exact("SF6"))
    gain = FOCAL**2 / (2 * F_NUMBER) / (1 - FOCAL / FOCUS) * WIDTH / SENSOR
    near = camera.focus_at(475.0).item()
    for depth in (0.5, 2.0, 30.0):
        want = gain * (1 / near - 1 / depth) - camera.coc(torch.full((1, 1), depth, dtype=F64), WIDTH).item()
        assert camera.coc_shift(475.0, WIDTH).item() == pytest.approx(want, rel=1e-10)
    assert camera.coc_shift(475.0, 2 * WIDTH).item() == pytest.approx(2 * camera.coc_shift(475.0, WIDTH).item())
    field = Field.pixels((5, 9), 0, double(0))
    assert camera.coc_shift(475.0, WIDTH, field)[2, 4].item() == pytest.approx(
        camera.coc_shift(475.0, WIDTH).item(), rel=1e-12
    )


@pytest.mark.parametrize("axial_map", [None, FieldMap(), FieldMap("exp")])
def test_no_strength_no_aberration(axial_map: FieldMap | None) -> None:
    field = Field.pixels((6, 8), 0, torch.zeros(()))
    none = Dispersion("SF10", axial=0.0, lateral=0.0, axial_map=axial_map)
    camera = tb.ThinLens(FOCAL, F_NUMBER, FOCUS, SENSOR, dispersion=none)
    plain = tb.ThinLens(FOCAL, F_NUMBER, FOCUS, SENSOR)
    for wavelength in LIGHT:
        assert not camera.coc_shift(wavelength, WIDTH, field).any()
        assert not none.enlargement(wavelength, field).any()
        assert not plain.coc_shift(wavelength, WIDTH, field).any()
        assert camera.focus_at(wavelength) == plain.focus_at(wavelength) == FOCUS
    full = Dispersion("SF10", lateral=0.02)
    assert not full.power(650.0, field).any()
    assert not full.enlargement(650.0, field).any()


@pytest.mark.parametrize("lateral_map", [None, FieldMap(), FieldMap("cube"), FieldMap("angular")])
def test_short_waves_make_larger_pictures(lateral_map: FieldMap | None) -> None:
    field = Field.pixels((7, 10), 0, double(0))
    dispersion = exact(lateral=0.03, lateral_map=lateral_map)
    share = torch.ones(7, 10, dtype=F64) if lateral_map is None else lateral_map(field.t, field.theta)
    for wavelength in LIGHT:
        found = dispersion.enlargement(wavelength, field)
        torch.testing.assert_close(found, 0.03 * (650 - wavelength) / 650 * share, rtol=1e-12, atol=1e-16)
    corner = Dispersion(lateral=0.01).enlargement(475.0, Field(double(5), double(3.5), (7, 10)))
    assert corner.item() == pytest.approx(0.0027, abs=5e-5)  # as its documentation says


def test_three_lights_for_three_channels() -> None:
    dispersion = Dispersion(axial=0.5)
    light = dispersion.light(3.0)
    assert tuple(one.wavelength for one in light) == RGB
    assert [one.rgb for one in light] == [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)]
    assert dispersion.light(0.9 * SEEN) == ()
    assert len(dispersion.light(1e4)) == 3
    assert dispersion.wavelengths() == (475.0, 650.0)


def narrow(wavelength: Tensor) -> Tensor:
    return (-((wavelength - 560) / 30).square()).exp()


@pytest.mark.parametrize("equaliser", [None, narrow])
@pytest.mark.parametrize(("axial", "lateral"), [(1.0, 0.0), (0.0, 0.1), (0.5, 0.1)])
@pytest.mark.parametrize("glass", ["BK7", "SF10"])
def test_bands_of_a_spectrum(glass: str, axial: float, lateral: float, equaliser: Any) -> None:
    dispersion = Dispersion(glass, axial, lateral, spectrum="continuous", equaliser=equaliser)
    assert dispersion.wavelengths() == (380.0, 780.0)
    assert dispersion.light(0.0) == dispersion.light(0.99 * SEEN) == ()
    counts = []
    for spread in (SEEN, 1.0, 3.5, 7.0, 15.0, 40.0, 64.0, 1e5):
        light = dispersion.light(spread)
        wavelengths = [one.wavelength for one in light]
        assert wavelengths == sorted(set(wavelengths))
        assert all(380 <= w <= 780 for w in wavelengths)
        rgb = torch.tensor([one.rgb for one in light], dtype=F64)
        assert (rgb >= 0).all()
        assert (rgb.sum(1) > 0).all()
        torch.testing.assert_close(rgb.sum(0), torch.ones(3, dtype=F64), rtol=0, atol=1e-9)
        counts.append(len(light))
    assert counts == sorted(counts)
    assert counts[-1] <= MOST
    if equaliser is None:  # otherwise bands without light are left out
        assert counts[0] == FEWEST
        assert counts[-1] > 0.7 * MOST


@pytest.mark.parametrize(("axial", "what"), [(1.0, "power"), (0.0, "wavelength")])
def test_bands_are_about_a_pixel_apart(axial: float, what: str) -> None:
    dispersion = Dispersion("SF10", axial, 0.1, spectrum="continuous")
    spread = 20.0
    centres = torch.tensor([one.wavelength for one in dispersion.light(spread)], dtype=F64)
    ends = torch.tensor([380.0, 780.0], dtype=F64)
    if what == "power":
        centres, ends = (1 / relative_focal_length("SF10", t, 650.0) for t in (centres, ends))
    steps = spread * centres.diff().abs() / (ends[1] - ends[0]).abs()
    assert float(steps.min()) > 0.5
    assert float(steps.max()) < 1.5


@pytest.mark.parametrize("border", [3.0, 4.0, 7.0, 25.0, 64.0])
def test_bands_come_without_a_jump(border: float) -> None:
    dispersion = Dispersion("BK7", 1.0, spectrum="continuous")
    sums = []
    for spread in (border - 1e-6, border + 1e-6):
        light = dispersion.light(spread)
        rgb = torch.tensor([one.rgb for one in light], dtype=F64)
        wavelengths = torch.tensor([one.wavelength for one in light], dtype=F64)
        waves = torch.stack([torch.cos(wavelengths / 400 * k) for k in range(1, 30)])
        sums.append(waves @ rgb)  # changes with any light that moves, comes or goes
    torch.testing.assert_close(*sums, rtol=0, atol=1e-4)


def test_batches_of_strengths() -> None:
    strengths = torch.tensor([0.2, 1.0, 0.0], dtype=F64)
    dispersion = Dispersion("F2", axial=strengths, lateral=0.1 * strengths)
    field = Field.pixels((4, 6), 0, double(0))
    ones = [Dispersion("F2", s, 0.1 * s) for s in strengths]
    assert dispersion.relative_focal_length(475.0).shape == (3,)
    assert dispersion.power(475.0).shape == (3,)
    camera = lens(dispersion)
    for name in ("power", "enlargement"):
        found = getattr(dispersion, name)(475.0, field)
        assert found.shape == (3, 1, 4, 6)
        for k, one in enumerate(ones):
            torch.testing.assert_close(found[k, 0], getattr(one, name)(475.0, field), rtol=1e-13, atol=0)
    shift = camera.coc_shift(475.0, WIDTH, field)
    assert shift.shape == (3, 1, 4, 6)
    assert camera.coc_shift(475.0, WIDTH).shape == (3, 1, 1, 1)
    for k, one in enumerate(ones):
        torch.testing.assert_close(shift[k, 0], lens(one).coc_shift(475.0, WIDTH, field), rtol=1e-13, atol=0)
        assert camera.focus_at(475.0)[k].item() == pytest.approx(lens(one).focus_at(475.0).item(), rel=1e-14)
    several = tb.ThinLens(FOCAL, torch.tensor([2.0, 4.0]), FOCUS, SENSOR, dispersion=Dispersion("F2"))
    found = several.coc_shift(475.0, WIDTH, Field.pixels((4, 6), 0, torch.zeros(())))
    assert found.shape == (2, 1, 4, 6)
    torch.testing.assert_close(found[0], 2 * found[1])


def test_gradients_reach_both_strengths() -> None:
    field = Field.pixels((4, 5), 0, double(0))
    axial, lateral = double(0.7).requires_grad_(), double(0.02).requires_grad_()

    def run(axial: Tensor, lateral: Tensor) -> tuple[Tensor, ...]:
        dispersion = Dispersion("SF10", axial, lateral)
        camera = lens(dispersion)
        return camera.coc_shift(475.0, WIDTH, field), dispersion.enlargement(475.0, field), camera.focus_at(475.0)

    assert torch.autograd.gradcheck(run, (axial, lateral))


def test_a_parameter_stays_the_same_object_and_learns() -> None:
    strength = nn.Parameter(torch.tensor(0.5))
    dispersion = Dispersion("BK7", axial=strength, lateral=0.01)
    assert dispersion.axial is strength
    camera = tb.ThinLens(FOCAL, F_NUMBER, FOCUS, SENSOR, dispersion=dispersion)
    assert dict(camera.named_parameters()) == {"dispersion.axial": strength}
    assert set(camera.state_dict()) >= {"dispersion.axial", "dispersion.lateral", "focal_length"}
    camera.coc_shift(475.0, WIDTH).backward()
    assert strength.grad is not None
    assert strength.grad > 0  # a stronger lens focuses blue nearer, so its radius is larger


def test_copies_pickles_state_and_dtype() -> None:
    dispersion = Dispersion("SF10", 0.4, 0.02, axial_map=FieldMap("square"), spectrum="continuous", equaliser=narrow)
    field = Field.pixels((4, 5), 0, torch.zeros(()))
    for again in (copy.deepcopy(dispersion), pickle.loads(pickle.dumps(dispersion.requires_grad_(False)))):
        assert repr(again) == repr(dispersion)
        assert torch.equal(again.power(475.0, field), dispersion.power(475.0, field))
        assert again.light(5.0) == dispersion.light(5.0)
    other = Dispersion("SF10", 0.1, 0.0, axial_map=FieldMap("square"))
    other.load_state_dict(dispersion.state_dict())
    assert torch.equal(other.power(475.0, field), dispersion.power(475.0, field))
    assert torch.equal(other.enlargement(475.0, field), dispersion.enlargement(475.0, field))
    camera = tb.ThinLens(FOCAL, F_NUMBER, FOCUS, SENSOR, dispersion=dispersion).to(F64)
    assert camera.dispersion is dispersion
    assert dispersion.axial.dtype == dispersion.lateral.dtype == F64
    assert camera.coc_shift(475.0, WIDTH).dtype == F64


def test_it_prints_what_it_is() -> None:
    text = repr(Dispersion("SF10", 0.25, torch.tensor([0.01, 0.02]), axial_map=None, lateral_map=FieldMap("square")))
    assert text == (
        "Dispersion('SF10', axial=0.25, lateral=(0.01, 0.02), axial_map=None, lateral_map=FieldMap(t**2), "
        "spectrum='rgb', reference=650, equaliser=None)"
    )
    assert "Dispersion('BK7', axial=1" in repr(tb.ThinLens(FOCAL, F_NUMBER, FOCUS, SENSOR, dispersion=Dispersion()))


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"glass": "jam"}, ValueError, "glass: expected one of BK7, .* got 'jam'"),
        ({"axial": "strong"}, TypeError, "axial: expected a number or a tensor, got str"),
        ({"axial": True}, TypeError, "axial: expected a number or a tensor, got bool"),
        ({"lateral": torch.tensor(1)}, TypeError, "lateral: expected a floating-point tensor, got torch.int64"),
        ({"lateral": torch.ones(1, 2)}, ValueError, r"lateral: expected a scalar or shape \(B,\), got \(1, 2\)"),
        (
            {"axial": torch.ones(2), "lateral": torch.ones(3)},
            ValueError,
            r"lateral: expected a scalar or shape \(2,\) like axial, got \(3,\)",
        ),
        ({"axial": math.inf}, ValueError, "axial: expected a finite strength, got inf"),
        ({"lateral": math.nan}, ValueError, "lateral: expected a finite strength, got nan"),
        ({"axial": 100.0}, ValueError, "axial: expected a strength that leaves focal lengths above 0, got 100"),
        (
            {"axial": torch.tensor([1.0, 90.0])},
            ValueError,
            "axial: expected a strength that leaves focal lengths above 0, got 90",
        ),
        ({"axial_map": "square"}, TypeError, "axial_map: expected a FieldMap or None, got str"),
        ({"lateral_map": 1.0}, TypeError, "lateral_map: expected a FieldMap or None, got float"),
        ({"spectrum": "white"}, ValueError, "spectrum: expected 'rgb' or 'continuous', got 'white'"),
        ({"reference": 0.65}, ValueError, "reference: expected 310 to 2300 nm, got 0.65"),
        ({"reference": "red"}, TypeError, "reference: expected a number, got str"),
        ({"equaliser": narrow}, ValueError, "equaliser: expected None with spectrum 'rgb', got one"),
        (
            {"equaliser": 2.0, "spectrum": "continuous"},
            TypeError,
            "equaliser: expected a callable or None, got float",
        ),
    ],
)
def test_what_does_not_fit_is_refused(arguments: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=f"^{message}$"):
        Dispersion(**arguments)


def test_focal_lengths_must_stay_above_zero_at_every_wavelength() -> None:
    # Of a reference of short wave, the long waves' focal lengths go to 0 with a negative strength.
    for strength, reference in ((80.0, 650.0), (-80.0, 475.0), (-100.0, 510.0)):
        with pytest.raises(ValueError, match=r"^axial: expected a strength that leaves focal lengths above 0"):
            Dispersion(axial=strength, reference=reference)


def test_a_lens_takes_a_dispersion_or_none() -> None:
    with pytest.raises(TypeError, match=r"^dispersion: expected a Dispersion or None, got str$"):
        tb.ThinLens(FOCAL, F_NUMBER, FOCUS, SENSOR, dispersion="BK7")  # type: ignore[arg-type]
    assert tb.ThinLens(FOCAL, F_NUMBER, FOCUS, SENSOR).dispersion is None
    assert tb.DisparityLens(1.0, 0.0).dispersion is None


def test_docstring_examples() -> None:
    result = doctest.testmod(torchbokeh.lens.dispersion)
    assert result.attempted > 1
    assert result.failed == 0
