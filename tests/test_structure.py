"""The street plan, held: sizes, names that occur once, and packages alone at the harness's top."""

import ast
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("mapfusion", "sim", "experiments", "tests")
MOST_LINES = 350  # of a file: what one sitting reads
MOST_FUNCTION_LINES = 60  # what a screen shows
FILES = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_files_and_functions_are_of_a_size_to_read(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= MOST_LINES
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and node.end_lineno:
            assert node.end_lineno - node.lineno < MOST_FUNCTION_LINES, node.name


def test_no_name_of_a_file_or_class_occurs_twice_in_the_harness() -> None:
    files = [p for p in FILES if p.is_relative_to(ROOT / "experiments") and p.stem != "__init__"]
    names = Counter(path.name for path in files)
    for path in files:
        tree = ast.parse(path.read_text(encoding="utf-8"))
        names.update(node.name for node in ast.walk(tree) if isinstance(node, ast.ClassDef))
    assert [name for name, n in names.items() if n > 1] == []


def test_the_top_of_the_harness_holds_packages_that_say_what_they_are() -> None:
    top = ROOT / "experiments"
    assert sorted(path.name for path in top.glob("*.py")) == ["__init__.py", "__main__.py"]
    packages = [path.parent for path in top.glob("*/__init__.py")]
    assert len(packages) == 7
    for package in packages:
        assert ast.get_docstring(ast.parse((package / "__init__.py").read_text(encoding="utf-8")))
