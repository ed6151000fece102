"""Noise estimation: scales of odometry and observation noise that make a log most likely.

With d = D x - u and the poses' information H, landmarks eliminated, the disturbances have the
covariance D H^-1 D'. With the poses gone first, H is a chain C less a matrix of low rank, so
H^-1 = C^-1 + X K^-1 X' with X = C^-1 B and K the landmarks' information (Woodbury).

The variance of a disturbance is a sum of levels, each times what the robot moved by: v = sum q_j
a_j. With the disturbances' means d and variances C given all observations, a level is right where

    sum of s_j d^2 / v = sum of s_j (1 - C / v),      s_j = q_j a_j / v,

the share of it in v: what is found, squared and in sigmas, is as much as the observations can tell.
The right side counts the disturbances that they do tell. Each round multiplies a level by the ratio
of the two (MacKay 1992, "Bayesian interpolation"), which ends where the marginal
likelihood is stationary, in far fewer rounds than EM.

A sensor states its errors for any texture and any distance, and with what lasts while a track does.
What lasts is in the tracks' offsets here; the rest differs from one sighting to the next, and the
log tells how much it is. Of squared Mahalanobis distances s of the observations from where they
should be, each of n coordinates, with the weights w that gross ones lose, the level q is

    q = sum of w s / sum of (n - c),

c what of an observation's coordinates went into its track's point: the same that tells the levels
of the odometry (MacKay 1992; `odometry_levels.py`). Without tracks nobody can tell what lasts from
what does not, and what is stated holds.

What is stated of an odometry has to hold for any floor and any turn; on one drive wheels may slip
sideways by a fifth of it. Where a robot saw little the path is as sure as its odometry, and so are
maps that are laid over each other by what was seen at the two ends. With the disturbances' means d
and variances C given all observations, and v as stated, the variances are v_j q_j along axis j:

    sum of d^2 / v_j = q_j sum of (1 - C / (v_j q_j)),

the level q_j under which what was smoothed is most likely (MacKay 1992; `noise_levels.py`).

The variances C take a factor of the poses' information and its inverse, the means d nothing. So
levels follow each step with C as it was told once, or nearly: of a disturbance that observations
tell with information J whatever the others are, the share C / v that is left untold is

    u = 1 / (1 + J v q),    so that under other levels    1 / u - 1    is as many times as much.

Odometry and observations are smoothed with what they state, the levels follow from what was found,
and again, until these change no more.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import scipy.linalg
from scipy.optimize import root_scalar

from mapfusion.fastslam.motion import MotionNoise
from mapfusion.geometry.numerics import Float, kernel
from mapfusion.smoother.elimination import chain_factor, own_factor, pose_point_blocks, solve_points
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
    factored,
    finished,
    followed,
    solved,
    stepped,
    stretched,
)
from mapfusion.smoother.problem import Sightings
from mapfusion.smoother.robust_loss import NO_TAILS, Tails, fitted_dof, student_weights, unweighted


class MotionPosterior(NamedTuple):
    """Of the increments after the first, T - 1 of them.

    Attributes:
        mean: (T - 1, 3) the disturbances on the smoothed path.
        variance: (T - 1, 3) theirs.
        constants_information: (C, C) of constants that the increments depend on, all else unknown.
        constants_gradient: (C,) of their log likelihood.
    """

    mean: Float
    variance: Float
    constants_information: Float
    constants_gradient: Float


def motion_posterior(
    end: Settled, odometry: Float, information: Float, by_constants: Float
) -> MotionPosterior:
    """Disturbances given the observations, and what they tell of constants.

    Args:
        end: where smoothing ended.
        odometry: (T, 3) increments, as they were smoothed.
        information: (T - 1, 3) theirs after the first.
        by_constants: (T - 1, 3, C) how the increments after the first change with the constants.
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
    """C's factor, and what is to be added to C^-1: X K^-1 X' as a product of columns."""
    factor = chain_factor(end.equations)
    B, K, _ = pose_point_blocks(end.seen, end.equations)
    X = scipy.linalg.cho_solve_banded((factor, True), B, check_finite=False)
    root = scipy.linalg.cholesky(K - B.T @ X, lower=True, check_finite=False)
    return factor, scipy.linalg.solve_triangular(root, X.T, lower=True, check_finite=False).T


def disturbance_variances(end: Settled) -> Float:
    """(T - 1, 3) of the disturbances, whatever was eliminated first."""
    before, after = disturbance_jacobians(end.estimate.path)
    if end.solution.landmarks_first:
        return _from_poses(end, before, after)
    factor, spread = _covariance_factors(end)
    variance = _of_differences(before, after, *_chain_covariances(factor, len(after)))
    return variance + np.sum(_difference(before, after, spread) ** 2, axis=2)


def _from_poses(end: Settled, before: Float, after: Float) -> Float:
    """From the inverse of the poses' information, in their order."""
    factor = own_factor(end.seen, end.equations, end.solution)
    Z, between = factor.inverse, factor.envelope.between
    place = end.seen.pose_place[1:] - 1
    own, link = between(Z, place, place), between(Z, place[:-1], place[1:])
    return _of_differences(before, after, own, link)


def _difference(before: Float, after: Float, of_poses: Float) -> Float:
    """D of columns (3 (T - 1), R) of the poses but the first: (T - 1, 3, R)."""
    blocks = of_poses.reshape(len(after), 3, -1)
    made = after @ blocks
    made[1:] += before[1:] @ blocks[:-1]
    return made


def _transposed_difference(before: Float, after: Float, of_increments: Float) -> Float:
    """D' of columns (T - 1, 3, C): (3 (T - 1), C)."""
    made = np.swapaxes(after, 1, 2) @ of_increments
    made[:-1] += np.swapaxes(before[1:], 1, 2) @ of_increments[1:]
    return made.reshape(-1, of_increments.shape[2])


def _of_differences(before: Float, after: Float, own: Float, link: Float) -> Float:
    """(T - 1, 3) variances of D x from covariances of the poses and of each with the next."""
    made = np.einsum("kij,kjl,kil->ki", after, own, after)
    made[1:] += np.einsum("kij,kjl,kil->ki", before[1:], own[:-1], before[1:])
    made[1:] += 2 * np.einsum("kij,kjl,kil->ki", before[1:], link, after[1:])
    return made


def _chain_covariances(factor: Float, n: int) -> tuple[Float, Float]:
    """(n, 3, 3) covariances of a chain of n poses, (n - 1, 3, 3) of each with the next."""
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
    """The blocks of the inverse on and beside the diagonal (Takahashi et al. 1973)."""
    for k in range(len(diagonal) - 1, -1, -1):
        inverse = np.linalg.inv(diagonal[k])
        own[k] = inverse.T @ inverse
        if k < len(below):
            G = below[k] @ inverse
            link[k] = -G.T @ own[k + 1]
            own[k] += G.T @ own[k + 1] @ G


LEVELS = ("translation_m_per_sqrt_m", "rotation_rad_per_sqrt_m", "rotation_rad_per_sqrt_rad")
# A round changes a level's square by no more than this: far off, the counts say too little.
_MOST_CHANGE = 4.0
# Below, a level is nothing to the filter, and its share can no longer be told from none.
_LEAST_LEVEL = 1e-4
# Disturbances that have to be told before a level is: of fewer its relative error is above 0.3.
LEAST_DISTURBANCES = 5.0


class Told(NamedTuple):
    """What a smoothed log tells of the levels, in the order of `LEVELS`.

    Attributes:
        found: (3,) left sides: squares, in sigmas.
        known: (3,) right sides: disturbances that the observations tell.
        information: (3, 3) of the levels' logarithms: of each disturbance, 2 k^2 s_i s_j with the
            share k = 1 - C / v of it that the observations tell.
    """

    found: Float
    known: Float
    information: Float


def pooled(of_each: Sequence[Told]) -> Told:
    """What several logs tell together."""
    return Told(*(np.sum(np.stack(values), axis=0) for values in zip(*of_each, strict=True)))


def plain(motion: MotionNoise) -> MotionNoise:
    """Random walks alone, alike along and across: systematic errors are estimated, not covered."""
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
    """What the disturbances of a log tell.

    Args:
        posterior: the disturbances.
        odometry: (T, 3) increments.
        information: (T - 1, 3) that they were smoothed with.
        motion: the levels that it came from.
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
    """The levels after a round; those that nothing is told about stay as they are."""
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
    """(3,) standard errors of the levels, as shares of them; 1 of what nothing is told about."""
    return np.sqrt(np.diag(np.linalg.inv(of_all.information + np.eye(3))))


# Coordinates that have to be told before a level is taken from them: a standard deviation is then
# known to a tenth of itself, 1 / sqrt(2 n).
LEAST_COORDINATES = 50.0
# Observations that agree to the last digit, as simulated without noise, have a level of zero. None
# is taken to be closer, in m, than this: a tenth of what holds a robot that stands still.
_LEAST_M = 1e-5


def told_observation_level(end: Settled, level: float) -> float:
    """The level q of the stated covariances of observations on tracks that stray.

    What is gross is so beside what is stated, or found if that is more: tails that are fitted on
    ever smaller levels grow heavier with each, and call gross what any sensor does at times.

    Args:
        end: where steps ended.
        level: that the stated covariances were multiplied by.

    Returns:
        q; 1 where fewer than `LEAST_TOLD` coordinates are told.
    """
    return _level(end.seen, end.estimate, end.weights, end.tails, end.solution.track_m2, level)


def first_observation_level(
    problem: Problem, at: Estimate, weights: Weights, tails: Tails
) -> float:
    """The level q of what is stated, before any step from an estimate."""
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


_NONE_TOLD = 1e-9  # disturbances; fewer are none, but for rounding
_LEVEL_TO = 1e-6  # share of itself that a level is solved to, far below its own error


class Untold(NamedTuple):
    """What observations leave open of disturbances, under some levels.

    Attributes:
        share: (T - 1, 3) of their variances; 1 where nothing is said of them.
        levels: (3,) that the stated variances were multiplied by.
    """

    share: Float
    levels: Float

    @classmethod
    def of(cls, problem: Problem, end: Settled, levels: Float) -> "Untold":
        """Where steps ended under these levels, those of the problem being as stated."""
        information = information_under(problem.information, levels)
        share = np.clip(disturbance_variances(end) * information, 0, 1)
        # nothing is said of the way from one robot's log to another's
        return cls(np.where(problem.information > 0, share, 1.0), levels)

    def known(self, levels: Float) -> Float:
        """Return how many disturbances (3,) are told under other levels, by each axis."""
        return np.array([self._known(axis, level) for axis, level in enumerate(levels)])

    def _known(self, axis: int, level: float) -> float:
        share, more = self.share[:, axis], level / self.levels[axis]
        return float(np.sum(1 - share / (share + (1 - share) * more)))

    def told_levels(self, problem: Problem, path: Float, levels: Float) -> Float:
        """Return the levels (3,) of the variances along, across and in the heading.

        Where fewer than `LEAST_TOLD` disturbances are told, those missing count as found at the
        stated variance, as under a scaled inverse chi-square prior. So a level is as stated where
        nothing is told. It cannot fall below the level at which the noise of `LEAST_TOLD`
        disturbances can still be told from none, which bounds the odometry's information.

        Args:
            problem: with the odometry's information as stated.
            path: (T, 3) as it was found.
            levels: (3,) under which it was found.
        """
        found = np.sum(disturbances(path, problem.odometry) ** 2 * problem.information, axis=0)
        told = found / np.maximum(self.known(levels), _NONE_TOLD)
        told = np.maximum(told, least_levels(problem.information))
        return np.array([self._with_missing(axis, level) for axis, level in enumerate(told)])

    def _with_missing(self, axis: int, told: float) -> float:
        """Return the level q of an axis where what is told says `told`.

        q (known(q) + missing(q)) = told known(q) + missing(q) has its root between `told` and 1.
        It is solved for q on both sides: to repeat q = f(q) would end in a cycle of two levels.
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


# Where steps end the odometry's levels are told anew, until no standard deviation is off by more
# than this share from what it was or was once before: those of motions that are hardly told may
# come and go.
_SETTLED = 0.05
# They are told first where the next step may move the path by so much, in squared sigmas a
# coordinate: what observations leave open of it changes little by that.
_NEAR = 1.0
# Steps are stretched where each moves the path by less.
_CLOSE = 1e-3
# The last step changes the observations' variances by no more than this share.
_FOLLOWED = 2e-3
_MOST_STEPS = 100


class Levels(NamedTuple):
    """Factors on stated variances; 1 where too little is told.

    Attributes:
        odometry: (3,) along, across and in the heading.
        observation: of observations on tracks.
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
    """Where steps end under the levels that the log tells, for the rest as `settled`.

    The observations' costs little to tell and follows each step, as the tails do. The odometry's
    takes the variances of what was found: these are told once steps are near their end, levels
    follow each step from there on, and where steps end it shows whether they are right. The factor
    and its inverse that this takes are those of the covariances. `odometry` (3,) are its levels to
    begin with.
    """
    weights = unweighted(problem.seen) if weights is None else weights
    levels = Levels(odometry, first_observation_level(problem, at, weights, tails))
    told, untold, known, before, n_steps = [odometry], None, False, None, 0
    stretch = 1.0  # of the step before: that the one after a stretched one is short, tells no end
    under = _under(problem, levels, problem.seen.on_level(levels.observation))
    at, weights, tails = followed(under, at, weights, tails)
    while True:
        end = solved(under, at, weights, tails, n_steps, None if before is None else before.nearby)
        observation, odometry = told_observation_level(end, levels.observation), levels.odometry
        follows = _differ(observation, levels.observation) < _FOLLOWED
        at_end = follows and stretch == 1 and end.is_within(CONVERGED)
        if n_steps == _MOST_STEPS or (known and at_end):
            return finished(under, end), levels
        if at_end or (untold is None and end.is_within(_NEAR)):
            end = factored(end)
            untold = Untold.of(problem, end, odometry)
            anew = untold.told_levels(problem, at.path, odometry)
            if at_end and _are_alike(anew, odometry):
                return finished(under, end), levels
            known = at_end and any(_are_alike(anew, each) for each in told)
            told.append(anew)
        stretch = stretched(before, end) if before and end.is_within(_CLOSE) else 1.0
        seen = problem.seen.on_level(observation)
        at, weights, tails = stepped(under, end, seen, stretch)
        if untold is not None:
            odometry = untold.told_levels(problem, at.path, odometry)
        levels = Levels(odometry, observation)
        under, before, n_steps = _under(problem, levels, seen), end, n_steps + 1


def _are_alike(levels: Float, others: Float) -> bool:
    return _differ(levels, others) < 2 * _SETTLED


def _differ(levels: Float | float, others: Float | float) -> float:
    """The most that a logarithm of them differs by."""
    return float(np.max(np.abs(np.log(levels / others))))


def _under(problem: Problem, levels: Levels, seen: Sightings) -> Problem:
    """The problem under levels, those of the observations being in `seen`."""
    information = information_under(problem.information, levels.odometry)
    return problem._replace(seen=seen, information=information)
