"""The guide and the README: Python code runs as it stands, links lead somewhere, tables are those of the report."""

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parents[1]
GUIDE = ROOT / "examples" / "guide"
PAGES = [ROOT / "README.md", *sorted(GUIDE.rglob("*.md"))]
LINKED = [*PAGES, ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md"]
NOT_INSTALLED = "# needs torchvision"
"""First line of a block that is compiled only: the tests bring no torchvision."""
SLOW = {"deployment.md"}
"""Pages whose code takes more than ten seconds."""


def _name(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def _blocks(page: Path) -> list[str]:
    """The fenced Python code of a page, in order."""
    return re.findall(r"^```python\n(.*?)^```", page.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)


def _code_of_pages() -> list[object]:
    pages = [page for page in PAGES if _blocks(page)]
    return [pytest.param(p, id=_name(p), marks=[pytest.mark.slow] if p.name in SLOW else []) for p in pages]


@pytest.mark.parametrize("page", _code_of_pages())
def test_code_runs(page: Path, tmp_path: Path) -> None:
    """One block after the other in one new interpreter, so that the later ones take the names from the first."""
    blocks = _blocks(page)
    for block in blocks:
        compile(block, _name(page), "exec")
    program = tmp_path / "page.py"
    program.write_text("\n".join(b for b in blocks if not b.startswith(NOT_INSTALLED)), encoding="utf-8")
    env = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"} | {"OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-P", "-W", "error", str(program)]
    done = subprocess.run(command, cwd=tmp_path, env=env, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("page", LINKED, ids=_name)
def test_links_lead_somewhere(page: Path) -> None:
    """Files only: the build of the guide checks the anchors."""
    links = re.findall(r"\]\(([^)#\s]+)", page.read_text(encoding="utf-8"))
    local = [link for link in links if "://" not in link]
    assert [link for link in local if not (page.parent / link).exists()] == []


def test_the_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 150


def test_pictures_of_pages_are_small() -> None:
    pictures = [file for folder in ("guide", "pictures") for file in (ROOT / "examples" / folder).rglob("*.*g")]
    assert pictures
    assert {_name(file) for file in pictures if file.stat().st_size > 300_000} == set()


def _make_benchmarks() -> ModuleType:
    spec = importlib.util.spec_from_file_location("make_benchmarks", GUIDE / "make_benchmarks.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_benchmarks_page_is_what_its_script_makes_of_the_committed_reports() -> None:
    make = _make_benchmarks()
    committed = make.PAGE.read_text(encoding="utf-8")
    assert make.page(committed, make.kept()) == committed


def test_tables_of_a_report_replace_those_between_the_marks(monkeypatch: pytest.MonkeyPatch) -> None:
    make = _make_benchmarks()
    machine = {"processor": "P", "processors": 2, "threads": 2, "Python": "3.11", "torch": "2", "numba": "0"}
    found = {"machine": machine, "commit": "abc"}
    report = "# Head\n\nx\n\n## One\n\n| a |\n\n### b\n\n## Two\n\nz\n"
    monkeypatch.setattr(make, "markdown", lambda found, plots: report)
    text = "<!-- report: One -->\n\nold\n\n<!-- /report -->\n<!-- report: Three -->\n\nby hand\n\n<!-- /report -->\n"
    made = make.page(text, [found, found])
    assert made.count("| a |\n\n### b\n\n") == made.count("Measured at abc: P, processors: 2") == 2
    assert "old" not in made
    assert "by hand" in made
    assert make.page(made, [found, found]) == made


def test_every_mark_of_the_benchmarks_page_is_a_section_of_the_report() -> None:
    """A mark of another name would never be filled."""
    source = "".join(file.read_text(encoding="utf-8") for file in (ROOT / "torchbokeh" / "report").rglob("*.py"))
    page = (GUIDE / "benchmarks.md").read_text(encoding="utf-8")
    titles = re.findall(r"^<!-- report: (.+) -->$", page, re.MULTILINE)
    assert titles
    assert page.count("<!-- /report -->") == len(titles)
    assert [title for title in titles if f'"{title}"' not in source] == []
