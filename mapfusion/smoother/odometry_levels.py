"""How far off a log's odometry is beside what it states: along, across and in the heading.

What is stated of an odometry has to hold for any floor and any turn; on one drive wheels may slip
sideways by a fifth of it. Where a robot saw little the path is as sure as its odometry, and so are
maps that are laid over each other by what was seen at the two ends. With the disturbances' means d
and variances C given all observations, and v as stated, the variances are v_j q_j along axis j:

    sum of d^2 / v_j = q_j sum of (1 - C / (v_j q_j)),

the level q_j under which what was smoothed is most likely (MacKay 1992; `noise_levels.py`).

The variances C take a factor of the poses' information and its inverse, the means d nothing. So
levels follow each step with C as it was told once, or nearly: of a disturbance that observations
tell with information J whatever the others are, the share C / v that is left untold is

    u = 1 / (1 + J v q),    so that under other levels    1 / u - 1    is as many times as much.
"""

from typing import NamedTuple

import numpy as np
from scipy.optimize import root_scalar

from mapfusion.se2 import Float
from mapfusion.smoother.motion_posterior import disturbance_variances
from mapfusion.smoother.noise_levels import LEAST_TOLD
from mapfusion.smoother.normal_equations import disturbances, information_under, least_levels
from mapfusion.smoother.settle import Problem, Settled

_NONE_TOLD = 1e-9  # disturbances; fewer are none, but for rounding
_LEVEL_TO = 1e-6  # share of itself that a level is solved to, far below its own error


class Untold(NamedTuple):
    """What observations leave open of disturbances, under some levels.

    Attributes:
        share: (T - 1, 3) of their variances; 1 where nothing is said of them.
        levels: (3,) that the stated variances were multiplied by.
    """

    share: Float
    levels: Float

    @classmethod
    def of(cls, problem: Problem, end: Settled, levels: Float) -> "Untold":
        """Where steps ended under these levels, those of the problem being as stated."""
        information = information_under(problem.information, levels)
        share = np.clip(disturbance_variances(end) * information, 0, 1)
        # nothing is said of the way from one robot's log to another's
        return cls(np.where(problem.information > 0, share, 1.0), levels)

    def known(self, levels: Float) -> Float:
        """Return how many disturbances (3,) are told under other levels, by each axis."""
        return np.array([self._known(axis, level) for axis, level in enumerate(levels)])

    def _known(self, axis: int, level: float) -> float:
        share, more = self.share[:, axis], level / self.levels[axis]
        return float(np.sum(1 - share / (share + (1 - share) * more)))

    def told_levels(self, problem: Problem, path: Float, levels: Float) -> Float:
        """Return the levels (3,) of the variances along, across and in the heading.

        Where fewer than `LEAST_TOLD` disturbances are told, those missing count as found at the
        stated variance, as under a scaled inverse chi-square prior. So a level is as stated where
        nothing is told. It cannot fall below the level at which the noise of `LEAST_TOLD`
        disturbances can still be told from none, which bounds the odometry's information.

        Args:
            problem: with the odometry's information as stated.
            path: (T, 3) as it was found.
            levels: (3,) under which it was found.
        """
        found = np.sum(disturbances(path, problem.odometry) ** 2 * problem.information, axis=0)
        told = found / np.maximum(self.known(levels), _NONE_TOLD)
        told = np.maximum(told, least_levels(problem.information))
        return np.array([self._with_missing(axis, level) for axis, level in enumerate(told)])

    def _with_missing(self, axis: int, told: float) -> float:
        """Return the level q of an axis where what is told says `told`.

        q (known(q) + missing(q)) = told known(q) + missing(q) has its root between `told` and 1.
        It is solved for q on both sides: to repeat q = f(q) would end in a cycle of two levels.
        """

        def excess(level: float) -> float:
            known = self._known(axis, level)
            missing = max(LEAST_TOLD - known, 0.0)
            return (told - level) * known + (1 - level) * missing

        at_told = excess(told)
        if at_told == 0 or told == 1:
            return told
        found = root_scalar(excess, bracket=(told, 1.0), method="brentq", rtol=_LEVEL_TO)
        return float(found.root)
