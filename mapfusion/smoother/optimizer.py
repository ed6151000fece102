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
from mapfusion.smoother.problem import OrderedObservations
from mapfusion.smoother.robust_loss import (
    GAUSSIAN_TAILS,
    Tails,
    information_shares,
    unit_weights,
    update_weights,
)

# Convergence tolerance: largest step of the poses, in squared sigmas a coordinate (0.003 sigma).
# Single landmarks with inconsistent tracks may take many more steps to converge.
CONVERGED = 1e-5
_MOST_STEPS = 50
_FOLLOWING = 2  # updates of weights and points after each step of the path
_MOST_HALVINGS = 12


class Problem(NamedTuple):
    """Least-squares problem: observations, odometry and priors of the offsets.

    Attributes:
        obs: the observations.
        odometry: increments, shape (T, 3).
        information: information of the increments after the first, shape (T - 1, 3); 0 for
            unknown increments.
        offset_prior: information of a track's offset along each axis, in 1/m^2.
    """

    obs: OrderedObservations
    odometry: Float
    information: Float
    offset_prior: float

    def cost(self, at: Estimate, weights: Weights) -> float:
        """Return the weighted sum of squares."""
        odometry = np.sum(self.information * disturbances(at.path, self.odometry) ** 2)
        obs = np.sum(weights.observation * squared_distances(self.obs, at))
        offsets = np.sum(weights.offset[:, None] * at.offset_m**2)
        return float(odometry + obs + self.offset_prior * offsets)


class OptimizerState(NamedTuple):
    """State after some steps.

    Attributes:
        obs: the observations.
        estimate: the estimate.
        weights: weights of observations and offsets.
        tails: tails of their Student-t distributions.
        n_steps: number of steps.
        equations: equations of the next step; their matrix is the inverse of the covariance.
        solution: solution of the equations.
    """

    obs: OrderedObservations
    estimate: Estimate
    weights: Weights
    tails: Tails
    n_steps: int
    equations: NormalEquations
    solution: Solution

    def is_converged(self, tolerance: float) -> bool:
        """Return True if the next step is below a tolerance, in squared sigmas a coordinate."""
        return self.solution.squared_step < tolerance * self.estimate.path.size


def optimize(
    problem: Problem,
    at: Estimate,
    tolerance: float = CONVERGED,
    weights: Weights | None = None,
    tails: Tails = GAUSSIAN_TAILS,
) -> OptimizerState:
    """Take steps from an estimate until one is below a tolerance.

    Args:
        problem: the least-squares problem.
        at: the initial estimate.
        tolerance: the tolerance, in squared sigmas a coordinate of the poses.
        weights: the initial weights; ones by default.
        tails: the initial tails.
    """
    weights = unit_weights(problem.obs) if weights is None else weights
    state = linearize_and_solve(problem, at, weights, tails)
    while state.n_steps < _MOST_STEPS and not state.is_converged(tolerance):
        state = linearize_and_solve(problem, *take_step(problem, state), state.n_steps + 1)
    return state


def take_final_step(problem: Problem, state: OptimizerState) -> OptimizerState:
    """Take the last step, which is small, without new weights."""
    return state._replace(estimate=_line_search(problem, state), n_steps=state.n_steps + 1)


def linearize_and_solve(
    problem: Problem,
    at: Estimate,
    weights: Weights,
    tails: Tails,
    n_steps: int = 0,
) -> OptimizerState:
    """Compute the next step from an estimate.

    It is a step of Fisher scoring: the gradient of the weighted squares over the expected
    information, which is less than the weighted information (`information_share`). The same
    equations give the covariance.
    """
    obs, odometry, information, offset_prior = problem
    shares = information_shares(tails, obs.n_dimensions)
    arguments = weights, offset_prior, odometry, information, shares
    equations = normal_equations(obs, at, *arguments)
    solution = solve(obs, equations)
    return OptimizerState(obs, at, weights, tails, n_steps, equations, solution)


def take_step(
    problem: Problem, state: OptimizerState, obs: OrderedObservations | None = None
) -> tuple[Estimate, Weights, Tails]:
    """Return the estimate after the next step, with new weights and tails.

    These are of the observations `obs` if given.
    """
    new_problem = problem if obs is None else problem._replace(obs=obs)
    return update_points_and_weights(
        new_problem, _line_search(problem, state), state.weights, state.tails
    )


def update_points_and_weights(
    problem: Problem, at: Estimate, weights: Weights | None = None, tails: Tails = GAUSSIAN_TAILS
) -> tuple[Estimate, Weights, Tails]:
    """Update points and robust weights alternately for a fixed path.

    They converge slowly for inconsistent tracks, and these updates are cheap. Initial weights are
    ones by default.
    """
    obs, _, _, offset_prior = problem
    weights = unit_weights(obs) if weights is None else weights
    for _ in range(_FOLLOWING):
        step, covariances = solve_points(obs, at, weights, offset_prior)
        at = Estimate(at.path, at.point_m + step.point_m, at.offset_m + step.offset_m)
        weights, tails = update_weights(obs, at, weights, tails, covariances, offset_prior)
    return at, weights, tails


def _line_search(problem: Problem, state: OptimizerState) -> Estimate:
    """Take the step, or the half, quarter, ... of it that does not increase the cost.

    The cost has the weights of the step (a generalised M step: Dempster, Laird and Rubin 1977).
    The likelihood of the Student-t distributions about the fitted points has another minimum: it
    would reject steps under weights from expected squares.
    """
    at, weights, step = state.estimate, state.weights, state.solution.step
    old_cost, step_fraction = problem.cost(at, weights), 1.0
    for _ in range(_MOST_HALVINGS):
        candidate = Estimate(
            *(old + step_fraction * new for old, new in zip(at, step, strict=True))
        )
        candidate.path[:, 2] = wrap(candidate.path[:, 2])
        if problem.cost(candidate, weights) <= old_cost:
            return candidate
        step_fraction /= 2
    return at
