"""Gauss-Newton optimizer with robust weights."""

from typing import NamedTuple

import numpy as np

from mapfusion.geometry.numerics import Float
from mapfusion.geometry.se2 import wrap
from mapfusion.smoother.elimination import Solution, solve, solve_points
from mapfusion.smoother.normal_equations import (
    Estimate,
    NormalEquations,
    Weights,
    disturbances,
    normal_equations,
    squared_distances,
)
from mapfusion.smoother.problem import Sightings
from mapfusion.smoother.robust_loss import NO_TAILS, Tails, informative, reweighted, unweighted

# Convergence tolerance: largest step of the poses, in squared sigmas a coordinate (0.003 sigma).
# Single landmarks with inconsistent tracks may take many more steps to converge.
CONVERGED = 1e-5
_MOST_STEPS = 50
_FOLLOWING = 2  # updates of weights and points after each step of the path
_MOST_HALVINGS = 12


class Problem(NamedTuple):
    """Least-squares problem: observations, odometry and priors of the offsets.

    Attributes:
        seen: the observations.
        odometry: increments, shape (T, 3).
        information: information of the increments after the first, shape (T - 1, 3); 0 for
            unknown increments.
        stray_information: information of a track's offset along each axis, in 1/m^2.
    """

    seen: Sightings
    odometry: Float
    information: Float
    stray_information: float

    def cost(self, at: Estimate, weights: Weights) -> float:
        """Return the weighted sum of squares."""
        walked = np.sum(self.information * disturbances(at.path, self.odometry) ** 2)
        seen = np.sum(weights.observation * squared_distances(self.seen, at))
        offsets = np.sum(weights.offset[:, None] * at.offset_m**2)
        return float(walked + seen + self.stray_information * offsets)


class Settled(NamedTuple):
    """State after some steps.

    Attributes:
        seen: the observations.
        estimate: the estimate.
        weights: weights of observations and offsets.
        tails: tails of their Student-t distributions.
        n_steps: number of steps.
        equations: equations of the next step; their matrix is the inverse of the covariance.
        solution: solution of the equations.
    """

    seen: Sightings
    estimate: Estimate
    weights: Weights
    tails: Tails
    n_steps: int
    equations: NormalEquations
    solution: Solution

    def is_within(self, least_move: float) -> bool:
        """Return True if the next step is below a tolerance, in squared sigmas a coordinate."""
        return self.solution.moved < least_move * self.estimate.path.size


def settled(
    problem: Problem,
    at: Estimate,
    least_move: float = CONVERGED,
    weights: Weights | None = None,
    tails: Tails = NO_TAILS,
) -> Settled:
    """Take steps from an estimate until one is below a tolerance.

    Args:
        problem: the least-squares problem.
        at: the initial estimate.
        least_move: the tolerance, in squared sigmas a coordinate of the poses.
        weights: the initial weights; ones by default.
        tails: the initial tails.
    """
    weights = unweighted(problem.seen) if weights is None else weights
    end = solved(problem, at, weights, tails)
    while end.n_steps < _MOST_STEPS and not end.is_within(least_move):
        end = solved(problem, *stepped(problem, end), end.n_steps + 1)
    return end


def finished(problem: Problem, end: Settled) -> Settled:
    """Take the last step, which is small, without new weights."""
    return end._replace(estimate=_further(problem, end), n_steps=end.n_steps + 1)


def solved(
    problem: Problem,
    at: Estimate,
    weights: Weights,
    tails: Tails,
    n_steps: int = 0,
) -> Settled:
    """Compute the next step from an estimate.

    It is a step of Fisher scoring: the gradient of the weighted squares over the expected
    information, which is less than the weighted information (`information_share`). The same
    equations give the covariance.
    """
    seen, odometry, information, stray_information = problem
    shares = informative(tails, seen.n_dimensions)
    given = weights, stray_information, odometry, information, shares
    equations = normal_equations(seen, at, *given)
    solution = solve(seen, equations)
    return Settled(seen, at, weights, tails, n_steps, equations, solution)


def stepped(
    problem: Problem, end: Settled, seen: Sightings | None = None
) -> tuple[Estimate, Weights, Tails]:
    """Return the estimate after the next step, with new weights and tails.

    These are of the observations `seen` if given.
    """
    after = problem if seen is None else problem._replace(seen=seen)
    return followed(after, _further(problem, end), end.weights, end.tails)


def followed(
    problem: Problem, at: Estimate, weights: Weights | None = None, tails: Tails = NO_TAILS
) -> tuple[Estimate, Weights, Tails]:
    """Update points and robust weights by turns for a fixed path.

    They converge slowly for inconsistent tracks, and these updates are cheap. Initial weights are
    ones by default.
    """
    seen, _, _, stray_information = problem
    weights = unweighted(seen) if weights is None else weights
    for _ in range(_FOLLOWING):
        step, known = solve_points(seen, at, weights, stray_information)
        at = Estimate(at.path, at.point_m + step.point_m, at.offset_m + step.offset_m)
        weights, tails = reweighted(seen, at, weights, tails, known, stray_information)
    return at, weights, tails


def _further(problem: Problem, end: Settled) -> Estimate:
    """Take the step, or the half, quarter, ... of it that does not increase the cost.

    The cost has the weights of the step (a generalised M step: Dempster, Laird and Rubin 1977).
    The likelihood of the Student-t distributions about the fitted points has another minimum: it
    would reject steps under weights from expected squares.
    """
    at, weights = end.estimate, end.weights
    before, share = problem.cost(at, weights), 1.0
    for _ in range(_MOST_HALVINGS):
        further = _moved(end, share)
        if problem.cost(further, weights) <= before:
            return further
        share /= 2
    return at


def _moved(end: Settled, share: float) -> Estimate:
    """Return the estimate after a share of the step."""
    at, step = end.estimate, end.solution.step
    further = Estimate(*(old + share * new for old, new in zip(at, step, strict=True)))
    further.path[:, 2] = wrap(further.path[:, 2])
    return further
