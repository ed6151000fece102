"""Odometry calibration from logs: systematic errors of each robot, noise parameters of all.

An increment (x, y, theta) of the log stands for the motion

    ((1 + distance) x, (1 + distance) y,
     (1 + turn + in_place s) theta + late_turn theta_before + bias |(x, y)|)

with the heading increment theta_before of the frame before. A late_turn together with its negative
as turn is a delay of the odometry. Turns in place have an additional error, because wheels that run
in opposite directions slip more. s is the share of a turn in place,

    s = max(0, 1 - |(x, y)| / (r |theta|)),

1 for a turn on the spot and 0 for a radius of r and more, at which no wheel runs backwards. The
model is linear in the constants.

Each round smooths the logs, takes a Gauss-Newton step of the constants on the marginal likelihood
and a step of the noise parameters (`noise_estimation`). No true poses are needed.
"""

from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass, fields

import numpy as np

from mapfusion.errors import InputError
from mapfusion.fastslam.motion import MotionNoise
from mapfusion.geometry.numerics import Float, require_finite, require_shape
from mapfusion.geometry.se2 import IDENTITY, compose, wrap
from mapfusion.robot_log import RobotLog, first_frames
from mapfusion.smoother.noise_estimation import (
    NOISE_PARAMETERS,
    NoiseStatistics,
    motion_posterior,
    noise_statistics,
    relative_errors,
    sum_statistics,
    update_noise,
    without_systematic_errors,
)
from mapfusion.smoother.normal_equations import (
    Estimate,
    disturbances,
    initial_landmarks,
    odometry_information,
    squared_distances,
)
from mapfusion.smoother.optimizer import Problem, optimize
from mapfusion.smoother.problem import OrderedObservations, order_observations
from mapfusion.smoother.robust_loss import fit_dof, student_deviance
from mapfusion.smoother.smooth import SmootherParameters

# r: half the track of a small robot (0.13 m of an iRobot Create, 0.2 m of a P3-AT).
HALF_TRACK_M = 0.15


@dataclass(frozen=True)
class OdometryError:
    """Constant odometry errors of a robot.

    Attributes:
        distance: relative error of distances.
        turn: relative error of the turns.
        late_turn: share of the previous turn that is made in this frame.
        bias_rad_per_m: turn per distance that is not measured, due to wheels of unequal size.
        in_place: relative error of turns in place, beside `turn`.
    """

    distance: float = 0.0
    turn: float = 0.0
    late_turn: float = 0.0
    bias_rad_per_m: float = 0.0
    in_place: float = 0.0

    @classmethod
    def of(cls, constants: Float) -> "OdometryError":
        """Return the errors from a parameter vector (5,) in the order of the attributes."""
        require_shape("constants", constants, (N_CONSTANTS,))
        require_finite("constants", constants)
        return cls(*map(float, constants))

    @property
    def constants(self) -> Float:
        """Parameter vector (5,) in the order of the attributes."""
        return np.array(astuple(self))

    def corrected(self, odometry: Float) -> Float:
        """Return the increments (T, 3) without these errors."""
        moved = odometry + np.einsum("kdc,c->kd", increment_jacobians(odometry), self.constants)
        moved[:, 2] = wrap(moved[:, 2])
        return moved


N_CONSTANTS = len(fields(OdometryError))


def increment_jacobians(odometry: Float) -> Float:
    """Return the Jacobians (T, 3, 5) of the corrected increments (T, 3) by the error parameters.

    The columns have the order of the attributes of `OdometryError`.
    """
    jacobian = np.zeros((len(odometry), 3, N_CONSTANTS))
    distance, turn = np.hypot(odometry[:, 0], odometry[:, 1]), odometry[:, 2]
    jacobian[:, :2, 0] = odometry[:, :2]
    jacobian[:, 2, 1] = turn
    jacobian[1:, 2, 2] = turn[:-1]
    jacobian[:, 2, 3] = distance
    # s |theta| = max(0, |theta| - distance / r)
    jacobian[:, 2, 4] = np.sign(turn) * np.maximum(0.0, np.abs(turn) - distance / HALF_TRACK_M)
    return jacobian


# Prior standard deviations of the constants. They matter only for constants without information,
# such as those of turns for a robot that never turns. Wheels are measured to 1 %; without this
# prior, constant range errors would look like errors of distances.
_PRIOR = np.array([0.01, 0.5, 0.5, 0.3, 0.5])
# A robot that spins without observations may have made one more or one less turn, and each has a
# local maximum of the likelihood in `in_place`. A path is computed from each of these values, with
# this prior standard deviation; the most likely one is used.
_IN_PLACE_STARTS, _IN_PLACE_SIGMA = (0.0, 0.4, -0.4), 0.2
# Initial noise, larger than that of most wheels.
_FIRST = MotionNoise(0.05, 0.1, 0.3, 0, 0, lateral_slip_m_per_rad=0)
_CLOSE = 1e-5  # tolerance of the smoother in a round, in squared sigmas a coordinate
# Rounds for each part of a log while the initial path is extended.
_PART_ROUNDS = 3
_MOST_ROUNDS = 40
# Rounds end if constants change by less than this many standard errors, and noise parameters by
# less than this share.
_SETTLED = 0.1
# Number of frames with observations in the first part of a log, and the growth of further parts.
_FIRST_FRAMES, _GROWTH = 30, 1.4


@dataclass(frozen=True)
class RobotCalibration:
    """Calibrated odometry of a robot.

    Attributes:
        robot: name of the robot.
        error: constant errors.
        standard_errors: standard errors of the constants, shape (5,).
        path: path smoothed with these constants, shape (T, 3).
    """

    robot: str
    error: OdometryError
    standard_errors: Float
    path: Float


@dataclass(frozen=True)
class Calibration:
    """Result of the calibration.

    Attributes:
        robots: robots in the order of the logs.
        motion: noise of the corrected odometry of all robots.
        relative_errors: relative standard errors of the noise in the order of
            `NOISE_PARAMETERS`, shape (3,).
        n_rounds: number of rounds.
        converged: true if the rounds converged.
    """

    robots: tuple[RobotCalibration, ...]
    motion: MotionNoise
    relative_errors: Float
    n_rounds: int
    converged: bool


@dataclass
class _Robot:
    """State of a log during the calibration."""

    log: RobotLog
    obs: OrderedObservations
    offset_prior: float
    path: Float
    constants: Float
    covariance: Float
    prior_mean: Float  # (5,) prior mean of the constants
    prior_sigma: Float  # (5,) prior standard deviations of the constants
    deviance: float = np.inf  # twice the negative log likelihood at the start of the last round

    @classmethod
    def of(
        cls, log: RobotLog, obs: OrderedObservations, offset_prior: float, path: Float
    ) -> "_Robot":
        """Return the initial state with the prior of any odometry."""
        nothing = np.zeros(N_CONSTANTS)
        covariance = np.diag(_PRIOR**2)
        return cls(log, obs, offset_prior, path, nothing, covariance, nothing, _PRIOR)

    def round(self, motion: MotionNoise) -> tuple[NoiseStatistics, float]:
        """Smooth and step the constants; return noise statistics and the step in sigmas."""
        odometry = OdometryError.of(self.constants).corrected(self.log.odometry)
        information = odometry_information(odometry, motion)
        problem = Problem(self.obs, odometry, information, self.offset_prior)
        points = initial_landmarks(self.obs, self.path)
        start = Estimate(self.path, points, np.zeros((len(self.obs.has_offset), 3)))
        state = optimize(problem, start, _CLOSE)
        self.path = state.estimate.path
        # deviance of odometry and observations with fitted tails
        squares, n = squared_distances(self.obs, state.estimate), self.obs.n_dimensions
        self.deviance = student_deviance(squares, fit_dof(squares, n), n)
        d = disturbances(self.path, odometry)
        self.deviance += float(np.sum(information * d**2))
        by_constants = increment_jacobians(self.log.odometry)[1:]
        posterior = motion_posterior(state, odometry, information, by_constants)
        constants_information = posterior.constants_information + np.diag(self.prior_sigma**-2)
        self.covariance = np.asarray(np.linalg.inv(constants_information), np.float64)
        prior_gradient = (self.prior_mean - self.constants) / self.prior_sigma**2
        step = self.covariance @ (posterior.constants_gradient + prior_gradient)
        self.constants = self.constants + step
        return noise_statistics(posterior, odometry, information, motion), float(
            np.sqrt(step @ constants_information @ step)
        )


def calibrate(
    logs: Sequence[RobotLog],
    landmarks: Sequence[np.ndarray],
    paths: Sequence[Float | None],
    parameters: SmootherParameters,
    on_round: Callable[[int, int], None] = lambda done, most: None,
) -> Calibration:
    """Estimate the constants and noise parameters of maximum likelihood.

    Args:
        logs: a log of each robot; the noise parameters are common to all.
        landmarks: landmark of each observation of each log, shape (N,); negative for none.
        paths: initial path of each log, shape (T, 3). None: computed by smoothing increasing parts
            of the log, which needs landmarks without wrong associations.
        parameters: parameters of the smoother; the odometry noise is not used.
        on_round: called with the number of rounds and their largest number.

    Raises:
        InputError: a log has too little motion or too few observations.
        ValueError: an array has a wrong shape.
    """
    motion = without_systematic_errors(_FIRST)
    robots = [
        _initial_state(log, landmark, path, parameters, motion)
        for log, landmark, path in zip(logs, landmarks, paths, strict=True)
    ]
    n_rounds = 0
    while True:
        n_rounds += 1
        rounds = [robot.round(motion) for robot in robots]
        statistics = sum_statistics([statistics_of_robot for statistics_of_robot, _ in rounds])
        previous_motion, motion = motion, update_noise(motion, statistics)
        changes = (
            abs(getattr(motion, name) / getattr(previous_motion, name) - 1)
            for name in NOISE_PARAMETERS
        )
        largest_step = max(0.0, *(step for _, step in rounds), *changes)
        on_round(n_rounds, _MOST_ROUNDS)
        if largest_step < _SETTLED or n_rounds == _MOST_ROUNDS:
            break
    calibrated = tuple(
        RobotCalibration(
            robot.log.robot,
            OdometryError.of(robot.constants),
            np.sqrt(np.diag(robot.covariance)),
            robot.path,
        )
        for robot in robots
    )
    return Calibration(
        calibrated, motion, relative_errors(statistics), n_rounds, largest_step < _SETTLED
    )


def _initial_state(
    log: RobotLog,
    landmark: np.ndarray,
    path: Float | None,
    parameters: SmootherParameters,
    motion: MotionNoise,
) -> _Robot:
    require_shape("landmark", landmark, (len(log.observations),))
    with_offsets = parameters.offset_prior
    if path is not None:
        require_shape("path", path, (len(log), 3))
        obs = order_observations(log, landmark, parameters.min_count, with_offsets=with_offsets > 0)
        return _checked(_Robot.of(log, obs, with_offsets, path))
    candidates = [
        _smooth_increasing_parts(log, landmark, parameters, motion, in_place)
        for in_place in _IN_PLACE_STARTS
    ]
    best = min(candidates, key=lambda robot: robot.deviance)
    best.prior_mean, best.prior_sigma = np.zeros(N_CONSTANTS), _PRIOR
    return best


def _smooth_increasing_parts(
    log: RobotLog,
    landmark: np.ndarray,
    parameters: SmootherParameters,
    motion: MotionNoise,
    in_place: float,
) -> _Robot:
    """Return the state after smoothing increasing parts of the log."""
    observed, with_offsets = np.unique(log.iteration), parameters.offset_prior
    state = _Robot.of(
        log, order_observations(log, landmark, 1, with_offsets=False), with_offsets, IDENTITY[None]
    )
    state.prior_mean = OdometryError(in_place=in_place).constants
    state.prior_sigma = OdometryError(*_PRIOR[:-1], in_place=_IN_PLACE_SIGMA).constants
    state.constants = state.prior_mean
    n_observed_frames = _FIRST_FRAMES
    while True:
        is_whole_log = n_observed_frames >= len(observed)
        n_frames = len(log) if is_whole_log else int(observed[n_observed_frames]) + 1
        part = log if is_whole_log else first_frames(log, n_frames)
        min_count = parameters.min_count if is_whole_log else 1
        state.log, state.obs = (
            part,
            order_observations(
                part, landmark[: len(part.observations)], min_count, with_offsets=with_offsets > 0
            ),
        )
        odometry = OdometryError.of(state.constants).corrected(part.odometry)
        path = np.concatenate([state.path, np.empty((len(odometry) - len(state.path), 3))])
        for k in range(len(state.path), len(odometry)):
            path[k] = compose(path[k - 1], odometry[k])
        state.path = path
        for _ in range(_PART_ROUNDS):
            _checked(state).round(motion)
        if is_whole_log:
            return state
        n_observed_frames = int(n_observed_frames * _GROWTH)


def _checked(robot: _Robot) -> _Robot:
    if not len(robot.obs):
        raise InputError(
            f"log {robot.log.robot}: no landmark was observed often enough to compute the motion"
        )
    return robot
