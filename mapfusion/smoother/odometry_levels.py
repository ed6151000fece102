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
from mapfusion.smoother.normal_equations import disturbances
from mapfusion.smoother.settle import Problem, Settled

# Disturbances that have to be told before a level is taken from them: a standard deviation is then
# known to a tenth of itself, 1 / sqrt(2 n). Of fewer, covariances would be as uncertain as levels.
LEAST_TOLD = 50.0


def told_odometry_levels(problem: Problem, end: Settled, levels: Float) -> Float:
    """(3,) q of the variances along, across and in the heading.

    Args:
        problem: with the odometry's information as stated.
        end: where steps ended.
        levels: (3,) that the stated variances were multiplied by.
    """
    found = np.sum(disturbances(end.estimate.path, problem.odometry) ** 2 * problem.information, 0)
    untold = disturbance_variances(end) * problem.information / levels
    said = problem.information > 0  # nothing is, of the way from one robot's log to another's
    known = np.sum(np.where(said, np.clip(1 - untold, 0, 1), 0), axis=0)
    return np.where(known < LEAST_TOLD, 1.0, found / np.maximum(known, LEAST_TOLD))
