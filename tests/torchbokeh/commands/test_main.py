"""The command line: what it renders, and one line and a status for everything that is wrong."""

import io
import os
import subprocess
import sys
from importlib.metadata import version

import numpy as np
import pytest
import torch

import torchbokeh as tb
from torchbokeh.commands.main import main
from torchbokeh.io.pictures import read_image, write_image


@pytest.fixture
def scene(tmp_path, monkeypatch):
    """A picture, a depth map with two planes and a disparity map, in the current folder."""
    monkeypatch.chdir(tmp_path)
    generator = torch.Generator().manual_seed(0)
    write_image("image.tif", torch.rand(1, 3, 24, 32, generator=generator))
    depth = np.full((24, 32), 2.0, np.float32)
    depth[:, 16:] = 5.0
    np.save("depth.npy", depth)
    np.save("millimetres.npy", (depth * 1000).astype(np.uint16))
    np.save("disparity.npy", 1 / depth)
    return tmp_path


def render(*flags):
    return main(["render", "image.tif", *flags, "-o", "out.tif"])


def tensors(name="depth"):
    return read_image("image.tif"), torch.from_numpy(np.load(f"{name}.npy")).float()[None, None]


def assert_rendered(expected):
    """``out.tif`` holds the picture, but for the rounding to 16 bits."""
    torch.testing.assert_close(read_image("out.tif"), expected, rtol=0, atol=3e-5)


THIN = ("--depth", "depth.npy", "--focus", "2m")


def test_render_is_lens_blur(scene, capsys):
    image, depth = tensors()
    assert render(*THIN, "--f-number", "0.5", "--focal-length", "40mm", "--sensor-width", "2.4cm") == 0
    blur = tb.LensBlur(tb.ThinLens(0.040, 0.5, 2.0, 0.024))
    assert_rendered(blur(image, depth))
    assert not torch.allclose(read_image("out.tif"), image, atol=0.05)
    said = capsys.readouterr()
    assert str(blur.plan(image, depth)) in said.out
    assert "out.tif: 32 x 24" in said.out
    assert said.err == ""


def test_defaults_are_a_50_mm_lens_at_2_8_on_full_frame(scene):
    image, depth = tensors()
    assert render(*THIN) == 0
    assert_rendered(tb.LensBlur(tb.ThinLens(0.05, 2.8, 2.0, 0.036))(image, depth))


def test_depth_scale_and_focus_at(scene):
    assert (
        render("--depth", "millimetres.npy", "--depth-scale", "0.001", "--focus-at", "20,3", "--f-number", "0.4") == 0
    )
    image, depth = tensors()
    expected = tb.LensBlur(tb.ThinLens(0.05, 0.4, 5.0, 0.036))(image, depth)
    assert_rendered(expected)


@pytest.mark.parametrize("focus", [("--focus-disparity", "0.2"), ("--focus-at", "30,20")])
def test_disparity(scene, focus):
    assert render("--disparity", "disparity.npy", "--strength", "10", *focus) == 0
    image, disparity = tensors("disparity")
    expected = tb.LensBlur(tb.DisparityLens(10.0, 0.2))(image, disparity)
    assert_rendered(expected)


def test_every_remaining_flag_reaches_the_blur(scene):
    threads = torch.get_num_threads()
    flags = "--f-number 0.1 --aperture 5-gon --max-coc 3.5 --layers 3 --exposure -1 --device cpu --threads 1"
    try:
        assert render(*THIN, *flags.split()) == 0
        assert torch.get_num_threads() == 1
    finally:
        torch.set_num_threads(threads)
    image, depth = tensors()
    blur = tb.LensBlur(tb.ThinLens(0.05, 0.1, 2.0, 0.036), aperture="5-gon", layers=3, max_coc=3.5)
    assert_rendered(blur(image, depth) / 2)


@pytest.mark.parametrize(
    ("flags", "dispersion"),
    [
        ("--dispersion 0.5", tb.Dispersion("BK7", 0.5)),
        ("--lateral=-0.2", tb.Dispersion("BK7", 0.0, -0.2)),
        (
            "--dispersion 0.3 --lateral 0.1 --glass SF11 --spectrum continuous",
            tb.Dispersion("SF11", 0.3, 0.1, spectrum="continuous"),
        ),
    ],
)
def test_dispersion(scene, flags, dispersion):
    assert render(*THIN, "--f-number", "0.5", *flags.split()) == 0
    image, depth = tensors()
    plain = tb.LensBlur(tb.ThinLens(0.05, 0.5, 2.0, 0.036))(image, depth)
    assert_rendered(tb.LensBlur(tb.ThinLens(0.05, 0.5, 2.0, 0.036, dispersion=dispersion))(image, depth))
    assert not torch.allclose(read_image("out.tif"), plain, atol=0.01)


def test_focus_at_infinity(scene):
    assert main(["render", "image.tif", "--depth", "depth.npy", "--focus", "inf", "-o", "out.png"]) == 0
    assert (scene / "out.png").exists()


BAD_FLAGS = [
    ("", "the following arguments are required: COMMAND"),
    ("paint", "invalid choice: 'paint'"),
    ("render", "required: IMAGE, -o/--output"),
    ("render image.tif -o out.png --focus 2", "one of the arguments --depth --disparity is required"),
    ("render image.tif -o out.png --depth depth.npy", "--focus --focus-at --focus-disparity is required"),
    ("{thin} --focus-at 1,1", "not allowed with argument"),
    ("{thin} --nonsense 3", "unrecognized arguments: --nonsense 3"),
    ("{thin} --f-number 0", "argument --f-number: expected a number above 0, got '0'"),
    ("{thin} --f-number=-2", "argument --f-number: expected a number above 0, got '-2'"),
    ("{thin} --f-number nan", "argument --f-number: expected a number, got 'nan'"),
    ("{thin} --f-number inf", "argument --f-number: expected a finite number, got 'inf'"),
    ("{thin} --focal-length 50in", "argument --focal-length: expected a number, got '50in'"),
    ("{thin} --focal-length mm", "argument --focal-length: expected a number, got ''"),
    ("{thin} --focal-length=-5mm", "argument --focal-length: expected a length above 0"),
    ("{thin} --focal-length 50", "not beyond the focal length 50 m; focus farther away, and write millimetres as 50mm"),
    ("{thin} --focal-length inf", "not beyond the focal length"),
    ("{thin} --sensor-width inf", "sensor_width: expected a positive finite"),
    ("{thin} --depth-scale 0", "argument --depth-scale: expected a number above 0"),
    ("{thin} --exposure 1e9", "argument --exposure: expected between -30 and 30 stops"),
    ("{thin} --max-coc 0", "argument --max-coc: expected a number above 0"),
    ("{thin} --layers 0", "argument --layers: expected a whole number from 1 to 1024"),
    ("{thin} --layers many", "argument --layers: expected a whole number from 1 to 1024"),
    ("{thin} --threads 100000", "argument --threads: expected a whole number from 1 to 1024"),
    ("{thin} --device tpu", "argument --device: invalid choice: 'tpu'"),
    ("{thin} --aperture blob", "argument --aperture: "),
    ("{thin} --aperture 2-gon", "argument --aperture: "),
    ("{thin} --strength 3", "--strength has no meaning with --depth; leave it out"),
    ("{thin} --dispersion nan", "argument --dispersion: expected a number, got 'nan'"),
    ("{thin} --lateral inf", "argument --lateral: expected a finite number, got 'inf'"),
    ("{thin} --dispersion 1 --glass butter", "glass: expected one of"),
    ("{thin} --dispersion 1 --spectrum cmyk", "argument --spectrum: invalid choice: 'cmyk'"),
    ("{thin} --glass BK7", "--glass has no meaning without --dispersion or --lateral"),
    ("{thin} --spectrum rgb", "--spectrum has no meaning without --dispersion or --lateral"),
    ("{depth} --focus 49mm", "the focus distance 0.049 m is not beyond the focal length 0.05 m"),
    ("{depth} --focus 0", "argument --focus: expected a length above 0"),
    ("{depth} --focus-at 1;1", "argument --focus-at: expected a pixel X,Y such as 320,240, got '1;1'"),
    ("{depth} --focus-at 32,0", "pixel 32,0 lies outside the 32 x 24 map"),
    ("{depth} --focus-disparity 1", "--focus-disparity has no meaning with --depth"),
    ("{disparity} --focus-at 1,1", "--disparity needs --strength"),
    ("{disparity} --strength 3 --focus 2", "--focus has no meaning with --disparity"),
    ("{disparity} --strength 3 --focus-at 1,1 --f-number 2", "--f-number has no meaning with --disparity"),
    ("{disparity} --strength 3 --focus-at 1,1 --dispersion 1", "--dispersion has no meaning with --disparity"),
    ("{disparity} --strength 3 --focus-at 1,1 --lateral 0", "--lateral has no meaning with --disparity"),
    ("{disparity} --strength 3 --focus-at 1,1 --glass BK7", "--glass has no meaning with --disparity"),
    ("{disparity} --strength 3 --focus-at 1,1 --spectrum rgb", "--spectrum has no meaning with --disparity"),
    ("{disparity} --strength=-3 --focus-at 1,1", "argument --strength: expected a number above 0"),
    ("{disparity} --strength 3 --focus-disparity inf", "argument --focus-disparity: expected a finite number"),
]


@pytest.mark.parametrize(("line", "message"), BAD_FLAGS)
def test_wrong_flags(scene, capsys, line, message):
    start = "render image.tif -o out.png"
    line = line.format(
        thin=f"{start} --depth depth.npy --focus 2",
        depth=f"{start} --depth depth.npy",
        disparity=f"{start} --disparity disparity.npy",
    )
    assert_refused(scene, capsys, line.split(), message)


def assert_refused(scene, capsys, argv, message):
    """Status 2, one line on stderr, nothing on stdout, no file changed."""
    before = {path.name: path.stat().st_mtime_ns for path in scene.iterdir()}
    assert main(argv) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith("torchbokeh: ")
    assert said.err.count("\n") == 1
    assert message in said.err
    assert {path.name: path.stat().st_mtime_ns for path in scene.iterdir()} == before


def save(name, value, where=(3, 5), shape=(24, 32)):
    values = np.ones(shape, np.float32)
    values[where] = value
    np.save(name, values)


@pytest.mark.parametrize(
    ("kind", "value", "message"),
    [
        ("depth", np.nan, "map.npy: 1 values are not positive, the first at 5,3 is nan; fill them first"),
        ("depth", -1.0, "the first at 5,3 is -1; fill them first"),
        ("depth", 0.0, "the first at 5,3 is 0; fill them first"),
        ("disparity", np.nan, "map.npy: 1 values are not finite, the first at 5,3 is nan; fill them first"),
        ("disparity", np.inf, "the first at 5,3 is inf; fill them first"),
    ],
)
def test_wrong_map_values(scene, capsys, kind, value, message):
    save("map.npy", value)
    flags = ["--focus", "2"] if kind == "depth" else ["--focus-disparity", "1", "--strength", "2"]
    argv = ["render", "image.tif", f"--{kind}", "map.npy", *flags, "-o", "out.png"]
    assert_refused(scene, capsys, argv, message)


def test_sizes_that_differ(scene, capsys):
    save("small.npy", 1.0, shape=(12, 16))
    argv = ["render", "image.tif", "--depth", "small.npy", "--focus", "2", "-o", "out.png"]
    assert_refused(scene, capsys, argv, "small.npy: is 16 x 12, but image.tif is 32 x 24; resize one to the other")


@pytest.mark.parametrize(
    ("image", "depth", "out", "message"),
    [
        ("missing.png", "depth.npy", "out.png", "missing.png: does not exist; check the name"),
        ("image.tif", "missing.npy", "out.png", "missing.npy: does not exist; check the name"),
        ("depth.npy.txt", "depth.npy", "out.png", "cannot read .txt"),
        ("image.tif", "image.tif", "out.png", "image.tif: its 3 channels differ; save the map as one channel"),
        ("image.tif", "depth.npy", "out.jpg", "out.jpg: cannot write .jpg"),
        ("image.tif", "depth.npy", "no/out.png", "the folder no does not exist; create it first"),
        ("missing.png", "depth.npy", "no/out.png", "the folder no does not exist"),  # the output is checked first
    ],
)
def test_wrong_files(scene, capsys, image, depth, out, message):
    assert_refused(scene, capsys, ["render", image, "--depth", depth, "--focus", "2", "-o", out], message)


@pytest.mark.skipif(torch.cuda.is_available(), reason="a CUDA device is there")
def test_cuda_that_is_not_there(scene, capsys):
    argv = ["render", "image.tif", *THIN, "--device", "cuda", "-o", "out.png"]
    assert_refused(scene, capsys, argv, "--device cuda: PyTorch finds no CUDA device; use --device cpu")


def test_a_message_of_several_lines_becomes_one(scene, capsys, monkeypatch):
    def fail(path):
        raise OSError("one\ntwo")

    monkeypatch.setattr("torchbokeh.commands.picture_flags.read_image", fail)
    assert_refused(scene, capsys, ["render", "image.tif", *THIN, "-o", "out.png"], "torchbokeh: one two\n")


@pytest.mark.parametrize(
    ("error", "status", "message"),
    [(KeyboardInterrupt(), 130, "interrupted"), (torch.OutOfMemoryError("CUDA"), 2, "the GPU is out of memory")],
)
def test_interruption_and_full_gpu(scene, capsys, monkeypatch, error, status, message):
    def fail(path):
        raise error

    monkeypatch.setattr("torchbokeh.commands.picture_flags.read_image", fail)
    assert render(*THIN) == status
    assert capsys.readouterr().err.startswith(f"torchbokeh: {message}")


def test_demo_passes_its_folder_on(scene, capsys, monkeypatch):
    folders = []
    monkeypatch.setattr("torchbokeh.commands.demo.run_demo", folders.append)
    assert main(["demo"]) == 0
    assert main(["demo", "--out", "elsewhere"]) == 0
    assert [str(folder) for folder in folders] == ["out/demo", "elsewhere"]


def test_demo_into_a_file(scene, capsys):
    assert_refused(
        scene,
        capsys,
        ["demo", "--out", "depth.npy"],
        "depth.npy: cannot be made a folder (File exists); choose another",
    )


@pytest.mark.parametrize("argv", [["--help"], ["render", "--help"], ["demo", "--help"], ["--version"]])
def test_help_and_version(capsys, argv):
    with pytest.raises(SystemExit) as caught:
        main(argv)
    assert caught.value.code == 0
    said = capsys.readouterr().out
    assert said == f"torchbokeh {version('torchbokeh')}\n" if argv == ["--version"] else "usage" in said


def test_module_runs_without_a_traceback(tmp_path):
    command = [sys.executable, "-m", "torchbokeh", "render", "missing.png"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert done.stderr.startswith("torchbokeh: ")


@pytest.fixture
def printed_to(monkeypatch):
    """Have standard output be a file, buffered or not; it is closed afterwards."""
    opened = []

    def open_as(file, unbuffered):
        raw = io.FileIO(file, "w")
        opened.append(io.TextIOWrapper(raw if unbuffered else io.BufferedWriter(raw), write_through=unbuffered))
        monkeypatch.setattr(sys, "stdout", opened[-1])

    yield open_as
    for stream in opened:
        stream.close()


PRINTING = [["--help"], ["--version"], ["psfs", "--help"], ["psfs", "table", "simple-lens", "--held-out", "1"]]


@pytest.mark.skipif(sys.platform != "linux", reason="needs a device that is full")
@pytest.mark.parametrize("unbuffered", [False, True])
@pytest.mark.parametrize("argv", PRINTING, ids=" ".join)
def test_a_full_disk_under_standard_output(capsys, printed_to, argv, unbuffered):
    printed_to("/dev/full", unbuffered)
    assert main(argv) == 2
    assert capsys.readouterr().err == "torchbokeh: standard output: cannot be written (No space left on device)\n"


@pytest.mark.parametrize("unbuffered", [False, True])
@pytest.mark.parametrize("argv", PRINTING, ids=" ".join)
def test_a_pipe_that_nobody_reads(capsys, printed_to, argv, unbuffered):
    """Not worth a word: after ``| head`` nobody wants more."""
    read, write = os.pipe()
    os.close(read)
    printed_to(write, unbuffered)
    assert main(argv) == 141
    assert capsys.readouterr().err == ""


def test_an_error_after_what_nobody_reads(scene, capsys, printed_to, monkeypatch):
    """Ctrl-C ends the reader too: nothing is left in the buffer that the interpreter could fail to write."""

    def fail(*args):
        raise KeyboardInterrupt

    read, write = os.pipe()
    os.close(read)
    printed_to(write, False)
    monkeypatch.setattr("torchbokeh.commands.render.write_image", fail)
    assert render(*THIN) == 130
    assert capsys.readouterr().err == "torchbokeh: interrupted\n"
    sys.stdout.flush()


def test_closed_standard_streams(scene, capsys, monkeypatch):
    for name, argv, status in (("stdout", THIN, 0), ("stderr", (), 2)):
        with monkeypatch.context() as patch:
            patch.setattr(sys, name, None)
            assert render(*argv) == status
            getattr(sys, name).close()
    assert capsys.readouterr().out == ""  # not what was meant for the closed stream either
