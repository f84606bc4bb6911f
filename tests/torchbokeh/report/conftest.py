"""One tiny report for all tests that read one."""

import pytest
import torch

from torchbokeh.report.chapter import run_experiments
from torchbokeh.report.settings import Settings
from torchbokeh.report.speed import gradients, sweeps

TINY = Settings(
    scenes=("photo", "coins"),
    repeat=2,
    budget=0.2,
    photo_size=64,
    photo_radii=(4.0,),
    recipe_size=48,
    recipe_radius=4.0,
    truth_size=40,
    truth_radius=3.0,
    truth_views=4,
    sweep_radii=(2.0, 4.0),
    sweep_sizes=(32, 64),
    sweep_radius=4.0,
    memory_sizes=(64,),
    layer_counts=(1, 3),
    motion_size=48,
    motions=((6.0, 10.0),),
    gradient_sizes=(40,),
    gradient_radii=(4.0,),
    export_qualities=(),
    export_sizes=(24, 32),
    chromatic_scenes=("coins",),
    chromatic_strengths=((0.5, 0.03),),
    chromatic_size=40,
    chromatic_radius=3.0,
    chromatic_truth=32,
    chromatic_views=(6, 12),
    chromatic_repeat=1,
    sample_views=(6, 12, 24),
    band_views=150,
)


@pytest.fixture(scope="session")
def tiny():
    return TINY


@pytest.fixture(scope="session")
def report():
    """What `run_experiments` finds at the tiny settings; memory, which takes processes, is made up."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sweeps, "peak_memory", lambda name, size, radius: size * size * (40 + len(name)))
        patch.setattr(gradients, "peak_memory", lambda name, size, radius, backward: size * size * len(name))
        found = run_experiments(TINY, lambda line: None)
    torch.set_num_threads(before)
    return found
