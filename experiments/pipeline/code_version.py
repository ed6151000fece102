"""Version of the code behind a result, and the folder of its compiled kernels.

Read from the import statements, without importing anything. A process reads each file once.

Numba by itself notices a change in a kernel's own file, not in a kernel that it calls from another
file. A folder named after the source of both cannot hand out an outdated kernel, and a change to
one module leaves alone what is compiled of those that do not import it.
"""

import functools
import hashlib
import importlib.metadata
import os
import re
import shutil
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

SOURCE_ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("mapfusion", "sim", "experiments")
# These find methods by name, so their imports reach every method there is. What a name stands for
# is in a stage's settings, and its source in `Stage.loads`.
_FINDS_BY_NAME = frozenset({"mapfusion/align/aligners.py"})
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


_VERSIONS_KEPT = 4  # of a module; going back and forth between branches stays fast
_HASH_DIGITS = 16
# What is not ours, a plug-in's kernels, goes where Numba would put it.
_LOCATORS = ("UserProvidedCacheLocator", "InTreeCacheLocator", "UserWideCacheLocator")


def use_kernel_cache() -> None:
    """Tell Numba where to keep compiled kernels; to be called before it is first imported.

    A `NUMBA_CACHE_DIR` set by the user is left alone. Worker processes inherit the setting.
    """
    # Numba tries one way of compiling a call after the other and discards the errors of those that
    # fail. To colour them, where colorama is installed, is a thirtieth of all compilation.
    os.environ.setdefault("NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING", "1")
    if "NUMBA_CACHE_DIR" in os.environ:
        return
    cache_home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    root = cache_home / "mapfusion" / "kernels"
    try:
        root.mkdir(parents=True, exist_ok=True)
        _remove_outdated(root)
    except OSError:  # a home that cannot be written to: Numba finds a place of its own
        return
    os.environ["NUMBA_CACHE_DIR"] = str(root)
    ours = f"{__name__}.{KernelLocator.__name__}"
    os.environ.setdefault("NUMBA_CACHE_LOCATOR_CLASSES", ",".join((ours, *_LOCATORS)))


def _remove_outdated(root: Path) -> None:
    seen = Counter[str]()
    for folder in sorted(root.iterdir(), key=_last_used, reverse=True):
        module, _, _ = folder.name.rpartition("-")
        seen[module] += 1
        if seen[module] > _VERSIONS_KEPT:
            shutil.rmtree(folder, ignore_errors=True)


def _last_used(folder: Path) -> float:
    try:
        return folder.stat().st_mtime
    except OSError:  # another command has just removed it
        return 0.0


class KernelLocator:
    """Tells Numba where the kernels of one of our modules are kept (its cache locators' protocol).

    Numba makes one for each kernel, by the name in `NUMBA_CACHE_LOCATOR_CLASSES`.
    """

    def __init__(self, folder: Path, path: str, line: int) -> None:
        self._folder, self._line = folder, line
        self._py_file = path  # where Numba's warning points to, of a kernel that cannot be kept

    @classmethod
    def from_function(cls, py_func: Callable[..., object], py_file: str) -> "KernelLocator | None":
        """That of a kernel in a file; none where it is not ours or cannot be kept."""
        root, path = os.environ.get("NUMBA_CACHE_DIR"), Path(py_file)
        if not root or not any(path.is_relative_to(SOURCE_ROOT / package) for package in PACKAGES):
            return None
        try:
            folder = _used(kernel_folder(Path(root), path))
        except OSError:
            return None
        return cls(folder, py_file, py_func.__code__.co_firstlineno)

    def get_cache_path(self) -> str:
        """The folder."""
        return str(self._folder)

    def ensure_cache_path(self) -> None:
        """Make the folder where it was removed since."""
        self._folder.mkdir(parents=True, exist_ok=True)

    def get_source_stamp(self) -> str:
        """What is in it is of one version of the source, which its name tells."""
        return self._folder.name

    def get_disambiguator(self) -> str:
        """Tells kernels of one name in one file apart."""
        return str(self._line)


@functools.cache
def kernel_folder(root: Path, path: Path) -> Path:
    """Where below `root` the kernels of a file of ours are kept, as the source stands."""
    module = ".".join(path.relative_to(SOURCE_ROOT).with_suffix("").parts)
    return root / f"{module}-{source_hash(imported_sources(module))[:_HASH_DIGITS]}"


@functools.cache
def _used(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    os.utime(folder)
    return folder
