"""Gauss-Newton steps on poses, landmarks and offsets, each with new robust weights."""

from typing import NamedTuple

import numpy as np

from mapfusion.se2 import Float, wrap
from mapfusion.smoother.elimination import Solution, solve
from mapfusion.smoother.normal_equations import (
    Estimate,
    NormalEquations,
    Weights,
    disturbances,
    normal_equations,
)
from mapfusion.smoother.residuals import squared_distances
from mapfusion.smoother.robust import NO_TAILS, Tails, informative, reweighted, unweighted
from mapfusion.smoother.sightings import Sightings

# The next step would move the poses by no more than this, in squared sigmas a coordinate: the third
# of a hundredth of a sigma. A step costs as the cube of the log, and there is little left to win:
# single landmarks, whose tracks contradict each other, may go on changing their minds for long.
_CONVERGED = 1e-5
_MOST_STEPS = 50
_MOST_HALVINGS = 12


class Problem(NamedTuple):
    """What is to be found is all that explains this.

    Attributes:
        seen: the observations.
        odometry: (T, 3) increments.
        information: (T - 1, 3) theirs after the first; 0 where they say nothing.
        stray_information: of a track's offset along each axis, in 1/m^2.
    """

    seen: Sightings
    odometry: Float
    information: Float
    stray_information: float

    def cost(self, at: Estimate, weights: Weights) -> float:
        """Sum of all squares under weights: twice the negative log likelihood they stand for."""
        walked = np.sum(self.information * disturbances(at.path, self.odometry) ** 2)
        seen = np.sum(weights.observation * squared_distances(self.seen, at))
        offsets = np.sum(weights.offset[:, None] * at.offset_m**2)
        return float(walked + seen + self.stray_information * offsets)


class Reached(NamedTuple):
    """Where steps ended, how many they were, and the weights and tails there."""

    estimate: Estimate
    weights: Weights
    tails: Tails
    n_steps: int


class Settled(NamedTuple):
    """The same of observations, with the equations of the covariances there and their solution."""

    seen: Sightings
    estimate: Estimate
    weights: Weights
    tails: Tails
    n_steps: int
    equations: NormalEquations
    solution: Solution


def settled(
    problem: Problem,
    at: Estimate,
    least_move: float = _CONVERGED,
    weights: Weights | None = None,
    tails: Tails = NO_TAILS,
) -> Settled:
    """Where steps end, as `reached`, and what is known of it."""
    seen, odometry, information, stray_information = problem
    end = reached(problem, at, least_move, weights, tails)
    known = informative(seen, end.weights, end.tails)
    equations = normal_equations(
        seen, end.estimate, known, stray_information, odometry, information
    )
    return Settled(seen, *end, equations, solve(seen, equations))


def reached(
    problem: Problem,
    at: Estimate,
    least_move: float = _CONVERGED,
    weights: Weights | None = None,
    tails: Tails = NO_TAILS,
) -> Reached:
    """Take steps from an estimate until the next would move the poses by less than `least_move`.

    It is in squared sigmas a coordinate. Weights and tails to begin with are those of an earlier
    round; all ones by default.
    """
    seen, odometry, information, stray_information = problem
    weights, n_steps = unweighted(seen) if weights is None else weights, 0
    while True:
        equations = normal_equations(seen, at, weights, stray_information, odometry, information)
        solution = solve(seen, equations)
        if n_steps == _MOST_STEPS or solution.moved < least_move * at.path.size:
            return Reached(at, weights, tails, n_steps)
        at = _stepped(problem, weights, at, solution.step)
        weights, tails = reweighted(seen, at, weights, solution, stray_information)
        n_steps += 1


def _stepped(problem: Problem, weights: Weights, at: Estimate, step: Estimate) -> Estimate:
    """The step, or as much of it as lowers the cost: half, a quarter, ...

    It is the cost under the weights that the step is of (a generalised M step: Dempster, Laird and
    Rubin 1977). The likelihood of the Student-t's about the *fitted* points has its least
    elsewhere: it would stop steps that weights from expected squares still ask for.
    """
    before, share = problem.cost(at, weights), 1.0
    for _ in range(_MOST_HALVINGS):
        further = Estimate(*(old + share * new for old, new in zip(at, step, strict=True)))
        further.path[:, 2] = wrap(further.path[:, 2])
        if problem.cost(further, weights) <= before:
            return further
        share /= 2
    return at
