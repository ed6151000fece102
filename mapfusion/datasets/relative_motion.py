"""Relative motions between frames of a robot log: observed ones, and those of odometry or truth.

A motion is observed if two frames show the same points: a least-squares fit of these points gives
the motion and its covariance. Motions of odometry or truth are differences of poses.

Points without labels, tracks and descriptors are tracked by their positions, as nearest neighbours
in consecutive frames (`tracked_by_position`).
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from mapfusion.descriptors import USURF, euclidean_distance_at
from mapfusion.fastslam.motion import MotionNoise
from mapfusion.geometry import se3
from mapfusion.geometry.numerics import Float, chi_square_bound
from mapfusion.geometry.se2 import between, compose, rotation, wrap
from mapfusion.robot_log import NO_TRACK, RobotLog
from mapfusion.tables import NO_LABEL
from mapfusion.vision.visual_odometry import MIN_LINKS, RigidMotion, estimate_rigid_motion

# Indices of x, y and the rotation about z within a translation and a rotation vector in space.
PLANAR = [0, 1, 5]
MIN_MOTIONS = 4  # of which a median is computed
_LINK_PROBABILITY = 0.999  # that a true link of consecutive frames lies inside the gate
_MAX_DESCRIPTOR_DISTANCE = 0.5  # as `FastSlamParameters.descriptor_threshold`
# Tolerances added to the covariances of a planar fit, relative to the extent of the points.
_TOLERANCES = (1.0, 0.25, 0.06, 0.015, 0.0)
# Condition number of links at a single place, which leave the rotation undetermined.
_MAX_CONDITION = 1e12
_MIN_PLANAR_LINKS = 2  # to determine a planar motion; their distance is checked as well
# Factors tried on the mean of stated variances, and the number of frames for the trial. Points
# whose covariances are in a wrong unit still determine the motion.
_COVARIANCE_FACTORS, _TRIAL_FRAMES = (1.0, 1e2, 1e4, 1e6), 40
# Largest distance of a point to its nearest neighbour in the next frame, over the distance to the
# second nearest one: Lowe's ratio test, stricter than for descriptors since a wrong neighbour may
# be close.
_NEIGHBOUR_RATIO = 0.5


class Motions(NamedTuple):
    """Motions from frame `start` to frame `end` of a log, in the robot frame at the start.

    Attributes:
        start: index of the first frame in the log, shape (N,).
        end: index of the last frame in the log, shape (N,).
        motion: translations in m and rotation vectors in rad, shape (N, 6).
        covariance: error covariances, shape (N, 6, 6). For planar data only the entries of x, y
            and the rotation about z are not zero.
        n_links: number of points that both frames show, shape (N,).
        n_agree: number of these points that agree with the motion, shape (N,).
    """

    start: np.ndarray
    end: np.ndarray
    motion: Float
    covariance: Float
    n_links: np.ndarray
    n_agree: np.ndarray

    @property
    def sigma(self) -> Float:
        """Root of the trace for translations (m) and for rotations (rad), shape (N, 2)."""
        variance = np.diagonal(self.covariance, axis1=1, axis2=2).reshape(-1, 2, 3)
        return np.sqrt(variance.sum(axis=2))


class _PairMotion(NamedTuple):
    """Observed motion T_first_second (4, 4) of one pair of frames; other fields as `Motions`."""

    T: Float
    covariance: Float
    n_links: int
    n_agree: int


def links(
    log: RobotLog, starts: np.ndarray, first: int, second: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the observations of the same points in two frames.

    Points are matched by label if the log has labels, else by track, else by mutually nearest
    descriptors.

    Args:
        log: the robot log.
        starts: `log.frame_starts()`.
        first: one frame.
        second: the other frame.

    Returns:
        Rows of the log's observations in the first and in the second frame, each of shape (n,).
    """
    observations = log.observations
    a, b = (np.arange(starts[k], starts[k + 1]) for k in (first, second))
    for identity, no_identity in ((observations.label, NO_LABEL), (observations.track, NO_TRACK)):
        if identity is not None:
            a, b = a[identity[a] != no_identity], b[identity[b] != no_identity]
            _, index_a, index_b = np.intersect1d(identity[a], identity[b], return_indices=True)
            return a[index_a], b[index_b]
    if observations.descriptor is None or not len(a) or not len(b):
        return a[:0], b[:0]
    descriptor_a, descriptor_b = observations.descriptor[a], observations.descriptor[b]
    similarity = descriptor_a @ descriptor_b.T  # 1 - d^2 / 2 of unit vectors with the distance d
    if observations.descriptor_kind != USURF:
        squares = (np.einsum("ij,ij->i", each, each) for each in (descriptor_a, descriptor_b))
        similarity += 1 - np.add.outer(*squares) / 2
    index_b, best_a = similarity.argmax(axis=1), similarity.argmax(axis=0)
    max_distance = euclidean_distance_at(_MAX_DESCRIPTOR_DISTANCE, observations.descriptor_kind)
    similar = similarity.max(axis=1) > 1 - max_distance**2 / 2
    mutual = similar & (best_a[index_b] == np.arange(len(a)))
    return a[mutual], b[index_b[mutual]]


def links_needed(log: RobotLog) -> int:
    """Return the number of points that two frames must share to determine a motion."""
    return _MIN_PLANAR_LINKS if log.planar else MIN_LINKS


def tracked_by_position(log: RobotLog) -> RobotLog:
    """Return the log with tracks of points that are nearest neighbours in consecutive frames.

    The neighbours in a frame are sought at the positions that a motion since the frame before
    predicts: the odometry, no motion, or the odometry of the frame before. A wrong prediction gives
    few neighbours, which seldom agree with one motion. Each frame takes the prediction with the
    most points that agree; the odometry is preferred.
    """
    previous = np.concatenate([np.zeros((1, 3)), log.odometry[:-1]])
    motions = np.stack([log.odometry, np.zeros_like(previous), previous])
    n_agree = np.zeros(motions.shape[:2], dtype=np.int64)
    for n, motion in zip(n_agree, motions, strict=True):
        observed, _ = _observed_steps(_tracked(log, motion))
        n[observed.end] = observed.n_agree
    return _tracked(log, motions[n_agree.argmax(axis=0), np.arange(len(log))])


def _tracked(log: RobotLog, motion: Float) -> RobotLog:
    """Return the log with tracks, given the predicted motions (T, 3) since the frame before."""
    from scipy.spatial import KDTree

    starts, position = log.frame_starts(), log.observations.position_m
    track = np.arange(len(position))
    for frame in range(1, len(log)):
        a, b = (np.arange(starts[k], starts[k + 1]) for k in (frame - 1, frame))
        if not len(a) or not len(b):
            continue
        p_before, p_after = position[a], position[b].copy()
        p_after[:, :2] = p_after[:, :2] @ rotation(motion[frame, 2]).T + motion[frame, :2]
        distance, nearest = (np.asarray(result) for result in KDTree(p_before).query(p_after, k=2))
        nearest_back = np.asarray(KDTree(p_after).query(p_before)[1])
        clear = distance[:, 0] < _NEIGHBOUR_RATIO * distance[:, 1]
        clear[clear] &= nearest_back[nearest[clear, 0]] == np.flatnonzero(clear)
        track[b[clear]] = track[a[nearest[clear, 0]]]
    return replace(log, observations=replace(log.observations, track=track))


def _planar_motion(
    p_before: Float, S_before: Float, p_after: Float, S_after: Float
) -> _PairMotion | None:
    """Fit a planar motion to links; return None if fewer than two agree or the rotation is free.

    The fit is a weighted least-squares fit of the links inside the gate. A tolerance that is added
    to all covariances decreases to zero, as in `estimate_rigid_motion`.
    """
    n = len(p_before)
    extent = float(np.sqrt(np.mean(np.var(p_after, axis=0)))) or 1.0
    weight, agree, gate = np.ones(n), np.ones(n, dtype=bool), chi_square_bound(_LINK_PROBABILITY, 2)
    for tolerance in _TOLERANCES:
        # Closed-form weighted least squares (Umeyama 1991).
        p_before_agree, p_after_agree, normalized_weight = (
            p_before[agree],
            p_after[agree],
            weight[agree] / weight[agree].sum(),
        )
        mean_before, mean_after = (
            normalized_weight @ p_before_agree,
            normalized_weight @ p_after_agree,
        )
        a, b = p_before_agree - mean_before, p_after_agree - mean_after
        sine = normalized_weight @ (b[:, 0] * a[:, 1] - b[:, 1] * a[:, 0])
        theta = float(np.arctan2(sine, normalized_weight @ np.sum(a * b, axis=1)))
        R = rotation(theta)
        t = mean_before - R @ mean_after
        # Gate and weights of the next fit.
        residual = p_before - p_after @ R.T - t
        spread = S_before + R @ S_after @ R.T + (tolerance * extent) ** 2 * np.eye(2)
        information = np.linalg.inv(spread)
        square = np.einsum("ni,nij,nj->n", residual, information, residual)
        agree, weight = square <= gate, 1.0 / np.trace(spread, axis1=1, axis2=2)
        if np.count_nonzero(agree) < _MIN_PLANAR_LINKS:
            return None
    # Covariance of the weighted least-squares estimate: G S G'.
    lever = p_after[agree] @ R.T
    J = np.zeros((len(lever), 2, 3))
    J[:, 0, 0] = J[:, 1, 1] = 1.0
    J[:, 0, 2], J[:, 1, 2] = -lever[:, 1], lever[:, 0]
    normal = np.einsum("nia,n,nib->ab", J, weight[agree], J)
    if np.linalg.cond(normal) > _MAX_CONDITION:
        return None
    gain = np.einsum("ab,nib,n->nai", np.linalg.inv(normal), J, weight[agree])
    covariance = np.zeros((6, 6))
    covariance[np.ix_(PLANAR, PLANAR)] = np.einsum("nai,nij,nbj->ab", gain, spread[agree], gain)
    T = se3.from_planar(np.array([*t, theta]))
    return _PairMotion(T, covariance, n, int(np.count_nonzero(agree)))


def _pair_motion(
    log: RobotLog, starts: np.ndarray, first: int, second: int, factor: float | None
) -> _PairMotion | None:
    """Return the motion between two frames; None if the links do not determine it.

    A covariance is as stated without a factor. With a factor, the errors are equal in all
    directions, and their variance is `factor` times the mean of the stated variances.
    """
    a, b = links(log, starts, first, second)
    observations = log.observations
    p, S = observations.position_m, observations.covariance_m2
    if factor is not None:
        axes = np.diag([1.0, 1.0, 0.0 if log.planar else 1.0])
        mean = np.trace(S, axis1=1, axis2=2) / np.trace(axes)
        S = factor * mean[:, None, None] * axes
    if log.planar and len(a) >= _MIN_PLANAR_LINKS:
        return _planar_motion(p[a, :2], S[a, :2, :2], p[b, :2], S[b, :2, :2])
    if log.planar or len(a) < MIN_LINKS:
        return None
    _, rigid_motion = estimate_rigid_motion(p[a], S[a], p[b], S[b], _LINK_PROBABILITY)
    if rigid_motion is None:
        return None
    return _PairMotion(
        rigid_motion.T_before_after, rigid_motion.covariance, len(a), rigid_motion.n_links
    )


def _motion_vectors(T: Float) -> Float:
    """Return translations and rotation vectors (N, 6) of motions (N, 4, 4); NaN where unknown."""
    from scipy.spatial.transform import Rotation  # the import takes a quarter of a second

    vectors = np.full((len(T), 6), np.nan)
    is_known = np.isfinite(T).all(axis=(1, 2))
    vectors[is_known, :3] = T[is_known, :3, 3]
    if is_known.any():
        vectors[is_known, 3:] = Rotation.from_matrix(T[is_known, :3, :3]).as_rotvec()
    return vectors


def observed_motions(log: RobotLog, lag: int = 1, factor: float | None = None) -> Motions:
    """Return the motions over every `lag` frames, for the pairs of frames that share enough points.

    A factor replaces the stated covariances by equal errors in all directions, whose variance is
    `factor` times the mean of the stated variances.
    """
    starts, frames, pair_motions = log.frame_starts(), [], list[_PairMotion]()
    for end in range(lag, len(log), lag):
        motion = _pair_motion(log, starts, end - lag, end, factor)
        if motion is not None:
            frames.append((end - lag, end))
            pair_motions.append(motion)
    start, end = np.array(frames, dtype=np.int64).reshape(-1, 2).T
    T = np.array([motion.T for motion in pair_motions]).reshape(-1, 4, 4)
    covariance = np.array([motion.covariance for motion in pair_motions]).reshape(-1, 6, 6)
    counts = np.array([(motion.n_links, motion.n_agree) for motion in pair_motions], dtype=np.int64)
    return Motions(start, end, _motion_vectors(T), covariance, *counts.reshape(-1, 2).T)


def motions_between_frames(motions: Sequence[tuple[int, RigidMotion]]) -> Motions:
    """Return known motions from frame to frame as `Motions`; each is given with its last frame."""
    end = np.array([k for k, _ in motions], dtype=np.int64)
    T = np.array([motion.T_before_after for _, motion in motions]).reshape(-1, 4, 4)
    covariance = np.array([motion.covariance for _, motion in motions]).reshape(-1, 6, 6)
    n_links = np.array([motion.n_links for _, motion in motions], dtype=np.int64)
    return Motions(end - 1, end, _motion_vectors(T), covariance, n_links, n_links)


def odometry_motions(log: RobotLog, noise: MotionNoise) -> Motions:
    """Return the motions from frame to frame of the odometry, with their stated noise."""
    n = len(log) - 1
    motion, covariance = np.zeros((n, 6)), np.zeros((n, 6, 6))
    motion[:, PLANAR] = log.odometry[1:]
    sigma = np.array([noise.standard_deviations(each) for each in log.odometry[1:]]).reshape(-1, 3)
    covariance[:, PLANAR, PLANAR] = sigma**2
    end, zeros = np.arange(1, n + 1), np.zeros(n, dtype=np.int64)
    return Motions(end - 1, end, motion, covariance, zeros, zeros)


def odometry_over_spans(
    odometry: Float, sigma: Float, observed: Motions, turned_rad: Float | None = None
) -> tuple[Float, Float, Float]:
    """Return the odometry over the spans of observed motions, to first order in its errors.

    Args:
        odometry: increments, shape (T, 3).
        sigma: their standard deviations, shape (T, 3).
        observed: N observed motions.
        turned_rad: angle by which a parameter turns the shift of each increment, shape (T,).

    Returns:
        Motions (N, 3), their covariances (N, 3, 3), and the derivatives (N, 2) of the shifts with
        respect to the parameter.
    """
    n = len(observed.start)
    T, C, B = np.zeros((n, 3)), np.zeros((n, 3, 3)), np.zeros((n, 2))
    for k in range(1, int(np.max(observed.end - observed.start, initial=0)) + 1):
        frame = observed.start + k
        R = np.tile(np.eye(3), (n, 1, 1))
        R[:, :2, :2] = rotation(T[:, 2])
        moved = compose(T, odometry[frame])
        across = np.column_stack([T[:, 1] - moved[:, 1], moved[:, 0] - T[:, 0]])
        by_heading = np.tile(np.eye(3), (n, 1, 1))
        by_heading[:, :2, 2] = across
        C = by_heading @ C @ np.swapaxes(by_heading, 1, 2)
        C += (R * sigma[frame, None] ** 2) @ np.swapaxes(R, 1, 2)
        if turned_rad is not None:
            B += turned_rad[frame, None] * across
        T = moved
    return T, C, B


def observed_spans(log: RobotLog) -> list[Motions]:
    """Return observed motions from frame to frame and over spans of 2, 4, 8, ... frames.

    Stated covariances that are far too small are enlarged (`_observed_steps`).
    """
    steps, factor = _observed_steps(log)
    return [steps, *(observed_motions(log, lag, factor) for lag in _span_lengths(len(log)))]


def _observed_steps(log: RobotLog) -> tuple[Motions, float | None]:
    """Return observed motions from frame to frame, and the factor on the stated variances.

    Stated covariances that are far too small, such as covariances in a wrong unit, are enlarged
    until the motion is determined for most frames that share points. They are made equal in all
    directions: of ranges and bearings, a wrong unit affects only the ranges.
    """
    factor = None
    steps = observed_motions(log)
    min_links = links_needed(log)
    if 2 * len(steps.end) < len(log) - 1:
        starts = log.frame_starts()
        tried = np.unique(np.linspace(1, len(log) - 1, _TRIAL_FRAMES).astype(int)).tolist()
        frames = [k for k in tried if len(links(log, starts, k - 1, k)[0]) >= min_links]
        for factor in (None, *_COVARIANCE_FACTORS):
            pair_motions = [_pair_motion(log, starts, k - 1, k, factor) for k in frames]
            if 2 * sum(motion is not None for motion in pair_motions) >= len(frames):
                break
        steps = steps if factor is None else observed_motions(log, 1, factor)
    return steps, factor


def composed_spans(steps: Motions, n_frames: int) -> list[Motions]:
    """Return motions from frame to frame and their compositions over 2, 4, 8, ... frames.

    Only spans in which every step is known are composed. Covariances are summed.
    """
    from scipy.spatial.transform import Rotation

    T_step = se3.pose(np.eye(3), np.zeros((int(steps.end.max(initial=0)) + 1, 3)))
    step_covariance = np.full((len(T_step), 6, 6), np.nan)
    if len(steps.end):
        R = Rotation.from_rotvec(steps.motion[:, 3:]).as_matrix()
        T_step[steps.end] = se3.pose(R, steps.motion[:, :3])
    step_covariance[steps.end] = steps.covariance
    spans = [steps]
    for lag in _span_lengths(n_frames):
        end = np.arange(lag, len(T_step), lag)
        T = np.tile(np.eye(4), (len(end), 1, 1))
        covariance = np.zeros((len(end), 6, 6))
        for k in range(lag):
            T = T @ T_step[end - lag + 1 + k]
            covariance += step_covariance[end - lag + 1 + k]
        is_known = np.isfinite(covariance).all(axis=(1, 2))
        none = np.zeros(int(is_known.sum()), dtype=np.int64)
        motion = _motion_vectors(T[is_known])
        spans.append(
            Motions(end[is_known] - lag, end[is_known], motion, covariance[is_known], none, none)
        )
    return spans


def _span_lengths(n_frames: int) -> list[int]:
    """Return the span lengths 2, 4, 8, ... of which a log has enough spans."""
    longest = max((n_frames - 1) // MIN_MOTIONS, 1)
    return [2**k for k in range(1, int(np.log2(longest)) + 1)]


def poses_from_increments(increments: Float) -> Float:
    """Return poses (T, 3) in the first frame from increments (T, 3); the first row is ignored."""
    heading = np.cumsum(increments[:, 2]) - increments[0, 2]
    heading_before = np.concatenate([[0.0], heading[:-1]])
    step = np.einsum("nij,nj->ni", rotation(heading_before), increments[:, :2])
    return np.column_stack([np.cumsum(step, axis=0) - step[0], wrap(heading)])


def motions_of_poses(poses: Float, start: np.ndarray, end: np.ndarray) -> tuple[Float, Float]:
    """Return the relative motions between pairs of poses.

    Args:
        poses: poses, shape (T, 3) or (T, 4, 4).
        start: indices of the first pose of each pair, shape (N,).
        end: indices of the second pose of each pair, shape (N,).

    Returns:
        Translations and rotation vectors, each of shape (N, 3).
    """
    if poses.ndim == 3:
        vectors = _motion_vectors(se3.between(poses[start], poses[end]))
        return vectors[:, :3], vectors[:, 3:]
    moved = between(poses[start], poses[end])
    shift, turn = np.zeros((len(moved), 3)), np.zeros((len(moved), 3))
    shift[:, :2], turn[:, 2] = moved[:, :2], moved[:, 2]
    return shift, turn
