import subprocess
import sys

import pytest

from torchbokeh.report.speed import memory as module
from torchbokeh.report.speed.memory import is_known, peak_memory

linux = pytest.mark.skipif(not is_known(), reason="only Linux tells the peak")


@linux
def test_resident_memory_grows_with_what_is_held():
    """In a process of its own: here the allocator may hand out memory that an earlier test left resident."""
    lines = [
        "import torch",
        "from torchbokeh.report.speed.memory import resident",
        "before = resident('VmRSS')",
        "held = torch.ones(16 << 20)",
        "print(before, resident('VmRSS'), resident('VmHWM'))",
    ]
    done = subprocess.run([sys.executable, "-P", "-c", "\n".join(lines)], capture_output=True, text=True, check=True)
    before, now, most = map(int, done.stdout.split())
    assert now - before > 0.9 * (64 << 20)
    assert most >= now


@linux
def test_the_peak_of_a_layered_convolution_holds_its_spectra():
    """Four planes of 512 x 512 in float32 are 4 MB; the picture, its layer, its spectrum and the result are a few."""
    assert 8e6 < peak_memory("layered FFT 8, over", 512, 4.0) < 100e6


@linux
def test_a_failure_says_why():
    with pytest.raises(RuntimeError, match=r"peak memory of nobody: KeyError"):
        peak_memory("nobody", 64, 4.0)


def test_systems_that_do_not_tell_get_none(monkeypatch, tmp_path):
    monkeypatch.setattr(module, "_STATUS", tmp_path / "nothing")
    assert peak_memory("gather", 64, 4.0) is None
