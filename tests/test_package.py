"""What is shipped: the wheel against the tree, what an import costs, and that imports run downwards only."""

import ast
import os
import shutil
import subprocess
import sys
import zipfile
from importlib.util import resolve_name
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
STOREYS = {"torchbokeh": "torchbokeh", "psfs": "torchbokeh.psfs", "ops": "torchbokeh.ops"}  # folder: package
MAY_IMPORT = {
    "ops": ("torchbokeh.ops",),
    "psfs": ("torchbokeh.ops", "torchbokeh.psfs"),
    "torchbokeh": ("torchbokeh",),
    "examples": ("torchbokeh",),
    "tests": ("torchbokeh",),
}
LAZY = (
    *("numba", "onnx", "onnxscript", "onnxruntime", "skimage", "matplotlib"),
    *("kornia", "PIL", "scipy", "OpenEXR", "tifffile", "webdataset"),
)


def _python(*args: str, cwd: Path, path: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Run a new interpreter in the folder ``cwd``, with only ``path`` as its PYTHONPATH."""
    env = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    if path is not None:
        env["PYTHONPATH"] = str(path)
    return subprocess.run([sys.executable, *args], cwd=cwd, env=env, capture_output=True, text=True)


def _output(*args: str, cwd: Path, path: Path | None = None) -> str:
    result = _python(*args, cwd=cwd, path=path)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A wheel built by way of a source archive, as for a release, from a copy: builds litter their folder."""
    tmp = tmp_path_factory.mktemp("build")
    for folder in STOREYS:
        shutil.copytree(ROOT / folder, tmp / "src" / folder, ignore=shutil.ignore_patterns("__pycache__"))
    for file in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / file, tmp / "src")
    # Without isolation nothing is downloaded; the extra `test` brings the build backend.
    _output("-m", "build", "--no-isolation", "--outdir", str(tmp / "dist"), str(tmp / "src"), cwd=tmp)
    return next((tmp / "dist").glob("*.whl"))


def test_wheel_holds_the_three_storeys_and_nothing_else(wheel: Path) -> None:
    expected = {
        f"{package.replace('.', '/')}/{file.relative_to(ROOT / folder).as_posix()}"
        for folder, package in STOREYS.items()
        for file in (ROOT / folder).rglob("*")
        if file.is_file() and "__pycache__" not in file.parts
    }
    shipped = {n for n in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in n}
    # Where a file is missing: does pyproject.toml list its folder in `packages`, its kind in `package-data`?
    assert shipped == expected


@pytest.mark.slow
def test_installed_wheel_is_imported_whole(wheel: Path, tmp_path: Path) -> None:
    """The dependencies stay those of this environment: a new virtual environment would download them."""
    site = tmp_path / "site"
    pip = ("-m", "pip", "install", "--quiet", "--no-index", "--no-deps", "--target", str(site), str(wheel))
    _output(*pip, cwd=tmp_path)
    code = (
        "import torchbokeh, torchbokeh.ops, torchbokeh.psfs\n"
        "from importlib.metadata import distribution\n"
        "main = [e.load() for e in distribution('torchbokeh').entry_points]\n"
        "for m in (torchbokeh, torchbokeh.ops, torchbokeh.psfs): print(m.__file__)\n"
        "for f in main: print(f.__code__.co_filename)"
    )
    files = [Path(line) for line in _output("-c", code, cwd=tmp_path, path=site).splitlines()]
    assert len(files) == 4
    assert all(site in file.parents for file in files), files


def test_import_leaves_rare_packages_alone(tmp_path: Path) -> None:
    code = f"import sys, torchbokeh; print(*(m for m in {LAZY} if m in sys.modules))"
    assert _output("-c", code, cwd=tmp_path).split() == []


def test_source_folder_alone_says_what_to_do(tmp_path: Path) -> None:
    shutil.copytree(ROOT / "torchbokeh", tmp_path / "torchbokeh")
    # -S leaves out site-packages and with it the real installation, editable or not.
    result = _python("-S", "-c", "import torchbokeh", cwd=tmp_path, path=tmp_path)
    assert result.returncode != 0
    last = result.stderr.splitlines()[-1]
    assert last.startswith("ImportError: torchbokeh was imported from a source folder without its parts")
    assert "pip install -e ." in last


def _imported(source: str, package: str) -> set[str]:
    """The full names that ``source``, a module of ``package``, imports, also inside its functions."""
    names = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            module = resolve_name("." * node.level + (node.module or ""), package)
            names |= {f"{module}.{alias.name}" for alias in node.names}
    return names


def _forbidden(names: set[str], allowed: tuple[str, ...]) -> set[str]:
    ours = {n for n in names if n.partition(".")[0] in STOREYS}
    return {n for n in ours if not any(n == a or n.startswith(a + ".") for a in allowed)}


@pytest.mark.parametrize("folder", MAY_IMPORT)
def test_imports_run_downwards_only(folder: str) -> None:
    found = {}
    for file in sorted((ROOT / folder).rglob("*.py")):
        inner = file.parent.relative_to(ROOT / folder).parts
        package = ".".join((STOREYS.get(folder, folder), *inner))
        names = _imported(file.read_text(encoding="utf-8"), package)
        found[file.relative_to(ROOT).as_posix()] = _forbidden(names, MAY_IMPORT[folder])
    assert {file: names for file, names in found.items() if names} == {}


ROOMS = (
    *("io", "lens", "picture", "plan", "banks", "compose", "scenes", "views"),
    *("renderers", "datasets", "learn", "report", "commands"),
)
"""Folders of torchbokeh/, from the bottom up: each imports itself and those before it."""

FORWARDED = {("scenes/__init__.py", "datasets")}
"""Names of data sets have been public in `torchbokeh.scenes` from the first, and are forwarded from there."""


def _room(name: str) -> str | None:
    """The room that a full name belongs to, if it is in one."""
    parts = name.split(".")
    return parts[1] if parts[0] == "torchbokeh" and len(parts) > 1 and parts[1] in ROOMS else None


def test_imports_run_downwards_between_rooms() -> None:
    assert {p.name for p in (ROOT / "torchbokeh").iterdir() if (p / "__init__.py").exists()} == set(ROOMS)
    upwards = {}
    for file in sorted((ROOT / "torchbokeh").rglob("*.py")):
        inner = file.relative_to(ROOT / "torchbokeh")
        if len(inner.parts) == 1:
            continue
        place, package = ROOMS.index(inner.parts[0]), ".".join(("torchbokeh", *inner.parent.parts))
        found = {_room(name) for name in _imported(file.read_text(encoding="utf-8"), package)} - {None}
        above = {room for room in found if ROOMS.index(str(room)) > place}
        above -= {room for where, room in FORWARDED if where == inner.as_posix()}
        if above:
            upwards[inner.as_posix()] = above
    assert upwards == {}


def _modules() -> dict[str, Path]:
    """Every module of the package, by its full name."""
    found = {}
    for folder, package in STOREYS.items():
        for file in (ROOT / folder).rglob("*.py"):
            parts = file.relative_to(ROOT / folder).with_suffix("").parts
            found[".".join((package, *(p for p in parts if p != "__init__")))] = file
    return found


def test_no_module_imports_itself_in_a_circle() -> None:
    """Kernels are left out: they take constants from their definitions, which load them when they are first called."""
    modules = _modules()
    imports = {}
    for name, file in modules.items():
        package = name if file.name == "__init__.py" else name.rpartition(".")[0]
        names = _imported(file.read_text(encoding="utf-8"), package)
        imports[name] = {n if n in modules else n.rpartition(".")[0] for n in names}
        imports[name] = {n for n in imports[name] if n in modules and ".kernels" not in n and n != name}
        if name == "torchbokeh.scenes":
            imports[name] -= {"torchbokeh.datasets"}
    while True:
        free = {name for name, those in imports.items() if not those & imports.keys()}
        if not free:
            break
        imports = {name: those for name, those in imports.items() if name not in free}
    assert imports == {}


LONGEST_FILE, LONGEST_FUNCTION, MOST_ARGUMENTS, MOST_SETTINGS = 400, 60, 10, 15


def test_files_and_functions_are_short() -> None:
    """Docstrings are not counted, and constructors may have more arguments: they name every setting."""
    long = {}
    for name, file in _modules().items():
        source = file.read_text(encoding="utf-8")
        if source.count("\n") > LONGEST_FILE:
            long[name] = source.count("\n")
        for node in ast.walk(ast.parse(source)):
            if not isinstance(node, ast.FunctionDef):
                continue
            first = node.body[0]
            said = ast.get_docstring(node) is not None and isinstance(first, ast.Expr)
            start = (first.end_lineno or 0) + 1 if said else first.lineno
            lines = (node.end_lineno or 0) - start + 1
            arguments = len(node.args.posonlyargs) + len(node.args.args) + len(node.args.kwonlyargs)
            most = MOST_SETTINGS if node.name == "__init__" else MOST_ARGUMENTS
            if lines > LONGEST_FUNCTION or arguments > most:
                long[f"{name}.{node.name}"] = max(lines, arguments)
    assert long == {}


@pytest.mark.parametrize(
    "line",
    ["import torchbokeh", "import ops.splat", "from torchbokeh import psfs", "from ..lens import ThinLens"],
)
def test_an_upward_import_is_seen(line: str) -> None:
    names = _imported(f"def f():\n    {line}", "torchbokeh.ops")
    assert _forbidden(names, MAY_IMPORT["ops"])
    assert not _forbidden(_imported("from . import checks", "torchbokeh.ops"), MAY_IMPORT["ops"])


def _files() -> list[Path]:
    """The files git keeps or would keep; outside a checkout, all but hidden, built and written ones."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    try:
        listed = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout
        files = [ROOT / name for name in listed.split("\0") if name]
    except (OSError, subprocess.CalledProcessError):
        written = {"build", "dist", "out"}
        tops = [f for f in ROOT.iterdir() if f.name not in written and not f.name.startswith(".")]
        files = [file for top in tops for file in (top, *top.rglob("*"))]
    return [file for file in files if file.is_file()]


def test_no_file_is_over_one_megabyte_and_the_banks_together_not_over_twelve() -> None:
    sizes = {file.relative_to(ROOT).as_posix(): file.stat().st_size for file in _files()}
    assert "pyproject.toml" in sizes
    banks = {name: size for name, size in sizes.items() if name.startswith("psfs/banks/")}
    assert sum(banks.values()) < 12_000_000
    assert {name: size for name, size in sizes.items() if size > 1_000_000 and name not in banks} == {}
