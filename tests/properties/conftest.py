"""Puts the folder among the packages, as ``properties``: `examples/benchmarks/search.py` does the same."""

import importlib.util
import sys
from pathlib import Path

if "properties" not in sys.modules:
    folder = Path(__file__).parent
    spec = importlib.util.spec_from_file_location(
        "properties", folder / "__init__.py", submodule_search_locations=[str(folder)]
    )
    assert spec is not None
    assert spec.loader is not None
    sys.modules["properties"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(sys.modules["properties"])
