"""Every method that can be named: built in, peers (`[peers]`), and those of installed plug-ins.

Nothing of a plug-in is imported until it is made: its package may do anything when it is.
"""

import functools
import hashlib
import importlib.metadata
import importlib.util
from dataclasses import dataclass
from enum import StrEnum
from importlib import import_module
from importlib.machinery import ModuleSpec
from operator import attrgetter
from pathlib import Path
from typing import Any

from mapfusion.align.aligners import ALIGNERS, PEERS, construct
from mapfusion.errors import did_you_mean

ENTRY_POINTS = "mapfusion.aligners"  # the group by which an installed package declares aligners
_CODE_SUFFIXES = (".py", ".so", ".pyd")
_PEER_PACKAGES = {  # distribution and import package
    "opencv": ("opencv-python-headless", "cv2"),
    "kiss_matcher": ("kiss-matcher", "kiss_matcher"),
}


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
        distribution: what is installed for it; empty for built-in ones.
        package: whose files the results depend on, beside our own source; empty for built-in ones.
    """

    name: str
    kind: Kind
    target: str
    distribution: str = ""
    package: str = ""

    @property
    def version(self) -> str:
        """Installed version of the distribution; empty for built-in and absent ones."""
        try:
            return importlib.metadata.version(self.distribution) if self.distribution else ""
        except importlib.metadata.PackageNotFoundError:
            return ""

    @property
    def absence(self) -> str:
        """Why it cannot run, and what would help; empty where it can."""
        if self.kind is not Kind.PEER or _find(self.package) is not None:
            return ""
        return (
            f"the package {self.distribution} is not installed; "
            "pip install 'mapfusion[peers]' installs it"
        )

    def origin(self) -> dict[str, str]:
        """What else than parameters and our own source its results depend on, for stage keys."""
        origin = {"target": self.target}
        if self.kind is not Kind.BUILT_IN:
            origin |= {"distribution": self.distribution, "version": self.version}
            origin["files"] = fingerprint(self.package)
        return origin


_OWN_METHODS = {
    name: KnownMethod(
        name,
        Kind.PEER if name in PEERS else Kind.BUILT_IN,
        f"{method.__module__}:{method.__name__}",
        *_PEER_PACKAGES.get(name, ()),
    )
    for name, method in (ALIGNERS | PEERS).items()
}


@functools.cache
def declared() -> dict[str, list[KnownMethod]]:
    """The aligners that installed packages declare, by name; packages are read once."""
    found: dict[str, list[KnownMethod]] = {}
    for entry in importlib.metadata.entry_points(group=ENTRY_POINTS):
        target = entry.value.partition("[")[0].strip()  # without the extras it may ask for
        distribution = entry.dist.name if entry.dist is not None else "an unnamed package"
        package = target.partition(":")[0].strip().partition(".")[0]
        method = KnownMethod(entry.name, Kind.PLUG_IN, target, distribution, package)
        found.setdefault(entry.name, []).append(method)
    return {name: sorted(found[name], key=attrgetter("distribution")) for name in sorted(found)}


def known_methods() -> dict[str, KnownMethod]:
    """Every method that can be named, built-in ones first."""
    clashes = name_clashes()
    plug_ins = {name: methods[0] for name, methods in declared().items() if name not in clashes}
    return _OWN_METHODS | plug_ins


def name_clashes() -> dict[str, str]:
    """For each name that is not one plug-in's alone: one line that says whose it is.

    Our own names stay ours; a name that two packages declare is nobody's.
    """
    lines = {}
    for name, methods in declared().items():
        packages = [method.distribution for method in methods]
        if name in _OWN_METHODS:
            lines[name] = (
                f"aligner {name}: mapfusion's own is used, the one that {', '.join(packages)} "
                "declares under the same name is not"
            )
        elif len(packages) > 1:
            they = " and by ".join(packages)
            lines[name] = f"aligner {name}: declared by {they}; uninstall all but one"
    return lines


def find_method(name: str) -> KnownMethod:
    """The method of that name; raises ValueError for nobody's, or that of several plug-ins."""
    # ours need no look at installed packages
    known = _OWN_METHODS if name in _OWN_METHODS else known_methods()
    if name not in known:
        unknown = (
            f"unknown aligner {name!r}, known are {', '.join(known)}{did_you_mean(name, known)}"
        )
        raise ValueError(name_clashes().get(name, unknown))
    return known[name]


def make_method(name: str, /, **parameters: Any) -> Any:
    """Build a method by name, in this process; it has `find`, or `align` in older packages.

    Raises:
        ValueError: the name or a parameter is unknown, or a parameter is out of range.
    """
    module, _, names = find_method(name).target.partition(":")
    return construct(name, attrgetter(names)(import_module(module)), parameters)


def _find(package: str) -> ModuleSpec | None:
    """Where a top-level package lies; it is not imported."""
    try:
        return importlib.util.find_spec(package)
    except (ImportError, ValueError):  # no name that a module can have
        return None


@functools.cache
def fingerprint(package: str) -> str:
    """Hash of the code files of an installed top-level package or module; empty when absent."""
    spec = _find(package)
    if spec is None:
        return ""
    roots = [Path(folder) for folder in spec.submodule_search_locations or ()]
    files = [(root, path) for root in roots for path in sorted(root.rglob("*"))]
    if spec.origin and not roots:
        files = [(Path(spec.origin).parent, Path(spec.origin))]
    digest = hashlib.sha256()
    for root, path in files:
        if path.suffix in _CODE_SUFFIXES:
            digest.update(str(path.relative_to(root)).encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()
