"""Every script in examples/ has ``--tiny`` and runs with it; those that make a picture put it at ``--out``.

A name that begins with an underscore is a module that scripts share, not a script.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image

EXAMPLES = Path(__file__).parent.parent / "examples"
SCRIPTS = sorted([*EXAMPLES.glob("[!_]*.py"), *EXAMPLES.glob("benchmarks/[!_]*.py")])
PICTURES = {"quickstart.py": ("new/a.png", 1), "focus_pull.py": ("new/a.gif", 4)}  # name, frames


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: str(path.relative_to(EXAMPLES)))
def test_example_runs(script, tmp_path):
    picture, frames = PICTURES.get(script.name, (None, 0))
    command = [sys.executable, str(script), "--tiny", *(["--out", picture] if picture else [])]
    env = {**os.environ, "OMP_NUM_THREADS": "1"}  # tests may run in parallel
    done = subprocess.run(command, cwd=tmp_path, env=env, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip(), "an example says what it found or wrote"
    if picture:
        with Image.open(tmp_path / picture) as image:
            assert image.size == (74, 50)
            assert getattr(image, "n_frames", 1) == frames


def test_the_examples_are_found():
    assert PICTURES.keys() <= {script.name for script in SCRIPTS}
