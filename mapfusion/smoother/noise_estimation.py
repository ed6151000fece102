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
    expected_point_squares,
    scaled_information,
    smallest_scales,
    squared_distances,
)
from mapfusion.smoother.optimizer import (
    CONVERGED,
    OptimizerState,
    Problem,
    linearize_and_solve,
    take_final_step,
    take_step,
    update_points_and_weights,
)
from mapfusion.smoother.problem import OrderedObservations
from mapfusion.smoother.robust_loss import (
    GAUSSIAN_TAILS,
    Tails,
    fit_dof,
    student_weights,
    unit_weights,
)


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
    state: OptimizerState, odometry: Float, information: Float, by_constants: Float
) -> MotionPosterior:
    """Return the posterior of the disturbances and of constants.

    Args:
        state: the smoothed state.
        odometry: increments that were smoothed, shape (T, 3).
        information: information of the increments after the first, shape (T - 1, 3).
        by_constants: derivatives of these increments by the constants, shape (T - 1, 3, C).
    """
    path, n = state.estimate.path, len(odometry) - 1
    factor, spread = _covariance_factors(state)
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


def _covariance_factors(state: OptimizerState) -> tuple[Float, Float]:
    """Return the factor of C, and columns whose products are X K^-1 X'."""
    factor = chain_factor(state.equations)
    B, K, _ = pose_point_blocks(state.obs, state.equations)
    X = scipy.linalg.cho_solve_banded((factor, True), B, check_finite=False)
    root = scipy.linalg.cholesky(K - B.T @ X, lower=True, check_finite=False)
    return factor, scipy.linalg.solve_triangular(root, X.T, lower=True, check_finite=False).T


def disturbance_variances(state: OptimizerState) -> Float:
    """Return the variances of the disturbances, shape (T - 1, 3)."""
    before, after = disturbance_jacobians(state.estimate.path)
    if state.solution.landmarks_first:
        return _from_poses(state, before, after)
    factor, spread = _covariance_factors(state)
    variance = _of_differences(before, after, *_chain_covariances(factor, len(after)))
    return variance + np.sum(_difference(before, after, spread) ** 2, axis=2)


def _from_poses(state: OptimizerState, before: Float, after: Float) -> Float:
    """Return the variances from the inverse of the poses' information."""
    factor = state.solution.factor
    Z, between = factor.inverse, factor.envelope.between
    place = state.obs.pose_place[1:] - 1
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


NOISE_PARAMETERS = (
    "translation_m_per_sqrt_m",
    "rotation_rad_per_sqrt_m",
    "rotation_rad_per_sqrt_rad",
)
# Largest factor on a level's square in one round; the counts are inaccurate far from the solution.
_MOST_CHANGE = 4.0
# Smaller levels have no effect in the filter, and their shares cannot be estimated.
_LEAST_LEVEL = 1e-4
# Number of determined disturbances that a level needs; with fewer its relative error exceeds 0.3.
LEAST_DISTURBANCES = 5.0


class NoiseStatistics(NamedTuple):
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


def sum_statistics(of_each: Sequence[NoiseStatistics]) -> NoiseStatistics:
    """Add the statistics of several logs."""
    return NoiseStatistics(
        *(np.sum(np.stack(values), axis=0) for values in zip(*of_each, strict=True))
    )


def without_systematic_errors(motion: MotionNoise) -> MotionNoise:
    """Return the noise without systematic errors, with equal levels along and across."""
    across = motion.translation_m_per_sqrt_m
    return replace(
        motion,
        scale_error=0,
        track_error=0,
        lateral_m_per_sqrt_m=across,
        lateral_slip_m_per_rad=0,
    )


def noise_statistics(
    posterior: MotionPosterior, odometry: Float, information: Float, motion: MotionNoise
) -> NoiseStatistics:
    """Return the statistics of a log's disturbances.

    Args:
        posterior: posterior of the disturbances.
        odometry: increments, shape (T, 3).
        information: information that they were smoothed with, shape (T - 1, 3).
        motion: the levels of this information.
    """
    distance, angle = np.hypot(odometry[1:, 0], odometry[1:, 1]), np.abs(odometry[1:, 2])
    amounts = np.stack([distance, distance, angle], axis=1)
    parts = amounts * np.array([getattr(motion, name) for name in NOISE_PARAMETERS]) ** 2
    squares, determined, information_of = np.zeros(3), np.zeros(3), np.zeros((3, 3))
    found = posterior.mean**2 * information
    known = np.clip(1 - posterior.variance * information, 0, 1)
    for scales, axes in ((slice(0, 1), (0, 1)), (slice(1, 3), (2,))):
        for axis in axes:
            share = parts[:, scales] * information[:, axis, None]
            squares[scales] += share.T @ found[:, axis]
            determined[scales] += share.T @ known[:, axis]
            weighted = known[:, axis, None] * share
            information_of[scales, scales] += 2 * weighted.T @ weighted
    return NoiseStatistics(squares, determined, information_of)


def update_noise(motion: MotionNoise, statistics: NoiseStatistics) -> MotionNoise:
    """Return the levels after a round; levels without information do not change."""
    scales = {}
    for name, found, known in zip(
        NOISE_PARAMETERS, statistics.found, statistics.known, strict=True
    ):
        before, ratio = getattr(motion, name), found / max(known, LEAST_DISTURBANCES)
        factor = np.sqrt(np.clip(ratio, 1 / _MOST_CHANGE, _MOST_CHANGE))
        scales[name] = (
            max(float(before * factor), _LEAST_LEVEL) if known >= LEAST_DISTURBANCES else before
        )
    across = scales["translation_m_per_sqrt_m"]
    return replace(motion, **scales, lateral_m_per_sqrt_m=across)


def relative_errors(statistics: NoiseStatistics) -> Float:
    """Return the relative standard errors of the levels, shape (3,); 1 without information."""
    return np.sqrt(np.diag(np.linalg.inv(statistics.information + np.eye(3))))


# Number of coordinates that a level needs. The relative error of a standard deviation,
# 1 / sqrt(2 n), is then a tenth.
LEAST_COORDINATES = 50.0
# Smallest standard deviation of an observation, in m: a tenth of that of a robot that stands still.
# Without it observations without noise would have the level zero.
_LEAST_M = 1e-5


def observation_scale(state: OptimizerState, scale: float) -> float:
    """Return the level q of observations on tracks with offsets.

    Residuals are gross relative to the stated errors, or to the estimated ones if these are larger.
    Tails that are fitted at ever smaller levels would become heavier each time.

    Args:
        state: the current state.
        scale: the current factor on the stated covariances.

    Returns:
        q; 1 if it depends on fewer than `LEAST_TOLD` coordinates.
    """
    return _level(
        state.obs, state.estimate, state.weights, state.tails, state.solution.track_m2, scale
    )


def initial_observation_scale(
    problem: Problem, at: Estimate, weights: Weights, tails: Tails
) -> float:
    """Return the level q before the first step from an estimate."""
    _, known = solve_points(problem.obs, at, weights, problem.offset_prior)
    return _level(problem.obs, at, weights, tails, known.track_m2, 1.0)


def _level(
    obs: OrderedObservations,
    at: Estimate,
    weights: Weights,
    tails: Tails,
    track_m2: Float,
    scale: float,
) -> float:
    n, rows = obs.n_dimensions, obs.has_offset[obs.track]
    if not rows.any():
        return 1.0
    square = squared_distances(obs, at)[rows]
    of_point = expected_point_squares(obs, at.path, track_m2)[rows]
    known = np.sum(n - np.minimum(weights.observation[rows] * of_point, n))
    if known < LEAST_COORDINATES:
        return 1.0
    beside = min(scale, 1.0) * (square + of_point)
    found = student_weights(beside, fit_dof(beside, n, tails.observation), n)
    stated = np.median(np.trace(obs.information[rows], axis1=1, axis2=2)) * scale / n
    least = min(_LEAST_M**2 * stated, 1.0)
    return max(float(scale * np.sum(found * square) / known), least)


_NONE_TOLD = 1e-9  # disturbances; fewer are rounding errors
_LEVEL_TO = 1e-6  # relative tolerance of a level, far below its statistical error


class PosteriorShares(NamedTuple):
    """Posterior shares of the disturbances' variances.

    Attributes:
        share: posterior over prior variance, shape (T - 1, 3); 1 without any observation.
        scales: levels of the prior variances, shape (3,).
    """

    share: Float
    scales: Float

    @classmethod
    def of(cls, problem: Problem, state: OptimizerState, scales: Float) -> "PosteriorShares":
        """Return the shares for a state with these levels; `problem` is as stated."""
        information = scaled_information(problem.information, scales)
        share = np.clip(disturbance_variances(state) * information, 0, 1)
        # the motion from one robot's log to the next is unknown
        return cls(np.where(problem.information > 0, share, 1.0), scales)

    def known(self, scales: Float) -> Float:
        """Return the number of disturbances that observations determine, by axis, shape (3,)."""
        return np.array([self._known(axis, scale) for axis, scale in enumerate(scales)])

    def _known(self, axis: int, scale: float) -> float:
        share, more = self.share[:, axis], scale / self.scales[axis]
        return float(np.sum(1 - share / (share + (1 - share) * more)))

    def estimate_scales(self, problem: Problem, path: Float, scales: Float) -> Float:
        """Return the levels (3,) of the variances along, across and in the heading.

        If fewer than `LEAST_TOLD` disturbances are determined, the missing ones count with the
        stated variance, as under a scaled inverse chi-square prior. So a level is 1 without
        information. It has a lower limit, which bounds the odometry's information.

        Args:
            problem: problem with the stated information of the odometry.
            path: current path, shape (T, 3).
            scales: current levels, shape (3,).
        """
        found = np.sum(disturbances(path, problem.odometry) ** 2 * problem.information, axis=0)
        told = found / np.maximum(self.known(scales), _NONE_TOLD)
        told = np.maximum(told, smallest_scales(problem.information))
        return np.array([self._with_missing(axis, scale) for axis, scale in enumerate(told)])

    def _with_missing(self, axis: int, told: float) -> float:
        """Return the level q of an axis with the estimate `told` and the missing disturbances.

        q (known(q) + missing(q)) = told known(q) + missing(q) has its root between `told` and 1.
        A root finder solves it, because the iteration q = f(q) may oscillate.
        """

        def excess(scale: float) -> float:
            known = self._known(axis, scale)
            missing = max(LEAST_DISTURBANCES - known, 0.0)
            return (told - scale) * known + (1 - scale) * missing

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


class NoiseScales(NamedTuple):
    """Factors on the stated variances; 1 if the log has too little information.

    Attributes:
        odometry: factors along, across and in the heading, shape (3,).
        observation: factor for observations on tracks.
    """

    odometry: Float
    observation: float


UNIT_SCALES = NoiseScales(np.ones(3), 1.0)


def optimize_with_noise(
    problem: Problem,
    at: Estimate,
    weights: Weights | None = None,
    tails: Tails = GAUSSIAN_TAILS,
    odometry: Float = UNIT_SCALES.odometry,
) -> tuple[OptimizerState, NoiseScales]:
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
    weights = unit_weights(problem.obs) if weights is None else weights
    scales = NoiseScales(odometry, initial_observation_scale(problem, at, weights, tails))
    told, untold, known, n_steps = [odometry], None, False, 0
    under = _under(problem, scales, problem.obs.with_covariance_scale(scales.observation))
    at, weights, tails = update_points_and_weights(under, at, weights, tails)
    while True:
        state = linearize_and_solve(under, at, weights, tails, n_steps)
        observation, odometry = observation_scale(state, scales.observation), scales.odometry
        follows = _differ(observation, scales.observation) < _FOLLOWED
        at_end = follows and state.is_converged(CONVERGED)
        if n_steps == _MOST_STEPS or (known and at_end):
            return take_final_step(under, state), scales
        if at_end or (untold is None and state.is_converged(_NEAR)):
            untold = PosteriorShares.of(problem, state, odometry)
            anew = untold.estimate_scales(problem, at.path, odometry)
            if at_end and _are_alike(anew, odometry):
                return take_final_step(under, state), scales
            known = at_end and any(_are_alike(anew, each) for each in told)
            told.append(anew)
        obs = problem.obs.with_covariance_scale(observation)
        at, weights, tails = take_step(under, state, obs)
        if untold is not None:
            odometry = untold.estimate_scales(problem, at.path, odometry)
        scales = NoiseScales(odometry, observation)
        under, n_steps = _under(problem, scales, obs), n_steps + 1


def _are_alike(scales: Float, others: Float) -> bool:
    return _differ(scales, others) < 2 * _SETTLED


def _differ(scales: Float | float, others: Float | float) -> float:
    """Return the largest absolute difference of the logarithms."""
    return float(np.max(np.abs(np.log(scales / others))))


def _under(problem: Problem, scales: NoiseScales, obs: OrderedObservations) -> Problem:
    """Return the problem with scaled odometry and the scaled observations `obs`."""
    information = scaled_information(problem.information, scales.odometry)
    return problem._replace(obs=obs, information=information)
