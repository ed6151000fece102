"""How far off a log's odometry is beside what it states: along, across and in the heading.

What is stated of an odometry has to hold for any floor and any turn; on one drive wheels may slip
sideways by a fifth of it. Where a robot saw little the path is as sure as its odometry, and so are
maps that are laid over each other by what was seen at the two ends. With the disturbances' means d
and variances C given all observations, and v as stated, the variances are v_j q_j along axis j:

    sum of d^2 / v_j = q_j sum of (1 - C / (v_j q_j)),

the level q_j under which what was smoothed is most likely (MacKay 1992; `noise_levels.py`).
"""

import numpy as np

from mapfusion.se2 import Float
from mapfusion.smoother.motion_posterior import disturbance_variances
from mapfusion.smoother.normal_equations import Estimate, Weights, disturbances
from mapfusion.smoother.robust import NO_TAILS, Tails
from mapfusion.smoother.settle import Problem, Settled, settled

# What is stated counts as so many disturbances that are told: a log that tells of fewer, or of
# none, stays near it. As many as a level needs to be told to a third of itself.
_STATED = 5.0
# Rounds end where none of the standard deviations changes by more than this share.
_SETTLED = 0.05
_MOST_ROUNDS = 5


def settled_with_levels(
    problem: Problem, at: Estimate, weights: Weights | None = None, tails: Tails = NO_TAILS
) -> Settled:
    """Where steps end under the levels that the observations tell; for the rest as `settled`."""
    end, levels = settled(problem, at, weights=weights, tails=tails), np.ones(3)
    for _ in range(_MOST_ROUNDS):
        before, levels = levels, told_levels(problem, end, levels)
        if np.abs(np.log(levels / before)).max() < 2 * _SETTLED:
            break
        n_steps, now = end.n_steps, problem._replace(information=problem.information / levels)
        end = settled(now, end.estimate, weights=end.weights, tails=end.tails)
        end = end._replace(n_steps=n_steps + end.n_steps)
    return end


def told_levels(problem: Problem, end: Settled, levels: Float) -> Float:
    """(3,) q of the variances along, across and in the heading.

    Args:
        problem: with the odometry's information as stated.
        end: where steps ended with these variances times `levels` (3,).
    """
    found = np.sum(disturbances(end.estimate.path, problem.odometry) ** 2 * problem.information, 0)
    untold = disturbance_variances(end) * problem.information / levels
    return (found + _STATED) / (np.sum(np.clip(1 - untold, 0, 1), axis=0) + _STATED)
