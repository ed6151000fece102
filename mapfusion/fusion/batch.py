"""Batch fusion: joint smoothing of all logs, the reference for the fusion of maps.

Joint fusion provides the associations and the initial poses of the maps. Then the logs of all
members are smoothed as one. Robots have to exchange their complete logs for this.
"""

from dataclasses import dataclass, replace

import numpy as np

from mapfusion.fusion.aligned_landmarks import ABSENT
from mapfusion.fusion.fusers import Component, FusedMap, MergeParameters
from mapfusion.fusion.joint import JointFuser
from mapfusion.smoother.joint_smoothing import smooth_jointly
from mapfusion.smoother.smooth import condensed_points

_NO_POINT = -1


@dataclass(frozen=True)
class Batch:
    """Joint smoothing of all logs of a component.

    The result is that of joint fusion, with the reason in `fallback`, if the logs cannot be
    smoothed.

    Attributes:
        max_memory_gb: largest memory of the smoother, which grows with the total length of the
            logs.
    """

    max_memory_gb: float = 8.0
    smoothed = True

    def fuse(self, component: Component, parameters: MergeParameters) -> FusedMap:
        """Fuse the maps of a component."""
        joint, members = JointFuser().fuse(component, parameters), component.members
        known = dict(enumerate(component.recordings))
        found = [known.get(int(k)) for k in members]
        logs = [each for each in found if each is not None]
        if len(logs) < len(found):
            name = component.maps[members[found.index(None)]].name
            return replace(joint, fallback=f"the log of {name}'s smoothed map is not known")
        if len({each.parameters.stray_m for each in logs}) > 1:
            return replace(joint, fallback="the logs have different values of stray_m")
        points = []  # fused point of each observation of each log, shape (N_k,)
        for k, each in zip(members, logs, strict=True):
            parents, source = joint.parents[:, k], component.maps[k].source_observation
            rows = np.flatnonzero(parents != ABSENT)
            point = dict(zip(source[parents[rows]].tolist(), rows.tolist(), strict=True))
            names, inverse = np.unique(each.landmark, return_inverse=True)
            own = np.array([point.get(name, _NO_POINT) for name in names.tolist()], np.int64)
            points.append(own[inverse])
        start = joint.T_first_map[members]
        try:
            smoothed = smooth_jointly(logs, points, start, self.max_memory_gb)
        except (np.linalg.LinAlgError, MemoryError) as error:
            return replace(joint, fallback=f"smoothing all logs at once: {error}")
        # replace positions and poses of the joint map by the smoothed ones
        position, covariance = condensed_points(smoothed.smoothed)
        landmarks = replace(
            joint.landmarks[smoothed.points],
            position_m=position,
            covariance_m2=covariance.marginal_m2,
            joint=covariance,
        )
        T, motion_covariance = joint.T_first_map.copy(), joint.motion_covariance.copy()
        T[members], motion_covariance[members] = smoothed.T_first_robot, smoothed.motion_covariance
        return replace(
            joint,
            landmarks=landmarks,
            parents=joint.parents[smoothed.points],
            T_first_map=T,
            motion_covariance=motion_covariance,
            paths=smoothed.paths,
        )
