"""Gauss-Newton optimizer with robust weights."""

from typing import NamedTuple

import numpy as np

from mapfusion.geometry.numerics import Float
from mapfusion.geometry.se2 import wrap
from mapfusion.smoother.cholesky import Factor
from mapfusion.smoother.elimination import Solution, own_factor, solve, solve_points
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

# The last step moves the poses by no more than this, in squared sigmas a coordinate: the third of a
# hundredth of a sigma. A step costs as the cube of the log, and there is little left to win:
# single landmarks, whose tracks contradict each other, may go on changing their minds for long.
CONVERGED = 1e-5
_MOST_STEPS = 50
_FOLLOWING = 2  # times that weights and points follow each other after a step
_MOST_HALVINGS = 12
# Steps are of one direction where the cosine of their angle is more than this. A step that is more
# than so many times as long as the one before it does not tell where they end.
_ONE_WAY, _LONGEST = 0.8, 0.9
# Of the way that steps after it would go, a stretched step goes this share.
_FURTHER = 0.5


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


class Settled(NamedTuple):
    """Where steps ended, how many they were, and what is known there.

    Attributes:
        seen: the observations.
        estimate: where steps ended.
        weights: of observations and offsets.
        tails: of their Student-t's.
        n_steps: that were taken.
        equations: of the next step, whose matrix is the inverse of the covariance.
        solution: theirs.
        nearby: the last factor that was found on the way.
    """

    seen: Sightings
    estimate: Estimate
    weights: Weights
    tails: Tails
    n_steps: int
    equations: NormalEquations
    solution: Solution
    nearby: Factor | None

    @property
    def way_m(self) -> Float:
        """(T, 2) the next step of the poses in the plane."""
        return self.solution.step.path[:, :2]

    def is_within(self, least_move: float) -> bool:
        """Whether the next step would move the poses by less, in squared sigmas a coordinate."""
        return self.solution.moved < least_move * self.estimate.path.size


def settled(
    problem: Problem,
    at: Estimate,
    least_move: float = CONVERGED,
    weights: Weights | None = None,
    tails: Tails = NO_TAILS,
) -> Settled:
    """Take steps from an estimate until one moves the poses by less than `least_move`.

    It is in squared sigmas a coordinate. Weights and tails to begin with are those of an earlier
    round; all ones by default.
    """
    weights = unweighted(problem.seen) if weights is None else weights
    end = solved(problem, at, weights, tails)
    while end.n_steps < _MOST_STEPS and not end.is_within(least_move):
        end = solved(problem, *stepped(problem, end), end.n_steps + 1, end.nearby)
    return end


def finished(problem: Problem, end: Settled) -> Settled:
    """With the last step taken, which is known and small; weights stay as they are."""
    return end._replace(estimate=_further(problem, end), n_steps=end.n_steps + 1)


def factored(end: Settled) -> Settled:
    """With the factor of its own equations, that covariances are made of."""
    factor = own_factor(end.seen, end.equations, end.solution)
    return end._replace(solution=end.solution._replace(factor=factor), nearby=factor)


def solved(
    problem: Problem,
    at: Estimate,
    weights: Weights,
    tails: Tails,
    n_steps: int = 0,
    nearby: Factor | None = None,
) -> Settled:
    """The next step from an estimate, and what is known there; `nearby` is of a step before.

    The step is that of Fisher's scoring: the slope of the weighted squares over the information
    that is there in truth, which is less than theirs (`information_share`). So the covariance is of
    the same equations, and steps go as far as weights that follow them will.
    """
    seen, odometry, information, stray_information = problem
    shares = informative(tails, seen.n_dimensions)
    given = weights, stray_information, odometry, information, shares
    equations = normal_equations(seen, at, *given)
    solution = solve(seen, equations, nearby)
    factor = nearby if solution.factor is None else solution.factor
    return Settled(seen, at, weights, tails, n_steps, equations, solution, factor)


def stepped(
    problem: Problem, end: Settled, seen: Sightings | None = None, stretch: float = 1.0
) -> tuple[Estimate, Weights, Tails]:
    """After the next step, and weights that follow it; of the observations `seen` from then on.

    A step that is stretched goes where many more like it would (`stretched`).
    """
    after = problem if seen is None else problem._replace(seen=seen)
    further = _further(problem, end) if stretch == 1 else _moved(end, stretch)
    return followed(after, further, end.weights, end.tails)


def stretched(before: Settled, end: Settled) -> float:
    """How many times as far a step is to go as it says, by the step before it.

    Weights follow where points go, and points weights: in the end steps are of one direction, each
    r times as long as the one before it, and together they lead to where 1 / (1 - r) of the first
    does (Aitken 1926). Of what that is more weights that follow the step itself go a share.
    """
    one, other = before.way_m, end.way_m
    length, along = np.linalg.norm(one), np.vdot(one, other)
    if not along > _ONE_WAY * length * np.linalg.norm(other):
        return 1.0
    r = float(along / length**2)
    return 1 + _FURTHER * r / (1 - r) if r < _LONGEST else 1.0


def followed(
    problem: Problem, at: Estimate, weights: Weights | None = None, tails: Tails = NO_TAILS
) -> tuple[Estimate, Weights, Tails]:
    """Weights and the points that they hold follow each other some way on a path.

    A point whose observations contradict each other is slow to make up its mind, and it costs
    little to let it while the path waits. All weights are ones by default.
    """
    seen, _, _, stray_information = problem
    weights = unweighted(seen) if weights is None else weights
    for _ in range(_FOLLOWING):
        step, known = solve_points(seen, at, weights, stray_information)
        at = Estimate(at.path, at.point_m + step.point_m, at.offset_m + step.offset_m)
        weights, tails = reweighted(seen, at, weights, tails, known, stray_information)
    return at, weights, tails


def _further(problem: Problem, end: Settled) -> Estimate:
    """The step, or as much of it as lowers the cost: half, a quarter, ...

    It is the cost under the weights that the step is of (a generalised M step: Dempster, Laird and
    Rubin 1977). The likelihood of the Student-t's about the *fitted* points has its least
    elsewhere: it would stop steps that weights from expected squares still ask for.
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
    """By a share of the step."""
    at, step = end.estimate, end.solution.step
    further = Estimate(*(old + share * new for old, new in zip(at, step, strict=True)))
    further.path[:, 2] = wrap(further.path[:, 2])
    return further
