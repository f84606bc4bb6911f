"""Exported files: what onnxruntime makes of them is what eager mode makes."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

import torchbokeh as tb
from torchbokeh.learn.export import export_onnx
from torchbokeh.learn.integration import Integrator
from torchbokeh.ops.dispatch import definitions_only, only_definitions
from torchbokeh.ops.splat import splat_spans
from torchbokeh.psfs import Disc, Ellipse, Polygon

onnxruntime = pytest.importorskip("onnxruntime")

SIZES = [(2, 40, 56), (1, 37, 61)]
LENSES = [(2.0, 0.1), (3.5, 0.2)]


def thin_lens(focus: float = 2.0, f_number: float = 0.1) -> tb.ThinLens:
    return tb.ThinLens(0.05, f_number, focus, 0.036)


def scene(batch: int, height: int, width: int) -> tuple[Tensor, Tensor]:
    """A picture with a highlight of 1e6, sky, a ramp of depth and a block in front."""
    image = torch.rand(batch, 3, height, width, generator=torch.Generator().manual_seed(0))
    image[..., height // 3, width // 3] = 1e6
    depth = torch.linspace(1.5, 6, width).repeat(batch, 1, height, 1)
    depth[..., height // 3 : height // 2, width // 4 : width // 2] = 1.2
    depth[..., :3, :] = torch.inf
    return image, depth


def session(path):
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 2
    return onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])


def run(loaded, *given: Tensor | float) -> Tensor:
    feed = {at.name: np.asarray(value, np.float32) for at, value in zip(loaded.get_inputs(), given, strict=True)}
    return torch.from_numpy(loaded.run(None, feed)[0])


def assert_same(found: Tensor, wanted: Tensor) -> None:
    """The mean radius of a cell may be rounded to the next step, which moves its light: seldom, and by 1e-4."""
    torch.testing.assert_close(found, wanted, rtol=2e-4, atol=1e-6)
    off = (found - wanted).abs() > 3e-5 * wanted.abs() + 1e-6
    assert off.sum() <= 0.005 * off.numel()


@pytest.fixture(scope="module", params=[("exact", 2, 1), ("balanced", 1, 2)], ids=lambda given: given[0])
def exported(request, tmp_path_factory):
    path = tmp_path_factory.mktemp("onnx") / "blur.onnx"
    quality, subapertures, layers = request.param
    blur = tb.LensBlur(thin_lens(), quality=quality, subapertures=subapertures, layers=layers)
    plan = blur.plan(*scene(1, 48, 64))
    export_onnx(blur, path, *scene(1, 48, 64))
    return blur, plan, session(path), path


@pytest.mark.slow
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("lens", LENSES)
def test_a_whole_blur_at_other_sizes_and_lenses(exported, size, lens):
    blur, plan, loaded, _ = exported
    given = scene(*size)
    other = tb.LensBlur(thin_lens(*lens), quality=blur.quality, layers=blur.layers)
    wanted = other(*given, plan=replace(plan, size=size[1:]))
    assert_same(run(loaded, *given, *lens), wanted)


@pytest.mark.slow
def test_inputs_are_in_the_order_of_forward(exported):
    _, _, loaded, _ = exported
    assert [(i.name, i.shape) for i in loaded.get_inputs()] == [
        ("image", ["batch", 3, "height", "width"]),
        ("depth", ["batch", 1, "height", "width"]),
        ("focus_distance", []),
        ("f_number", []),
    ]
    assert [(o.name, o.shape) for o in loaded.get_outputs()] == [("blurred", ["batch", 3, "height", "width"])]


@pytest.mark.slow
def test_operators_are_standard_ones(exported):
    import onnx

    model = onnx.load(exported[3])
    own = {function.name for function in model.functions}
    nodes = [*model.graph.node, *(node for function in model.functions for node in function.node)]
    assert all(node.domain == "" or node.op_type in own for node in nodes)
    assert not {"DFT", "RFFT"} & {node.op_type for node in nodes}
    assert exported[3].stat().st_size < 500_000  # outlines, cut at rows and columns, are a part of it


@pytest.mark.slow
def test_runs_without_torch(exported, tmp_path):
    given = scene(1, 20, 24)
    np.savez(tmp_path / "given.npz", image=given[0].numpy(), depth=given[1].numpy())
    code = """
import sys, numpy, onnxruntime
session = onnxruntime.InferenceSession(sys.argv[1], providers=["CPUExecutionProvider"])
given = dict(numpy.load(sys.argv[2]))
given |= {"focus_distance": numpy.array(2, "float32"), "f_number": numpy.array(0.1, "float32")}
numpy.save(sys.argv[3], session.run(None, given)[0])
assert "torch" not in sys.modules
"""
    found = tmp_path / "found.npy"
    subprocess.run([sys.executable, "-c", code, exported[3], tmp_path / "given.npz", found], check=True)
    assert_same(torch.from_numpy(np.load(found)), run(exported[2], *given, 2.0, 0.1))


class Spans(torch.nn.Module):
    """A splat with the PSF of one aperture."""

    def __init__(self, aperture) -> None:
        super().__init__()
        self.profile = aperture.profile()

    def forward(self, image, coc):
        return splat_spans(image, coc, self.profile, integrate=True)


@pytest.mark.parametrize("aperture", [Disc(), Ellipse(1.7, 0.4), Polygon(5, 0.2, 0.5)], ids=repr)
def test_splats_add_up_whatever_the_radius(aperture, tmp_path):
    """Many pixels fall on the same columns, in every row of the loop, on what earlier rows have left."""
    splatting = tb.KernelSplatting(aperture, quality="exact")
    coc = torch.linspace(-30, 30, 40 * 56).reshape(1, 1, 40, 56)
    path = export_onnx(splatting, tmp_path / "splat.onnx", torch.rand(1, 2, 40, 56), coc)
    loaded = session(path)
    generator = torch.Generator().manual_seed(1)
    for size, radius in (
        ((2, 31, 23), 2.0),
        ((1, 9, 70), 12.0),
        ((1, 24, 24), 1e4),
        ((1, 1, 1), 3.0),
        ((1, 160, 200), 9.0),
    ):
        batch, height, width = size
        image = torch.rand(batch, 2, height, width, generator=generator)
        image[..., 0, 0] = 1e6
        signed = radius * (2 * torch.rand(batch, 1, height, width, generator=generator) - 1)
        signed[..., 0, 0] = radius
        # Angles are float32, 6e-8: on the rim of the highlight, where nearly nothing of it is left, that is seen.
        plan = replace(splatting.plan(image, signed), surrounded=0, lit=0.0)  # as that of the exported picture
        found, wanted = run(loaded, image, signed), splatting(image, signed, plan=plan)
        torch.testing.assert_close(found, wanted, rtol=3e-5, atol=1e-8 * 1e6)


@pytest.mark.slow
def test_layers_with_a_lens_for_each_picture(tmp_path):
    layers = torch.rand(2, 2, 4, 24, 32, generator=torch.Generator().manual_seed(2))
    layers[:, :, :3] *= layers[:, :, 3:]
    disparity = torch.tensor([0.9, 0.2]).view(1, 2, 1, 1, 1).repeat(2, 1, 1, 24, 32)
    disparity = disparity + 0.1 * torch.rand(2, 2, 1, 24, 32, generator=torch.Generator().manual_seed(3))
    lens = tb.DisparityLens(torch.tensor([20.0, 9.0]), torch.tensor([0.4, 0.6]))
    blur = tb.LensBlur(lens, quality="exact", subapertures=1)
    loaded = session(export_onnx(blur, tmp_path / "layers.onnx", layers, disparity))
    wanted = blur(layers, disparity)
    assert_same(run(loaded, layers, disparity, lens.strength, lens.focus_disparity), wanted)


def test_coc_in_place_of_a_lens_and_a_wide_margin(tmp_path):
    blur = tb.LensBlur(layers=1, subapertures=1, margin=36)
    image = scene(1, 96, 104)[0]
    coc = torch.linspace(-6, 9, 104).repeat(1, 1, 96, 1)
    loaded = session(export_onnx(blur, tmp_path / "coc.onnx", image, coc))
    assert [i.name for i in loaded.get_inputs()] == ["image", "coc"]
    assert_same(run(loaded, image, coc), blur(image, coc=coc))


@pytest.mark.parametrize("integrator", [tb.PyramidIntegrator(), tb.ScanlineIntegrator()], ids=repr)
def test_integrators_at_other_sizes(integrator: Integrator, tmp_path):
    loaded = session(export_onnx(integrator, tmp_path / "integrator.onnx", torch.rand(1, 4, 64, 64)))
    if isinstance(integrator, tb.PyramidIntegrator):
        assert integrator.levels is None
        integrator = tb.PyramidIntegrator(levels=7)  # those of 64 px
    for size in ((2, 64, 64), (1, 33, 90)):
        image = torch.nn.functional.pad(torch.rand(size[0], 4, size[1] - 4, size[2] - 4), (2,) * 4)
        image[..., 10, 10] = 1e3
        buffer = integrator.differentiate(image)
        found, wanted = run(loaded, buffer), integrator(buffer)
        torch.testing.assert_close(found, wanted, rtol=1e-4, atol=1e-3)


def test_definitions_change_little():
    image, coc = torch.rand(1, 3, 24, 32), torch.linspace(-20, 20, 32).repeat(1, 1, 24, 1)
    splatting = tb.KernelSplatting(quality="balanced")
    assert not only_definitions()
    with definitions_only():
        assert only_definitions()
        slow = splatting(image, coc)
    torch.testing.assert_close(slow, splatting(image, coc), rtol=1e-4, atol=1e-5)


def moved(blur: tb.LensBlur) -> tb.Plan:
    return blur.plan(*scene(1, 24, 32), motion=torch.full((1, 2, 24, 32), 9.0))


@pytest.mark.parametrize(
    ("arguments", "plan", "error", "message"),
    [
        ((torch.nn.Identity(), torch.rand(1, 3, 8, 8)), None, TypeError, "module: expected a LensBlur"),
        ((tb.FFTIntegrator(), torch.rand(1, 3, 8, 8)), None, TypeError, "module: .* got FFTIntegrator"),
        ((tb.PyramidIntegrator(), [[1.0]]), None, TypeError, r"inputs\[0\]: expected a tensor, got list"),
        ((tb.PyramidIntegrator(), torch.rand(1, 3, 8, 8).double()), None, ValueError, r"inputs\[0\]: expected float32"),
        ((tb.PyramidIntegrator(), torch.rand(3, 8, 8)), None, ValueError, r"inputs\[0\]: expected shape"),
        ((tb.PyramidIntegrator(),), None, ValueError, "inputs: expected a buffer, got 0"),
        ((tb.PyramidIntegrator(), torch.rand(1, 3, 8, 8)), 3, ValueError, "plan: expected None for an integrator"),
        ((tb.LensBlur(thin_lens()), torch.rand(1, 3, 8, 8)), None, ValueError, "inputs: expected an image and"),
        ((tb.LensBlur(thin_lens()), *scene(1, 8, 8)), 3, TypeError, "plan: expected a Plan or None, got int"),
        (
            (tb.LensBlur(thin_lens()), torch.rand(1, 3, 8, 8), torch.full((1, 1, 8, 8), 2.0)),
            None,
            ValueError,
            "plan: expected one of a scene whose blur varies",
        ),
        (
            (tb.LensBlur(thin_lens()), *scene(1, 24, 32)),
            tb.LensBlur(thin_lens()).plan(
                torch.ones(1, 2, 4, 24, 32), scene(1, 24, 32)[1][:, None].repeat(1, 2, 1, 1, 1)
            ),
            ValueError,
            "plan: expected one for 0 layers, got one for 2",
        ),
        ((tb.LensBlur(thin_lens()), *scene(1, 24, 32)), moved(tb.LensBlur(thin_lens())), ValueError, "and motion"),
    ],
)
def test_what_is_not_exported(arguments, plan, error, message, tmp_path):
    with pytest.raises(error, match=message):
        export_onnx(arguments[0], tmp_path / "a.onnx", *arguments[1:], plan=plan)
    assert not list(tmp_path.iterdir())


def test_dispersion_is_not_exported(tmp_path):
    lens = tb.ThinLens(0.05, 0.1, 2.0, 0.036, dispersion=tb.Dispersion("BK7"))
    with pytest.raises(ValueError, match="without dispersion"):
        export_onnx(tb.LensBlur(lens), tmp_path / "a.onnx", *scene(1, 24, 32))


@pytest.mark.slow
def test_merging_is_in_the_file(exported):
    """The plan of the merged quality has more than one level: else the test above would not see it."""
    blur, plan, _, _ = exported
    assert (plan.highest > 0) == (blur.quality == "balanced")
