"""Every script in examples/ has ``--tiny`` and runs with it; those that make a picture put it at ``--out``.

A name that begins with an underscore is a module that scripts share, not a script.
"""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
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
}


def run(command, folder):
    """Run Python with these arguments; return what it printed."""
    env = {**os.environ, "OMP_NUM_THREADS": "1"}  # tests may run in parallel
    done = subprocess.run([sys.executable, *command], cwd=folder, env=env, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip(), "an example says what it found or wrote"
    return done.stdout


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


@pytest.mark.slow
def test_two_processes_train_together(tmp_path):
    torchrun = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    said = run([*torchrun, str(EXAMPLES / "train_distributed.py"), "--tiny"], tmp_path)
    assert "2 processes" in said
    before, after = (float(loss) for loss in re.findall(r"loss ([0-9.]+)", said))
    assert after < 0.8 * before
    assert len(list(tmp_path.glob("out/train/shard-*.tar"))) == 4
