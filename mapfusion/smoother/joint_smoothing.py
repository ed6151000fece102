"""Joint smoothing of several robots' logs that share landmarks.

The logs are put one after the other. Between the last frame of one and the first of the next the
odometry says nothing, so where a robot began is only known by what it saw; the first robot's first
pose is the frame.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mapfusion.geometry.numerics import Float
from mapfusion.geometry.se2 import IDENTITY, between, compose
from mapfusion.parameters import require_shape
from mapfusion.robot_log import NO_TRACK, Observations, RobotLog
from mapfusion.smoother.elimination import pose_covariances, require_memory
from mapfusion.smoother.noise_estimation import AS_STATED, settled_with_levels
from mapfusion.smoother.normal_equations import Estimate, first_points
from mapfusion.smoother.optimizer import Problem, factored, settled
from mapfusion.smoother.problem import sightings_of
from mapfusion.smoother.smooth import Smoothed, SmootherParameters


@dataclass(frozen=True)
class Recording:
    """A robot's log, and what is known of it.

    Attributes:
        log: T frames with N observations.
        landmark: (N,) `source_observation` of the map's landmark that each observation is of;
            negative for none.
        path: (T, 3) a good guess, as of the smoother; its first pose is the map's frame.
        parameters: of the smoother.
    """

    log: RobotLog
    landmark: np.ndarray
    path: Float
    parameters: SmootherParameters

    def __post_init__(self) -> None:
        require_shape("landmark", self.landmark, (len(self.log.observations),))
        require_shape("path", self.path, (len(self.log), 3))


_NOTHING = np.zeros((1, 3))  # what odometry says of the way from one robot's end to another's start


@dataclass(frozen=True)
class SmoothedTogether:
    """What K logs say, all at once, in the frame of the first robot's first pose.

    Attributes:
        smoothed: poses of one log after the other, points and their joint covariance.
        points: (L,) their numbers, as they were given.
        T_first_robot: (K, 3) first pose of each robot.
        motion_covariance: (K, 3, 3) theirs; zero for the first.
        paths: (T_k, 3) of each robot.
    """

    smoothed: Smoothed
    points: np.ndarray
    T_first_robot: Float
    motion_covariance: Float
    paths: tuple[Float, ...]


def smooth_together(
    recordings: Sequence[Recording],
    points: Sequence[np.ndarray],
    T_first_robot: Float,
    max_memory_gb: float,
) -> SmoothedTogether:
    """The most probable paths and points of K robots whose tracks stray and wheels err alike.

    It starts near where it ends, so there is no round of thinking the observations worse.

    Args:
        recordings: K of them; `stray_m` is that of the first.
        points: of each, (N_k,) which point each observation is of, whoever saw it; negative for
            none.
        T_first_robot: (K, 3) where the robots' frames lie in the first one's, to start from.
        max_memory_gb: smoothing is refused where it may take more.

    Raises:
        LinAlgError: nothing says where a robot is.
        MemoryError: it may take more than `max_memory_gb`.
    """
    log, point = _one_log([each.log for each in recordings]), np.concatenate(points)
    stray_information = recordings[0].parameters.stray_information
    seen = sightings_of(log, point, min_count=1, stray=stray_information > 0)
    require_memory(seen, max_memory_gb)
    starts = np.cumsum([0, *(len(each.log) for each in recordings[:-1])])
    path = np.concatenate(
        [
            compose(T, between(each.path[0], each.path))
            for T, each in zip(T_first_robot, recordings, strict=True)
        ]
    )
    path[0] = IDENTITY  # but for rounding it is that already
    information = [
        np.concatenate([each.parameters.odometry_information(each.log), _NOTHING])
        for each in recordings
    ]
    problem = Problem(seen, log.odometry, np.concatenate(information)[:-1], stray_information)
    start = Estimate(path, first_points(seen, path), np.zeros((len(seen.strays), 3)))
    own_odometry = all(each.parameters.has_own_odometry for each in recordings)
    if own_odometry:
        end, levels = settled_with_levels(problem, start)
    else:
        end, levels = settled(problem, start), AS_STATED
    end, covariance = factored(end), np.zeros((len(starts), 3, 3))
    covariance[1:] = pose_covariances(seen, end.equations, end.solution, starts[1:])
    names = point[seen.row[seen.starts[:-1]]]
    paths = tuple(np.split(end.estimate.path, starts[1:]))
    smoothed = Smoothed.of(problem, end, point, levels)
    if smoothed.second_order is not None:
        covariance += smoothed.second_order.pose_covariances(starts)
    return SmoothedTogether(smoothed, names, end.estimate.path[starts], covariance, paths)


def _one_log(logs: Sequence[RobotLog]) -> RobotLog:
    """One after the other; no two have a track in common."""
    n_before = np.cumsum([0, *(len(log) for log in logs[:-1])])
    tracks, first_free = [], 0
    for log in logs:
        track = log.observations.track
        track = np.full(len(log.observations), NO_TRACK) if track is None else track
        tracks.append(np.where(track == NO_TRACK, NO_TRACK, track.astype(np.int64) + first_free))
        first_free = max(first_free, int(tracks[-1].max(initial=NO_TRACK)) + 1)
    iteration = [log.iteration + n for log, n in zip(logs, n_before, strict=True)]
    seen = Observations(
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
        seen,
    )
