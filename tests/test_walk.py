import importlib.util
from pathlib import Path

import pytest

spec = importlib.util.spec_from_file_location("walk", Path(__file__).with_name("walk.py"))
assert spec is not None
assert spec.loader is not None
walk = importlib.util.module_from_spec(spec)
spec.loader.exec_module(walk)

MOST = {"plain": (9, 10), "dispersion": (9, 10), "motion": (12, 14), "motion and dispersion": (12, 14)}
"""Functions on the longest way from a forward pass to a kernel, and files on all of them."""


@pytest.mark.parametrize("quality", walk.QUALITIES)
def test_the_way_to_a_kernel_is_short(quality: str) -> None:
    for name, found in walk.walks(quality).items():
        functions, files = MOST[name]
        assert found.chain[0][1] == "forward"
        assert len(found.chain) <= functions, found.chain
        assert len(found.files) <= files, sorted(found.files)
