"""Aligners that come from elsewhere: what is installed, which version, and which files.

Nothing of a plug-in is imported here: its package may do anything when it is.
"""

import functools
import hashlib
import importlib.metadata
import importlib.util
from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum
from importlib.machinery import ModuleSpec
from pathlib import Path

ENTRY_POINTS = "mapfusion.aligners"  # the group by which an installed package declares aligners
_CODE_SUFFIXES = (".py", ".so", ".pyd")


class Kind(StrEnum):
    """Whose method it is."""

    BUILT_IN = "built in"
    PEER = "peer"
    PLUG_IN = "plug-in"


@dataclass(frozen=True)
class KnownMethod:
    """An alignment method that can be named.

    Attributes:
        name: as scenarios give it.
        kind: whose it is.
        target: `module:class` of what is constructed with the parameters.
        distribution: the package behind it; empty for built-in ones.
        module: whose files the results depend on, beside our own source; empty for built-in ones.
        extra: of ours that installs the package; empty for plug-ins.
    """

    name: str
    kind: Kind
    target: str
    distribution: str = ""
    module: str = ""
    extra: str = ""

    @property
    def version(self) -> str:
        """Installed version of the package behind it; empty for built-in and absent ones."""
        return _version(self.distribution) if self.distribution else ""

    @property
    def absence(self) -> str:
        """Why it cannot run, and what would help; empty where it can."""
        if self.kind is not Kind.PEER or _find(_top(self.module)) is not None:
            return ""
        return (
            f"the package {self.distribution} is not installed; "
            f"pip install 'mapfusion[{self.extra}]' installs it"
        )

    def origin(self) -> dict[str, str]:
        """What else than parameters and our own source its results depend on, for stage keys."""
        if self.kind is Kind.BUILT_IN:
            return {"target": self.target}
        return {
            "target": self.target,
            "distribution": self.distribution,
            "version": self.version,
            "files": fingerprint(_top(self.module)),
        }


def declared() -> tuple[KnownMethod, ...]:
    """Every aligner that an installed package declares, by name and package."""
    found = []
    for entry in importlib.metadata.entry_points(group=ENTRY_POINTS):
        target = entry.value.partition("[")[0].strip()  # without the extras it may ask for
        package = entry.dist.name if entry.dist is not None else "an unnamed package"
        module = target.partition(":")[0].strip()
        found.append(KnownMethod(entry.name, Kind.PLUG_IN, target, package, module))
    return tuple(sorted(found, key=lambda method: (method.name, method.distribution)))


def clashes(taken: Iterable[str], plug_ins: Iterable[KnownMethod]) -> dict[str, str]:
    """For each name that is not one plug-in's alone: one line that says whose it is.

    Names `taken` by our own methods stay theirs; a name that two packages declare is nobody's.
    """
    own = set(taken)
    by_name: dict[str, list[str]] = {}
    for method in plug_ins:
        by_name.setdefault(method.name, []).append(method.distribution)
    lines = {}
    for name, packages in by_name.items():
        if name in own:
            lines[name] = (
                f"aligner {name}: mapfusion's own is used, the one that {', '.join(packages)} "
                "declares under the same name is not"
            )
        elif len(packages) > 1:
            lines[name] = (
                f"aligner {name}: declared by {' and by '.join(packages)}; uninstall all but one"
            )
    return lines


def _top(module: str) -> str:
    return module.partition(".")[0]


def _find(package: str) -> ModuleSpec | None:
    """Where a top-level package lies; it is not imported."""
    try:
        return importlib.util.find_spec(package)
    except (ImportError, ValueError):  # no name that a module can have
        return None


def _version(distribution: str) -> str:
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return ""


@functools.cache
def fingerprint(package: str) -> str:
    """Hash of the code files of an installed top-level package or module; empty when absent."""
    spec = _find(package)
    if spec is None:
        return ""
    digest = hashlib.sha256()
    for root, path in _code_files(spec.submodule_search_locations, spec.origin):
        digest.update(str(path.relative_to(root)).encode() + b"\0")
        digest.update(path.read_bytes())
    return digest.hexdigest()


def _code_files(folders: Iterable[str] | None, origin: str | None) -> list[tuple[Path, Path]]:
    """(root, file) of each file of code."""
    if folders is None:
        return [] if origin is None else [(Path(origin).parent, Path(origin))]
    found = []
    for folder in folders:
        root = Path(folder)
        files = [path for path in root.rglob("*") if path.suffix in _CODE_SUFFIXES]
        found += [(root, path) for path in sorted(files)]
    return found
