"""Discovery of alignment methods by name: built in, peers (`[peers]`), plug-ins and own files.

Discovery reads the metadata of packages. It imports no plug-in, since an import may run any code.
"""

import functools
import hashlib
import importlib.metadata
import importlib.util
import json
from dataclasses import dataclass
from enum import StrEnum
from importlib.machinery import ModuleSpec
from operator import attrgetter
from pathlib import Path
from typing import Any

from experiments.plugins.isolated_process import IsolatedAligner, ProcessFailedError, process_for
from mapfusion.align.aligners import ALIGNERS, PEERS, Aligner, as_aligner, construct
from mapfusion.errors import did_you_mean, not_installed
from mapfusion.fusion.fusers import FUSERS, target_of
from mapfusion.plugin_classes import IN_FILE, load_class, target_in_file

ENTRY_POINTS = "mapfusion.aligners"  # group of the entry points that declare aligners
_CODE_SUFFIXES = (".py", ".so", ".pyd")
_PEER_PACKAGES = {  # distribution and import package
    "opencv": ("opencv-python-headless", "cv2"),
    "kiss_matcher": ("kiss-matcher", "kiss_matcher"),
}


class Kind(StrEnum):
    """Origin of a method."""

    BUILT_IN = "built in"
    PEER = "peer"
    PLUG_IN = "plug-in"


@dataclass(frozen=True)
class KnownMethod:
    """Alignment method and the package that provides it.

    Attributes:
        name: name in scenarios.
        kind: origin of the method.
        target: `module:class` or `file.py:class`; the class is constructed with the parameters.
        distribution: name of the distribution to install; empty for built-in methods and files.
        package: import package of the distribution, or the file; empty for built-in methods.
    """

    name: str
    kind: Kind
    target: str
    distribution: str = ""
    package: str = ""

    @property
    def version(self) -> str:
        """Installed version of the distribution; empty for built-in and absent methods."""
        try:
            return importlib.metadata.version(self.distribution) if self.distribution else ""
        except importlib.metadata.PackageNotFoundError:
            return ""

    @property
    def own_module(self) -> str:
        """Module of this project with the source of the method; all of them for a plug-in."""
        return "mapfusion.align" if self.kind is Kind.PLUG_IN else self.target.partition(":")[0]

    @property
    def absence(self) -> str:
        """Reason why a peer cannot run, with a remedy; empty if the method can run."""
        if self.kind is not Kind.PEER or _find_spec(self.package) is not None:
            return ""
        return not_installed(self.distribution, "peers")

    def origin(self) -> dict[str, str]:
        """Return the code that results depend on, beside our own, for the keys of stages."""
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
    """Return the aligners that installed packages declare, by name, in alphabetical order."""
    found: dict[str, list[KnownMethod]] = {}
    for entry in importlib.metadata.entry_points(group=ENTRY_POINTS):
        target = entry.value.partition("[")[0].strip()  # without extras
        distribution = entry.dist.name if entry.dist is not None else "an unnamed package"
        package = target.partition(":")[0].strip().partition(".")[0]
        method = KnownMethod(entry.name, Kind.PLUG_IN, target, distribution, package)
        found.setdefault(entry.name, []).append(method)
    return {name: sorted(found[name], key=attrgetter("distribution")) for name in sorted(found)}


def known_methods() -> dict[str, KnownMethod]:
    """Return all methods by name, built-in methods first."""
    clashes = name_clashes()
    plug_ins = {name: methods[0] for name, methods in declared().items() if name not in clashes}
    return _OWN_METHODS | plug_ins


def name_clashes() -> dict[str, str]:
    """Return a one-line explanation for each name that more than one package claims.

    Our own methods keep their names. A name that two plug-ins declare cannot be used.
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
            together = " and by ".join(packages)
            lines[name] = f"aligner {name}: declared by {together}; uninstall all but one"
    return lines


def find_method(name: str) -> KnownMethod:
    """Return the method of a name, or of a class in a file, `FILE.py:CLASS`.

    Raises:
        ValueError: no method has the name, several plug-ins declare it, or there is no such file.
    """
    if in_file := target_in_file(name, "an aligner"):
        return KnownMethod(name, Kind.PLUG_IN, in_file, package=in_file.rpartition(":")[0])
    # Our own methods need no search of installed packages.
    known = _OWN_METHODS if name in _OWN_METHODS else known_methods()
    if name not in known:
        unknown = (
            f"unknown aligner {name!r}, known are {', '.join(known)}{did_you_mean(name, known)}"
        )
        if name.endswith(".py"):
            unknown = f"{name}: name the class too, as in {name}:MyAligner"
        raise ValueError(name_clashes().get(name, unknown))
    return known[name]


def absolute_method(name: str, folder: Path | None = None) -> str:
    """Return the name of a method with an absolute path if it names a file.

    Args:
        name: name of a method.
        folder: folder that a relative path belongs to; None: the working folder.
    """
    own_file = IN_FILE.fullmatch(name)
    return f"{(folder or Path()).absolute() / own_file[1]}:{own_file[2]}" if own_file else name


def make_method(name: str, /, **parameters: Any) -> Any:
    """Construct a method in this process; it has `find`, or `align` in older packages.

    Raises:
        ValueError: the name or a parameter is unknown, or a parameter is out of range.
    """
    method = find_method(name)
    own_file = IN_FILE.fullmatch(method.target)
    return construct(own_file[2] if own_file else name, load_class(method.target), parameters)


def callable_aligner(method: str, parameters: dict[str, Any], time_limit_s: float) -> Aligner:
    """Return an aligner that runs in this process if it is built in, else in an isolated one.

    Args:
        method: name of the method.
        parameters: its parameters.
        time_limit_s: wall-clock limit of each call in an isolated process.

    Raises:
        ValueError: the name is unknown, or a parameter is not usable.
    """
    found = find_method(method)
    if found.kind is Kind.BUILT_IN:
        return as_aligner(make_method(method, **parameters))
    return IsolatedAligner(method, _as_json(method, parameters), time_limit_s, found.absence)


def code_of_fuser(name: str) -> str:
    """Return target and hash of the code of a plug-in fuser, for the keys of stages.

    It is empty for ours, whose sources are in the keys.
    """
    if name in FUSERS:
        return ""
    target = target_of(name)
    return f"{target} {fingerprint(target.partition(':')[0].partition('.')[0])}"


def require_usable(method: str, parameters: dict[str, Any]) -> None:
    """Construct the method once, a plug-in in its own process; raise ValueError if that fails."""
    if find_method(method).kind is Kind.PLUG_IN:
        _require_made(method, _as_json(method, parameters))
    else:
        make_method(method, **parameters)


@functools.cache  # a sweep validates the same methods many times
def _require_made(method: str, parameters: str) -> None:
    try:
        process_for(method, parameters)
    except ProcessFailedError as error:
        raise ValueError(f"plug-in {method}: {error}") from error


def _as_json(method: str, parameters: dict[str, Any]) -> str:
    try:
        return json.dumps(parameters, sort_keys=True, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ValueError(f"parameters: {method}: {error}") from error


def _find_spec(package: str) -> ModuleSpec | None:
    """Return the location of a top-level package without importing it; None if it is absent."""
    try:
        return importlib.util.find_spec(package)
    except (ImportError, ValueError):  # not a valid module name
        return None


@functools.cache
def fingerprint(package: str) -> str:
    """Return the SHA-256 of the code files of a top-level package, module or file; "" if absent."""
    is_file = package.endswith(".py")
    spec = None if is_file else _find_spec(package)
    if spec is None and not is_file:
        return ""
    folders = [Path(folder) for folder in (spec and spec.submodule_search_locations) or ()]
    files = [(root, path) for root in folders for path in sorted(root.rglob("*"))]
    if is_file:
        files = [(Path(package).parent, Path(package))]
    elif spec and spec.origin and not folders:
        files = [(Path(spec.origin).parent, Path(spec.origin))]
    digest = hashlib.sha256()
    for root, path in files:
        if path.suffix in _CODE_SUFFIXES:
            digest.update(str(path.relative_to(root)).encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()
