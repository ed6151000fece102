"""Batch fusion: one smoother over all logs, the reference for what fusing maps can reach.

Joint fusion says which landmarks are one point and where the maps lie; from there all members' logs
are smoothed as one. Robots that fuse so have to exchange all that they measured.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mapfusion.fusion.aligned_landmarks import ABSENT
from mapfusion.fusion.fused_map import Component, FusedMap, MergeParameters
from mapfusion.fusion.joint import JointFuser
from mapfusion.landmark_map import LandmarkMap
from mapfusion.smoother.joint_smoothing import AssociatedLog, JointlySmoothed, smooth_jointly
from mapfusion.smoother.smooth import condensed_points

_NO_POINT = -1


@dataclass(frozen=True)
class Batch:
    """All logs of a component at once; what hinders that is the joint map's `fallback`.

    Attributes:
        max_memory_gb: that smoothing may take; it grows with the length of all logs together.
    """

    max_memory_gb: float = 8.0
    smoothed = True

    def fuse(self, component: Component, parameters: MergeParameters) -> FusedMap:
        """Fuse the component's members."""
        joint = JointFuser().fuse(component, parameters)
        recordings = _recordings(component)
        if isinstance(recordings, str):
            return replace(joint, fallback=recordings)
        points = [
            _points(component.maps[k], joint.parents[:, k], each.landmark)
            for k, each in zip(component.members, recordings, strict=True)
        ]
        start = joint.T_first_map[component.members]
        try:
            together = smooth_jointly(recordings, points, start, self.max_memory_gb)
        except (np.linalg.LinAlgError, MemoryError) as error:
            return replace(joint, fallback=f"smoothing all logs at once: {error}")
        return _fused_map(joint, component.members, together)


def _recordings(component: Component) -> Sequence[AssociatedLog] | str:
    """Those of the members, or why they cannot be smoothed together."""
    known = dict(enumerate(component.recordings))
    found = [known.get(int(k)) for k in component.members]
    recordings = [each for each in found if each is not None]
    if len(recordings) < len(found):
        name = component.maps[component.members[found.index(None)]].name
        return f"the log that {name}'s map was smoothed from is not known"
    if len({each.parameters.stray_m for each in recordings}) > 1:
        return "the logs' tracks stray by different amounts"
    return recordings


def _points(landmarks: LandmarkMap, parents: np.ndarray, landmark: np.ndarray) -> np.ndarray:
    """(N,) the fused point of each observation, by the map's landmark that it is of.

    Args:
        landmarks: the map.
        parents: (C,) its row in each fused point, ABSENT for none.
        landmark: (N,) the landmark's `source_observation`, negative for none.
    """
    has = np.flatnonzero(parents != ABSENT)
    point = {int(landmarks.source_observation[parents[row]]): int(row) for row in has}
    names, inverse = np.unique(landmark, return_inverse=True)
    return np.array([point.get(int(name), _NO_POINT) for name in names], dtype=np.int64)[inverse]


def _fused_map(joint: FusedMap, members: np.ndarray, together: JointlySmoothed) -> FusedMap:
    """The joint map's points, where all logs say they are."""
    position, covariance = condensed_points(together.smoothed)
    landmarks = replace(
        joint.landmarks[together.points],
        position_m=position,
        covariance_m2=covariance.marginal_m2,
        joint=covariance,
    )
    T, motion_covariance = joint.T_first_map.copy(), joint.motion_covariance.copy()
    T[members], motion_covariance[members] = together.T_first_robot, together.motion_covariance
    return replace(
        joint,
        landmarks=landmarks,
        parents=joint.parents[together.points],
        T_first_map=T,
        motion_covariance=motion_covariance,
        paths=together.paths,
    )
