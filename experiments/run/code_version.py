"""Which code makes a result: our files behind a module, their hash, and the libraries' versions.

Read from the import statements, without importing anything. A process reads each file once.
"""

import functools
import hashlib
import importlib.metadata
import os
import re
from collections.abc import Iterator
from pathlib import Path

SOURCE_ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("mapfusion", "sim", "experiments")
# These find methods by name, so their imports reach every method there is. What a name stands for
# is in a stage's settings, and its source in `Stage.loads`.
_FINDS_BY_NAME = frozenset({"mapfusion/align/registry.py"})
_DATA = ".urdf"  # files that a module reads from its own folder
_KEPT = (".py", _DATA)
_NUMERICAL_LIBRARIES = ("numba", "numpy", "opencv-python-headless", "pyarrow", "pybullet", "scipy")
# Parsing all files would take each process that is started tenths of a second, so a statement is
# told by its looks. A line of a text may have them, too: at worst that adds a file.
_STATEMENT = re.compile(
    r"""
    [\r\n;:][ \t\f]*  # what may stand before a statement
    (?:from\b(?P<package>(?:[\w. \t\f]|\\\r?\n)+?))?
    \bimport\b(?P<names>\s*\((?:[^()#]|\#.*)*\)|(?:[\w.,* \t\f]|\\\r?\n)+)
    """,
    re.VERBOSE,
)
_NO_NAME = re.compile(r"#.*|[()\\]")


@functools.cache
def library_versions() -> dict[str, str]:
    """Installed versions of the libraries whose arithmetic ends up in the results."""
    return {name: importlib.metadata.version(name) for name in _NUMERICAL_LIBRARIES}


@functools.cache
def source_hash(parts: tuple[str, ...] = PACKAGES) -> str:
    """Hash of source files; of packages, all files in them. Paths below the project's root."""
    digest = hashlib.sha256()
    for part in parts:
        for file in _files_below(SOURCE_ROOT, part):
            digest.update(file.encode() + b"\0")
            digest.update(_content(SOURCE_ROOT, file))
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
    reached: set[str] = set()
    todo: list[str] = []
    for module in modules:
        path = _file_of(SOURCE_ROOT, module)
        if path is None:
            raise ValueError(f"{module}: no module below {SOURCE_ROOT}")
        folder, _, name = path.rpartition("/")
        inside = _files_below(SOURCE_ROOT, folder) if name == "__init__.py" else (path,)
        todo += [file for file in inside if not file.endswith(_DATA)]
    while todo:
        path = todo.pop()
        if path not in reached:
            reached.add(path)
            todo += imports_of(SOURCE_ROOT, path)
    folders = {path.rpartition("/")[0] for path in reached}
    data = {
        file
        for package in PACKAGES
        for file in _files_below(SOURCE_ROOT, package)
        if file.endswith(_DATA) and file.rpartition("/")[0] in folders
    }
    return tuple(sorted(reached | data))


@functools.cache
def imports_of(root: Path, path: str) -> tuple[str, ...]:
    """Files of ours that a file imports, those imported inside of functions too.

    All paths are below `root`.
    """
    if path in _FINDS_BY_NAME:
        return ()
    text = "\n" + _content(root, path).decode(errors="replace")
    found: list[str | None] = []
    for package, names in _imported_names(text):
        if package is None:
            found += [_file_of(root, name) for name in names]
        else:  # what is imported from a package may be a module in it
            whole = _file_of(root, package)
            found += [_file_of(root, f"{package}.{name}") or whole for name in names]
    return tuple(filter(None, found))


def _imported_names(text: str) -> Iterator[tuple[str | None, list[str]]]:
    """Of each import statement: what it imports from, if it says so, and the names it imports."""
    for statement in _STATEMENT.finditer(text):
        package = statement["package"]
        listed = (name.split() for name in _NO_NAME.sub(" ", statement["names"]).split(","))
        names = [name for name, *_ in filter(None, listed)]  # without `as` and what follows
        yield (package and "".join(package.replace("\\", " ").split())), names


@functools.cache
def _file_of(root: Path, module: str) -> str | None:
    package, *_ = module.split(".")
    if package not in PACKAGES:
        return None
    path = module.replace(".", "/")
    known = _known_files(root, package)
    return next((name for name in (f"{path}.py", f"{path}/__init__.py") if name in known), None)


@functools.cache
def _known_files(root: Path, part: str) -> frozenset[str]:
    return frozenset(_files_below(root, part))


@functools.cache
def _files_below(root: Path, part: str) -> tuple[str, ...]:
    """A file that is source or data; of a folder, all of them in it, sorted folder by folder."""
    if not (root / part).is_dir():
        return (part,) if part.endswith(_KEPT) else ()
    found = []
    for folder, _, names in os.walk(root / part):
        place = Path(folder).relative_to(root).as_posix()
        found += [f"{place}/{name}" for name in names if name.endswith(_KEPT)]
    return tuple(sorted(found, key=lambda file: file.split("/")))


@functools.cache
def _content(root: Path, path: str) -> bytes:
    return (root / path).read_bytes()
