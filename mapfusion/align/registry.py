"""The aligners by name: built in, other people's (`[peers]`), and those of installed plug-ins."""

import functools
import importlib
from typing import Any, ClassVar, Protocol

import numpy as np

from mapfusion.align.clique import Clique
from mapfusion.align.correspondences import Correspondences, HeightGate
from mapfusion.align.gnc import Gnc
from mapfusion.align.icp import Icp
from mapfusion.align.impicp import ImpIcp
from mapfusion.align.plugins import Kind, Method, clashes, declared
from mapfusion.align.ransac import Ransac
from mapfusion.align.ransac_mahalanobis import RansacMahalanobis
from mapfusion.align.result import Alignment
from mapfusion.align.svd import Svd
from mapfusion.landmark_map import LandmarkMap


class Aligner(Protocol):
    """Estimates the motion between two maps from correspondences.

    `randomised` tells whether another generator can give another answer.
    """

    randomised: ClassVar[bool]

    def align(
        self,
        map_a: LandmarkMap,
        map_b: LandmarkMap,
        correspondences: Correspondences,
        rng: np.random.Generator,
    ) -> Alignment:
        """Estimate T_a_b."""
        ...


ALIGNERS: dict[str, type[Aligner]] = {
    "ransac": Ransac,
    "svd": Svd,
    "icp": Icp,
    "impicp": ImpIcp,
    "gnc": Gnc,
    "clique": Clique,
    "ransac_mahalanobis": RansacMahalanobis,
}

_PEERS = (
    Method(
        "opencv",
        Kind.PEER,
        "mapfusion.align.peers.opencv:OpenCv",
        "opencv-python-headless",
        "cv2",
        "peers",
    ),
    Method(
        "kiss_matcher",
        Kind.PEER,
        "mapfusion.align.peers.kiss_matcher:KissMatcher",
        "kiss-matcher",
        "kiss_matcher",
        "peers",
    ),
)


@functools.cache
def known_methods() -> dict[str, Method]:
    """Every method that can be named, built-in ones first; installed packages are read once."""
    own = [
        Method(name, Kind.BUILT_IN, f"{aligner.__module__}:{aligner.__name__}")
        for name, aligner in ALIGNERS.items()
    ]
    found = {method.name: method for method in (*own, *_PEERS)}
    refused = name_clashes()
    return found | {method.name: method for method in declared() if method.name not in refused}


@functools.cache
def name_clashes() -> dict[str, str]:
    """One line for each name that several methods claim."""
    return clashes([*ALIGNERS, *(peer.name for peer in _PEERS)], declared())


def find_method(name: str) -> Method:
    """The method of that name.

    Raises:
        ValueError: nobody's name, or that of several plug-ins.
    """
    known = known_methods()
    if name in known:
        return known[name]
    if name in name_clashes():
        raise ValueError(name_clashes()[name])
    raise ValueError(f"unknown aligner {name!r}, known are {', '.join(known)}")


def make_aligner(name: str, **parameters: Any) -> Aligner:
    """Build an aligner by name, in this process, whoever's it is.

    Raises:
        ValueError: the name or a parameter is unknown, or a parameter is out of range.
    """
    method = find_method(name)
    if method.kind is Kind.BUILT_IN:
        constructor: Any = ALIGNERS[name]
    else:
        constructor = load(method.target)
    try:
        if isinstance(parameters.get("height"), dict):  # as a scenario file has it
            parameters = parameters | {"height": HeightGate(**parameters["height"])}
        return constructor(**parameters)
    except TypeError as error:
        raise ValueError(f"parameters: {name}: {error}") from error


def load(target: str) -> Any:
    """The object that `module:name` (or `module:outer.inner`) stands for; imports the module."""
    module, _, names = target.partition(":")
    found: Any = importlib.import_module(module)
    for name in names.split("."):
        found = getattr(found, name)
    return found
