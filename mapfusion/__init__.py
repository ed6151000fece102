"""Landmark maps of independent robots: built by FastSLAM, aligned, merged.

Frames are right-handed: x forward, y left, z up; metres, radians, seconds.
`T_a_b` maps points given in frame b into frame a.

The names below are what a user needs; each is imported when it is first used, so that
`import mapfusion` costs nothing. See `experiments/docs/library.md` for an example.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # the same names for editors and type checkers; a test holds both lists together
    from mapfusion.align.acceptance import Acceptance as Acceptance
    from mapfusion.align.correspondences import Correspondences as Correspondences
    from mapfusion.align.correspondences import MatchParameters as MatchParameters
    from mapfusion.align.correspondences import match as match
    from mapfusion.align.refine import Refinement as Refinement
    from mapfusion.align.registry import Aligner as Aligner
    from mapfusion.align.registry import make_aligner as make_aligner
    from mapfusion.align.result import Alignment as Alignment
    from mapfusion.align.result import Status as Status
    from mapfusion.errors import InputError as InputError
    from mapfusion.fastslam.association import Association as Association
    from mapfusion.fastslam.filter import FastSlam as FastSlam
    from mapfusion.fastslam.filter import StepResult as StepResult
    from mapfusion.fastslam.motion import MotionNoise as MotionNoise
    from mapfusion.fastslam.parameters import FastSlamParameters as FastSlamParameters
    from mapfusion.fastslam.proposal import Proposal as Proposal
    from mapfusion.fastslam.run import build_map as build_map
    from mapfusion.fastslam.run import run_log as run_log
    from mapfusion.landmark_map import LandmarkMap as LandmarkMap
    from mapfusion.landmark_map import read_map as read_map
    from mapfusion.landmark_map import write_map as write_map
    from mapfusion.merge import FusedMap as FusedMap
    from mapfusion.merge import MergeParameters as MergeParameters
    from mapfusion.merge import merge as merge_maps  # noqa: F401 - renamed, as here `merge` is the module
    from mapfusion.recordings.registry import import_recording as import_recording
    from mapfusion.robot_log import Observations as Observations
    from mapfusion.robot_log import RobotLog as RobotLog
    from mapfusion.robot_log import read_log as read_log
    from mapfusion.robot_log import write_log as write_log

    __version__: str

_NAMES_OF = {
    "align.acceptance": ("Acceptance",),
    "align.correspondences": ("Correspondences", "MatchParameters", "match"),
    "align.refine": ("Refinement",),
    "align.registry": ("Aligner", "make_aligner"),
    "align.result": ("Alignment", "Status"),
    "errors": ("InputError",),
    "fastslam.association": ("Association",),
    "fastslam.filter": ("FastSlam", "StepResult"),
    "fastslam.motion": ("MotionNoise",),
    "fastslam.parameters": ("FastSlamParameters",),
    "fastslam.proposal": ("Proposal",),
    "fastslam.run": ("build_map", "run_log"),
    "landmark_map": ("LandmarkMap", "read_map", "write_map"),
    "merge": ("FusedMap", "MergeParameters", "merge_maps"),
    "recordings.registry": ("import_recording",),
    "robot_log": ("Observations", "RobotLog", "read_log", "write_log"),
}
_MODULE_OF = {name: module for module, names in _NAMES_OF.items() for name in names}
_CALLED_THERE = {"merge_maps": "merge"}

__all__ = sorted(_MODULE_OF)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("mapfusion")
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = importlib.import_module(f"{__name__}.{_MODULE_OF[name]}")
    value = getattr(module, _CALLED_THERE.get(name, name))
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, "__version__"})
