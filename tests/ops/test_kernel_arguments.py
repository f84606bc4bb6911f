import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

import torchbokeh
import torchbokeh.ops

MOST = 8
KERNELS = sorted((Path(torchbokeh.ops.__file__).parent / "kernels").glob("*.py"))
MODULES = sorted(path for package in (torchbokeh, torchbokeh.ops) for path in Path(package.__path__[0]).rglob("*.py"))


def functions(source: str, *, operators_only: bool) -> Iterator[ast.FunctionDef]:
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.FunctionDef):
            decorators = " ".join(ast.unparse(decorator) for decorator in node.decorator_list)
            if not operators_only or "custom_op" in decorators:
                yield node


def count(function: ast.FunctionDef) -> int:
    a = function.args
    return sum(map(len, (a.posonlyargs, a.args, a.kwonlyargs))) + (a.vararg is not None) + (a.kwarg is not None)


def too_many(paths: list[Path], *, operators_only: bool) -> list[str]:
    """The functions that take more than `MOST` arguments, by file, line and name."""
    return [
        f"{path.name}:{function.lineno} {function.name} takes {count(function)}"
        for path in paths
        for function in functions(path.read_text(), operators_only=operators_only)
        if count(function) > MOST
    ]


def test_no_kernel_takes_many_arguments() -> None:
    assert len(KERNELS) > 5
    assert too_many(KERNELS, operators_only=False) == []


def test_no_operator_takes_many_arguments() -> None:
    found = [f.name for path in MODULES for f in functions(path.read_text(), operators_only=True)]
    assert {"_splat_merged_op", "_splat_points_op", "_foreground_over_rest_op"} <= set(found)
    assert too_many(MODULES, operators_only=True) == []


@pytest.mark.parametrize(
    "arguments", ["a, b, c, d, e, f, g, h, i", "a, /, b, c, d, e, f, g, *h, i", "a, b, c, d, e, f, g, *h, **i"]
)
def test_one_that_does_is_named(arguments: str, tmp_path: Path) -> None:
    path = tmp_path / "kernels.py"
    path.write_text(f"@torch.library.custom_op('x::y')\ndef crowded({arguments}): ...\ndef other(a): ...\n")
    for operators_only in (False, True):
        assert too_many([path], operators_only=operators_only) == ["kernels.py:2 crowded takes 9"]
