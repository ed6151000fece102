"""Levels of the odometry's noise against noise that is known."""

from dataclasses import replace

import numpy as np

from mapfusion.robot_log import RobotLog
from mapfusion.se2 import Float, rotation
from mapfusion.smoother.levels import settled_with_levels
from mapfusion.smoother.normal_equations import Estimate, odometry_information
from mapfusion.smoother.residuals import first_points
from mapfusion.smoother.settle import Problem
from mapfusion.smoother.sightings import sightings_of
from tests.mapfusion.smoother.white_noise_logs import NOISE, Known, dead_reckoned, white_noise_log

SEEN_M = 0.0003  # a fifth of what a step's odometry errs by across the motion
STATED = np.array([3.0, 3.0, 0.5])  # how far stated deviations are from the true ones


def seen_well(known: Known, rng: np.random.Generator) -> RobotLog:
    """The log with observations that err by `SEEN_M`."""
    log, seen = known.log, known.log.observations
    assert seen.label is not None
    pose, at = known.path[log.iteration], known.point_m[seen.label].copy()
    at[:, :2] = np.einsum("nji,nj->ni", rotation(pose[:, 2]), at[:, :2] - pose[:, :2])
    position = at + SEEN_M * rng.standard_normal(at.shape)
    covariance = np.tile(SEEN_M**2 * np.eye(3), (len(at), 1, 1))
    return replace(log, observations=replace(seen, position_m=position, covariance_m2=covariance))


def levels_of(log: RobotLog) -> Float:
    label, path = log.observations.label, dead_reckoned(log)
    assert label is not None
    seen = sightings_of(log, label, 1, stray=False)
    information = odometry_information(log.odometry, NOISE) / STATED**2
    at = Estimate(path, first_points(seen, path), np.zeros((len(seen.strays), 3)))
    return settled_with_levels(Problem(seen, log.odometry, information, 0), at)[1].odometry


def test_levels_are_those_of_the_noise() -> None:
    """Pooled over logs, to the error of a variance of so many disturbances."""
    found = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        found.append(levels_of(seen_well(white_noise_log(rng, 80, 30), rng)) * STATED**2)
    assert np.all(np.abs(np.log(np.mean(found, axis=0))) < 0.25)  # 3 sigmas of 300 told


def test_a_log_that_tells_nothing_stays_as_stated() -> None:
    """Landmarks seen once each: whatever the odometry did, nothing contradicts it."""
    rng = np.random.default_rng(1)
    log = seen_well(white_noise_log(rng, 80, 40), rng)
    label = np.arange(len(log.observations), dtype=np.int32)
    log = replace(log, observations=replace(log.observations, label=label))
    np.testing.assert_allclose(levels_of(log), 1.0)
