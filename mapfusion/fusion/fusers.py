"""Fusers by name: built-in ones, and those of installed packages.

A package offers one as an entry point of the group `mapfusion.fusers`: its name, and a class that
is made without arguments and is a `Fuser`.
"""

import importlib
from importlib.metadata import entry_points
from typing import Protocol

from mapfusion.errors import did_you_mean, moved_module_note
from mapfusion.fusion.fused_map import Component, FusedMap, MergeParameters


class Fuser(Protocol):
    """Makes one map of several that believed alignments connect.

    It is made without arguments. What it cannot fuse it carries over; it raises nothing.

    Attributes:
        smoothed: whether it is to be given smoothed maps, where there are any, else the filter's.
    """

    smoothed: bool

    def fuse(self, component: Component, parameters: MergeParameters) -> FusedMap:
        """Fuse the component's members."""
        ...


GROUP = "mapfusion.fusers"
FUSERS = {
    "kalman": "mapfusion.fusion.kalman:Kalman",
    "kalman-drift": "mapfusion.fusion.kalman:KalmanDrift",
    "covariance_intersection": "mapfusion.fusion.covariance_intersection:CovarianceIntersection",
    "joint": "mapfusion.fusion.joint:JointFuser",
    "batch": "mapfusion.fusion.batch:Batch",
}
# Reference that smooths all logs again, which takes as long as all the rest of fusing.
REFERENCE = "batch"
USUAL = "joint"  # what fuses maps unless another one is named


def target_of(name: str) -> str:
    """`module:class` of the fuser of that name; of two of one name it is ours.

    Raises:
        ValueError: there is none of that name.
    """
    if name in FUSERS:
        return FUSERS[name]
    offered = {entry.name: entry.value for entry in entry_points(group=GROUP)}
    if name not in offered:
        known = [*FUSERS, *offered]
        there = f"known are {', '.join(known)}{did_you_mean(name, known)}"
        raise ValueError(f"unknown fuser {name!r}, {there}")
    return offered[name]


def make_fuser(name: str = USUAL) -> Fuser:
    """The fuser of that name.

    Raises:
        ValueError: there is none of that name, or the package's own cannot be used.
    """
    target = target_of(name)
    module, _, attribute = target.partition(":")
    try:
        made = getattr(importlib.import_module(module), attribute)()
    except Exception as error:
        told = f"{error}{moved_module_note(error)}"
        raise ValueError(f"fuser {name}: {target} cannot be made: {told}") from error
    for wanted in ("fuse", "smoothed"):
        if not hasattr(made, wanted):
            raise ValueError(f"fuser {name}: {target} has no {wanted}")
    return made
