"""The most probable path and landmarks of a whole log: Gauss-Newton on the poses."""

from dataclasses import dataclass, field
from typing import Annotated, NamedTuple

import numpy as np
import scipy.linalg

from mapfusion.arguments import Range, require_in_range, require_shape
from mapfusion.fastslam.motion import MotionNoise
from mapfusion.robot_log import RobotLog
from mapfusion.se2 import Float, between, wrap
from mapfusion.smoother.elimination import (
    Eliminated,
    eliminate,
    first_points,
    landmark_steps,
    squared_distances,
)
from mapfusion.smoother.odometry import add_odometry, disturbances, odometry_information
from mapfusion.smoother.sightings import Sightings, sightings_of
from mapfusion.smoother.student import MOST_DOF, fitted_dof, student_cost, student_weights

# The next step would lower the cost, in squared sigmas, by no more than this.
_CONVERGED = 1e-4
_MOST_STEPS = 50
_MOST_HALVINGS = 12


@dataclass(frozen=True)
class SmootherParameters:
    """Settings of the smoother.

    Attributes:
        motion: noise of the odometry.
        min_count: observations that a landmark needs.
    """

    motion: MotionNoise = field(default_factory=MotionNoise)
    min_count: Annotated[int, Range(2, 1000, "observations")] = 3

    def __post_init__(self) -> None:
        require_in_range(self)


class Estimate(NamedTuple):
    """Path (T, 3) and landmarks (L, 3), in the frame of the first pose."""

    path: Float
    point_m: Float


@dataclass(frozen=True)
class Smoothed:
    """What a log says, all at once.

    Attributes:
        estimate: path and landmarks.
        seen: the observations that went into them.
        factor: (3T - 3, 3T - 3) lower Cholesky factor of the poses' information; the first pose is
            the frame, and known.
        eliminated: the landmarks' part of the normal equations.
        weight: (N,) of each observation.
        dof: degrees of freedom of the observations' Student-t.
        n_steps: Gauss-Newton steps that were taken.
    """

    estimate: Estimate
    seen: Sightings
    factor: Float
    eliminated: Eliminated
    weight: Float
    dof: float
    n_steps: int


def smooth(
    log: RobotLog, landmark: np.ndarray, path: Float, parameters: SmootherParameters
) -> Smoothed:
    """The most probable path and landmarks.

    Args:
        log: what the robot measured.
        landmark: (N,) which landmark each observation is of, negative for none.
        path: (T, 3) where to start from; its first pose is the map's frame.
        parameters: settings.

    Raises:
        ValueError: shapes that do not fit.
    """
    require_shape("path", path, (len(log), 3))
    seen = sightings_of(log, landmark, parameters.min_count)
    information = odometry_information(log.odometry, parameters.motion)
    path = between(path[0], path)
    at = Estimate(path, first_points(seen, path))
    weight, dof = np.ones(len(seen)), MOST_DOF
    for n_steps in range(_MOST_STEPS + 1):
        S, g = np.zeros((3 * len(path), 3 * len(path))), np.zeros(3 * len(path))
        add_odometry(at.path, log.odometry, information, S, g)
        eliminated = eliminate(seen, *at, weight, S, g)
        factor = scipy.linalg.cholesky(S[3:, 3:], lower=True, check_finite=False)
        way = np.zeros(len(g))
        way[3:] = -scipy.linalg.cho_solve((factor, True), g[3:], check_finite=False)
        step = Estimate(way.reshape(-1, 3), landmark_steps(seen, eliminated, way))
        if n_steps == _MOST_STEPS or -float(way @ g) < _CONVERGED:
            break
        at = _stepped(seen, log.odometry, information, dof, at, step)
        squares = squared_distances(seen, *at, eliminated.covariance_m2)
        dof = fitted_dof(squares, seen.n_dimensions)
        weight = student_weights(squares, dof, seen.n_dimensions)
    return Smoothed(at, seen, factor, eliminated, weight, dof, n_steps)


def _stepped(
    seen: Sightings,
    odometry: Float,
    information: Float,
    dof: float,
    at: Estimate,
    step: Estimate,
) -> Estimate:
    """The step, or as much of it as lowers the cost: half, a quarter, ..."""

    def cost(of: Estimate) -> float:
        squares = squared_distances(seen, *of)
        walked = float(np.sum(information * disturbances(of.path, odometry) ** 2))
        return walked + student_cost(squares, dof, seen.n_dimensions)

    before, share = cost(at), 1.0
    for _ in range(_MOST_HALVINGS):
        path = at.path + share * step.path
        path[:, 2] = wrap(path[:, 2])
        further = Estimate(path, at.point_m + share * step.point_m)
        if cost(further) <= before:
            return further
        share /= 2
    return at
