"""Odometry calibration from logs: systematic errors of each robot, noise levels of all.

An increment (x, y, theta) of the log stands for the motion

    ((1 + distance) x, (1 + distance) y,
     (1 + turn + in_place s) theta + late_turn theta_before + bias |(x, y)|)

with the heading increment before it, theta_before: a late_turn beside a turn of its negative is a
delay of the odometry. In place a robot turns by another share of what is counted than while it
drives: wheels that run against each other slip otherwise, and motors that are near their limit
cannot add a turn to a motion. s is the share of a turn that is made in place,

    s = max(0, 1 - |(x, y)| / (r |theta|)),

1 of a turn on the spot, 0 of one with a radius of r and more, with which no wheel runs backwards.
All is linear in the constants, so their estimate is a least squares.

By turns the logs are smoothed, the constants take a Gauss-Newton step on the likelihood that the
poses and landmarks have been integrated out of, and the noise levels a step of `noise_levels`. What
robots saw again tells their odometry's errors; no truth is needed.
"""

from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass, fields, replace

import numpy as np

from mapfusion.errors import InputError
from mapfusion.fastslam.motion import MotionNoise
from mapfusion.geometry.numerics import Float
from mapfusion.geometry.se2 import IDENTITY, compose, wrap
from mapfusion.parameters import require_finite, require_shape
from mapfusion.robot_log import RobotLog, first_frames
from mapfusion.smoother.noise_estimation import (
    LEVELS,
    Told,
    motion_posterior,
    plain,
    pooled,
    relative_errors,
    told,
    updated,
)
from mapfusion.smoother.normal_equations import (
    Estimate,
    disturbances,
    first_points,
    odometry_information,
    squared_distances,
)
from mapfusion.smoother.optimizer import Problem, Settled, settled
from mapfusion.smoother.problem import Sightings, sightings_of
from mapfusion.smoother.robust_loss import fitted_dof, student_deviance
from mapfusion.smoother.smooth import SmootherParameters

# r: half the track of a small robot (0.13 m of an iRobot Create, 0.2 m of a P3-AT).
HALF_TRACK_M = 0.15


@dataclass(frozen=True)
class OdometryError:
    """The constants of one robot.

    Attributes:
        distance: relative error of distances.
        turn: relative error of the turns.
        late_turn: share of the turn before that is only made now.
        bias_rad_per_m: turn with the way that wheels of unequal size do not count.
        in_place: relative error of turns in place, beside `turn`.
    """

    distance: float = 0.0
    turn: float = 0.0
    late_turn: float = 0.0
    bias_rad_per_m: float = 0.0
    in_place: float = 0.0

    @classmethod
    def of(cls, constants: Float) -> "OdometryError":
        """From an array (5,) in the order of the attributes."""
        require_shape("constants", constants, (N_CONSTANTS,))
        require_finite("constants", constants)
        return cls(*map(float, constants))

    @property
    def constants(self) -> Float:
        """(5,) in the order of the attributes."""
        return np.array(astuple(self))

    def corrected(self, odometry: Float) -> Float:
        """The increments (T, 3) without these errors."""
        moved = odometry + np.einsum("kdc,c->kd", sensitivity(odometry), self.constants)
        moved[:, 2] = wrap(moved[:, 2])
        return moved

    def corrected_log(self, log: RobotLog) -> RobotLog:
        """The log with its increments corrected."""
        return replace(log, odometry=self.corrected(log.odometry))


N_CONSTANTS = len(fields(OdometryError))


def sensitivity(odometry: Float) -> Float:
    """(T, 3, 5) by how much each constant changes the increments (T, 3)."""
    by = np.zeros((len(odometry), 3, N_CONSTANTS))
    way, turn = np.hypot(odometry[:, 0], odometry[:, 1]), odometry[:, 2]
    by[:, :2, 0] = odometry[:, :2]
    by[:, 2, 1] = turn
    by[1:, 2, 2] = turn[:-1]
    by[:, 2, 3] = way
    # s |theta| = max(0, |theta| - way / r)
    by[:, 2, 4] = np.sign(turn) * np.maximum(0.0, np.abs(turn) - way / HALF_TRACK_M)
    return by


# What is known of any odometry before: standard deviations of its constants. They hold those that
# a log says nothing about, as of a robot that never turns, and weigh nothing beside one that does.
# Wheels are measured to a hundredth; ranges with lasting errors would claim more than that.
_PRIOR = np.array([0.01, 0.5, 0.5, 0.3, 0.5])
# A robot that spins while it sees nothing may have made a turn more or less than it is taken to
# have made, and what in_place goes with that is a maximum of the likelihood of its own. So a path
# is looked for from each of these, and within this deviation of it; the likeliest goes on.
_IN_PLACE_STARTS, _IN_PLACE_SIGMA = (0.0, 0.4, -0.4), 0.2
# Where smoothing starts: noise that most wheels stay below.
_FIRST = MotionNoise(0.05, 0.1, 0.3, 0, 0, lateral_slip_m_per_rad=0)
_CLOSE = 1e-5  # squared sigmas a coordinate that the next step of a round would move the path by
# Rounds for each part of a log on the way to a first path: constants are soon well enough known.
_PART_ROUNDS = 3
_MOST_ROUNDS = 40
# Rounds end where none changes a constant by more than this many of its standard errors, or a
# level by more than this share of it.
_SETTLED = 0.1
# A path is found first for so many frames with observations, then for so many times as many.
_FIRST_FRAMES, _GROWTH = 30, 1.4


@dataclass(frozen=True)
class RobotCalibration:
    """One robot's odometry.

    Attributes:
        robot: its name.
        error: its constant errors.
        standard_errors: (5,) theirs.
        path: (T, 3) smoothed with them.
    """

    robot: str
    error: OdometryError
    standard_errors: Float
    path: Float


@dataclass(frozen=True)
class Calibration:
    """What logs tell of their odometry.

    Attributes:
        robots: in the order of the logs.
        motion: noise of the corrected odometry, one for all robots.
        relative_errors: (3,) of its levels in the order of `LEVELS`, standard errors
            as shares of them.
        n_rounds: that it took.
        settled: whether rounds ended as nothing changed any more; else there were too many.
    """

    robots: tuple[RobotCalibration, ...]
    motion: MotionNoise
    relative_errors: Float
    n_rounds: int
    settled: bool


@dataclass
class _Robot:
    """A log as it is being calibrated."""

    log: RobotLog
    seen: Sightings
    stray_information: float
    path: Float
    constants: Float
    covariance: Float
    likeliest: Float  # (5,) constants before anything is seen
    prior: Float  # (5,) standard deviations of these
    deviance: float = np.inf  # twice the negative log likelihood that the last round began with

    @classmethod
    def of(cls, log: RobotLog, seen: Sightings, stray_information: float, path: Float) -> "_Robot":
        """With nothing known of the odometry but what is known of any."""
        nothing = np.zeros(N_CONSTANTS)
        covariance = np.diag(_PRIOR**2)
        return cls(log, seen, stray_information, path, nothing, covariance, nothing, _PRIOR)

    def round(self, motion: MotionNoise) -> tuple[Told, float]:
        """Smooth, step the constants: what is told of the noise, and the step in sigmas."""
        odometry = OdometryError.of(self.constants).corrected(self.log.odometry)
        information = odometry_information(odometry, motion)
        problem = Problem(self.seen, odometry, information, self.stray_information)
        points = first_points(self.seen, self.path)
        start = Estimate(self.path, points, np.zeros((len(self.seen.strays), 3)))
        end = settled(problem, start, _CLOSE)
        self.path, self.deviance = end.estimate.path, _deviance(problem, end)
        by_constants = sensitivity(self.log.odometry)[1:]
        posterior = motion_posterior(end, odometry, information, by_constants)
        known = posterior.constants_information + np.diag(self.prior**-2)
        self.covariance = np.asarray(np.linalg.inv(known), np.float64)
        expected = (self.likeliest - self.constants) / self.prior**2
        step = self.covariance @ (posterior.constants_gradient + expected)
        self.constants = self.constants + step
        return told(posterior, odometry, information, motion), float(np.sqrt(step @ known @ step))


def calibrate(
    logs: Sequence[RobotLog],
    landmarks: Sequence[np.ndarray],
    paths: Sequence[Float | None],
    parameters: SmootherParameters,
    on_round: Callable[[int, int], None] = lambda done, most: None,
) -> Calibration:
    """The most likely constants and noise levels.

    Args:
        logs: of one robot each; the noise levels are common to all.
        landmarks: of each, (N,) which landmark each observation is of, negative for none.
        paths: of each, (T, 3) where to start from; None: found from the log, by smoothing more and
            more of it, which needs landmarks that are known for sure.
        parameters: of the smoother; what they say of the odometry is not used.
        on_round: told the rounds done, and how many there are at most.

    Raises:
        InputError: a log has too little motion or too few observations to tell.
        ValueError: shapes that do not fit.
    """
    motion = plain(_FIRST)
    robots = [
        _begun(log, landmark, path, parameters, motion)
        for log, landmark, path in zip(logs, landmarks, paths, strict=True)
    ]
    n_rounds = 0
    while True:
        n_rounds += 1
        rounds = [robot.round(motion) for robot in robots]
        all_told = pooled([each for each, _ in rounds])
        before, motion = motion, updated(motion, all_told)
        moved = max(0.0, *(step for _, step in rounds), _change(before, motion))
        on_round(n_rounds, _MOST_ROUNDS)
        if moved < _SETTLED or n_rounds == _MOST_ROUNDS:
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
    return Calibration(calibrated, motion, relative_errors(all_told), n_rounds, moved < _SETTLED)


def _change(before: MotionNoise, after: MotionNoise) -> float:
    """The largest relative change of a level."""
    return max(abs(getattr(after, name) / getattr(before, name) - 1) for name in LEVELS)


def _deviance(problem: Problem, end: Settled) -> float:
    """Of what was smoothed: of the odometry, and of the observations with the tails they have."""
    walked = disturbances(end.estimate.path, problem.odometry)
    squares, n = squared_distances(problem.seen, end.estimate), problem.seen.n_dimensions
    seen = student_deviance(squares, fitted_dof(squares, n), n)
    return seen + float(np.sum(problem.information * walked**2))


def _begun(
    log: RobotLog,
    landmark: np.ndarray,
    path: Float | None,
    parameters: SmootherParameters,
    motion: MotionNoise,
) -> _Robot:
    require_shape("landmark", landmark, (len(log.observations),))
    stray = parameters.stray_information
    if path is not None:
        require_shape("path", path, (len(log), 3))
        seen = sightings_of(log, landmark, parameters.min_count, stray=stray > 0)
        return _checked(_Robot.of(log, seen, stray, path))
    found = [_grown(log, landmark, parameters, motion, in_place) for in_place in _IN_PLACE_STARTS]
    likeliest = min(found, key=lambda robot: robot.deviance)
    likeliest.likeliest, likeliest.prior = np.zeros(N_CONSTANTS), _PRIOR
    return likeliest


def _grown(
    log: RobotLog,
    landmark: np.ndarray,
    parameters: SmootherParameters,
    motion: MotionNoise,
    in_place: float,
) -> _Robot:
    """With a path that was found by smoothing more and more of the log."""
    observed, stray = np.unique(log.iteration), parameters.stray_information
    grown = _Robot.of(log, sightings_of(log, landmark, 1, stray=False), stray, IDENTITY[None])
    grown.likeliest = OdometryError(in_place=in_place).constants
    grown.prior = OdometryError(*_PRIOR[:-1], in_place=_IN_PLACE_SIGMA).constants
    grown.constants = grown.likeliest
    n_seen = _FIRST_FRAMES
    while True:
        whole = n_seen >= len(observed)
        n_frames = len(log) if whole else int(observed[n_seen]) + 1
        part = log if whole else first_frames(log, n_frames)
        least = parameters.min_count if whole else 1
        grown.log, grown.seen = (
            part,
            sightings_of(part, landmark[: len(part.observations)], least, stray=stray > 0),
        )
        odometry = OdometryError.of(grown.constants).corrected(part.odometry)
        grown.path = _extended(grown.path, odometry)
        for _ in range(_PART_ROUNDS):
            _checked(grown).round(motion)
        if whole:
            return grown
        n_seen = int(n_seen * _GROWTH)


def _extended(path: Float, odometry: Float) -> Float:
    """A path, and how the odometry (T, 3) goes on from its end."""
    made = np.concatenate([path, np.empty((len(odometry) - len(path), 3))])
    for k in range(len(path), len(odometry)):
        made[k] = compose(made[k - 1], odometry[k])
    return made


def _checked(robot: _Robot) -> _Robot:
    if not len(robot.seen):
        raise InputError(
            f"log {robot.log.robot}: no landmark was seen often enough to tell how the robot moved"
        )
    return robot
