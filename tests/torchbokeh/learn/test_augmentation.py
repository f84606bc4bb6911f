"""RandomLensBlur against LensBlur, and what kornia asks of an augmentation."""

import doctest
from typing import Any

import pytest
import torch
from kornia.augmentation import AugmentationSequential, RandomHorizontalFlip
from kornia.color import linear_rgb_to_rgb, rgb_to_linear_rgb
from torch import Tensor

import torchbokeh as tb
import torchbokeh.learn.augmentation
from torchbokeh.learn.augmentation import RandomLensBlur, plausible_lenses

HEIGHT, WIDTH = 20, 28
FAST: dict[str, Any] = {"f_number": (1.4, 2.8), "sensor_width": 0.003}  # blur that is seen in so few pixels


@pytest.fixture(autouse=True)
def _seed() -> None:
    torch.manual_seed(3)


def scenes(count: int = 3) -> tuple[Tensor, Tensor]:
    """Pictures with a card in front of a slope, every one nearer than the last."""
    generator = torch.Generator().manual_seed(7)
    image = torch.rand(count, 3, HEIGHT, WIDTH, generator=generator)
    depth = torch.linspace(2.0, 9.0, WIDTH).expand(count, 1, HEIGHT, WIDTH).clone()
    depth[..., :4] = torch.inf
    depth[..., 5:15, 8:18] = 1.0
    return image, depth / torch.arange(1.0, count + 1).view(-1, 1, 1, 1)


@pytest.mark.parametrize("linear", [False, True])
@pytest.mark.parametrize("focus", [None, (0.6, 4.0)])
def test_it_is_lens_blur_at_the_drawn_lenses(linear: bool, focus: tuple[float, float] | None) -> None:
    image, depth = scenes()
    settings: dict[str, Any] = FAST | {"quality": "exact", "aperture": "6-gon", "max_coc": 9.0}
    aug = RandomLensBlur(focus_distance=focus, linear=linear, p=1.0, **settings)
    out = aug(image, depth=depth)
    lenses = aug.lenses(aug._params)
    assert {name: value.shape for name, value in lenses.items()} == dict.fromkeys(lenses, (3,))
    assert lenses["f_number"].unique().numel() == 3
    for k in range(3):
        lens: dict[str, Any] = {name: value[k].item() for name, value in lenses.items()}
        blur = tb.LensBlur(tb.ThinLens(**lens), "6-gon", max_coc=9.0)
        one, far = image[k : k + 1], depth[k : k + 1]
        want = blur(one, far) if linear else linear_rgb_to_rgb(blur(rgb_to_linear_rgb(one), far))
        torch.testing.assert_close(out[k : k + 1], want, atol=1e-6, rtol=0)
        assert not torch.allclose(want, one, atol=1e-2)


def test_a_quantile_is_a_depth_of_each_picture_without_the_sky() -> None:
    image, depth = scenes()
    aug = RandomLensBlur(**FAST, focus_quantile=1.0, p=1.0, same_on_batch=True)
    aug(image, depth=depth)
    torch.testing.assert_close(aug.lenses(aug._params)["focus_distance"], 9.0 / torch.arange(1.0, 4))
    near = aug.lenses(aug._params | {"focus_quantile": torch.zeros(3)})["focus_distance"]
    torch.testing.assert_close(near, 1.0 / torch.arange(1.0, 4))
    sky = aug.lenses(aug._params, torch.full_like(depth, torch.inf))
    assert sky["focus_distance"].isinf().all()
    macro = aug.lenses(aug._params, torch.full_like(depth, 0.01))
    assert torch.equal(macro["focus_distance"], 2 * macro["focal_length"])


def test_params_repeat_a_call() -> None:
    image, depth = scenes()
    aug = RandomLensBlur(**FAST, p=0.6)
    drawn = aug.forward_parameters(image.shape) | {"batch_prob": torch.tensor([1.0, 0.0, 1.0])}
    out = aug(image, params=drawn, depth=depth)
    assert [torch.equal(a, b) for a, b in zip(out, image, strict=True)] == [False, True, False]
    params = aug._params
    aug(image, depth=depth)
    assert torch.equal(aug(image, params=params), out)
    assert torch.equal(aug(image, params=params, depth=depth), out)
    assert not torch.equal(aug(image, params=params, depth=depth.flip(3)), out)
    assert "depth" not in drawn
    assert torch.equal(aug(image, drawn, depth=depth), aug(image, drawn | {"depth": depth}))


def test_seeds() -> None:
    image, depth = scenes()
    aug = RandomLensBlur(**FAST, p=1.0)
    outs = []
    for seed in (0, 0, 1):
        torch.manual_seed(seed)
        outs.append(aug(image, depth=depth))
    assert torch.equal(outs[0], outs[1])
    assert not torch.equal(outs[0], outs[2])


def test_same_on_batch() -> None:
    image, depth = scenes()
    aug = RandomLensBlur(**FAST, focus_distance=(1.0, 3.0), p=1.0, same_on_batch=True)
    out = aug(image[:1].expand(3, -1, -1, -1), depth=depth[:1].expand(3, -1, -1, -1))
    assert torch.equal(out[0], out[1])
    assert torch.equal(out[0], out[2])
    assert all(value.unique().numel() == 1 for value in aug.lenses(aug._params).values())


@pytest.mark.parametrize("never", [{"p": 0.0}, {"p": 1.0, "p_batch": 0.0}])
def test_pictures_that_are_left_out_stay(never: dict[str, Any]) -> None:
    image, depth = scenes()
    assert torch.equal(RandomLensBlur(**never)(image, depth=depth), image)
    assert torch.equal(RandomLensBlur(**never)(image, depth=-depth), image)  # and their depth is not looked at


def test_one_picture() -> None:
    image, depth = scenes(1)
    aug = RandomLensBlur(**FAST, p=1.0, keepdim=True)
    out = aug(image[0], depth=depth[0])
    assert out.shape == (3, HEIGHT, WIDTH)
    assert torch.equal(aug(image, params=aug._params)[0], out)
    assert RandomLensBlur(**FAST, p=1.0)(image[0], depth=depth).shape == image.shape


def test_a_batch_of_none() -> None:
    image, depth = scenes()
    assert RandomLensBlur(**FAST, p=1.0)(image[:0], depth=depth[:0]).shape == (0, 3, HEIGHT, WIDTH)


@pytest.mark.parametrize("p", [0.5, 1.0])
def test_in_a_container_all_but_the_image_stay(p: float) -> None:
    image, depth = scenes()
    mask = (depth < 2).float()
    boxes = torch.tensor([[[1.0, 1.0], [5.0, 1.0], [5.0, 6.0], [1.0, 6.0]]]).expand(3, 1, 4, 2)
    points = torch.tensor([[[3.0, 4.0], [9.0, 2.0]]]).expand(3, 2, 2)
    aug = AugmentationSequential(RandomLensBlur(**FAST, p=p), data_keys=["input", "mask", "bbox", "keypoints"])
    torch.manual_seed(4)
    params = aug.forward_parameters(image.shape)
    params[0].data["depth"] = depth
    out, *others = aug(image, mask, boxes, points, params=params)
    for got, want in zip(others, (mask, boxes, points), strict=True):
        assert torch.equal(got, want)
    assert torch.equal(out, RandomLensBlur(**FAST, p=p)(image, params[0].data))
    assert not torch.equal(out, image)
    assert torch.equal(aug(image, mask, boxes, points, params=aug._params)[0], out)


def test_geometry_after_the_blur_moves_all() -> None:
    image, depth = scenes()
    blur = RandomLensBlur(**FAST, p=1.0)
    aug = AugmentationSequential(blur, RandomHorizontalFlip(p=1.0), data_keys=["input", "mask"])
    params = aug.forward_parameters(image.shape)
    params[0].data["depth"] = depth
    out, mask = aug(image, image[:, :1], params=params)
    torch.testing.assert_close(out.flip(3), blur(image, params[0].data))
    assert torch.equal(mask.flip(3), image[:, :1])


@pytest.mark.parametrize("linear", [False, True])
def test_gradients(linear: bool) -> None:
    image, depth = (x.requires_grad_() for x in scenes())
    RandomLensBlur(**FAST, p=1.0, linear=linear)(image, depth=depth).square().sum().backward()
    for x in (image, depth):
        assert x.grad is not None
        assert x.grad.isfinite().all()
        assert (x.grad.flatten(1).abs().amax(1) > 0).all()


def test_dtypes() -> None:
    image, depth = scenes()
    aug = RandomLensBlur(**FAST, p=1.0)
    out = aug(image, depth=depth)
    assert aug(image.double(), params=aug._params, depth=depth.double()).dtype == torch.float64
    half = aug(image.bfloat16(), params=aug._params)
    assert half.dtype == torch.bfloat16
    torch.testing.assert_close(half.float(), out, atol=2e-2, rtol=0)
    drawn = RandomLensBlur().double().forward_parameters(image.shape)
    assert drawn["f_number"].dtype == torch.float64


def test_what_is_printed() -> None:
    text = repr(RandomLensBlur(f_number=2.0, p=0.3))
    for part in ("f_number=(2.0, 2.0)", "focal_length=(0.024, 0.085)", "focus_quantile=", "p=0.3", "linear=False"):
        assert part in text


def test_plausible_lenses() -> None:
    lenses = plausible_lenses(4000, torch.Generator().manual_seed(0))
    middles = {"focal_length": (0.024 * 0.085) ** 0.5, "f_number": (1.4 * 8) ** 0.5, "focus_distance": 5**0.5}
    ends = {"focal_length": (0.024, 0.085), "f_number": (1.4, 8.0), "focus_distance": (0.5, 10.0)}
    assert (lenses["sensor_width"] == 0.036).all()
    for name, middle in middles.items():
        value = lenses[name]
        assert value.shape == (4000,)
        assert value.median().item() == pytest.approx(middle, rel=0.06)
        assert ends[name][0] <= value.min()
        assert value.max() <= ends[name][1] * (1 + 1e-6)
    again = plausible_lenses(4000, torch.Generator().manual_seed(0))
    assert all(torch.equal(again[name], lenses[name]) for name in lenses)
    depth = scenes()[1]
    focus = plausible_lenses(3, depth=depth)["focus_distance"]
    assert all((far == d).any() for far, d in zip(focus, depth, strict=True))


BAD_SETTINGS = [
    ({"f_number": 0.0}, ValueError, "f_number: expected values above 0 and finite"),
    ({"f_number": (4.0, 2.0)}, ValueError, "the lower one first"),
    ({"focal_length": (0.02, float("nan"))}, ValueError, "focal_length: expected values above 0"),
    ({"sensor_width": float("inf")}, ValueError, "sensor_width: expected values above 0 and finite"),
    ({"sensor_width": "wide"}, TypeError, "sensor_width: expected a number or a pair"),
    ({"f_number": (1.0, 2.0, 3.0)}, TypeError, "f_number: expected a number or a pair"),
    ({"focus_quantile": (0.5, 1.5)}, ValueError, r"focus_quantile: expected values in \[0, 1\]"),
    ({"focus_distance": (0.05, 2.0)}, ValueError, "focus_distance: expected more than the longest focal length"),
    ({"linear": 1}, TypeError, "linear: expected a bool"),
    ({"quality": "best"}, ValueError, "quality"),
    ({"max_coc": 0.0}, ValueError, "max_coc"),
]


@pytest.mark.parametrize(("settings", "error", "message"), BAD_SETTINGS)
def test_bad_settings_are_refused(settings: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        RandomLensBlur(**settings)


def test_bad_calls_are_refused() -> None:
    image, depth = scenes()
    aug = RandomLensBlur(p=1.0)
    with pytest.raises(TypeError, match="depth: expected a tensor, as depth= or as params"):
        aug(image)
    with pytest.raises(TypeError, match="depth: expected a tensor, got list"):
        aug(image, depth=[1.0])
    with pytest.raises(TypeError, match="floating-point"):
        aug(image, depth=depth.nan_to_num(posinf=9).long())
    for bad in (depth[:2], depth[:, 0], depth.expand(-1, 3, -1, -1), depth[..., 1:]):
        with pytest.raises(ValueError, match="depth: expected shape"):
            aug(image, depth=bad)
    with pytest.raises(ValueError, match="depth: expected values above 0"):
        aug(image, depth=-depth)
    with pytest.raises(ValueError, match="input: expected shape"):
        aug(image[:, :1], depth=depth)
    with pytest.raises(ValueError, match="params: expected those of 3 pictures, got those of 2"):
        aug(image, params=aug.forward_parameters((2, 3, HEIGHT, WIDTH)), depth=depth)
    with pytest.raises(ValueError, match="count: expected at least 0"):
        plausible_lenses(-1)
    with pytest.raises(TypeError, match="count: expected an int"):
        plausible_lenses(2.0)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="depth: expected shape"):
        plausible_lenses(2, depth=depth)


def test_doctests() -> None:
    assert doctest.testmod(torchbokeh.learn.augmentation).failed == 0
