"""Stage of a run: settings, work and inputs, with a key that identifies the results.

A key is a hash of the stage's settings, the keys of the stages before it, the sources that its
function imports, and the versions of the libraries. Changed code or settings give a new key, so
stored results are never outdated. The function only receives its settings and its job, so it cannot
read anything that is not in the key. The sources of a module are found from import statements,
without importing anything. A process reads each file once.

Numba recompiles a kernel when its own file changes, but not when a kernel or a constant of another
file changes. So the folder of compiled kernels is named by a hash of all sources. All processes
share the folder. Numba writes whole files, so processes need no lock: at worst two processes
compile the same kernel at the same time.
"""

import contextlib
import functools
import hashlib
import importlib.metadata
import json
import os
import re
import shutil
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

SOURCE_ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("mapfusion", "sim", "experiments")
# These modules find methods by name and import all methods. The method is in a stage's settings,
# and its source in `Stage.loads`.
_FINDS_BY_NAME = frozenset({"mapfusion/align/aligners.py"})
_DATA = ".urdf"  # suffix of files that a module reads from its own folder
_KEPT = (".py", _DATA)
_MANUAL = "docs"  # of `experiments`: a link in a checkout, a folder in a copy of one; no source
_NUMERICAL_LIBRARIES = ("numba", "numpy", "opencv-python-headless", "pyarrow", "scipy")
_SIMULATOR = "pybullet"  # optional; used by modules of `sim` only
# Import statement as written by the formatter; Python's parser takes ten times as long.
_IMPORT = re.compile(r"^[ \t]*(?:from ([\w.]+) )?import (\([^)]*\)|.+)$", re.MULTILINE)
_NO_NAME = re.compile(r"#.*|[()]")


@functools.cache
def library_versions(*, simulator: bool = True) -> dict[str, str]:
    """Return installed versions of the libraries that the results depend on.

    Args:
        simulator: include PyBullet, if it is installed.
    """
    versions = {name: importlib.metadata.version(name) for name in _NUMERICAL_LIBRARIES}
    if simulator:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            versions[_SIMULATOR] = importlib.metadata.version(_SIMULATOR)
    return versions


@functools.cache
def source_hash(parts: tuple[str, ...] = PACKAGES) -> str:
    """Return a hash of source files and packages, given by paths below the project's root."""
    digest = hashlib.sha256()
    for part in parts:
        for file in _files_below(SOURCE_ROOT, part):
            digest.update(file.encode() + b"\0")
            digest.update(_content(SOURCE_ROOT, file))
    return digest.hexdigest()


@functools.cache
def imported_sources(*modules: str) -> tuple[str, ...]:
    """Return the files of modules of this project and of all their direct and indirect imports.

    A package stands for all its modules.

    Returns:
        Paths below the project's root, sorted, with the data files of the modules' folders.

    Raises:
        ValueError: a name is not a module of this project.
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
    """Return the project files that a file imports, also inside functions; paths below `root`."""
    if path in _FINDS_BY_NAME:
        return ()
    found: list[str | None] = []
    for package, listed in _IMPORT.findall(_content(root, path).decode()):
        names = [name.split()[0] for name in _NO_NAME.sub(" ", listed).split(",") if name.strip()]
        if package:  # an imported name may be a module of the package
            whole = _file_of(root, package)
            found += [_file_of(root, f"{package}.{name}") or whole for name in names]
        else:
            found += [_file_of(root, name) for name in names]
    return tuple(filter(None, found))


@functools.cache
def _file_of(root: Path, module: str) -> str | None:
    """Return the file of a module of this project, else None."""
    package, *_ = module.split(".")
    if package not in PACKAGES:
        return None
    path = module.replace(".", "/")
    known = _files_below(root, package)
    return next((name for name in (f"{path}.py", f"{path}/__init__.py") if name in known), None)


@functools.cache
def _files_below(root: Path, part: str) -> tuple[str, ...]:
    """Return the source and data files of a folder, sorted by folder, or the file itself."""
    if not (root / part).is_dir():
        return (part,) if part.endswith(_KEPT) else ()
    found = []
    for folder, subfolders, names in os.walk(root / part):
        subfolders[:] = [name for name in subfolders if name != _MANUAL]
        place = Path(folder).relative_to(root).as_posix()
        found += [f"{place}/{name}" for name in names if name.endswith(_KEPT)]
    return tuple(sorted(found, key=lambda file: file.split("/")))


@functools.cache
def _content(root: Path, path: str) -> bytes:
    return (root / path).read_bytes()


# Packages with kernels that other files use.
_SOURCES = ("mapfusion", "sim")
_VERSIONS_KEPT = 8  # a change between branches then needs no new compilation
_HASH_DIGITS = 16


def use_kernel_cache() -> None:
    """Set Numba's folder of compiled kernels; call this before the import of Numba.

    Worker processes inherit the setting. A `NUMBA_CACHE_DIR` set by the user is kept.
    """
    if "NUMBA_CACHE_DIR" in os.environ:
        return
    cache_home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    root = cache_home / "mapfusion" / "kernels"
    folder = root / source_hash(_SOURCES)[:_HASH_DIGITS]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        os.utime(folder)
        outdated = sorted(root.iterdir(), key=_last_used, reverse=True)[_VERSIONS_KEPT:]
    except OSError:  # a home without write permission: Numba chooses another folder
        return
    for each in outdated:
        shutil.rmtree(each, ignore_errors=True)
    os.environ["NUMBA_CACHE_DIR"] = str(folder)


def _last_used(folder: Path) -> float:
    """Return the time of the last use of a folder."""
    try:
        return folder.stat().st_mtime
    except OSError:  # another process has just removed it
        return 0.0


@dataclass(frozen=True)
class Job:
    """Part of a stage's work.

    Attributes:
        inputs: folders of the stages before it, by the names that the stage gives them.
        output: folder of the stage.
        part: name of the part; empty for a stage with one part.
    """

    inputs: Mapping[str, Path]
    output: Path
    part: str = ""


_KEY_LENGTH = 16  # hexadecimal digits: 64 bits, no collision in any store one disk can hold
WHOLE = ("",)  # parts of a stage that is computed as a whole

# Function of a stage; returns further figures about the work (times; never results) or None.
Work = Callable[[Any, Job], Mapping[str, float] | None]


class StageKind(NamedTuple):
    """Common attributes of all stages of one name; see `Stage`."""

    name: str
    label: str
    work: Work
    writes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Stage:
    """Step from inputs to files.

    Attributes:
        name: name of the kind of stage, and of its folder in the store.
        label: name in the progress display.
        settings: frozen settings, which are part of the key.
        work: function `work(settings, job)` of a module, whose imports are the sources.
        writes: names of the files of a finished part, with `{part}` in place of its name.
        before: stages whose folders it reads, by the names that it gives them.
        parts: names of the parts, which are independent of each other. A part needs all parts of
            the stages before it, but only the same part of a stage with the same parts.
        loads: modules that it imports by name.
        shares: name of data that it keeps in memory; stages with the same name share the data of
            a part. It does not affect the results.
    """

    name: str
    label: str
    settings: Any
    work: Work
    writes: tuple[str, ...] = ()
    before: Mapping[str, "Stage | RecordedLog"] = field(default_factory=dict)
    parts: tuple[str, ...] = WHOLE
    loads: tuple[str, ...] = ()
    shares: str = ""

    @cached_property
    def sources(self) -> tuple[str, ...]:
        """Source files whose content is part of the key."""
        return imported_sources(self.work.__module__, *self.loads)

    @cached_property
    def key(self) -> str:
        """Key that identifies the results among those of the same stage."""
        from pydantic_core import to_jsonable_python

        # results without the simulator stay valid when it is installed later
        simulator = any(path.startswith("sim/") for path in self.sources)
        content = {
            "stage": self.name,
            "settings": to_jsonable_python(self.settings),
            "before": {name: stage.key for name, stage in self.before.items()},
            "source": source_hash(self.sources),
            "libraries": library_versions(simulator=simulator),
        }
        text = json.dumps(content, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:_KEY_LENGTH]


@dataclass(frozen=True)
class RecordedLog:
    """Recorded robot log: a finished stage, whose key is a hash of its content."""

    path: Path

    @cached_property
    def key(self) -> str:
        """Hash of its tables."""
        digest = hashlib.sha256()
        tables = [*self.path.glob("[!.]*.parquet"), *self.path.glob("[!.]*.csv")]
        for file in sorted(tables):
            digest.update(file.name.encode() + b"\0")
            digest.update(file.read_bytes())
        return digest.hexdigest()[:_KEY_LENGTH]


def in_dependency_order(goals: "Iterable[Stage | RecordedLog]") -> list[Stage]:
    """Return stages and all stages before them, each once and after the stages that it needs."""
    found: dict[Stage, None] = {}
    for goal in goals:
        if isinstance(goal, Stage):
            found |= dict.fromkeys([*in_dependency_order(goal.before.values()), goal])
    return list(found)
