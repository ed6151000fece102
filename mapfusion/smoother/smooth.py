"""The most probable path and landmarks of a whole log: Gauss-Newton on the poses."""

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from mapfusion.arguments import Range, require_in_range, require_shape
from mapfusion.fastslam.motion import MotionNoise
from mapfusion.robot_log import RobotLog
from mapfusion.se2 import Float, between, wrap
from mapfusion.smoother.elimination import common_part, solve
from mapfusion.smoother.errors_of_views import OwnErrors, SharedErrors
from mapfusion.smoother.normal_equations import (
    Estimate,
    add_odometry,
    disturbances,
    no_equations,
    odometry_information,
)
from mapfusion.smoother.residuals import first_points
from mapfusion.smoother.sightings import Sightings, sightings_of
from mapfusion.smoother.tracks import Stray

# The next step would lower the cost, in squared sigmas, by no more than this.
_CONVERGED = 1e-4
_MOST_STEPS = 50
_MOST_HALVINGS = 12


@dataclass(frozen=True)
class SmootherParameters:
    """Settings of the smoother.

    Attributes:
        motion: noise of the odometry.
        stray: how far corners stray from their landmarks along a track.
        min_count: observations that a landmark needs.
    """

    motion: MotionNoise = field(default_factory=MotionNoise)
    stray: Stray = field(default_factory=Stray)
    min_count: Annotated[int, Range(2, 1000, "observations")] = 3

    def __post_init__(self) -> None:
        require_in_range(self)


@dataclass(frozen=True)
class Smoothed:
    """What a log says, all at once.

    Attributes:
        estimate: path and landmarks.
        seen: the observations that went into them.
        weight: (N,) of each observation.
        dof: degrees of freedom of the observations' Student-t.
        n_steps: Gauss-Newton steps that were taken.
        own_m2: (L, 3, 3), see `common`.
        common: (R, 3L) the landmarks' joint covariance is block diagonal of `own_m2` plus
            common' common.
    """

    estimate: Estimate
    seen: Sightings
    weight: Float
    dof: float
    n_steps: int
    own_m2: Float
    common: Float

    def joint_covariance(self) -> Float:
        """(3L, 3L), dense: for small maps."""
        joint, n = self.common.T @ self.common, len(self.own_m2)
        each = np.arange(n)
        joint.reshape(n, 3, n, 3)[each, :, each, :] += self.own_m2
        return joint


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
    stray = parameters.stray
    errors = SharedErrors(seen, stray, at) if stray.sigma_m > 0 else OwnErrors(seen)
    n_steps = 0
    while True:
        equations = errors.add(at, no_equations(seen, at))
        add_odometry(at.path, log.odometry, information, equations)
        solution = solve(seen, equations)
        if n_steps == _MOST_STEPS or solution.decrease < _CONVERGED:
            common = common_part(seen, equations, solution)
            own_m2 = solution.own_m2
            return Smoothed(at, seen, errors.weight, errors.dof, n_steps, own_m2, common)
        at = _stepped(errors, log.odometry, information, at, solution.step)
        errors.weigh(at, solution.own_m2)
        n_steps += 1


def _stepped(
    errors: OwnErrors | SharedErrors,
    odometry: Float,
    information: Float,
    at: Estimate,
    step: Estimate,
) -> Estimate:
    """The step, or as much of it as lowers the cost: half, a quarter, ..."""

    def cost(of: Estimate) -> float:
        return float(np.sum(information * disturbances(of.path, odometry) ** 2)) + errors.cost(of)

    before, share = cost(at), 1.0
    for _ in range(_MOST_HALVINGS):
        path = at.path + share * step.path
        path[:, 2] = wrap(path[:, 2])
        further = Estimate(path, at.point_m + share * step.point_m)
        if cost(further) <= before:
            return further
        share /= 2
    return at
