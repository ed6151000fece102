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
from mapfusion.smoother.settle import CONVERGED, Problem, Settled, finished, solved, stepped

# The odometry's levels are told anew until no standard deviation changes by more than this share,
# but no more often than so many times: of motions that are hardly told they may come and go.
_SETTLED, _MOST_TOLD = 0.05, 4
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

    def differ(self, other: "Levels") -> float:
        """The most that a logarithm of them differs by."""
        ratio = np.append(self.odometry / other.odometry, self.observation / other.observation)
        return float(np.abs(np.log(ratio)).max())


AS_STATED = Levels(np.ones(3), 1.0)


def settled_with_levels(
    problem: Problem, at: Estimate, weights: Weights | None = None, tails: Tails = NO_TAILS
) -> tuple[Settled, Levels]:
    """Where steps end under the levels that the log tells, for the rest as `settled`.

    The observations' costs little to tell and follows each step, as the tails do; the odometry's is
    told where steps are close to their end, and they go on from there.
    """
    levels, n_steps, n_told, known = AS_STATED, 0, 0, False
    weights = unweighted(problem.seen) if weights is None else weights
    while True:
        under = _with(problem, levels)
        end = solved(under, at, weights, tails, n_steps)
        further = levels._replace(observation=told_observation_level(end, levels.observation))
        ends = known and end.is_within(CONVERGED) and further.differ(levels) < _FOLLOWED
        if ends or n_steps == _MOST_STEPS:
            return finished(under, end), levels
        if not known and end.is_within(_CLOSE):
            odometry, n_told = told_odometry_levels(problem, end, levels.odometry), n_told + 1
            further = further._replace(odometry=odometry)
            known = further.differ(levels) < 2 * _SETTLED or n_told == _MOST_TOLD
        levels = further
        at, weights, tails = stepped(under, end, _with(problem, levels).seen)
        n_steps += 1


def _with(problem: Problem, levels: Levels) -> Problem:
    information = problem.information / levels.odometry
    return problem._replace(seen=problem.seen.on_level(levels.observation), information=information)
