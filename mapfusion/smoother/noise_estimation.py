"""Estimation of odometry and observation noise by maximum marginal likelihood.

Covariances of the disturbances: with d = D x - u and the poses' information H, landmarks
eliminated, they are D H^-1 D'. If the poses are eliminated first, H is a chain C minus a matrix of
low rank, so H^-1 = C^-1 + X K^-1 X' with X = C^-1 B and K the landmarks' information (Woodbury).

Noise parameters (odometry calibration): the variance of a disturbance is a sum of parameters times
amounts of motion, v = sum q_j a_j. With the posterior means d and variances C of the disturbances,
the stationary point is

    sum of s_j d^2 / v = sum of s_j (1 - C / v),      s_j = q_j a_j / v,

where s_j is the share of parameter j in v. The right side counts the disturbances that observations
determine. Each round multiplies a parameter by the ratio of both sides (MacKay 1992, "Bayesian
interpolation"), which converges in far fewer rounds than EM.

Noise scales (smoother): a noise scale q is a factor on stated variances. The iteration starts from
the stated noise and alternates between steps and new scales until neither changes. For the odometry
along axis j with stated variances v,

    sum of d^2 / v = q_j sum of (1 - C / (v q_j)).

The variances C need the inverse of the poses' information, the means d do not. So scales follow
each step with C from an earlier step. If observations determine a disturbance with information J,
its posterior share is C / (v q) = 1 / (1 + J v q); so the odds 1 / share - 1 are proportional to q.

The stated errors of a sensor include errors that are constant along a track. The tracks' offsets
model the constant part, and the noise scale of observations is that of the rest. With squared
Mahalanobis distances s of the residuals in n coordinates and robust weights w,

    q = sum of w s / sum of (n - c),

where c is the number of an observation's coordinates that determine its track's point. Without
tracks the scale cannot be estimated and is 1.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import scipy

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
    before, after = disturbance_jacobians(state.estimate.path)
    factor, low_rank = _covariance_factors(state)
    variance = _variances_from_chain(before, after, factor, low_rank)

    # information of the constants: eliminate the poses, with D' times the constants' columns
    weighted = information[:, :, None] * by_constants
    of_poses = np.swapaxes(after, 1, 2) @ weighted
    of_poses[:-1] += np.swapaxes(before[1:], 1, 2) @ weighted[1:]
    of_poses = of_poses.reshape(-1, weighted.shape[2])
    solved = scipy.linalg.cho_solve_banded((factor, True), of_poses, check_finite=False)
    shared = low_rank.T @ of_poses
    of_constants = np.einsum("kdc,kde->ce", by_constants, weighted)
    of_constants -= of_poses.T @ solved + shared.T @ shared
    mean = disturbances(state.estimate.path, odometry)
    return MotionPosterior(mean, variance, of_constants, np.einsum("kdc,kd->c", weighted, mean))


def disturbance_variances(state: OptimizerState) -> Float:
    """Return the variances of the disturbances, shape (T - 1, 3)."""
    before, after = disturbance_jacobians(state.estimate.path)
    if not state.solution.landmarks_first:
        return _variances_from_chain(before, after, *_covariance_factors(state))
    factor = state.solution.factor
    Z, blocks = factor.inverse, factor.envelope.between
    index = state.obs.pose_index[1:] - 1
    diagonal_blocks, link = blocks(Z, index, index), blocks(Z, index[:-1], index[1:])
    return _variances_from_covariances(before, after, diagonal_blocks, link)


def _covariance_factors(state: OptimizerState) -> tuple[Float, Float]:
    """Return the factor of C, and columns whose products are X K^-1 X'."""
    factor = chain_factor(state.equations)
    B, K, _ = pose_point_blocks(state.obs, state.equations)
    X = scipy.linalg.cho_solve_banded((factor, True), B, check_finite=False)
    root = scipy.linalg.cholesky(K - B.T @ X, lower=True, check_finite=False)
    return factor, scipy.linalg.solve_triangular(root, X.T, lower=True, check_finite=False).T


def _variances_from_chain(before: Float, after: Float, factor: Float, low_rank: Float) -> Float:
    """Return the variances (T - 1, 3) of D x for the result of `_covariance_factors`."""
    n = len(after)
    diagonal, below = np.zeros((n, 3, 3)), np.zeros((max(n - 1, 0), 3, 3))
    for r in range(3):
        for q in range(3):
            if r >= q:
                diagonal[:, r, q] = factor[r - q, q::3]
            below[:, r, q] = factor[3 + r - q, q : 3 * (n - 1) : 3]
    diagonal_blocks, link = np.empty((n, 3, 3)), np.empty((max(n - 1, 0), 3, 3))
    _selected_inverse(diagonal, below, diagonal_blocks, link)
    variance = _variances_from_covariances(before, after, diagonal_blocks, link)
    blocks = low_rank.reshape(n, 3, -1)
    differences = after @ blocks
    differences[1:] += before[1:] @ blocks[:-1]
    variance += np.sum(differences**2, axis=2)
    return variance


def _variances_from_covariances(
    before: Float, after: Float, diagonal_blocks: Float, link: Float
) -> Float:
    """Return the variances (T - 1, 3) of D x from the covariances of poses and successive pairs."""
    variance = np.einsum("kij,kjl,kil->ki", after, diagonal_blocks, after)
    variance[1:] += np.einsum("kij,kjl,kil->ki", before[1:], diagonal_blocks[:-1], before[1:])
    variance[1:] += 2 * np.einsum("kij,kjl,kil->ki", before[1:], link, after[1:])
    return variance


@kernel
def _selected_inverse(diagonal: Float, below: Float, diagonal_blocks: Float, link: Float) -> None:
    """Write the blocks of a chain's inverse on and beside the diagonal (Takahashi et al. 1973)."""
    for k in range(len(diagonal) - 1, -1, -1):
        inverse = np.linalg.inv(diagonal[k])
        diagonal_blocks[k] = inverse.T @ inverse
        if k < len(below):
            G = below[k] @ inverse
            link[k] = -G.T @ diagonal_blocks[k + 1]
            diagonal_blocks[k] += G.T @ diagonal_blocks[k + 1] @ G


NOISE_PARAMETERS = (
    "translation_m_per_sqrt_m",
    "rotation_rad_per_sqrt_m",
    "rotation_rad_per_sqrt_rad",
)
# Largest factor on a parameter's square in one round; the counts are inaccurate far from the
# solution.
_MOST_CHANGE = 4.0
# Smaller parameters have no effect in the filter, and their shares cannot be estimated.
_LEAST_PARAMETER = 1e-4
# Number of determined disturbances that a parameter or scale needs; with fewer its relative error
# exceeds 0.3.
LEAST_DISTURBANCES = 5.0


class NoiseStatistics(NamedTuple):
    """Statistics of a smoothed log for the parameters, in the order of `NOISE_PARAMETERS`.

    Attributes:
        squares: left sides, squares in sigmas, shape (3,).
        determined: right sides, numbers of determined disturbances, shape (3,).
        information: information of the parameters' logarithms, shape (3, 3): the sum of
            2 k^2 s_i s_j over the disturbances, with k = 1 - C / v.
    """

    squares: Float
    determined: Float
    information: Float


def sum_statistics(logs: Sequence[NoiseStatistics]) -> NoiseStatistics:
    """Add the statistics of several logs."""
    return NoiseStatistics(
        *(np.sum(np.stack(values), axis=0) for values in zip(*logs, strict=True))
    )


def without_systematic_errors(motion: MotionNoise) -> MotionNoise:
    """Return the noise without systematic errors, with equal parameters along and across."""
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
        motion: the parameters of this information.
    """
    distance, angle = np.hypot(odometry[1:, 0], odometry[1:, 1]), np.abs(odometry[1:, 2])
    amounts = np.stack([distance, distance, angle], axis=1)
    parts = amounts * np.array([getattr(motion, name) for name in NOISE_PARAMETERS]) ** 2
    squares, determined, information_of = np.zeros(3), np.zeros(3), np.zeros((3, 3))
    in_sigmas = posterior.mean**2 * information
    redundancy = np.clip(1 - posterior.variance * information, 0, 1)
    for parameters, axes in ((slice(0, 1), (0, 1)), (slice(1, 3), (2,))):
        for axis in axes:
            share = parts[:, parameters] * information[:, axis, None]
            squares[parameters] += share.T @ in_sigmas[:, axis]
            determined[parameters] += share.T @ redundancy[:, axis]
            weighted = redundancy[:, axis, None] * share
            information_of[parameters, parameters] += 2 * weighted.T @ weighted
    return NoiseStatistics(squares, determined, information_of)


def update_noise(motion: MotionNoise, statistics: NoiseStatistics) -> MotionNoise:
    """Return the parameters after a round; parameters without information do not change."""
    changed = {}
    rows = zip(NOISE_PARAMETERS, statistics.squares, statistics.determined, strict=True)
    for name, squares, determined in rows:
        if determined >= LEAST_DISTURBANCES:
            ratio = squares / determined
            factor = np.sqrt(np.clip(ratio, 1 / _MOST_CHANGE, _MOST_CHANGE))
            changed[name] = max(float(getattr(motion, name) * factor), _LEAST_PARAMETER)
    motion = replace(motion, **changed)
    return replace(motion, lateral_m_per_sqrt_m=motion.translation_m_per_sqrt_m)


def relative_errors(statistics: NoiseStatistics) -> Float:
    """Return the relative standard errors of the parameters (3,); 1 without information."""
    return np.sqrt(np.diag(np.linalg.inv(statistics.information + np.eye(3))))


# Number of coordinates that the noise scale of observations needs. The relative error of a standard
# deviation, 1 / sqrt(2 n), is then a tenth.
LEAST_COORDINATES = 50.0
# Smallest standard deviation of an observation, in m: a tenth of that of a robot that stands still.
# Without it observations without noise would have the scale zero.
_LEAST_M = 1e-5


def observation_scale(state: OptimizerState, scale: float) -> float:
    """Return the noise scale q of observations on tracks with offsets.

    Residuals are gross relative to the stated errors, or to the estimated ones if these are larger.
    Tails that are fitted at ever smaller scales would become heavier each time.

    Args:
        state: the current state.
        scale: the current factor on the stated covariances.

    Returns:
        q; 1 if it depends on fewer than `LEAST_COORDINATES` coordinates.
    """
    return _estimate_observation_scale(
        state.obs, state.estimate, state.weights, state.tails, state.solution.track_m2, scale
    )


def initial_observation_scale(
    problem: Problem, at: Estimate, weights: Weights, tails: Tails
) -> float:
    """Return the noise scale q of observations before the first step from an estimate."""
    _, covariances = solve_points(problem.obs, at, weights, problem.offset_prior)
    return _estimate_observation_scale(problem.obs, at, weights, tails, covariances.track_m2, 1.0)


def _estimate_observation_scale(
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
    degrees_of_freedom = np.sum(n - np.minimum(weights.observation[rows] * of_point, n))
    if degrees_of_freedom < LEAST_COORDINATES:
        return 1.0
    beside = min(scale, 1.0) * (square + of_point)
    student_weight = student_weights(beside, fit_dof(beside, n, tails.observation), n)
    stated = np.median(np.trace(obs.information[rows], axis1=1, axis2=2)) * scale / n
    min_scale = min(_LEAST_M**2 * stated, 1.0)
    return max(float(scale * np.sum(student_weight * square) / degrees_of_freedom), min_scale)


_NONE_DETERMINED = 1e-9  # disturbances; fewer are rounding errors
_SCALE_TOLERANCE = 1e-6  # relative tolerance of a noise scale, far below its statistical error


class PosteriorShares(NamedTuple):
    """Posterior shares of the disturbances' variances.

    Attributes:
        share: posterior over prior variance, shape (T - 1, 3); 1 without any observation.
        scales: noise scales of the prior variances, shape (3,).
    """

    share: Float
    scales: Float

    @classmethod
    def of(cls, problem: Problem, state: OptimizerState, scales: Float) -> "PosteriorShares":
        """Return the shares for a state with these scales; `problem` has the stated noise."""
        information = scaled_information(problem.information, scales)
        share = np.clip(disturbance_variances(state) * information, 0, 1)
        # the motion from one robot's log to the next is unknown
        return cls(np.where(problem.information > 0, share, 1.0), scales)

    def known(self, scales: Float) -> Float:
        """Return the number of disturbances that observations determine, by axis, shape (3,)."""
        return np.array([self._known(axis, scale) for axis, scale in enumerate(scales)])

    def _known(self, axis: int, scale: float) -> float:
        share, scale_ratio = self.share[:, axis], scale / self.scales[axis]
        return float(np.sum(1 - share / (share + (1 - share) * scale_ratio)))

    def estimate_scales(self, problem: Problem, path: Float, scales: Float) -> Float:
        """Return the noise scales (3,) along, across and in the heading.

        If fewer than `LEAST_DISTURBANCES` disturbances are determined, the missing ones count with
        the stated variance, as under a scaled inverse chi-square prior. So a scale is 1 without
        information. The odometry's information has an upper bound, which bounds the scale.

        Args:
            problem: problem with the stated information of the odometry.
            path: current path, shape (T, 3).
            scales: current noise scales, shape (3,).
        """
        squared_disturbances = np.sum(
            disturbances(path, problem.odometry) ** 2 * problem.information, axis=0
        )
        likely = squared_disturbances / np.maximum(self.known(scales), _NONE_DETERMINED)
        likely = np.maximum(likely, smallest_scales(problem.information))
        return np.array([self._with_prior(axis, scale) for axis, scale in enumerate(likely)])

    def _with_prior(self, axis: int, likely: float) -> float:
        """Return the scale q of an axis with the estimate `likely` and the missing disturbances.

        q (known(q) + missing(q)) = likely known(q) + missing(q) has its root between `likely` and
        1. A fixed-point iteration may oscillate, so a root finder solves it.
        """

        def excess(scale: float) -> float:
            n_determined = self._known(axis, scale)
            missing = max(LEAST_DISTURBANCES - n_determined, 0.0)
            return (likely - scale) * n_determined + (1 - scale) * missing

        if excess(likely) == 0 or likely == 1:
            return likely
        root = scipy.optimize.root_scalar(
            excess, bracket=(likely, 1.0), method="brentq", rtol=_SCALE_TOLERANCE
        )
        return float(root.root)


# When the steps have converged the odometry's scales are computed again, with new covariances. The
# iteration ends if every standard deviation changes by less than this share. It also ends if the
# scales return to an earlier value, because scales with little information may oscillate.
_SETTLED = 0.01
# The odometry's scales are computed first when the next step moves the path by less than this, in
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
    """Take steps until the estimate and the noise scales converge (see `optimize`).

    The observations' scale is cheap and is updated after each step, as the tails are. The
    odometry's scales need the covariances of the motions, which are computed when steps are close
    to convergence. The scales then follow each step. New covariances at the end of the steps show
    if the scales are right.

    Args:
        problem: the least-squares problem, with noise as stated.
        at: the initial estimate.
        weights: the initial robust weights; all ones by default.
        tails: the initial tails of the Student-t distributions.
        odometry: the initial noise scales of the odometry, shape (3,).

    Returns:
        the state after the last step, and the noise scales.
    """
    weights = unit_weights(problem.obs) if weights is None else weights
    scales = NoiseScales(odometry, initial_observation_scale(problem, at, weights, tails))
    history, shares, returned, n_steps = [odometry], None, False, 0
    scaled = _with_scales(problem, scales, problem.obs.with_covariance_scale(scales.observation))
    at, weights, tails = update_points_and_weights(scaled, at, weights, tails)
    while True:
        state = linearize_and_solve(scaled, at, weights, tails, n_steps)
        observation, odometry = observation_scale(state, scales.observation), scales.odometry
        is_followed = _differ(observation, scales.observation) < _FOLLOWED
        converged = is_followed and state.is_converged(CONVERGED)
        if n_steps == _MOST_STEPS or (returned and converged):
            return take_final_step(scaled, state), scales
        if converged or (shares is None and state.is_converged(_NEAR)):
            shares = PosteriorShares.of(problem, state, odometry)
            new_scales = shares.estimate_scales(problem, at.path, odometry)
            if converged and _are_alike(new_scales, odometry):
                return take_final_step(scaled, state), scales
            returned = converged and any(_are_alike(new_scales, each) for each in history)
            history.append(new_scales)
        obs = problem.obs.with_covariance_scale(observation)
        at, weights, tails = take_step(scaled, state, obs)
        if shares is not None:
            odometry = shares.estimate_scales(problem, at.path, odometry)
        scales = NoiseScales(odometry, observation)
        scaled, n_steps = _with_scales(problem, scales, obs), n_steps + 1


def _are_alike(scales: Float, others: Float) -> bool:
    return _differ(scales, others) < 2 * _SETTLED


def _differ(scales: Float | float, others: Float | float) -> float:
    """Return the largest absolute difference of the logarithms."""
    return float(np.max(np.abs(np.log(scales / others))))


def _with_scales(problem: Problem, scales: NoiseScales, obs: OrderedObservations) -> Problem:
    """Return the problem with scaled odometry and the scaled observations `obs`."""
    information = scaled_information(problem.information, scales.odometry)
    return problem._replace(obs=obs, information=information)
