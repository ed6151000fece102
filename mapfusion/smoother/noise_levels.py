"""The levels of odometry noise under which what was smoothed is most likely.

The variance of a disturbance is a sum of levels, each times what the robot moved by: v = sum q_j
a_j. With the disturbances' means d and variances C given all observations, a level is right where

    sum of s_j d^2 / v = sum of s_j (1 - C / v),      s_j = q_j a_j / v,

the share of it in v: what is found, squared and in sigmas, is as much as the observations can tell.
The right side counts the disturbances that they do tell. Each round multiplies a level by the ratio
of the two (MacKay 1992, "Bayesian interpolation"), which ends where the marginal
likelihood is stationary, in far fewer rounds than EM.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from mapfusion.fastslam.motion import MotionNoise
from mapfusion.se2 import Float
from mapfusion.smoother.motion_posterior import MotionPosterior

LEVELS = ("translation_m_per_sqrt_m", "rotation_rad_per_sqrt_m", "rotation_rad_per_sqrt_rad")
# A round changes a level's square by no more than this: far off, the counts say too little.
_MOST_CHANGE = 4.0
# Below, a level is nothing to the filter, and its share can no longer be told from none.
_LEAST_LEVEL = 1e-4
# Disturbances that have to be told before a level is: of fewer its relative error is above 0.3.
LEAST_TOLD = 5.0


class Told(NamedTuple):
    """What a smoothed log tells of the levels, in the order of `LEVELS`.

    Attributes:
        found: (3,) left sides: squares, in sigmas.
        known: (3,) right sides: disturbances that the observations tell.
        information: (3, 3) of the levels' logarithms: of each disturbance, 2 k^2 s_i s_j with the
            share k = 1 - C / v of it that the observations tell.
    """

    found: Float
    known: Float
    information: Float


def pooled(of_each: Sequence[Told]) -> Told:
    """What several logs tell together."""
    return Told(*(np.sum(np.stack(values), axis=0) for values in zip(*of_each, strict=True)))


def plain(motion: MotionNoise) -> MotionNoise:
    """Random walks alone, alike along and across: systematic errors are estimated, not covered."""
    across = motion.translation_m_per_sqrt_m
    return replace(
        motion,
        scale_error=0,
        track_error=0,
        lateral_m_per_sqrt_m=across,
        lateral_slip_m_per_rad=0,
    )


def told(
    posterior: MotionPosterior, odometry: Float, information: Float, motion: MotionNoise
) -> Told:
    """What the disturbances of a log tell.

    Args:
        posterior: the disturbances.
        odometry: (T, 3) increments.
        information: (T - 1, 3) that they were smoothed with.
        motion: the levels that it came from.
    """
    distance, angle = np.hypot(odometry[1:, 0], odometry[1:, 1]), np.abs(odometry[1:, 2])
    amounts = np.stack([distance, distance, angle], axis=1)
    parts = amounts * np.array([getattr(motion, name) for name in LEVELS]) ** 2
    squares, tells, information_of = np.zeros(3), np.zeros(3), np.zeros((3, 3))
    found = posterior.mean**2 * information
    known = np.clip(1 - posterior.variance * information, 0, 1)
    for levels, axes in ((slice(0, 1), (0, 1)), (slice(1, 3), (2,))):
        for axis in axes:
            share = parts[:, levels] * information[:, axis, None]
            squares[levels] += share.T @ found[:, axis]
            tells[levels] += share.T @ known[:, axis]
            weighted = known[:, axis, None] * share
            information_of[levels, levels] += 2 * weighted.T @ weighted
    return Told(squares, tells, information_of)


def updated(motion: MotionNoise, of_all: Told) -> MotionNoise:
    """The levels after a round; those that nothing is told about stay as they are."""
    levels = {}
    for name, found, known in zip(LEVELS, of_all.found, of_all.known, strict=True):
        before, ratio = getattr(motion, name), found / max(known, LEAST_TOLD)
        factor = np.sqrt(np.clip(ratio, 1 / _MOST_CHANGE, _MOST_CHANGE))
        levels[name] = max(float(before * factor), _LEAST_LEVEL) if known >= LEAST_TOLD else before
    across = levels["translation_m_per_sqrt_m"]
    return replace(motion, **levels, lateral_m_per_sqrt_m=across)


def relative_errors(of_all: Told) -> Float:
    """(3,) standard errors of the levels, as shares of them; 1 of what nothing is told about."""
    return np.sqrt(np.diag(np.linalg.inv(of_all.information + np.eye(3))))
