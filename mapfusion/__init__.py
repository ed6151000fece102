"""Mapping with FastSLAM, alignment and fusion of landmark maps of independent robots.

Frames are right-handed: x forward, y left, z up; metres, radians, seconds.
`T_a_b` maps points given in frame b into frame a.

The names below are the public interface. Each is imported at its first use, so that
`import mapfusion` is fast; `__init__.pyi` declares them for editors and type checkers.
`mapfusion docs library` shows an example.
"""

import importlib
from typing import Any

_NAMES_OF = {
    "align.aligners": ("Aligner", "make_aligner"),
    "align.alignment": ("Alignment", "Status"),
    "align.correspondences": ("Correspondences", "MatchParameters", "match"),
    "align.refinement": ("Refinement",),
    "datasets.formats": ("import_recording", "read_recording"),
    "descriptors": ("DescriptorKind",),
    "errors": ("InputError",),
    "fastslam.association": ("Association",),
    "fastslam.filter": ("FastSlam", "FastSlamParameters", "StepResult"),
    "fastslam.mapping": ("build_map", "run_log"),
    "fastslam.motion": ("MotionNoise",),
    "fastslam.proposal": ("Proposal",),
    "fusion.fusers": ("AlignedPair", "FusedMap", "Fusion", "MergeParameters", "make_fuser"),
    "fusion.merge": ("fuse_maps",),
    "fusion.team_graph": ("EdgeStatus", "TeamParameters", "Unconfirmed"),
    "landmark_map": ("LandmarkMap", "read_map", "write_map"),
    "fusion.map_merging": ("MapAlignment", "MergedMaps", "align_maps", "merge_maps"),
    "robot_log": ("Observations", "RobotLog", "read_log", "write_log"),
    "smoother.smooth": ("AssociatedLog",),
    "verification.false_alarms": ("Acceptance",),
    "verification.regions": ("EvidenceParameters",),
    "verification.registration": ("Registered", "Registration"),
    "verification.verdict": ("Verifier",),
}
_MODULE_OF = {name: module for module, names in _NAMES_OF.items() for name in names}
_CALLED_THERE = {"fuse_maps": "merge"}

__all__ = sorted(_MODULE_OF)  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        from mapfusion.errors import DISTRIBUTION

        return version(DISTRIBUTION)
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = importlib.import_module(f"{__name__}.{_MODULE_OF[name]}")
    value = getattr(module, _CALLED_THERE.get(name, name))
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, "__version__"})
