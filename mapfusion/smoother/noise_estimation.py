"""Noise estimation: scales of odometry and observation noise that make a log most likely.

With d = D x - u and the poses' information H, landmarks eliminated, the disturbances have the
covariance D H^-1 D'. With the poses gone first, H is a chain C less a matrix of low rank, so
H^-1 = C^-1 + X K^-1 X' with X = C^-1 B and K the landmarks' information (Woodbury).

The variance of a disturbance is a sum of levels times amounts of motion: v = sum q_j a_j. With the
posterior means d and variances C of the disturbances, the stationary point is

    sum of s_j d^2 / v = sum of s_j (1 - C / v),      s_j = q_j a_j / v,

where s_j is the share of level j in v. The right side counts the disturbances that observations
determine. Each round multiplies a level by the ratio of both sides (MacKay 1992, "Bayesian
interpolation"), which converges in far fewer rounds than EM.

Stated errors of a sensor include errors that are constant along a track. Here the tracks' offsets
model the constant part, and the level is that of the rest. With squared Mahalanobis distances s of
the residuals in n coordinates and robust weights w, the level q is

    q = sum of w s / sum of (n - c),

where c is the number of an observation's coordinates that determine its track's point (MacKay 1992;
`odometry_levels.py`). Without tracks the level cannot be estimated and is 1.

Stated errors of an odometry have to hold for any floor, and on one drive they may be much smaller
or larger. Let d be the posterior means and C the posterior variances of the disturbances, and v the
stated variances. The variances are v_j q_j along axis j:

    sum of d^2 / v_j = q_j sum of (1 - C / (v_j q_j)),

where q_j is the level of maximum marginal likelihood (MacKay 1992; `noise_levels.py`).

The variances C need the inverse of the poses' information, the means d do not. So levels follow
each step with C from an earlier step. If observations determine a disturbance with information J,
the share C / v that remains unknown is

    u = 1 / (1 + J v q),    so that under other levels    1 / u - 1    is as many times as much.

A level is a factor on the stated variances. The iteration starts from the stated noise and
alternates between steps and new levels until neither changes.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import scipy.linalg
from scipy.optimize import root_scalar

from mapfusion.fastslam.motion import MotionNoise
from mapfusion.geometry.numerics import Float, kernel
from mapfusion.smoother.elimination import chain_factor, pose_point_blocks, solve_points
from mapfusion.smoother.normal_equations import (
    Estimate,
    Weights,
    disturbance_jacobians,
    disturbances,
    information_under,
    least_levels,
    squared_distances,
    squares_of_points,
)
from mapfusion.smoother.optimizer import (
    CONVERGED,
    Problem,
    Settled,
    finished,
    followed,
    solved,
    stepped,
)
from mapfusion.smoother.problem import Sightings
from mapfusion.smoother.robust_loss import NO_TAILS, Tails, fitted_dof, student_weights, unweighted


class MotionPosterior(NamedTuple):
    """Posterior of the T - 1 disturbances after the first frame.

    Attributes:
        mean: disturbances on the smoothed path, shape (T - 1, 3).
        variance: their variances, shape (T - 1, 3).
        constants_information: marginal information of constants that the increments depend on,
            shape (C, C).
        constants_gradient: gradient of their log likelihood, shape (C,).
    """

    mean: Float
    variance: Float
    constants_information: Float
    constants_gradient: Float


def motion_posterior(
    end: Settled, odometry: Float, information: Float, by_constants: Float
) -> MotionPosterior:
    """Return the posterior of the disturbances and of constants.

    Args:
        end: the smoothed state.
        odometry: increments that were smoothed, shape (T, 3).
        information: information of the increments after the first, shape (T - 1, 3).
        by_constants: derivatives of these increments by the constants, shape (T - 1, 3, C).
    """
    path, n = end.estimate.path, len(odometry) - 1
    factor, spread = _covariance_factors(end)
    before, after = disturbance_jacobians(path)
    variance = _of_differences(before, after, *_chain_covariances(factor, n))
    variance += np.sum(_difference(before, after, spread) ** 2, axis=2)

    weighted = information[:, :, None] * by_constants
    pulled = _transposed_difference(before, after, weighted)
    solved = scipy.linalg.cho_solve_banded((factor, True), pulled, check_finite=False)
    shared = spread.T @ pulled
    of_constants = np.einsum("kdc,kde->ce", by_constants, weighted)
    of_constants -= pulled.T @ solved + shared.T @ shared
    mean = disturbances(path, odometry)
    return MotionPosterior(mean, variance, of_constants, np.einsum("kdc,kd->c", weighted, mean))


def _covariance_factors(end: Settled) -> tuple[Float, Float]:
    """Return the factor of C, and columns whose products are X K^-1 X'."""
    factor = chain_factor(end.equations)
    B, K, _ = pose_point_blocks(end.seen, end.equations)
    X = scipy.linalg.cho_solve_banded((factor, True), B, check_finite=False)
    root = scipy.linalg.cholesky(K - B.T @ X, lower=True, check_finite=False)
    return factor, scipy.linalg.solve_triangular(root, X.T, lower=True, check_finite=False).T


def disturbance_variances(end: Settled) -> Float:
    """Return the variances of the disturbances, shape (T - 1, 3)."""
    before, after = disturbance_jacobians(end.estimate.path)
    if end.solution.landmarks_first:
        return _from_poses(end, before, after)
    factor, spread = _covariance_factors(end)
    variance = _of_differences(before, after, *_chain_covariances(factor, len(after)))
    return variance + np.sum(_difference(before, after, spread) ** 2, axis=2)


def _from_poses(end: Settled, before: Float, after: Float) -> Float:
    """Return the variances from the inverse of the poses' information."""
    factor = end.solution.factor
    Z, between = factor.inverse, factor.envelope.between
    place = end.seen.pose_place[1:] - 1
    own, link = between(Z, place, place), between(Z, place[:-1], place[1:])
    return _of_differences(before, after, own, link)


def _difference(before: Float, after: Float, of_poses: Float) -> Float:
    """Return D times columns (3 (T - 1), R) of the unknown poses, shape (T - 1, 3, R)."""
    blocks = of_poses.reshape(len(after), 3, -1)
    made = after @ blocks
    made[1:] += before[1:] @ blocks[:-1]
    return made


def _transposed_difference(before: Float, after: Float, of_increments: Float) -> Float:
    """Return D' times columns (T - 1, 3, C), shape (3 (T - 1), C)."""
    made = np.swapaxes(after, 1, 2) @ of_increments
    made[:-1] += np.swapaxes(before[1:], 1, 2) @ of_increments[1:]
    return made.reshape(-1, of_increments.shape[2])


def _of_differences(before: Float, after: Float, own: Float, link: Float) -> Float:
    """Return the variances (T - 1, 3) of D x from the covariances of poses and successive pairs."""
    made = np.einsum("kij,kjl,kil->ki", after, own, after)
    made[1:] += np.einsum("kij,kjl,kil->ki", before[1:], own[:-1], before[1:])
    made[1:] += 2 * np.einsum("kij,kjl,kil->ki", before[1:], link, after[1:])
    return made


def _chain_covariances(factor: Float, n: int) -> tuple[Float, Float]:
    """Return the covariances (n, 3, 3) of a chain and (n - 1, 3, 3) of successive poses."""
    diagonal, below = np.zeros((n, 3, 3)), np.zeros((max(n - 1, 0), 3, 3))
    for r in range(3):
        for q in range(3):
            if r >= q:
                diagonal[:, r, q] = factor[r - q, q::3]
            below[:, r, q] = factor[3 + r - q, q : 3 * (n - 1) : 3]
    own, link = np.empty((n, 3, 3)), np.empty((max(n - 1, 0), 3, 3))
    _selected_inverse(diagonal, below, own, link)
    return own, link


@kernel
def _selected_inverse(diagonal: Float, below: Float, own: Float, link: Float) -> None:
    """Write the blocks of the inverse on and beside the diagonal (Takahashi et al. 1973)."""
    for k in range(len(diagonal) - 1, -1, -1):
        inverse = np.linalg.inv(diagonal[k])
        own[k] = inverse.T @ inverse
        if k < len(below):
            G = below[k] @ inverse
            link[k] = -G.T @ own[k + 1]
            own[k] += G.T @ own[k + 1] @ G


LEVELS = ("translation_m_per_sqrt_m", "rotation_rad_per_sqrt_m", "rotation_rad_per_sqrt_rad")
# Largest factor on a level's square in one round; the counts are inaccurate far from the solution.
_MOST_CHANGE = 4.0
# Smaller levels have no effect in the filter, and their shares cannot be estimated.
_LEAST_LEVEL = 1e-4
# Number of determined disturbances that a level needs; with fewer its relative error exceeds 0.3.
LEAST_DISTURBANCES = 5.0


class Told(NamedTuple):
    """Statistics of a smoothed log for the levels, in the order of `LEVELS`.

    Attributes:
        found: left sides, squares in sigmas, shape (3,).
        known: right sides, numbers of determined disturbances, shape (3,).
        information: information of the levels' logarithms, shape (3, 3): the sum of 2 k^2 s_i s_j
            over the disturbances, with k = 1 - C / v.
    """

    found: Float
    known: Float
    information: Float


def pooled(of_each: Sequence[Told]) -> Told:
    """Add the statistics of several logs."""
    return Told(*(np.sum(np.stack(values), axis=0) for values in zip(*of_each, strict=True)))


def plain(motion: MotionNoise) -> MotionNoise:
    """Return the noise without systematic errors, with equal levels along and across."""
    across = motion.translation_m_per_sqrt_m
    return replace(
        motion,
        scale_error=0,
        track_error=0,
        lateral_m_per_sqrt_m=across,
        lateral_slip_m_per_rad=0,
    )


def told(
    posterior: MotionPosterior, odometry: Float, information: Float, motion: MotionNoise
) -> Told:
    """Return the statistics of a log's disturbances.

    Args:
        posterior: posterior of the disturbances.
        odometry: increments, shape (T, 3).
        information: information that they were smoothed with, shape (T - 1, 3).
        motion: the levels of this information.
    """
    distance, angle = np.hypot(odometry[1:, 0], odometry[1:, 1]), np.abs(odometry[1:, 2])
    amounts = np.stack([distance, distance, angle], axis=1)
    parts = amounts * np.array([getattr(motion, name) for name in LEVELS]) ** 2
    squares, tells, information_of = np.zeros(3), np.zeros(3), np.zeros((3, 3))
    found = posterior.mean**2 * information
    known = np.clip(1 - posterior.variance * information, 0, 1)
    for levels, axes in ((slice(0, 1), (0, 1)), (slice(1, 3), (2,))):
        for axis in axes:
            share = parts[:, levels] * information[:, axis, None]
            squares[levels] += share.T @ found[:, axis]
            tells[levels] += share.T @ known[:, axis]
            weighted = known[:, axis, None] * share
            information_of[levels, levels] += 2 * weighted.T @ weighted
    return Told(squares, tells, information_of)


def updated(motion: MotionNoise, of_all: Told) -> MotionNoise:
    """Return the levels after a round; levels without information do not change."""
    levels = {}
    for name, found, known in zip(LEVELS, of_all.found, of_all.known, strict=True):
        before, ratio = getattr(motion, name), found / max(known, LEAST_DISTURBANCES)
        factor = np.sqrt(np.clip(ratio, 1 / _MOST_CHANGE, _MOST_CHANGE))
        levels[name] = (
            max(float(before * factor), _LEAST_LEVEL) if known >= LEAST_DISTURBANCES else before
        )
    across = levels["translation_m_per_sqrt_m"]
    return replace(motion, **levels, lateral_m_per_sqrt_m=across)


def relative_errors(of_all: Told) -> Float:
    """Return the relative standard errors of the levels, shape (3,); 1 without information."""
    return np.sqrt(np.diag(np.linalg.inv(of_all.information + np.eye(3))))


# Number of coordinates that a level needs. The relative error of a standard deviation,
# 1 / sqrt(2 n), is then a tenth.
LEAST_COORDINATES = 50.0
# Smallest standard deviation of an observation, in m: a tenth of that of a robot that stands still.
# Without it observations without noise would have the level zero.
_LEAST_M = 1e-5


def told_observation_level(end: Settled, level: float) -> float:
    """Return the level q of observations on tracks with offsets.

    Residuals are gross relative to the stated errors, or to the estimated ones if these are larger.
    Tails that are fitted at ever smaller levels would become heavier each time.

    Args:
        end: the current state.
        level: the current factor on the stated covariances.

    Returns:
        q; 1 if it depends on fewer than `LEAST_TOLD` coordinates.
    """
    return _level(end.seen, end.estimate, end.weights, end.tails, end.solution.track_m2, level)


def first_observation_level(
    problem: Problem, at: Estimate, weights: Weights, tails: Tails
) -> float:
    """Return the level q before the first step from an estimate."""
    _, known = solve_points(problem.seen, at, weights, problem.stray_information)
    return _level(problem.seen, at, weights, tails, known.track_m2, 1.0)


def _level(
    seen: Sightings, at: Estimate, weights: Weights, tails: Tails, track_m2: Float, level: float
) -> float:
    n, rows = seen.n_dimensions, seen.strays[seen.track]
    if not rows.any():
        return 1.0
    square = squared_distances(seen, at)[rows]
    of_point = squares_of_points(seen, at.path, track_m2)[rows]
    known = np.sum(n - np.minimum(weights.observation[rows] * of_point, n))
    if known < LEAST_COORDINATES:
        return 1.0
    beside = min(level, 1.0) * (square + of_point)
    found = student_weights(beside, fitted_dof(beside, n, tails.observation), n)
    stated = np.median(np.trace(seen.information[rows], axis1=1, axis2=2)) * level / n
    least = min(_LEAST_M**2 * stated, 1.0)
    return max(float(level * np.sum(found * square) / known), least)


_NONE_TOLD = 1e-9  # disturbances; fewer are rounding errors
_LEVEL_TO = 1e-6  # relative tolerance of a level, far below its statistical error


class Untold(NamedTuple):
    """Posterior shares of the disturbances' variances.

    Attributes:
        share: posterior over prior variance, shape (T - 1, 3); 1 without any observation.
        levels: levels of the prior variances, shape (3,).
    """

    share: Float
    levels: Float

    @classmethod
    def of(cls, problem: Problem, end: Settled, levels: Float) -> "Untold":
        """Return the shares for a state with these levels; `problem` is as stated."""
        information = information_under(problem.information, levels)
        share = np.clip(disturbance_variances(end) * information, 0, 1)
        # the motion from one robot's log to the next is unknown
        return cls(np.where(problem.information > 0, share, 1.0), levels)

    def known(self, levels: Float) -> Float:
        """Return the number of disturbances that observations determine, by axis, shape (3,)."""
        return np.array([self._known(axis, level) for axis, level in enumerate(levels)])

    def _known(self, axis: int, level: float) -> float:
        share, more = self.share[:, axis], level / self.levels[axis]
        return float(np.sum(1 - share / (share + (1 - share) * more)))

    def told_levels(self, problem: Problem, path: Float, levels: Float) -> Float:
        """Return the levels (3,) of the variances along, across and in the heading.

        If fewer than `LEAST_TOLD` disturbances are determined, the missing ones count with the
        stated variance, as under a scaled inverse chi-square prior. So a level is 1 without
        information. It has a lower limit, which bounds the odometry's information.

        Args:
            problem: problem with the stated information of the odometry.
            path: current path, shape (T, 3).
            levels: current levels, shape (3,).
        """
        found = np.sum(disturbances(path, problem.odometry) ** 2 * problem.information, axis=0)
        told = found / np.maximum(self.known(levels), _NONE_TOLD)
        told = np.maximum(told, least_levels(problem.information))
        return np.array([self._with_missing(axis, level) for axis, level in enumerate(told)])

    def _with_missing(self, axis: int, told: float) -> float:
        """Return the level q of an axis with the estimate `told` and the missing disturbances.

        q (known(q) + missing(q)) = told known(q) + missing(q) has its root between `told` and 1.
        A root finder solves it, because the iteration q = f(q) may oscillate.
        """

        def excess(level: float) -> float:
            known = self._known(axis, level)
            missing = max(LEAST_DISTURBANCES - known, 0.0)
            return (told - level) * known + (1 - level) * missing

        at_told = excess(told)
        if at_told == 0 or told == 1:
            return told
        found = root_scalar(excess, bracket=(told, 1.0), method="brentq", rtol=_LEVEL_TO)
        return float(found.root)


# When the steps have converged the odometry's levels are computed again, with new covariances. The
# iteration ends if every standard deviation changes by less than this share. It also ends if the
# levels return to an earlier value, because levels with little information may oscillate.
_SETTLED = 0.01
# The odometry's levels are computed first when the next step moves the path by less than this, in
# squared sigmas a coordinate. The covariances change little after that.
_NEAR = 1.0
# The last step changes the observations' variances by no more than this share.
_FOLLOWED = 2e-3
_MOST_STEPS = 100


class Levels(NamedTuple):
    """Factors on the stated variances; 1 if the log has too little information.

    Attributes:
        odometry: factors along, across and in the heading, shape (3,).
        observation: factor for observations on tracks.
    """

    odometry: Float
    observation: float


AS_STATED = Levels(np.ones(3), 1.0)


def settled_with_levels(
    problem: Problem,
    at: Estimate,
    weights: Weights | None = None,
    tails: Tails = NO_TAILS,
    odometry: Float = AS_STATED.odometry,
) -> tuple[Settled, Levels]:
    """Take steps until the estimate and the noise levels converge (see `settled`).

    The observations' level is cheap and is updated after each step, as the tails are. The
    odometry's levels need the covariances of the motions, which are computed when steps are close
    to convergence. The levels then follow each step. New covariances at the end of the steps show
    if the levels are right.

    Args:
        problem: the least-squares problem, with noise as stated.
        at: the initial estimate.
        weights: the initial robust weights; all ones by default.
        tails: the initial tails of the Student-t distributions.
        odometry: the initial levels of the odometry, shape (3,).

    Returns:
        the state after the last step, and the levels.
    """
    weights = unweighted(problem.seen) if weights is None else weights
    levels = Levels(odometry, first_observation_level(problem, at, weights, tails))
    told, untold, known, n_steps = [odometry], None, False, 0
    under = _under(problem, levels, problem.seen.on_level(levels.observation))
    at, weights, tails = followed(under, at, weights, tails)
    while True:
        end = solved(under, at, weights, tails, n_steps)
        observation, odometry = told_observation_level(end, levels.observation), levels.odometry
        follows = _differ(observation, levels.observation) < _FOLLOWED
        at_end = follows and end.is_within(CONVERGED)
        if n_steps == _MOST_STEPS or (known and at_end):
            return finished(under, end), levels
        if at_end or (untold is None and end.is_within(_NEAR)):
            untold = Untold.of(problem, end, odometry)
            anew = untold.told_levels(problem, at.path, odometry)
            if at_end and _are_alike(anew, odometry):
                return finished(under, end), levels
            known = at_end and any(_are_alike(anew, each) for each in told)
            told.append(anew)
        seen = problem.seen.on_level(observation)
        at, weights, tails = stepped(under, end, seen)
        if untold is not None:
            odometry = untold.told_levels(problem, at.path, odometry)
        levels = Levels(odometry, observation)
        under, n_steps = _under(problem, levels, seen), n_steps + 1


def _are_alike(levels: Float, others: Float) -> bool:
    return _differ(levels, others) < 2 * _SETTLED


def _differ(levels: Float | float, others: Float | float) -> float:
    """Return the largest absolute difference of the logarithms."""
    return float(np.max(np.abs(np.log(levels / others))))


def _under(problem: Problem, levels: Levels, seen: Sightings) -> Problem:
    """Return the problem with scaled odometry and the scaled observations `seen`."""
    information = information_under(problem.information, levels.odometry)
    return problem._replace(seen=seen, information=information)
