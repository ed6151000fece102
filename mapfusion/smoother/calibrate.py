"""Odometry calibrated from logs alone: constant errors of each robot, noise levels of all.

By turns the logs are smoothed, the constants take a Gauss-Newton step on the likelihood that the
poses and landmarks have been integrated out of, and the noise levels a step of `noise_levels`. What
robots saw again tells their odometry's errors; no truth is needed.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from mapfusion.arguments import require_shape
from mapfusion.errors import InputError
from mapfusion.fastslam.motion import MotionNoise
from mapfusion.log_part import first_frames
from mapfusion.robot_log import RobotLog
from mapfusion.se2 import IDENTITY, Float, compose
from mapfusion.smoother.motion_posterior import motion_posterior
from mapfusion.smoother.noise_levels import (
    LEVELS,
    Told,
    plain,
    pooled,
    relative_errors,
    told,
    updated,
)
from mapfusion.smoother.normal_equations import (
    Estimate,
    disturbances,
    odometry_information,
)
from mapfusion.smoother.odometry_error import N_CONSTANTS, OdometryError, sensitivity
from mapfusion.smoother.residuals import first_points, squared_distances
from mapfusion.smoother.settle import Problem, Settled, settled
from mapfusion.smoother.sightings import Sightings, sightings_of
from mapfusion.smoother.smooth import SmootherParameters
from mapfusion.smoother.student import fitted_dof, student_deviance

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
