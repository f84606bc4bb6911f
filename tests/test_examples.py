"""Every script in examples/ has ``--tiny`` and runs with it; those that make a picture put it at ``--out``.

A name that begins with an underscore is a module that scripts share, not a script.
"""

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from PIL import Image

EXAMPLES = Path(__file__).parent.parent / "examples"
SCRIPTS = sorted([*EXAMPLES.glob("[!_]*.py"), *EXAMPLES.glob("benchmarks/[!_]*.py")])
PICTURES = {  # name, size, frames
    "quickstart.py": ("new/a.png", (74, 50), 1),
    "focus_pull.py": ("new/a.gif", (74, 50), 4),
    "scenes.py": ("new/a.png", (128, 192), 1),
    "operating_points.py": ("new/a.png", (148, 100), 1),
    "logo_bokeh.py": ("new/a.png", (80, 48), 1),
    "reconstruct.py": ("new/a.png", (192, 32), 1),
    "motion.py": ("new/a.png", (144, 32), 1),
    "depth_from_defocus.py": ("new/a.png", (320, 104), 1),
    "depth_from_focus.py": ("new/a.png", (96, 64), 1),
}


def run(command, folder):
    """Run Python with these arguments; return what it printed."""
    env = {**os.environ, "OMP_NUM_THREADS": "1"}  # tests may run in parallel
    done = subprocess.run([sys.executable, *command], cwd=folder, env=env, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip(), "an example says what it found or wrote"
    return done.stdout


@pytest.mark.slow
@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: str(path.relative_to(EXAMPLES)))
def test_example_runs(script, tmp_path):
    picture, size, frames = PICTURES.get(script.name, (None, None, 0))
    run([str(script), "--tiny", *(["--out", picture] if picture else [])], tmp_path)
    if picture:
        with Image.open(tmp_path / picture) as image:
            assert image.size == size
            assert getattr(image, "n_frames", 1) == frames


def test_the_examples_are_found():
    assert PICTURES.keys() <= {script.name for script in SCRIPTS}


def load(name):
    """An example as a module."""
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_network_learns_from_photographs_alone():
    example = load("depth_from_defocus")
    data = example.FocalStacks(seed=0, size=32, count=6, views=8).load(workers=0)
    del data["depth"]
    torch.manual_seed(0)
    losses = torch.tensor(list(example.train(example.UNet(), data, steps=40)))
    first, *_, last = losses.tensor_split(4)
    assert last.mean() < 0.9 * first.mean()


def test_depth_and_focus_move_through_soft_layers_only():
    example = load("depth_from_focus")
    image, truth, taken, strength = example.photographs(seed=1, size=32, views=32)
    start = 0.8 * truth + 0.1, 1 / torch.tensor(example.GUESS)
    soft, hard = example.lens_blur(strength), example.argmax_layers(strength)

    assert "none" not in example.gradients(soft, image, taken, start)
    depth, focus = example.descend(soft, image, taken, start, steps=10, even=0.0)
    before, after = (float(example.misfit(soft, image, taken, *at)) for at in (start, (depth, focus)))
    assert after < 0.9 * before
    assert (focus != start[1]).tolist() == [False, True, True, True]

    words = example.gradients(hard, image, taken, start)
    assert "picture none" not in words
    assert words.endswith("depth none, focus none")
    depth, focus = example.descend(hard, image, taken, start, steps=2, even=0.0)
    assert torch.equal(depth, start[0])
    assert torch.equal(focus, start[1])


def test_argmax_layers_look_like_the_lens_all_the_same():
    example = load("depth_from_focus")
    image, truth, taken, strength = example.photographs(seed=1, size=64, views=64)
    focus = 1 / torch.tensor(example.FOCUS)
    sharp = (example.shown(image) - example.shown(taken)).abs().mean()
    for way in (example.lens_blur, example.argmax_layers):
        assert example.misfit(way(strength), image, taken, truth, focus) < 0.35 * sharp


@pytest.mark.slow
def test_two_processes_train_together(tmp_path):
    torchrun = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    said = run([*torchrun, str(EXAMPLES / "train_distributed.py"), "--tiny"], tmp_path)
    assert "2 processes" in said
    before, after = (float(loss) for loss in re.findall(r"loss ([0-9.]+)", said))
    assert after < 0.8 * before
    assert len(list(tmp_path.glob("out/train/shard-*.tar"))) == 4
