"""Batch smoother: most probable path and landmarks of a whole log.

The filter associates observations while its path is uncertain, and neighbouring corners of a
textured wall are often closer than that. On the smoothed path two tracks i, j of one corner, with
points p and covariances W from their own observations, have the squared distance

    (p_i - p_j)' (W_i + W_j + 2 s^2)^-1 (p_i - p_j),

which is chi-square distributed if the offsets from the corner have the standard deviation s. The
path was fitted to the same tracks, so its errors do not increase the distance.
"""

from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np

from mapfusion.attitude import Attitude, attitude_height_errors
from mapfusion.fastslam.motion import MotionNoise
from mapfusion.geometry.joint_covariance import (
    RANK,
    JointCovariance,
    KnownErrors,
    SharedErrors,
    StackedErrors,
    condensed,
)
from mapfusion.geometry.numerics import Float, chi_square_bound, one_blas_thread
from mapfusion.geometry.se2 import between, rotation
from mapfusion.landmark_map import LandmarkMap
from mapfusion.parameters import Range, require_in_range, require_shape
from mapfusion.robot_log import STRAY_M, RobotLog
from mapfusion.smoother.elimination import require_memory, shared_errors
from mapfusion.smoother.noise_estimation import AS_STATED, Levels, settled_with_levels
from mapfusion.smoother.normal_equations import (
    Estimate,
    Weights,
    first_points,
    information_of,
    information_under,
    odometry_information,
)
from mapfusion.smoother.optimizer import Problem, Settled, finished, followed, settled
from mapfusion.smoother.problem import Sightings, sightings_of
from mapfusion.smoother.robust_loss import MOST_DOF, Tails
from mapfusion.smoother.second_order import SecondOrder, second_order_errors
from mapfusion.viewing import viewing_of_log

# Probability that two tracks of one corner are not split.
_TOGETHER = 0.999
_SINGULAR = 1e-12  # pivot over diagonal element that is a rounding error
# Number of pairs of tracks that are compared at the same time, to limit the memory: a landmark may
# have thousands of tracks.
_PAIRS_AT_ONCE = 100_000


def parted(seen: Sightings, landmark: np.ndarray, path: Float, stray_m: float) -> np.ndarray:
    """Split landmarks of several corners; return the landmark of each observation, shape (N,).

    The corner with the observation after which a landmark is numbered keeps the number. Without it
    the corner with the most observations does. Other corners get the number of their first
    observation that is not the number of another landmark.

    Args:
        seen: the observations.
        landmark: landmark of each observation of the log, shape (N,).
        path: path of the robot, shape (T, 3).
        stray_m: s.
    """
    made = landmark.copy()
    if not seen.strays.any():
        return made
    point, covariance = _track_points(seen, path)
    covariance[seen.strays] += stray_m**2 * np.eye(3)
    first = np.searchsorted(seen.track_starts, seen.starts)
    counts, n = np.diff(seen.track_starts), seen.n_dimensions
    bound = chi_square_bound(_TOGETHER, n)
    corner = _corners(first, counts, point[:, :n], covariance[:, :n, :n], bound)
    names = set(landmark.tolist())
    for own in np.flatnonzero(np.maximum.reduceat(corner, first[:-1])):
        track = np.repeat(corner[first[own] : first[own + 1]], counts[first[own] : first[own + 1]])
        rows = seen.row[seen.starts[own] : seen.starts[own + 1]]
        home = track[rows == landmark[rows[0]]]
        keeps = home[0] if len(home) else 0
        for k in np.setdiff1d(track, keeps):
            mine = rows[track == k]
            free = [row for row in mine.tolist() if row not in names]
            made[mine] = min(free, default=-1)
    return made


def _track_points(seen: Sightings, path: Float) -> tuple[Float, Float]:
    """Return the points (B, 3) of the tracks from their own observations, and covariances."""
    pose, R = path[seen.frame], np.zeros((len(seen), 3, 3))
    R[:, :2, :2], R[:, 2, 2] = rotation(pose[:, 2]), 1.0
    point = np.einsum("nij,nj->ni", R, seen.position_m)
    point[:, :2] += pose[:, :2]
    W = R @ seen.information @ np.swapaxes(R, 1, 2)
    total, n = seen.sum_by_track(W), seen.n_dimensions
    covariance = np.zeros_like(total)
    covariance[:, :n, :n] = np.linalg.inv(total[:, :n, :n])
    weighted = seen.sum_by_track(np.einsum("nij,nj->ni", W, point))
    return np.einsum("tij,tj->ti", covariance, weighted), covariance


def _corners(
    first: np.ndarray, counts: np.ndarray, point: Float, covariance: Float, bound: float
) -> np.ndarray:
    """Return the corner of each track within its landmark, from 0, shape (B,).

    Repeatedly the track with the most agreeing observations forms a corner with the tracks that
    agree with it.
    """
    corner, of = np.zeros(len(point), dtype=np.int64), _landmarks(first)
    i, j = _apart(first, point, covariance, bound)
    of_apart = of[i]
    for own in np.unique(of_apart):
        begin, size = first[own], first[own + 1] - first[own]
        here = slice(*np.searchsorted(of_apart, [own, own + 1]))
        near, one, other = np.ones((size, size), dtype=bool), i[here] - begin, j[here] - begin
        near[one, other] = near[other, one] = False
        left, k = np.ones(size, dtype=bool), 0
        while left.any():
            agree = np.where(left, near @ (left * counts[begin : begin + size]), 0)
            taken = left & near[np.argmax(agree)]
            corner[begin : begin + size][taken] = k
            left, k = left & ~taken, k + 1
    return corner


def _landmarks(first: np.ndarray) -> np.ndarray:
    """Return the landmark of each track (B,); `first` (L + 1,) are the landmarks' first tracks."""
    return np.repeat(np.arange(len(first) - 1), np.diff(first))


def _apart(first: np.ndarray, point: Float, covariance: Float, bound: float) -> np.ndarray:
    """Return pairs (2, A) of tracks of one landmark that disagree, ordered by the first track."""
    begin = first[_landmarks(first)]
    before = np.arange(len(point)) - begin  # tracks of the same landmark before each
    part = np.cumsum(before) // _PAIRS_AT_ONCE
    S, off = (np.ascontiguousarray(values.T) for values in (covariance, point))
    found = []
    for own in np.split(np.arange(len(point)), np.flatnonzero(np.diff(part)) + 1):
        n = before[own]
        i = np.repeat(own, n)
        j = np.arange(len(i)) - np.repeat(np.cumsum(n) - n - begin[own], n)
        away = _squares(S[..., i] + S[..., j], off[..., i] - off[..., j]) > bound
        found.append(np.stack([i[away], j[away]]))
    return np.concatenate(found, axis=1)


def _squares(S: Float, off: Float) -> Float:
    """Return squared Mahalanobis distances (P,) of `off` (n, P); 0 for singular S (n, n, P).

    Uses S = L D L' and overwrites both arguments.
    """
    total, regular = np.zeros(S.shape[-1]), np.ones(S.shape[-1], dtype=bool)
    least = [_SINGULAR * S[k, k] for k in range(len(S))]
    for k in range(len(S)):
        regular &= S[k, k] > least[k]
        pivot = np.where(regular, S[k, k], 1.0)
        total += off[k] ** 2 / pivot
        share = S[k + 1 :, k] / pivot
        off[k + 1 :] -= share * off[k]
        S[k + 1 :, k + 1 :] -= share[:, None] * S[k, k + 1 :]
    return np.where(regular, total, 0.0)


# Factor on the observations' standard deviations in a first round (graduated non-convexity). With a
# poor initial path most observations look gross and would lose their weights. The second value is
# the tolerance of this round, in squared sigmas a coordinate.
_THOUGHT_WORSE, _CLOSE = 4.0, 3e-2
# If the odometry's variances exceed the stated ones by this factor, good observations look gross
# until the level is known. The weights are then computed again with the level.
_FAR_WORSE = 4.0
# Standard deviations of an unknown motion between two frames.
_UNTOLD_M, _UNTOLD_RAD = 10.0, 1.0
_LEAST_SEEN = 3  # two observations determine a pose; one is redundant


@dataclass(frozen=True)
class SmootherParameters:
    """Settings of the smoother.

    Attributes:
        motion: stated noise of the odometry; the smoother estimates its level.
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
    def stray_information(self) -> float:
        """Information of a track's offset along each axis, in 1/m^2; 0 without offsets."""
        return 1 / self.stray_m**2 if self.stray_m else 0.0

    @property
    def has_own_odometry(self) -> bool:
        """True if some odometry is independent, so that its noise can be estimated."""
        known = self.odometry_covariance
        return known is None or bool(np.isnan(known).any())

    def odometry_information(self, log: RobotLog) -> Float:
        """Return the inverse variances of the increments after the first, shape (T - 1, 3)."""
        if self.odometry_covariance is None:
            return odometry_information(log.odometry, self.motion)
        blind = np.diff(log.frame_starts()) < _LEAST_SEEN
        needed = blind[:-1] | blind[1:]
        told = self.odometry_covariance[1 : len(log)]
        sigma = np.array([self.motion.with_floor(own) for own in told]).reshape(-1, 3)
        sigma[~needed] = [_UNTOLD_M, _UNTOLD_M, _UNTOLD_RAD]
        own = np.isnan(told).any(axis=(1, 2))
        information = information_of(sigma)
        information[own] = odometry_information(log.odometry, self.motion)[own]
        return information


@dataclass(frozen=True)
class Smoothed:
    """Result of the smoother.

    Attributes:
        landmark: landmark of each observation of the log, shape (N,); negative for none.
        estimate: path, landmarks and tracks' offsets.
        seen: the observations, with information scaled by the level.
        weights: weights of observations and offsets.
        tails: tails of their Student-t distributions.
        observation_level: estimated factor on the stated covariances of observations on tracks.
        odometry_level: estimated factors on the odometry's stated variances along, across and in
            the heading, shape (3,).
        n_steps: number of Gauss-Newton steps.
        own_m2: see `common`, shape (L, 3, 3).
        common: Y (R, 3L): the landmarks' joint covariance is block diagonal of `own_m2` plus Y' Y.
        second_order: second-order errors, which are part of `common`; None if negligible.
    """

    landmark: np.ndarray
    estimate: Estimate
    seen: Sightings
    weights: Weights
    tails: Tails
    observation_level: float
    odometry_level: Float
    n_steps: int
    own_m2: Float
    common: SharedErrors
    second_order: SecondOrder | None = None

    @classmethod
    def of(
        cls,
        problem: Problem,
        end: Settled,
        landmark: np.ndarray,
        levels: Levels = AS_STATED,
        steps_before: int = 0,
    ) -> "Smoothed":
        """Return the result for the final state of the steps.

        Args:
            problem: the problem with the stated odometry.
            end: the final state.
            landmark: landmark of each observation of the log, shape (N,).
            levels: the estimated levels.
            steps_before: number of steps in earlier rounds.
        """
        common = shared_errors(end.seen, end.equations, end.solution)
        information = information_under(problem.information, levels.odometry)
        further = second_order_errors(problem._replace(information=information), end)
        if further is not None:
            rows = further.point_m.reshape(len(further.point_m), -1)
            common = StackedErrors(common, KnownErrors(rows))
        of_levels = levels.observation, levels.odometry
        found = (end.estimate, end.seen, end.weights, end.tails, *of_levels)
        n_steps, own_m2 = steps_before + end.n_steps, end.solution.own_m2
        return cls(landmark, *found, n_steps, own_m2, common, further)

    def joint_covariance(self) -> Float:
        """Return the dense joint covariance (3L, 3L), for small maps."""
        common, n = self.common.spread(np.eye(len(self.common))), len(self.own_m2)
        joint = common @ common.T
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

    Landmarks whose tracks are of several corners are split (`one_corner.py`).

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
    known = _problem(log, landmark, parameters, information)
    require_memory(known.seen, max_memory_gb)
    start, n_steps = _without_gross(known, path)
    path = start[0].path
    parts = parted(known.seen, landmark, path, parameters.stray_m)
    if not np.array_equal(parts, landmark):
        known = _problem(log, parts, parameters, information)
        start = followed(known, _start(known, path))
    if parameters.has_own_odometry:
        end, levels = settled_with_levels(known, *start)
        if levels.odometry.max() > _FAR_WORSE and end.tails.observation < MOST_DOF:
            path, n_steps = end.estimate.path, n_steps + end.n_steps
            del end  # frees the memory of its factors
            under = information_under(information, levels.odometry)
            start, n_again = _without_gross(known._replace(information=under), path)
            n_steps += n_again
            end, levels = settled_with_levels(known, *start, levels.odometry)
    else:  # visual odometry has no level of its own
        at, weights, tails = start
        end, levels = settled(known, at, weights=weights, tails=tails), AS_STATED
    return Smoothed.of(known, end, parts, levels, n_steps)


def _without_gross(problem: Problem, path: Float) -> tuple[tuple[Estimate, Weights, Tails], int]:
    """Return the start of the next round after a round with larger errors, and its steps."""
    seen = problem.seen
    worse = replace(seen, information=seen.information / _THOUGHT_WORSE**2)
    blurred = problem._replace(seen=worse)
    end = finished(blurred, settled(blurred, _start(problem, path), _CLOSE))
    return (end.estimate, end.weights, end.tails), end.n_steps


def _problem(
    log: RobotLog, landmark: np.ndarray, parameters: SmootherParameters, information: Float
) -> Problem:
    seen = sightings_of(log, landmark, parameters.min_count, stray=parameters.stray_m > 0)
    return Problem(seen, log.odometry, information, parameters.stray_information)


def _start(problem: Problem, path: Float) -> Estimate:
    seen = problem.seen
    return Estimate(path, first_points(seen, path), np.zeros((len(seen.strays), 3)))


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
        attitude: attitude that the observations were levelled with; None for a level body.
    """
    seen, landmark = smoothed.seen, smoothed.landmark
    if attitude is not None and seen.n_dimensions > 2:
        smoothed = _with_attitude(smoothed, attitude)
    point, joint = condensed_points(smoothed, rank)
    source = landmark[seen.row[seen.starts[:-1]]].astype(np.int64)
    look = log.observations[source]
    count = np.diff(seen.starts).astype(np.int32)
    about = (count, source, look.descriptor, look.label, log.planar, log.robot)
    viewing = viewing_of_log(log, landmark, smoothed.estimate.path, source)
    return LandmarkMap(point, joint.marginal_m2, *about, joint, viewing, log.calibration)


@one_blas_thread
def condensed_points(smoothed: Smoothed, rank: int = RANK) -> tuple[Float, JointCovariance]:
    """Return the landmarks (L, 3) and their condensed joint covariance; planar z is zero."""
    point = smoothed.estimate.point_m.copy()
    joint = condensed(smoothed.own_m2, smoothed.common, rank)
    if smoothed.seen.n_dimensions == 2:
        point[:, 2] = 0.0
        joint.own_m2[:, 2, :] = joint.own_m2[:, :, 2] = joint.common_m[:, :, 2] = 0.0
    return point, joint


def _with_attitude(smoothed: Smoothed, attitude: Attitude) -> Smoothed:
    """Add the errors of the attitude to the landmarks' shared errors."""
    seen, estimate = smoothed.seen, smoothed.estimate
    lifted = attitude_height_errors(
        attitude, estimate.path, seen.frame, seen.landmark, estimate.point_m
    )
    moved = np.zeros((*lifted.shape, 3))
    moved[..., 2] = lifted
    by_path = smoothed.common.spread(np.eye(len(smoothed.common))).T
    both = np.vstack([by_path, moved.reshape(len(moved), -1)])
    return replace(smoothed, common=KnownErrors(both))
