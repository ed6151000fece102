"""Every method that can be named: built in, peers (`[peers]`), and those of installed plug-ins."""

import functools
import importlib
from typing import Any

from experiments.methods.installed import Kind, KnownMethod, clashes, declared
from mapfusion.align.registry import ALIGNERS, PEERS, construct

_PEER_PACKAGES = {  # distribution and module
    "opencv": ("opencv-python-headless", "cv2"),
    "kiss_matcher": ("kiss-matcher", "kiss_matcher"),
}


def _own_methods() -> dict[str, KnownMethod]:
    """Built-in ones and peers."""
    own = {
        name: KnownMethod(name, Kind.BUILT_IN, f"{method.__module__}:{method.__name__}")
        for name, method in ALIGNERS.items()
    }
    for name, method in PEERS.items():
        target = f"{method.__module__}:{method.__name__}"
        own[name] = KnownMethod(name, Kind.PEER, target, *_PEER_PACKAGES[name], "peers")
    return own


@functools.cache
def known_methods() -> dict[str, KnownMethod]:
    """Every method that can be named, built-in ones first; installed packages are read once."""
    refused = name_clashes()
    plug_ins = {method.name: method for method in declared() if method.name not in refused}
    return _own_methods() | plug_ins


@functools.cache
def name_clashes() -> dict[str, str]:
    """One line for each name that several methods claim."""
    return clashes(_own_methods(), declared())


def find_method(name: str) -> KnownMethod:
    """The method of that name.

    Raises:
        ValueError: nobody's name, or that of several plug-ins.
    """
    own = _own_methods()
    if name in own:  # installed packages need not be read
        return own[name]
    known = known_methods()
    if name in known:
        return known[name]
    if name in name_clashes():
        raise ValueError(name_clashes()[name])
    raise ValueError(f"unknown aligner {name!r}, known are {', '.join(known)}")


def make_method(name: str, **parameters: Any) -> Any:
    """Build a method by name, in this process, whoever's it is.

    Returns:
        What has `find` (`mapfusion.align.method.Method`), or `align` in packages written before it.

    Raises:
        ValueError: the name or a parameter is unknown, or a parameter is out of range.
    """
    return construct(name, load(find_method(name).target), parameters)


def load(target: str) -> Any:
    """The object that `module:name` (or `module:outer.inner`) stands for; imports the module."""
    module, _, names = target.partition(":")
    found: Any = importlib.import_module(module)
    for name in names.split("."):
        found = getattr(found, name)
    return found
