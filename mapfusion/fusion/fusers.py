"""Fusers by name: built-in fusers and plug-ins.

A package provides a fuser by an entry point of the group `mapfusion.fusers`: its name and a class
that implements `Fuser` and has a constructor without arguments.
"""

import importlib
from importlib.metadata import entry_points
from typing import Protocol

from mapfusion.errors import did_you_mean, moved_module_note
from mapfusion.fusion.fused_map import Component, FusedMap, MergeParameters


class Fuser(Protocol):
    """Interface of fusers, which fuse the maps of a connected component.

    The constructor has no arguments. Landmarks that cannot be fused are kept; `fuse` raises no
    errors.

    Attributes:
        smoothed: true if the fuser uses the smoother's maps if there are any; false if it uses the
            filter's maps.
    """

    smoothed: bool

    def fuse(self, component: Component, parameters: MergeParameters) -> FusedMap:
        """Fuse the maps of a component."""
        ...


GROUP = "mapfusion.fusers"
FUSERS = {
    "kalman": "mapfusion.fusion.kalman:Kalman",
    "kalman-drift": "mapfusion.fusion.kalman:KalmanDrift",
    "kalman_as_printed": "mapfusion.fusion.kalman:KalmanAsPrinted",
    "covariance_intersection": "mapfusion.fusion.covariance_intersection:CovarianceIntersection",
    "joint": "mapfusion.fusion.joint:JointFuser",
    "batch": "mapfusion.fusion.batch:Batch",
}
# Reference that smooths all logs jointly, which is much slower than the other fusers.
REFERENCE = "batch"
# The paper's fuser with the wrong sign of eq. 13.
AS_PRINTED = "kalman_as_printed"
# Fusers of scenarios that name none.
COMPARED = tuple(name for name in FUSERS if name not in (REFERENCE, AS_PRINTED))
USUAL = "joint"  # default fuser


def target_of(name: str) -> str:
    """Return `module:class` of a fuser; built-in names take precedence.

    Raises:
        ValueError: the name is unknown.
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
    """Return the fuser with this name.

    Raises:
        ValueError: the name is unknown, or a plug-in cannot be used.
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
