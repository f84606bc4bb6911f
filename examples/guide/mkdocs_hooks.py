"""Lets mkdocstrings read the package: its folders torchbokeh, ops and psfs are put together as in an installed one."""

import shutil
import tempfile
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.plugins import event_priority

ROOT = Path(__file__).resolve().parents[2]
_assembled = tempfile.TemporaryDirectory()  # removed when the build ends


@event_priority(100)  # before mkdocstrings reads its settings
def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Copy the sources into one package, and have the API read from there."""
    package = Path(_assembled.name) / "torchbokeh"
    for folder, place in (("torchbokeh", package), ("ops", package / "ops"), ("psfs", package / "psfs")):
        ignored = shutil.ignore_patterns("__pycache__", "*.safetensors")
        shutil.copytree(ROOT / folder, place, ignore=ignored, dirs_exist_ok=True)
    for file in package.rglob("*.py"):
        text = file.read_text(encoding="utf-8")
        file.write_text(text.replace(" Example:\n", " Examples:\n"), encoding="utf-8")  # what is shown as code
    config.plugins["mkdocstrings"].config.handlers["python"]["paths"] = [_assembled.name]
    return config
