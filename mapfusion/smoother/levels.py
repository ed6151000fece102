"""Where steps end under the levels of noise that the log itself tells.

Odometry and observations are smoothed with what they state, the levels follow from what was found,
and again, until these change no more.
"""

from typing import NamedTuple

import numpy as np

from mapfusion.se2 import Float
from mapfusion.smoother.normal_equations import Estimate, Weights, information_under
from mapfusion.smoother.observation_level import first_observation_level, told_observation_level
from mapfusion.smoother.odometry_levels import Untold
from mapfusion.smoother.robust import NO_TAILS, Tails, unweighted
from mapfusion.smoother.settle import (
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
from mapfusion.smoother.sightings import Sightings

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
