import torch

from torchbokeh.report.internals import QUALITY_NAMES
from torchbokeh.report.scenes import photo, special
from torchbokeh.report.speed.blur import INPUTS, slabs


def test_slabs_are_the_picture_in_layers():
    seen = photo(64, 6.0)
    layers, coc = slabs(seen, 5)
    assert layers.shape == (1, 5, 4, 64, 64)
    assert coc.shape == (1, 5, 1, 64, 64)
    torch.testing.assert_close(layers.sum(1)[:, :3], seen.image)
    assert layers[:, :, 3].sum(1).unique().tolist() == [1.0]
    means = [coc[0, k][layers[0, k, 3:] > 0].mean() for k in range(5)]
    assert means == sorted(means)  # front to back


def test_every_input_and_quality_is_held_against_truth_and_exact(report):
    found = report["experiments"]["truth"]
    assert {row["scene"] for row in found} == {"coins"}
    kinds = {(row["input"], row["quality"]) for row in found}
    assert kinds >= {(given, quality) for given in ("one layer", *INPUTS) for quality in QUALITY_NAMES}
    assert found[0]["input"] == "truth"
    for row in found[1:]:
        assert 0 < row["ssim_truth"] < 1
        assert row["times_one_layer"] > 0
        if row["quality"] == "exact":
            assert row["l1_exact"] == 0
        if row["input"] == "one layer":
            assert row["times_one_layer"] == 1


def test_layers_are_counted(report, tiny):
    found = report["experiments"]["layers"]
    assert {(row["kind"], row["layers"]) for row in found} == {
        (kind, count) for kind in ("bins of an image", "layers of the input") for count in tiny.layer_counts
    }


def test_plans_are_told_with_what_they_save(report):
    found = {row["scene"]: row for row in report["experiments"]["left_out"]}
    assert found.keys() == special(32, 4.0).keys()
    assert found["full"]["share_of_full"] == 1
    assert found["all in focus"]["share_of_full"] < 0.5
    assert "passes through" in found["all in focus"]["plan"]
    assert found["all in focus"]["beside"].keys() == {"image.clone()"}
    assert {"kornia filter2d", "kornia fft_conv"} <= found["one depth"]["beside"].keys()
