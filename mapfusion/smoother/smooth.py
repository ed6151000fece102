"""The most probable path and landmarks of a whole log."""

from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np

from mapfusion.arguments import Range, require_in_range, require_shape
from mapfusion.fastslam.motion import MotionNoise
from mapfusion.joint_covariance import KnownErrors, SharedErrors, StackedErrors
from mapfusion.one_thread import one_blas_thread
from mapfusion.robot_log import RobotLog
from mapfusion.se2 import Float, between
from mapfusion.smoother.elimination import require_memory, shared_errors
from mapfusion.smoother.levels import AS_STATED, Levels, settled_with_levels
from mapfusion.smoother.normal_equations import (
    Estimate,
    Weights,
    information_of,
    information_under,
    odometry_information,
)
from mapfusion.smoother.one_corner import parted
from mapfusion.smoother.residuals import first_points
from mapfusion.smoother.robust import Tails
from mapfusion.smoother.second_order import SecondOrder, second_order_errors
from mapfusion.smoother.settle import (
    Problem,
    Settled,
    factored,
    finished,
    followed,
    settled,
)
from mapfusion.smoother.sightings import Sightings, sightings_of
from mapfusion.smoother.student import MOST_DOF
from mapfusion.stray import STRAY_M

# Factor on the observations' standard deviations in a first round (graduated non-convexity): where
# the path to start from is far off, most observations look gross and lose the weight to mend it.
# It need not end closer than this, in squared sigmas a coordinate, to where the next one goes on.
_THOUGHT_WORSE, _CLOSE = 4.0, 3e-2
# Where odometry is this many times worse than stated (level of its variances), observations that
# contradict it look gross before the level is known. They are then judged anew, under the level.
_FAR_WORSE = 4.0
# Of a motion that nothing but observations tells: what a robot does between frames is less.
_UNTOLD_M, _UNTOLD_RAD = 10.0, 1.0
_LEAST_SEEN = 3  # observations that fix a pose, with one to spare


@dataclass(frozen=True)
class SmootherParameters:
    """Settings of the smoother.

    Attributes:
        motion: noise of the odometry as stated; how much of it there is the log tells.
        stray_m: standard deviation, along each axis, of where the point that a track is of lies
            beside the landmark; 0: it is the landmark.
        min_count: observations that a landmark needs.
        odometry_covariance: (T, 3, 3) or longer, of odometry that was taken from what the log
            observes and must not count twice: it says only how to come to frames that see too
            little to tell, and from them. None, or NaN at a frame: the odometry is a source of its
            own.
    """

    motion: MotionNoise = field(default_factory=MotionNoise)
    stray_m: Annotated[float, Range(0, 10, "m")] = STRAY_M
    min_count: Annotated[int, Range(1, 1_000_000, "observations")] = 3
    odometry_covariance: Float | None = None

    def __post_init__(self) -> None:
        require_in_range(self)

    @property
    def stray_information(self) -> float:
        """Of a track's offset along each axis, in 1/m^2; 0 where there are no offsets."""
        return 1 / self.stray_m**2 if self.stray_m else 0.0

    @property
    def has_own_odometry(self) -> bool:
        """Whether any odometry is a source of its own, so that its noise can be learned."""
        known = self.odometry_covariance
        return known is None or bool(np.isnan(known).any())

    def odometry_information(self, log: RobotLog) -> Float:
        """(T - 1, 3) inverse variances of the log's increments after the first."""
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
    """What a log says, all at once.

    Attributes:
        landmark: (N,) which landmark each observation of the log is of, negative for none.
        estimate: path, landmarks and tracks' offsets.
        seen: the observations that went into them, their information on this level.
        weights: of observations and offsets.
        tails: of their Student-t's.
        observation_level: factor on the stated covariances of observations on tracks, as the log
            tells it.
        odometry_level: (3,) factors on the odometry's stated variances along, across and in the
            heading, likewise.
        n_steps: Gauss-Newton steps that were taken.
        own_m2: (L, 3, 3), see `common`.
        common: Y (R, 3L): the landmarks' joint covariance is block diagonal of `own_m2` plus Y' Y.
        second_order: errors of second order, which `common` has among its own; None where they do
            not matter.
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
        """Where steps ended under some levels, after some of earlier rounds.

        The problem's odometry is as stated.
        """
        end = factored(end)
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
        """(3L, 3L), dense: for small maps."""
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
    """The most probable path and landmarks.

    Landmarks that were seen as several corners become several (`one_corner.py`).

    Args:
        log: what the robot measured.
        landmark: (N,) which landmark each observation is of, negative for none.
        path: (T, 3) where to start from; its first pose is the map's frame.
        parameters: settings.
        max_memory_gb: smoothing is refused where it may take more.

    Raises:
        LinAlgError: the equations cannot be solved.
        MemoryError: it may take more than `max_memory_gb`.
        ValueError: shapes that do not fit.
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
            del end  # its factors take as much memory as all else
            under = information_under(information, levels.odometry)
            start, n_again = _without_gross(known._replace(information=under), path)
            n_steps += n_again
            end, levels = settled_with_levels(known, *start, levels.odometry)
    else:  # odometry that pictures told is used where these say nothing: they tell no level
        at, weights, tails = start
        end, levels = settled(known, at, weights=weights, tails=tails), AS_STATED
    return Smoothed.of(known, end, parts, levels, n_steps)


def _without_gross(problem: Problem, path: Float) -> tuple[tuple[Estimate, Weights, Tails], int]:
    """Return where a round ends in which observations are thought worse than stated; its steps."""
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
