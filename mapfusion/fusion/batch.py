"""Batch fusion: joint smoothing of all logs, the reference for the fusion of maps.

Joint fusion provides the associations and the initial poses of the maps. Then the logs of all
members are smoothed as one. Robots have to exchange their complete logs for this.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mapfusion.fusion.fusers import Component, FusedMap, MergeParameters
from mapfusion.fusion.joint import JointFuser
from mapfusion.fusion.landmark_association import ABSENT
from mapfusion.geometry.numerics import Float
from mapfusion.geometry.se2 import IDENTITY, between, compose
from mapfusion.robot_log import NO_TRACK, Observations, RobotLog
from mapfusion.smoother.elimination import require_memory
from mapfusion.smoother.noise_estimation import UNIT_SCALES, optimize_with_noise
from mapfusion.smoother.normal_equations import Estimate, initial_landmarks
from mapfusion.smoother.optimizer import Problem, optimize
from mapfusion.smoother.problem import order_observations
from mapfusion.smoother.smooth import AssociatedLog, Smoothed, condensed_points

_NO_POINT = -1
_UNKNOWN = np.zeros((1, 3))  # information of the motion between two logs


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
        recording_of_map = dict(enumerate(component.recordings))
        recordings = [recording_of_map.get(int(k)) for k in members]
        logs = [each for each in recordings if each is not None]
        if len(logs) < len(recordings):
            name = component.maps[members[recordings.index(None)]].name
            return replace(joint, fallback=f"the log of {name}'s smoothed map is not known")
        if len({each.parameters.stray_m for each in logs}) > 1:
            return replace(joint, fallback="the logs have different values of stray_m")
        points = []  # fused point of each observation of each log, shape (N_k,)
        for k, each in zip(members, logs, strict=True):
            parents, source = joint.parents[:, k], component.maps[k].source_observation
            rows = np.flatnonzero(parents != ABSENT)
            point = dict(zip(source[parents[rows]].tolist(), rows.tolist(), strict=True))
            names, inverse = np.unique(each.landmark, return_inverse=True)
            point_indices = np.array(
                [point.get(name, _NO_POINT) for name in names.tolist()], np.int64
            )
            points.append(point_indices[inverse])
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


@dataclass(frozen=True)
class JointlySmoothed:
    """Result of smoothing K logs, in the frame of the first robot's first pose.

    Attributes:
        smoothed: poses of all logs, points and their joint covariance.
        points: number of each point as given, shape (L,).
        T_first_robot: first pose of each robot, shape (K, 3).
        motion_covariance: covariances of the first poses, shape (K, 3, 3); zero for the first.
        paths: path of each robot, shape (T_k, 3).
    """

    smoothed: Smoothed
    points: np.ndarray
    T_first_robot: Float
    motion_covariance: Float
    paths: tuple[Float, ...]


def smooth_jointly(
    recordings: Sequence[AssociatedLog],
    points: Sequence[np.ndarray],
    T_first_robot: Float,
    max_memory_gb: float,
) -> JointlySmoothed:
    """Compute the most probable paths and points of K robots with equal noise scales.

    The logs are concatenated. The odometry between the last frame of one log and the first frame
    of the next is unknown, so only observations determine where a robot began. The frame is the
    first pose of the first robot.

    Args:
        recordings: K recordings; `stray_m` is that of the first.
        points: point number of each observation of each log, shape (N_k,); the same number in two
            logs is the same point; negative for none.
        T_first_robot: initial poses of the robots' frames in the first one, shape (K, 3).
        max_memory_gb: smoothing that may take more memory is refused.

    Raises:
        LinAlgError: the pose of a robot is not determined.
        MemoryError: it may take more than `max_memory_gb`.
    """
    log, point = _concatenate([each.log for each in recordings]), np.concatenate(points)
    offset_prior = recordings[0].parameters.offset_prior
    obs = order_observations(log, point, min_count=1, with_offsets=offset_prior > 0)
    require_memory(obs, max_memory_gb)
    starts = np.cumsum([0, *(len(each.log) for each in recordings[:-1])])
    path = np.concatenate(
        [
            compose(T, between(each.path[0], each.path))
            for T, each in zip(T_first_robot, recordings, strict=True)
        ]
    )
    path[0] = IDENTITY  # removes rounding errors
    information = [
        np.concatenate([each.parameters.odometry_information(each.log), _UNKNOWN])
        for each in recordings
    ]
    problem = Problem(obs, log.odometry, np.concatenate(information)[:-1], offset_prior)
    start = Estimate(path, initial_landmarks(obs, path), np.zeros((len(obs.has_offset), 3)))
    if all(each.parameters.has_own_odometry for each in recordings):
        state, scales = optimize_with_noise(problem, start)
    else:
        state, scales = optimize(problem, start), UNIT_SCALES
    names = point[obs.row[obs.starts[:-1]]]
    paths = tuple(np.split(state.estimate.path, starts[1:]))
    smoothed = Smoothed.of(problem, state, point, scales)
    T_first_robot, covariance = state.estimate.path[starts], smoothed.path_covariance[starts]
    return JointlySmoothed(smoothed, names, T_first_robot, covariance, paths)


def _concatenate(logs: Sequence[RobotLog]) -> RobotLog:
    """Concatenate the logs; they have no common tracks."""
    n_before = np.cumsum([0, *(len(log) for log in logs[:-1])])
    tracks, first_free = [], 0
    for log in logs:
        track = log.observations.track
        track = np.full(len(log.observations), NO_TRACK) if track is None else track
        tracks.append(np.where(track == NO_TRACK, NO_TRACK, track.astype(np.int64) + first_free))
        first_free = max(first_free, int(tracks[-1].max(initial=NO_TRACK)) + 1)
    iteration = [log.iteration + n for log, n in zip(logs, n_before, strict=True)]
    obs = Observations(
        np.concatenate([log.observations.position_m for log in logs]),
        np.concatenate([log.observations.covariance_m2 for log in logs]),
        track=np.concatenate(tracks),
    )
    return RobotLog(
        logs[0].robot,
        any(log.planar for log in logs),
        np.arange(n_before[-1] + len(logs[-1])) * 1.0,
        np.concatenate([log.odometry for log in logs]),
        np.concatenate(iteration),
        obs,
    )
