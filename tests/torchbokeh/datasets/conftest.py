import importlib.util
from pathlib import Path

import pytest

# pytest puts no folder on the path: the helper beside this file is loaded by its place.
spec = importlib.util.spec_from_file_location("fake_dataset", Path(__file__).with_name("_fake.py"))
fake = importlib.util.module_from_spec(spec)
spec.loader.exec_module(fake)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A folder written in one go."""
    out = tmp_path_factory.mktemp("shards") / "new" / "whole"
    assert [path.name for path in fake.write(out)] == [f"shard-{j:06d}.tar" for j in range(7)]
    return out
