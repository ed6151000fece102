"""Adoption: a robot's filter goes on in the map that was fused from its own map and others.

The fused map is in the frame of the robot. Its shared errors, which include those of the motions
between the maps, become drift of the filter (`fastslam.loop_closing`): landmarks that robot b
observed at about the same time move together. When the robot sees such landmarks, it closes a loop.
In particles, drawn motions would not last: after a few resamplings all particles have the same one.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from mapfusion.fastslam.filter import PriorMap
from mapfusion.fastslam.loop_closing import KNOT_SPACING, between_knots
from mapfusion.fusion.fusers import FusedMap
from mapfusion.fusion.landmark_association import ABSENT
from mapfusion.geometry.joint_covariance import JointCovariance
from mapfusion.geometry.numerics import Float
from mapfusion.geometry.se2 import IDENTITY, compose, motion_jacobian
from mapfusion.landmark_map import LandmarkMap
from mapfusion.robot_log import RobotLog
from mapfusion.smoother.smooth import Smoothed

# Sources of landmarks that the robot has not observed itself start here. Other sources are rows of
# its log.
ADOPTED = 2**30
# Most knots of the drift. The filter removes every second one above 64.
_MOST_KNOTS = 40
# Weights of the changes of drift between neighbouring knots, in points. Shared errors are fitted
# exactly where landmarks are; the correction of a path is averaged over several frames.
_OF_SHARED, _OF_PATH = 1e-2, 100.0
# Number of frames between two knots of the correction of a path.
_PATH_SPACING = 5


@dataclass(frozen=True)
class TimedMap:
    """Smoothed map of a robot's own log, with the frames that last showed its landmarks.

    Attributes:
        landmarks: N landmarks with a joint covariance, in the frame of the robot.
        last_frame: last frame of the robot's log that showed each landmark, shape (N,).
        n_frames: number of frames of the log.
    """

    landmarks: LandmarkMap
    last_frame: np.ndarray
    n_frames: int

    @classmethod
    def of(cls, log: RobotLog, smoothed: Smoothed, landmarks: LandmarkMap) -> "TimedMap":
        """Return the map of a smoothed log."""
        obs = smoothed.obs
        last_frame = np.maximum.reduceat(obs.frame, obs.starts[:-1])
        return cls(landmarks, last_frame, len(log))


class Drift(NamedTuple):
    """Shared errors of a map as drift.

    Attributes:
        knots: frames of the drift, shape (K,).
        by_shared: drift at the knots and at present by one sigma of each shared variable, shape
            (K + 1, 3, R).
        remainder_m: displacements that are no drift, shape (N, R, 3).
    """

    knots: np.ndarray
    by_shared: Float
    remainder_m: Float

    @property
    def remainder_m2(self) -> Float:
        """Covariances by the displacements that are no drift, shape (N, 3, 3)."""
        return np.swapaxes(self.remainder_m, 1, 2) @ self.remainder_m

    @property
    def covariance(self) -> Float:
        """Covariance of the drift, shape (3K + 3, 3K + 3)."""
        stacked = self.by_shared.reshape(-1, self.by_shared.shape[2])
        return stacked @ stacked.T


def fit_drift(
    position_m: Float,
    frame: np.ndarray,
    displaced_m: Float,
    segments: Sequence[np.ndarray],
    smoothness: float,
) -> Float:
    """Fit drift to displacements of points by least squares.

    Drift is linear between knots. A point is displaced by J d, with d the drift in its frame and J
    the Jacobian of a small motion of the plane. Between neighbouring knots of a segment, a change
    of the drift costs the mean square displacement of the points by it.

    Args:
        position_m: positions of n points, shape (n, 2 or more).
        frame: frame of each point, shape (n,).
        displaced_m: displacements in the plane in R cases, shape (n, 2, R).
        segments: knots of each segment, ascending within and between segments.
        smoothness: weight of the changes, in points.

    Returns:
        Drift at the K knots, shape (K, 3, R).
    """
    knots = np.concatenate(segments)
    weight, jacobian = between_knots(knots, frame), motion_jacobian(IDENTITY, position_m)
    design = np.einsum("nij,nk->nikj", jacobian, weight).reshape(-1, 3 * len(knots))
    normal = design.T @ design
    change = smoothness * np.mean(np.swapaxes(jacobian, 1, 2) @ jacobian, axis=0)
    starts = np.cumsum([0, *map(len, segments)])
    for first, stop in itertools.pairwise(starts.tolist()):
        for k in range(first, stop - 1):
            a, b = slice(3 * k, 3 * k + 3), slice(3 * k + 3, 3 * k + 6)
            normal[a, a] += change
            normal[b, b] += change
            normal[a, b] -= change
            normal[b, a] -= change
    right = design.T @ displaced_m.reshape(-1, displaced_m.shape[2])
    solution = np.linalg.lstsq(normal, right, rcond=None)[0]
    return solution.reshape(len(knots), 3, -1)


def drift_of_map(
    joint: JointCovariance,
    position_m: Float,
    last_frame: np.ndarray,
    segments: Sequence[tuple[int, int]],
) -> Drift:
    """Approximate the shared errors of a map by drift.

    Args:
        joint: joint covariance of N landmarks by R shared variables.
        position_m: positions, shape (N, 3).
        last_frame: last frame that showed each landmark, shape (N,).
        segments: first and last frame of each robot's log, in ascending order. The last frame of
            the last segment is the present.
    """
    n_frames = sum(last - first + 1 for first, last in segments)
    spacing = max(KNOT_SPACING, n_frames / _MOST_KNOTS)
    knots = [_knots(*segment, spacing) for segment in segments]
    displaced_m = np.swapaxes(joint.common_m[:, :, :2], 1, 2)
    drift = fit_drift(position_m, last_frame, displaced_m, knots, _OF_SHARED)
    frames, remainder = np.concatenate(knots), joint.common_m.copy()
    at_landmark = np.einsum("nk,kir->nir", between_knots(frames, last_frame), drift)
    by_drift = motion_jacobian(IDENTITY, position_m) @ at_landmark
    remainder[:, :, :2] -= np.swapaxes(by_drift, 1, 2)
    return Drift(frames[:-1], drift, remainder)


def _knots(first: int, last: int, spacing: float) -> np.ndarray:
    """Return evenly spaced frames, with both ends."""
    n = max(2, 1 + round((last - first) / spacing))
    return np.unique(np.linspace(first, last, n).round().astype(np.int64))


def corrected_path(path: Float, frame: np.ndarray, before_m: Float, after_m: Float) -> Float:
    """Move each pose of a path as the landmarks moved that were observed from it.

    Args:
        path: poses, shape (T, 3).
        frame: frame of each of n observations, shape (n,).
        before_m: landmark of each observation before the correction, in the plane, shape (n, 2).
        after_m: the same after it, shape (n, 2).
    """
    if not len(frame):
        return path
    knots = _knots(0, len(path) - 1, _PATH_SPACING)
    displaced_m = (after_m - before_m)[:, :, None]
    drift = fit_drift(before_m, frame, displaced_m, [knots], _OF_PATH)[:, :, 0]
    return compose(between_knots(knots, np.arange(len(path))) @ drift, path)


def prior_of(
    fused: FusedMap,
    maps: Sequence[TimedMap],
    smoothed: Smoothed,
    log: RobotLog,
    offset_m2: float,
) -> PriorMap:
    """Return what a robot's filter goes on with.

    Args:
        fused: map fused from the robot's map and those of others.
        maps: these maps, that of the robot first.
        smoothed: result of the smoother for its log.
        log: its log so far.
        offset_m2: variance of the offset between a track's point and its landmark.
    """
    own, landmarks, parents = maps[0], fused.landmarks, fused.parents
    joint = landmarks.joint
    if joint is None:  # a simpler fuser stood in
        joint = JointCovariance(landmarks.covariance_m2, np.zeros((len(landmarks), 0, 3)))
    is_own = parents[:, 0] != ABSENT
    source = ADOPTED + np.arange(len(landmarks), dtype=np.int64)
    source[is_own] = own.landmarks.source_observation[parents[is_own, 0]]
    # logs of the others precede that of the robot
    last_frame, segments, first = np.zeros(len(landmarks), np.int64), [(0, len(log) - 1)], 0
    for k in fused.members[1:]:
        other = maps[k]
        first -= other.n_frames
        has = (parents[:, k] != ABSENT) & (last_frame == 0)  # the first robot that has it
        last_frame[has] = first + other.last_frame[parents[has, k]]
        segments.insert(0, (first, first + other.n_frames - 1))
    last_frame[is_own] = own.last_frame[parents[is_own, 0]]

    drift = drift_of_map(joint, landmarks.position_m, last_frame, segments)
    conditional_m2 = joint.own_m2 + drift.remainder_m2 + offset_m2 * np.eye(3)

    fused_row = np.full(len(own.landmarks), ABSENT)
    fused_row[parents[is_own, 0]] = np.flatnonzero(is_own)
    obs = smoothed.obs
    row = fused_row[obs.landmark]
    used = np.flatnonzero(row != ABSENT)
    used = used[np.argsort(obs.frame[used], kind="stable")]
    before_m = own.landmarks.position_m[obs.landmark[used], :2]
    path = corrected_path(
        smoothed.estimate.path, obs.frame[used], before_m, landmarks.position_m[row[used], :2]
    )
    path[0] = smoothed.estimate.path[0]  # the frame of the map
    return PriorMap(
        replace(landmarks, covariance_m2=conditional_m2, joint=None),
        source,
        last_frame,
        path,
        smoothed.landmark,
        log.frame_starts(),
        drift.knots,
        drift.covariance,
    )
