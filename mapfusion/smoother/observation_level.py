"""How far off a log's observations are beside what they state, along their tracks.

A sensor states its errors for any texture and any distance, and with what lasts while a track does.
What lasts is in the tracks' offsets here; the rest differs from one sighting to the next, and the
log tells how much it is. Of squared Mahalanobis distances s of the observations from where they
should be, each of n coordinates, with the weights w that gross ones lose, the level q is

    q = sum of w s / sum of (n - c),

c what of an observation's coordinates went into its track's point: the same that tells the levels
of the odometry (MacKay 1992; `odometry_levels.py`). Without tracks nobody can tell what lasts from
what does not, and what is stated holds.
"""

import numpy as np

from mapfusion.se2 import Float
from mapfusion.smoother.elimination import solve_points
from mapfusion.smoother.normal_equations import Estimate, Weights
from mapfusion.smoother.residuals import squared_distances, squares_of_points
from mapfusion.smoother.robust import Tails
from mapfusion.smoother.settle import Problem, Settled
from mapfusion.smoother.sightings import Sightings
from mapfusion.smoother.student import fitted_dof, student_weights

# Coordinates that have to be told before a level is taken from them: a standard deviation is then
# known to a tenth of itself, 1 / sqrt(2 n).
LEAST_TOLD = 50.0
# Observations that agree to the last digit, as simulated without noise, have a level of zero. None
# is taken to be closer, in m, than this: a tenth of what holds a robot that stands still.
_LEAST_M = 1e-5


def told_observation_level(end: Settled, level: float) -> float:
    """The level q of the stated covariances of observations on tracks that stray.

    What is gross is so beside what is stated, or found if that is more: tails that are fitted on
    ever smaller levels grow heavier with each, and call gross what any sensor does at times.

    Args:
        end: where steps ended.
        level: that the stated covariances were multiplied by.

    Returns:
        q; 1 where fewer than `LEAST_TOLD` coordinates are told.
    """
    return _level(end.seen, end.estimate, end.weights, end.tails, end.solution.track_m2, level)


def first_observation_level(
    problem: Problem, at: Estimate, weights: Weights, tails: Tails
) -> float:
    """The level q of what is stated, before any step from an estimate."""
    _, known = solve_points(problem.seen, at, weights, problem.stray_information)
    return _level(problem.seen, at, weights, tails, known.track_m2, 1.0)


def _level(
    seen: Sightings, at: Estimate, weights: Weights, tails: Tails, track_m2: Float, level: float
) -> float:
    n, rows = seen.n_dimensions, seen.strays[seen.track]
    if not rows.any():
        return 1.0
    square = squared_distances(seen, at)[rows]
    of_point = squares_of_points(seen, at.path, track_m2)[rows]
    known = np.sum(n - np.minimum(weights.observation[rows] * of_point, n))
    if known < LEAST_TOLD:
        return 1.0
    beside = min(level, 1.0) * (square + of_point)
    found = student_weights(beside, fitted_dof(beside, n, tails.observation), n)
    stated = np.median(np.trace(seen.information[rows], axis1=1, axis2=2)) * level / n
    least = min(_LEAST_M**2 * stated, 1.0)
    return max(float(level * np.sum(found * square) / known), least)
