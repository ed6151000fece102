"""Batch smoother: most probable path and landmarks of a whole log.

The filter associates observations while its path is uncertain, and neighbouring corners of a
textured wall are often closer than that uncertainty. So landmarks are split on the smoothed path.
Two tracks i, j of the same corner, with points p and covariances W from their own observations,
have the squared distance

    (p_i - p_j)' (W_i + W_j + 2 s^2)^-1 (p_i - p_j),

which is chi-square distributed if the offsets from the corner have the standard deviation s. The
path was fitted to the same tracks, so its errors do not increase the distance.
"""

from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
import scipy

from mapfusion.attitude import Attitude, attitude_height_errors
from mapfusion.fastslam.motion import MotionNoise
from mapfusion.geometry.joint_covariance import (
    RANK,
    JointCovariance,
    KnownErrors,
    SharedErrors,
    StackedErrors,
    reduce_rank,
)
from mapfusion.geometry.numerics import Float, chi_square_bound, one_blas_thread, require_shape
from mapfusion.geometry.se2 import IDENTITY, between, rotation
from mapfusion.landmark_map import LandmarkMap
from mapfusion.parameters import Range, require_in_range
from mapfusion.robot_log import STRAY_M, RobotLog
from mapfusion.smoother.elimination import pose_covariances, require_memory, shared_errors
from mapfusion.smoother.noise_estimation import UNIT_SCALES, NoiseScales, optimize_with_noise
from mapfusion.smoother.normal_equations import (
    Estimate,
    Weights,
    bounded_information,
    initial_landmarks,
    odometry_information,
    scaled_information,
)
from mapfusion.smoother.optimizer import (
    OptimizerState,
    Problem,
    optimize,
    take_final_step,
    update_points_and_weights,
)
from mapfusion.smoother.problem import OrderedObservations, order_observations
from mapfusion.smoother.robust_loss import Tails
from mapfusion.smoother.second_order import SecondOrder, second_order_errors
from mapfusion.viewing import viewing_of_log

# Probability that two tracks of one corner are not split.
_SAME_CORNER = 0.999
_SINGULAR = 1e-12  # pivot over diagonal element that is a rounding error
# Number of pairs of tracks that are compared at the same time, to limit the memory: a landmark may
# have thousands of tracks.
_PAIRS_AT_ONCE = 100_000


def split_landmarks(
    obs: OrderedObservations, landmark: np.ndarray, path: Float, stray_m: float
) -> np.ndarray:
    """Split landmarks of several corners; return the landmark of each observation, shape (N,).

    The corner with the observation after which a landmark is numbered keeps the number. Without it
    the corner with the most observations does. Other corners get the number of their first
    observation that is not the number of another landmark.

    Args:
        obs: the observations.
        landmark: landmark of each observation of the log, shape (N,).
        path: path of the robot, shape (T, 3).
        stray_m: s.
    """
    split = landmark.copy()
    if not obs.has_offset.any():
        return split
    # points of the tracks from their own observations, and covariances
    pose, R = path[obs.frame], np.zeros((len(obs), 3, 3))
    R[:, :2, :2], R[:, 2, 2] = rotation(pose[:, 2]), 1.0
    point = np.einsum("nij,nj->ni", R, obs.position_m)
    point[:, :2] += pose[:, :2]
    W = R @ obs.information @ np.swapaxes(R, 1, 2)
    total, n = obs.sum_by_track(W), obs.n_dimensions
    covariance = np.zeros_like(total)
    covariance[:, :n, :n] = np.linalg.inv(total[:, :n, :n])
    point = np.einsum("tij,tj->ti", covariance, obs.sum_by_track(np.einsum("nij,nj->ni", W, point)))
    covariance[obs.has_offset] += stray_m**2 * np.eye(3)

    first = np.searchsorted(obs.track_starts, obs.starts)
    counts, bound = np.diff(obs.track_starts), chi_square_bound(_SAME_CORNER, n)
    pairs = _inconsistent_pairs(first, point[:, :n], covariance[:, :n, :n], bound)
    corner = _corners(first, counts, pairs)
    names = set(landmark.tolist())
    for landmark_index in np.flatnonzero(np.maximum.reduceat(corner, first[:-1])):
        track = np.repeat(
            corner[first[landmark_index] : first[landmark_index + 1]],
            counts[first[landmark_index] : first[landmark_index + 1]],
        )
        rows = obs.row[obs.starts[landmark_index] : obs.starts[landmark_index + 1]]
        home = track[rows == landmark[rows[0]]]
        keeps = home[0] if len(home) else 0
        for k in np.setdiff1d(track, keeps):
            track_rows = rows[track == k]
            free = [row for row in track_rows.tolist() if row not in names]
            split[track_rows] = min(free, default=-1)
    return split


def _corners(first: np.ndarray, counts: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Return the corner of each track within its landmark, from 0, shape (B,).

    Repeatedly the track with the most consistent observations forms a corner with the tracks that
    are consistent with it.

    Args:
        first: first track of each landmark, shape (L + 1,).
        counts: number of observations of each track, shape (B,).
        pairs: inconsistent tracks of one landmark, shape (2, A).
    """
    corner, (i, j) = np.zeros(len(counts), dtype=np.int64), pairs
    of_pair = _landmark_of_tracks(first)[i]
    for landmark_index in np.unique(of_pair):
        first_track, size = first[landmark_index], first[landmark_index + 1] - first[landmark_index]
        pair_slice = slice(*np.searchsorted(of_pair, [landmark_index, landmark_index + 1]))
        is_consistent = np.ones((size, size), dtype=bool)
        track_i = i[pair_slice] - first_track
        track_j = j[pair_slice] - first_track
        is_consistent[track_i, track_j] = is_consistent[track_j, track_i] = False
        left, k = np.ones(size, dtype=bool), 0
        while left.any():
            agree = np.where(
                left, is_consistent @ (left * counts[first_track : first_track + size]), 0
            )
            is_split = left & is_consistent[np.argmax(agree)]
            corner[first_track : first_track + size][is_split] = k
            left, k = left & ~is_split, k + 1
    return corner


def _landmark_of_tracks(first: np.ndarray) -> np.ndarray:
    """Return the landmark of each track (B,); `first` (L + 1,) are the landmarks' first tracks."""
    return np.repeat(np.arange(len(first) - 1), np.diff(first))


def _inconsistent_pairs(
    first: np.ndarray, point: Float, covariance: Float, bound: float
) -> np.ndarray:
    """Return inconsistent pairs (2, A) of tracks of one landmark, ordered by the first track."""
    first_track = first[_landmark_of_tracks(first)]
    n_before = np.arange(len(point)) - first_track  # tracks of the same landmark before each
    part = np.cumsum(n_before) // _PAIRS_AT_ONCE
    S, position_columns = (np.ascontiguousarray(values.T) for values in (covariance, point))
    pairs = []
    for rows in np.split(np.arange(len(point)), np.flatnonzero(np.diff(part)) + 1):
        n = n_before[rows]
        i = np.repeat(rows, n)
        j = np.arange(len(i)) - np.repeat(np.cumsum(n) - n - first_track[rows], n)
        # squared Mahalanobis distances from S = L D L'; 0 for singular S
        sums = S[..., i] + S[..., j]
        differences = position_columns[..., i] - position_columns[..., j]
        total, regular = np.zeros(sums.shape[-1]), np.ones(sums.shape[-1], dtype=bool)
        singular_limits = [_SINGULAR * sums[r, r] for r in range(len(sums))]
        for r in range(len(sums)):
            regular &= sums[r, r] > singular_limits[r]
            pivot = np.where(regular, sums[r, r], 1.0)
            total += differences[r] ** 2 / pivot
            share = sums[r + 1 :, r] / pivot
            differences[r + 1 :] -= share * differences[r]
            sums[r + 1 :, r + 1 :] -= share[:, None] * sums[r, r + 1 :]
        apart = np.where(regular, total, 0.0) > bound
        pairs.append(np.stack([i[apart], j[apart]]))
    return np.concatenate(pairs, axis=1)


# Factor on the observations' standard deviations in a first round (graduated non-convexity). With a
# poor initial path most observations look like outliers and would lose their weights.
_INFLATION = 4.0
_FIRST_TOLERANCE = 3e-2  # tolerance of this round, in squared sigmas a coordinate
# If the odometry's variances exceed the stated ones by this factor, the variances stated for its
# noisy increments are not those stated for the motion, and those of the smoothed motion are taken.
_LARGE_SCALE = 4.0
# Standard deviations of an unknown motion between two frames.
_UNKNOWN_M, _UNKNOWN_RAD = 10.0, 1.0
_LEAST_OBSERVATIONS = 3  # two observations determine a pose; one is redundant


@dataclass(frozen=True)
class SmootherParameters:
    """Settings of the smoother.

    Attributes:
        motion: stated noise of the odometry; the smoother estimates its scale.
        stray_m: standard deviation, along each axis, of the offset between a track's point and its
            landmark; 0: no offset.
        min_count: number of observations that a landmark needs.
        odometry_covariance: covariances of visual odometry, shape (T, 3, 3) or longer. It comes
            from the observations themselves and must not count twice, so it is used only beside
            frames with too few observations. None, or NaN at a frame: the odometry is independent
            of the observations.
    """

    motion: MotionNoise = field(default_factory=MotionNoise)
    stray_m: Annotated[float, Range(0, 10, "m")] = STRAY_M
    min_count: Annotated[int, Range(1, 1_000_000, "observations")] = 3
    odometry_covariance: Float | None = None

    def __post_init__(self) -> None:
        require_in_range(self)

    @property
    def offset_prior(self) -> float:
        """Information of a track's offset along each axis, in 1/m^2; 0 without offsets."""
        return 1 / self.stray_m**2 if self.stray_m else 0.0

    @property
    def has_own_odometry(self) -> bool:
        """True if some odometry is independent, so that its noise can be estimated."""
        covariance = self.odometry_covariance
        return covariance is None or bool(np.isnan(covariance).any())

    def odometry_information(self, log: RobotLog, path: Float | None = None) -> Float:
        """Return the inverse variances of the increments after the first, shape (T - 1, 3).

        The motion noise depends on the motion: that of the odometry, or of a path (T, 3).
        """
        motion = log.odometry
        if path is not None:
            motion = np.concatenate([IDENTITY[None], between(path[:-1], path[1:])])
        if self.odometry_covariance is None:
            return odometry_information(motion, self.motion)
        blind = np.diff(log.frame_starts()) < _LEAST_OBSERVATIONS
        needed = blind[:-1] | blind[1:]
        stated = self.odometry_covariance[1 : len(log)]
        sigma = np.array([self.motion.with_floor(is_missing) for is_missing in stated]).reshape(
            -1, 3
        )
        sigma[~needed] = [_UNKNOWN_M, _UNKNOWN_M, _UNKNOWN_RAD]
        is_missing = np.isnan(stated).any(axis=(1, 2))
        information = bounded_information(sigma)
        information[is_missing] = odometry_information(motion, self.motion)[is_missing]
        return information


@dataclass(frozen=True)
class AssociatedLog:
    """Log of a robot with data association and path.

    Attributes:
        log: T frames with N observations.
        landmark: `source_observation` of the map's landmark for each observation, shape (N,);
            negative for none.
        path: approximate path, shape (T, 3), for example smoothed; its first pose is the frame of
            the map.
        parameters: parameters of the smoother.
    """

    log: RobotLog
    landmark: np.ndarray
    path: Float
    parameters: SmootherParameters

    def __post_init__(self) -> None:
        require_shape("landmark", self.landmark, (len(self.log.observations),))
        require_shape("path", self.path, (len(self.log), 3))


@dataclass(frozen=True)
class Smoothed:
    """Result of the smoother.

    Attributes:
        landmark: landmark of each observation of the log, shape (N,); negative for none.
        estimate: path, landmarks and tracks' offsets.
        obs: the observations, with information divided by `observation_scale`.
        weights: weights of observations and offsets.
        tails: tails of their Student-t distributions.
        observation_scale: estimated factor on the stated covariances of observations on tracks.
        odometry_scales: estimated factors on the odometry's stated variances along, across and in
            the heading, shape (3,).
        odometry_information: inverse variances of the increments after the first, with the factors,
            shape (T - 1, 3).
        n_steps: number of Gauss-Newton steps.
        own_m2: see `common`, shape (L, 3, 3).
        common: Y (R, 3L): the landmarks' joint covariance is block diagonal of `own_m2` plus Y' Y.
        path_covariance: covariances of the poses, shape (T, 3, 3); that of the first one, which is
            the frame of the map, is 0.
        second_order: second-order errors, which are part of `common` and `path_covariance`; None
            if negligible.
    """

    landmark: np.ndarray
    estimate: Estimate
    obs: OrderedObservations
    weights: Weights
    tails: Tails
    observation_scale: float
    odometry_scales: Float
    odometry_information: Float
    n_steps: int
    own_m2: Float
    common: SharedErrors
    path_covariance: Float
    second_order: SecondOrder | None = None

    @classmethod
    def of(
        cls,
        problem: Problem,
        state: OptimizerState,
        landmark: np.ndarray,
        scales: NoiseScales = UNIT_SCALES,
        steps_before: int = 0,
    ) -> "Smoothed":
        """Return the result for the final state of the steps.

        Args:
            problem: the problem with the stated odometry.
            state: the final state.
            landmark: landmark of each observation of the log, shape (N,).
            scales: the estimated noise scales.
            steps_before: number of steps in earlier rounds.
        """
        solved = state.obs, state.equations, state.solution
        common, path_covariance = shared_errors(*solved), pose_covariances(*solved)
        information = scaled_information(problem.information, scales.odometry)
        further = second_order_errors(problem._replace(information=information), state)
        if further is not None:
            rows = further.point_m.reshape(len(further.point_m), -1)
            common = StackedErrors(common, KnownErrors(rows))
            path_covariance += further.pose_covariances()
        of_noise = scales.observation, scales.odometry, information
        found = (state.estimate, state.obs, state.weights, state.tails, *of_noise)
        n_steps, own_m2 = steps_before + state.n_steps, state.solution.own_m2
        return cls(landmark, *found, n_steps, own_m2, common, path_covariance, further)

    def joint_covariance(self) -> Float:
        """Return the dense joint covariance (3L, 3L), for small maps."""
        shared_m, n = self.common.spread(np.eye(len(self.common))), len(self.own_m2)
        joint = shared_m @ shared_m.T
        each = np.arange(n)
        joint.reshape(n, 3, n, 3)[each, :, each, :] += self.own_m2
        return joint


@one_blas_thread
def smooth(
    log: RobotLog,
    landmark: np.ndarray,
    path: Float,
    parameters: SmootherParameters,
    max_memory_gb: float = np.inf,
) -> Smoothed:
    """Compute the most probable path and landmarks.

    Landmarks with tracks of several corners are split (`split_landmarks`).

    Args:
        log: the log.
        landmark: landmark of each observation, shape (N,); negative for none.
        path: initial path, shape (T, 3); its first pose is the frame of the map.
        parameters: settings.
        max_memory_gb: smoothing that may take more memory is refused.

    Raises:
        LinAlgError: the equations are singular.
        MemoryError: it may take more than `max_memory_gb`.
        ValueError: an array has a wrong shape.
    """
    require_shape("path", path, (len(log), 3))
    information, path = parameters.odometry_information(log), between(path[0], path)
    problem = _problem(log, landmark, parameters, information)
    require_memory(problem.obs, max_memory_gb)
    start, n_steps = _robust_start(problem, path)
    path = start[0].path
    parts = split_landmarks(problem.obs, landmark, path, parameters.stray_m)
    if not np.array_equal(parts, landmark):
        problem = _problem(log, parts, parameters, information)
        start = update_points_and_weights(problem, _start(problem, path))
    if parameters.has_own_odometry:
        state, scales = optimize_with_noise(problem, *start)
        if scales.odometry.max() > _LARGE_SCALE:
            used = scaled_information(information, scales.odometry)
            information = parameters.odometry_information(log, state.estimate.path)
            problem = problem._replace(information=information)
            first_scales = np.mean(1 / used, axis=0) / np.mean(1 / information, axis=0)
            start, n_steps = (state.estimate, state.weights, state.tails), n_steps + state.n_steps
            del state  # frees the memory of its factors
            state, scales = optimize_with_noise(problem, *start, first_scales)
    else:  # the noise of visual odometry is not estimated
        at, weights, tails = start
        state, scales = optimize(problem, at, weights=weights, tails=tails), UNIT_SCALES
    return Smoothed.of(problem, state, parts, scales, n_steps)


def _robust_start(problem: Problem, path: Float) -> tuple[tuple[Estimate, Weights, Tails], int]:
    """Return the result of a round with inflated covariances, and its number of steps."""
    obs = problem.obs
    inflated = replace(obs, information=obs.information / _INFLATION**2)
    first_problem = problem._replace(obs=inflated)
    state = take_final_step(
        first_problem, optimize(first_problem, _start(problem, path), _FIRST_TOLERANCE)
    )
    return (state.estimate, state.weights, state.tails), state.n_steps


def _problem(
    log: RobotLog, landmark: np.ndarray, parameters: SmootherParameters, information: Float
) -> Problem:
    obs = order_observations(
        log, landmark, parameters.min_count, with_offsets=parameters.stray_m > 0
    )
    return Problem(obs, log.odometry, information, parameters.offset_prior)


def _start(problem: Problem, path: Float) -> Estimate:
    obs = problem.obs
    return Estimate(path, initial_landmarks(obs, path), np.zeros((len(obs.has_offset), 3)))


def smoothed_map(
    log: RobotLog,
    smoothed: Smoothed,
    rank: int = RANK,
    attitude: Attitude | None = None,
) -> LandmarkMap:
    """Return the landmarks as a map in the frame of the first pose.

    Args:
        log: the smoothed log.
        smoothed: the result of the smoother, with landmarks numbered by rows of the log.
        rank: number of shared variables of the joint covariance.
        attitude: attitude that the observations were corrected with; None for a level body.
    """
    obs, landmark = smoothed.obs, smoothed.landmark
    if attitude is not None and obs.n_dimensions > 2:
        # add the errors of the attitude to the landmarks' shared errors
        estimate, shared_error = smoothed.estimate, smoothed.common
        heights = attitude_height_errors(
            attitude, estimate.path, obs.frame, obs.landmark, estimate.point_m
        )
        by_attitude = np.zeros((*heights.shape, 3))
        by_attitude[..., 2] = heights
        by_path = shared_error.spread(np.eye(len(shared_error))).T
        error_columns = np.vstack([by_path, by_attitude.reshape(len(by_attitude), -1)])
        smoothed = replace(smoothed, common=KnownErrors(error_columns))
    point, joint = condensed_points(smoothed, rank)
    source = landmark[obs.row[obs.starts[:-1]]].astype(np.int64)
    source_observation = log.observations[source]
    count = np.diff(obs.starts).astype(np.int32)
    attributes = (
        count,
        source,
        source_observation.descriptor,
        source_observation.label,
        log.planar,
        log.robot,
    )
    seen = log.iteration, log.observations.position_m
    viewing = viewing_of_log(*seen, landmark, smoothed.estimate.path, source)
    kind = source_observation.descriptor_kind
    map_fields = joint, viewing, log.calibration
    return LandmarkMap(point, joint.marginal_m2, *attributes, *map_fields, descriptor_kind=kind)


def with_path_errors(
    filtered: LandmarkMap, smoothed: LandmarkMap, complete: bool = True
) -> LandmarkMap:
    """Add the joint covariance of its errors to a map of the filter.

    The covariances of the filter are conditional on the path of one particle. The errors of its map
    are those of the smoothed map, of known joint covariance, plus the difference of the two maps.
    The difference counts as one more shared displacement of one sigma. A landmark that the smoothed
    map lacks has the shared errors of the nearest landmark, and its own covariance.

    Args:
        filtered: map of the filter.
        smoothed: smoothed map of the same log in the same frame, with a joint covariance.
        complete: False if the smoothed map is of an earlier iteration. The errors of the path since
            then are missing.
    """
    assert smoothed.joint is not None
    order = np.argsort(smoothed.source_observation, kind="stable")
    sources = smoothed.source_observation[order]
    index = np.searchsorted(sources, filtered.source_observation) % max(len(sources), 1)
    in_both = np.flatnonzero(sources[index] == filtered.source_observation) if len(sources) else []
    if not len(in_both):
        return filtered
    twin = order[index[in_both]]
    difference_m = filtered.position_m[in_both] - smoothed.position_m[twin]
    shared_m = np.concatenate([smoothed.joint.common_m[twin], difference_m[:, None]], axis=1)
    tree = scipy.spatial.KDTree(filtered.position_m[in_both, :2])
    nearest = tree.query(filtered.position_m[:, :2])[1]
    nearest[in_both] = np.arange(len(in_both))
    own_m2 = filtered.covariance_m2.copy()
    own_m2[in_both] = smoothed.joint.own_m2[twin]
    return replace(filtered, joint=JointCovariance(own_m2, shared_m[nearest], complete))


@one_blas_thread
def condensed_points(smoothed: Smoothed, rank: int = RANK) -> tuple[Float, JointCovariance]:
    """Return the landmarks (L, 3) and their condensed joint covariance; planar z is zero."""
    point = smoothed.estimate.point_m.copy()
    joint = reduce_rank(smoothed.own_m2, smoothed.common, rank)
    if smoothed.obs.n_dimensions == 2:
        point[:, 2] = 0.0
        joint.own_m2[:, 2, :] = joint.own_m2[:, :, 2] = joint.common_m[:, :, 2] = 0.0
    return point, joint
