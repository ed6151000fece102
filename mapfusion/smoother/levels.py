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
from mapfusion.smoother.robust import NO_TAILS, Tails
from mapfusion.smoother.settle import Problem, Settled, settled

# Rounds end where none of the standard deviations changes by more than this share.
_SETTLED = 0.05
_MOST_ROUNDS = 10
# Until then the next step may move the path by so much, in squared sigmas a coordinate.
_CLOSE = 1e-3


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
    """Where steps end under the levels that the log tells, for the rest as `settled`."""
    levels, n_steps = AS_STATED, 0
    for _ in range(_MOST_ROUNDS):
        end = settled(_with(problem, levels), at, _CLOSE, weights, tails)
        at, weights, tails, n_steps = end.estimate, end.weights, end.tails, n_steps + end.n_steps
        before, levels = levels, _told(problem, end, levels)
        if levels.differ(before) < 2 * _SETTLED:
            break
    end = settled(_with(problem, levels), at, weights=weights, tails=tails)
    return end._replace(n_steps=n_steps + end.n_steps), levels


def _told(problem: Problem, end: Settled, levels: Levels) -> Levels:
    return Levels(
        told_odometry_levels(problem, end, levels.odometry),
        told_observation_level(end, levels.observation),
    )


def _with(problem: Problem, levels: Levels) -> Problem:
    information = problem.information / levels.odometry
    return problem._replace(seen=problem.seen.on_level(levels.observation), information=information)
