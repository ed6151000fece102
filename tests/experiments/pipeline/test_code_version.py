"""Tests of `experiments.pipeline.code_version`."""

import ast
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest

from experiments.pipeline import code_version
from experiments.pipeline.code_version import PACKAGES, SOURCE_ROOT, use_kernel_cache

FILES = {
    "ours/__init__.py": "",
    "ours/start.py": "import numpy\nfrom ours import by_package, nested, spelled\n",
    "ours/by_package.py": "def late():\n    import ours.by_name\n",
    "ours/by_name.py": "from ours.by_module import number as renamed\n",
    "ours/nested.py": """
class Late:
    with open(__file__):
        for _ in ():
            pass
        else:
            try:
                pass
            except OSError:
                if True:
                    import ours.by_handler
    match 1:
        case 1:
            import ours.by_case
""",
    "ours/spelled.py": """import os
from ours import (  # not only this
    by_comment as one,  # ours.unused
    by_bracket,
)
from ours.kit import name, other
import numpy as np, ours.by_comma as last
""",
    "ours/by_comment.py": "",
    "ours/by_bracket.py": "",
    "ours/by_comma.py": "",
    "ours/kit/__init__.py": "",
    "ours/kit/other.py": "",
    "ours/by_handler.py": "",
    "ours/by_case.py": "",
    "ours/by_module.py": "from ours import start  # a circle\nnumber = 1\n",
    "ours/unused.py": "",
    "ours/robot.urdf": "",
}


@pytest.fixture(autouse=True)
def _nothing_read_yet() -> Iterator[None]:
    """The caches hold what a process has read; files change in a test alone."""
    _forget()
    yield
    _forget()


def _forget() -> None:
    for name in dir(code_version):
        clear = getattr(getattr(code_version, name), "cache_clear", None)
        if clear is not None:
            clear()


def test_every_import_of_ours_is_followed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, text in FILES.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    (tmp_path / "numpy.py").write_text("")  # beside ours, as where packages are installed
    deep = tmp_path / "ours" / "whole" / "within" / "deep.py"
    deep.parent.mkdir(parents=True)
    deep.write_text("from ours import unused\n")
    (tmp_path / "ours" / "whole" / "__init__.py").touch()
    monkeypatch.setattr(code_version, "SOURCE_ROOT", tmp_path)
    monkeypatch.setattr(code_version, "PACKAGES", ("ours",))
    found = code_version.imported_sources("ours.start")
    assert set(found) == set(FILES) - {"ours/unused.py", "ours/__init__.py"}
    expected = {"ours/unused.py", "ours/robot.urdf"}
    expected |= {f"ours/whole/{name}" for name in ("__init__.py", "within/deep.py")}
    assert set(code_version.imported_sources("ours.whole")) == expected


def test_statements_are_found_as_python_finds_them() -> None:
    for package in code_version.PACKAGES:
        for path in (code_version.SOURCE_ROOT / package).rglob("*.py"):
            name = path.relative_to(code_version.SOURCE_ROOT).as_posix()
            if name not in code_version._FINDS_BY_NAME:
                found = code_version.imports_of(code_version.SOURCE_ROOT, name)
                assert set(found) == _parsed_imports(path), name


def _parsed_imports(path: Path) -> set[str]:
    """Files of ours that a file imports, by Python's own parser."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_bytes())):
        if isinstance(node, ast.Import):
            found.update(*(_candidates(alias.name)[:1] for alias in node.names))
        elif isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                inside, whole = (
                    _candidates(m) for m in (f"{node.module}.{alias.name}", node.module)
                )
                found.update((inside or whole)[:1])
    return found


def _candidates(module: str) -> list[str]:
    path = module.replace(".", "/")
    files = (f"{path}.py", f"{path}/__init__.py")
    ours = module.split(".")[0] in code_version.PACKAGES
    return [file for file in files if ours and (code_version.SOURCE_ROOT / file).is_file()]


@pytest.mark.parametrize(
    ("file", "matters"),
    [
        ("ours/a.py", True),
        ("ours/new.py", True),
        ("ours/within/deep/er.py", True),
        ("ours/robot.urdf", True),
        ("single.py", True),
        ("ours/notes.txt", False),
        ("other.py", False),
    ],
)
def test_the_hash_is_of_all_source_and_of_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, file: str, matters: bool
) -> None:
    monkeypatch.setattr(code_version, "SOURCE_ROOT", tmp_path)
    (tmp_path / "ours").mkdir()
    for name in ("ours/a.py", "ours/robot.urdf", "ours/notes.txt", "single.py"):
        (tmp_path / name).write_text("1")

    def found() -> str:
        _forget()
        return code_version.source_hash(("ours", "single.py"))

    before = found()
    assert found() == before
    (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / file).write_text("2")
    changed = found()
    assert (changed != before) == matters
    if matters and file != "single.py":
        (tmp_path / file).rename(tmp_path / "ours" / f"moved{Path(file).suffix}")
        assert found() not in (before, changed)


KERNELS = {
    "callee": "@njit(cache=True)\ndef callee(x):\n    return x + 1\n",
    "caller": "from mapfusion.callee import callee\n"
    "@njit(cache=True)\ndef caller(x):\n    return 2 * callee(x)\n",
    "apart": "@njit(cache=True)\ndef apart(x):\n    return 3 * x\n",
}
CALL = """
import importlib, json
from experiments.pipeline.code_version import use_kernel_cache
use_kernel_cache()
told = {}
for name in ("caller", "apart"):
    kernel = getattr(importlib.import_module("mapfusion." + name), name)
    told[name] = kernel(10), bool(kernel.stats.cache_hits)
print(json.dumps(told))
"""


class Source:
    """A copy of ours with three kernels more, in an environment of its own."""

    def __init__(self, folder: Path) -> None:
        self._root, self.cache = folder / "source", folder / "cache"
        for package in PACKAGES:
            unwanted = shutil.ignore_patterns("__pycache__")
            shutil.copytree(SOURCE_ROOT / package, self._root / package, ignore=unwanted)
        for name in KERNELS:
            self.restore(name)

    def write(self, module: str, text: str) -> None:
        """Put a module of kernels in place."""
        path = self._root / "mapfusion" / f"{module}.py"
        path.write_text("from numba import njit\n" + text, encoding="utf-8")

    def restore(self, module: str) -> None:
        """Put a module of kernels in place as it was first, its time of change included."""
        self.write(module, KERNELS[module])
        os.utime(self._root / "mapfusion" / f"{module}.py", (1e9, 1e9))

    def called(self) -> dict[str, list[object]]:
        """Return the kernels' values for 10, and whether each kernel was in the cache."""
        left_out = {"NUMBA_CACHE_DIR", "PYTHONPATH"}
        environment = {name: value for name, value in os.environ.items() if name not in left_out}
        environment["XDG_CACHE_HOME"] = str(self.cache)
        # Python tells versions of a module apart by size and whole seconds; tests are faster
        environment["PYTHONDONTWRITEBYTECODE"] = "1"
        asked = partial(subprocess.run, [sys.executable, "-c", CALL], cwd=self._root)
        told = asked(env=environment, capture_output=True, text=True, check=True)
        return json.loads(told.stdout)

    @property
    def versions(self) -> list[Path]:
        """The folders of kernels, one for each version of the source."""
        return list((self.cache / "mapfusion" / "kernels").iterdir())


@pytest.fixture
def source(tmp_path: Path) -> Source:
    """Called once."""
    source = Source(tmp_path)
    assert source.called() == {"caller": [22, False], "apart": [30, False]}
    return source


def test_kernels_are_compiled_once(source: Source) -> None:
    assert source.called() == {"caller": [22, True], "apart": [30, True]}
    assert len(source.versions) == 1


def test_a_kernel_is_compiled_anew_when_one_that_it_calls_has_changed(source: Source) -> None:
    source.write("callee", KERNELS["callee"].replace("x + 1", "x + 2"))
    assert source.called() == {"caller": [24, False], "apart": [30, False]}
    source.restore("callee")
    assert source.called() == {"caller": [22, True], "apart": [30, True]}


def test_the_versions_used_last_are_kept(source: Source) -> None:
    (first,) = source.versions
    for age in range(20):
        old = first.with_name(f"old{age}")
        old.mkdir()
        os.utime(old, (1e9 - age, 1e9 - age))
    source.called()
    kept = {path.name for path in source.versions}
    assert kept == {first.name, *(f"old{age}" for age in range(7))}


def test_a_folder_chosen_by_the_user_is_left_alone(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", "chosen")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    use_kernel_cache()
    assert os.environ["NUMBA_CACHE_DIR"] == "chosen"
    assert not list(tmp_path.iterdir())


def test_kernels_of_experiments_call_none_of_experiments() -> None:
    """The name of the folder says nothing of the source of `experiments`."""
    found = 0
    for path in (SOURCE_ROOT / "experiments").rglob("*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        ours = {
            alias.asname or alias.name
            for node in ast.walk(tree)
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("experiments")
            for alias in node.names
        }
        for node in tree.body:
            if isinstance(node, ast.FunctionDef) and "kernel" in map(
                ast.unparse, node.decorator_list
            ):
                found += 1
                used = {each.id for each in ast.walk(node) if isinstance(each, ast.Name)}
                assert not used & ours, f"{path}: {node.name}"
    assert found
