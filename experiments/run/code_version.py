"""Which code makes a result: our files behind a module, their hash, and the libraries' versions.

Read from the import statements, without importing anything.
"""

import ast
import functools
import hashlib
import importlib.metadata
from collections.abc import Iterator
from pathlib import Path

SOURCE_ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("mapfusion", "sim", "experiments")
# These find methods by name, so their imports reach every method there is. What a name stands for
# is in a stage's settings, and its source in `Stage.loads`.
_FINDS_BY_NAME = frozenset({"mapfusion.align.registry"})
_HOLD_STATEMENTS = (ast.stmt, ast.ExceptHandler, ast.match_case)
_DATA = "*.urdf"  # files that a module reads from its own folder
_NUMERICAL_LIBRARIES = ("numba", "numpy", "opencv-python-headless", "pyarrow", "pybullet", "scipy")


@functools.cache
def library_versions() -> dict[str, str]:
    """Installed versions of the libraries whose arithmetic ends up in the results."""
    return {name: importlib.metadata.version(name) for name in _NUMERICAL_LIBRARIES}


@functools.cache
def source_hash(parts: tuple[str, ...] = PACKAGES) -> str:
    """Hash of source files; of packages, all files in them. Paths below the project's root."""
    digest = hashlib.sha256()
    for part in parts:
        path = SOURCE_ROOT / part
        files = sorted(path.rglob("*")) if path.is_dir() else [path]
        for file in files:
            if file.match("*.py") or file.match(_DATA):
                digest.update(str(file.relative_to(SOURCE_ROOT)).encode() + b"\0")
                digest.update(file.read_bytes())
    return digest.hexdigest()


@functools.cache
def imported_sources(*modules: str) -> tuple[str, ...]:
    """Files of these modules of ours and of all they import of ours, directly or not.

    A package stands for all that is in it.

    Returns:
        Paths below the project's root, sorted, data files of the modules' folders among them.

    Raises:
        ValueError: a name that is no module of ours.
    """
    reached: set[Path] = set()
    todo: list[Path] = []
    for module in modules:
        path = _file_of(module)
        if path is None:
            raise ValueError(f"{module}: no module below {SOURCE_ROOT}")
        todo += path.parent.rglob("*.py") if path.name == "__init__.py" else [path]
    while todo:
        path = todo.pop()
        if path not in reached:
            reached.add(path)
            todo += _imports(path)
    data = {file for folder in {path.parent for path in reached} for file in folder.glob(_DATA)}
    return tuple(sorted(path.relative_to(SOURCE_ROOT).as_posix() for path in reached | data))


@functools.cache
def _imports(path: Path) -> tuple[Path, ...]:
    """Files of ours that the file imports, those imported inside of functions too."""
    if path in {_file_of(module) for module in _FINDS_BY_NAME}:
        return ()
    found: list[Path | None] = []
    for node in _statements(ast.parse(path.read_bytes(), str(path))):
        if isinstance(node, ast.Import):
            found += [_file_of(alias.name) for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            # what is imported from a package may be a module in it
            package, names = node.module, [alias.name for alias in node.names]
            found += [_file_of(f"{package}.{name}") or _file_of(package) for name in names]
    return tuple(filter(None, found))


def _statements(node: ast.AST) -> Iterator[ast.AST]:
    """All statements below a node; imports are no expressions, which would be most of the tree."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, _HOLD_STATEMENTS):
            yield child
            yield from _statements(child)


def _file_of(module: str) -> Path | None:
    package, *_ = names = module.split(".")
    if package not in PACKAGES:
        return None
    path = SOURCE_ROOT.joinpath(*names)
    candidates = (path.with_suffix(".py"), path / "__init__.py")
    return next((candidate for candidate in candidates if candidate.is_file()), None)
