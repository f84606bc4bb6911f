import pytest
import torch

from torchbokeh.report.scenes import NAMES, PHOTO, layered_picture, photo, picture, special
from torchbokeh.scenes import RECIPES


@pytest.mark.parametrize("name", [PHOTO, "coins", "sky"])
def test_a_scene_has_the_size_and_the_blur_that_are_asked_for(name):
    seen = picture(name, 48, 5.0)
    assert seen.image.shape == (1, 3, 48, 48)
    assert seen.coc.shape == (1, 1, 48, 48)
    assert seen.image.isfinite().all()
    assert 2.0 < seen.coc.abs().max() <= 5.001
    assert seen.coc.min() < -1
    assert seen.coc.max() > 1


def test_the_names_are_those_of_the_recipes_and_the_photo():
    assert set(NAMES) == {PHOTO, *RECIPES}
    with pytest.raises(ValueError, match="photo, coins"):
        picture("nowhere", 32, 4.0)


def test_the_photo_looks_the_same_at_every_size():
    small, large = photo(64, 8.0), photo(128, 16.0)
    assert (small.image > 10).any()
    shrunk = torch.nn.functional.interpolate(large.coc, 64, mode="nearest") / 2
    assert ((shrunk - small.coc).abs() < 0.5).float().mean() > 0.95
    assert torch.equal(photo(64, 8.0).coc, small.coc)
    assert not torch.equal(photo(64, 8.0, seed=1).coc, small.coc)


def test_special_scenes_are_what_they_are_called():
    found = special(64, 8.0)
    assert found["all in focus"].coc.abs().max() < 0.5
    assert found["one depth"].coc.unique().tolist() == [8.0]
    assert found["no foreground"].coc.min() >= 0
    assert found["slight blur"].coc.abs().max() <= 2.001
    lit = found["nothing but highlights"].image.amax(1) > 0
    assert 0 < lit.float().mean() < 0.5
    assert found["ramp"].coc.std(3).max() < 1e-6
    assert found["full"].coc.min() < -5


def test_a_layered_picture_is_still_and_whole():
    seen = layered_picture("fence", 48, 6.0, 16)
    assert seen.layers.dim() == seen.layer_coc.dim() == 5
    assert seen.layers.shape[1] == seen.layer_coc.shape[1] > 1
    colour, left = 0, 1
    for layer in seen.layers[0]:
        colour, left = colour + left * layer[:3], left * (1 - layer[3:])
    torch.testing.assert_close(colour[None], seen.image, rtol=1e-3, atol=1e-3)
    assert seen.background_coc.min() > -1.51
    assert not torch.equal(*seen.halves)
    torch.testing.assert_close(seen.truth, (seen.halves[0] + seen.halves[1]) / 2)


def test_the_background_is_the_picture_where_nothing_stands_in_front():
    seen = layered_picture("fence", 48, 6.0, 16)
    front = (seen.layers[:, :, 3:] * (seen.layer_coc < -1.5)).amax(1)
    assert 0.05 < (front > 0.5).float().mean() < 0.95
    clear = (front == 0).expand_as(seen.image)
    torch.testing.assert_close(seen.background[clear], seen.image[clear], rtol=1e-3, atol=1e-3)
