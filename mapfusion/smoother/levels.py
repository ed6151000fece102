"""Where steps end under the levels of noise that the log itself tells.

Odometry and observations are smoothed with what they state, the levels follow from what was found,
and again, until these change no more.
"""

from typing import NamedTuple

import numpy as np

from mapfusion.se2 import Float
from mapfusion.smoother.normal_equations import Estimate, Weights
from mapfusion.smoother.observation_level import told_observation_level
from mapfusion.smoother.odometry_levels import told_odometry_levels
from mapfusion.smoother.robust import NO_TAILS, Tails, unweighted
from mapfusion.smoother.settle import (
    CONVERGED,
    Problem,
    Settled,
    factored,
    finished,
    solved,
    stepped,
)

# The odometry's levels are told anew until no standard deviation is off by more than this share
# from what it was once before: those of motions that are hardly told may come and go.
_SETTLED = 0.05
# Each time the next step may move the path by so much, in squared sigmas a coordinate.
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
    problem: Problem, at: Estimate, weights: Weights | None = None, tails: Tails = NO_TAILS
) -> tuple[Settled, Levels]:
    """Where steps end under the levels that the log tells, for the rest as `settled`.

    The observations' costs little to tell and follows each step, as the tails do; the odometry's is
    told where steps are close to their end, and they go on from there.
    """
    levels, n_steps, told, known = AS_STATED, 0, [AS_STATED.odometry], False
    under, nearby = problem, None
    weights = unweighted(problem.seen) if weights is None else weights
    while True:
        end = solved(under, at, weights, tails, n_steps, nearby)
        observation = told_observation_level(end, levels.observation)
        follows = _differ(observation, levels.observation) < _FOLLOWED
        if n_steps == _MOST_STEPS or (known and follows and end.is_within(CONVERGED)):
            return finished(under, end), levels
        odometry = levels.odometry
        if not known and end.is_within(_CLOSE):
            end = factored(end)
            odometry = told_odometry_levels(problem, end, odometry)
            known = any(_differ(odometry, each) < 2 * _SETTLED for each in told)
            told.append(odometry)
        levels = Levels(odometry, observation)
        after = _with(problem, levels)
        at, weights, tails = stepped(under, end, after.seen)
        under, n_steps, nearby = after, n_steps + 1, end.nearby


def _differ(levels: Float | float, others: Float | float) -> float:
    """The most that a logarithm of them differs by."""
    return float(np.max(np.abs(np.log(levels / others))))


def _with(problem: Problem, levels: Levels) -> Problem:
    information = problem.information / levels.odometry
    return problem._replace(seen=problem.seen.on_level(levels.observation), information=information)
