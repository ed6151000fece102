"""Where compiled kernels are kept: a folder for each module, as it and all it imports stand.

Numba by itself notices a change in a kernel's own file, not in a kernel that it calls from another
file. A folder named after the source of both cannot hand out an outdated kernel, and a change to
one module leaves alone what is compiled of those that do not import it.
"""

import functools
import os
import shutil
from collections import Counter
from collections.abc import Callable
from pathlib import Path

from experiments.run.code_version import PACKAGES, SOURCE_ROOT, imported_sources, source_hash

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
