"""Which of our files some code runs: what a key covers when a whole package would be too much.

Read from the import statements, without importing anything.
"""

import ast
import functools
from collections.abc import Iterator
from pathlib import Path

from experiments.methods.installed import Kind, KnownMethod
from experiments.store import SOURCE_ROOT


@functools.cache
def imported_sources(*modules: str) -> tuple[str, ...]:
    """Files of these modules of ours and of all they import of ours, directly or not.

    Args:
        modules: dotted names.

    Returns:
        Paths below the project's root, sorted.

    Raises:
        ValueError: a name that is no module of ours.
    """
    reached: set[Path] = set()
    todo = []
    for module in modules:
        path = _file_of(module)
        if path is None:
            raise ValueError(f"{module}: no module below {SOURCE_ROOT}")
        todo.append(path)
    while todo:
        path = todo.pop()
        if path not in reached:
            reached.add(path)
            todo += _imports(path)
    return tuple(sorted(path.relative_to(SOURCE_ROOT).as_posix() for path in reached))


def method_sources(method: KnownMethod) -> tuple[str, ...]:
    """Our own files behind an aligner's answers, as `Store.stage` takes them."""
    if method.kind is Kind.PLUG_IN:  # it may import whatever helps it
        return ("mapfusion/align",)
    return imported_sources(method.target.partition(":")[0])


def _imports(path: Path) -> Iterator[Path]:
    """Files of ours that the file imports, those imported inside of functions too."""
    for node in ast.walk(ast.parse(path.read_bytes(), str(path))):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            # what is imported from a package may be a module in it
            names = [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
        yield from filter(None, map(_file_of, names))


def _file_of(module: str) -> Path | None:
    path = SOURCE_ROOT.joinpath(*module.split("."))
    for candidate in (path.with_suffix(".py"), path / "__init__.py"):
        if candidate.is_file():
            return candidate
    return None
