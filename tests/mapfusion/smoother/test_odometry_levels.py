"""Levels of the odometry's noise against noise that is known."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from mapfusion.geometry.numerics import Float
from mapfusion.geometry.se2 import compose, rotation
from mapfusion.robot_log import RobotLog
from mapfusion.smoother.noise_estimation import LEAST_DISTURBANCES, Untold, settled_with_levels
from mapfusion.smoother.normal_equations import (
    Estimate,
    first_points,
    information_under,
    least_levels,
    odometry_information,
)
from mapfusion.smoother.optimizer import Problem
from mapfusion.smoother.problem import sightings_of
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


def told_by_themselves(
    rng: np.random.Generator, level: Float, n: int
) -> tuple[Problem, Float, Float]:
    """A problem, and disturbances (n, 3) that were measured each for itself: these, and J."""
    odometry = np.column_stack([0.3 + 0 * np.arange(n + 1), np.zeros((n + 1, 2))])
    stated = rng.uniform(1e-4, 1e-3, (n, 3))
    J = rng.uniform(0.3, 3, (n, 3)) / stated
    measured = rng.standard_normal((n, 3)) * np.sqrt(level * stated + 1 / J)
    log = replace(white_noise_log(rng, n + 1, 1).log, odometry=odometry)
    seen = sightings_of(log, np.full(len(log.observations), -1), 1, stray=False)
    return Problem(seen, odometry, 1 / stated, 0), measured, J


def path_of(odometry: Float, disturbance: Float) -> Float:
    path = np.zeros((len(odometry), 3))
    for k in range(1, len(path)):
        path[k] = compose(path[k - 1], odometry[k] + disturbance[k - 1])
    return path


def test_levels_that_follow_steps_end_where_they_are_likeliest() -> None:
    """Of disturbances that are told each for itself, whatever levels the variances are of."""
    rng, true = np.random.default_rng(0), np.array([0.3, 1.0, 3.0])
    problem, measured, J = told_by_themselves(rng, true, 600)
    v, first = 1 / problem.information, np.array([1.0, 0.5, 1.5])
    untold = Untold(1 / (1 + J * v * first), first)
    levels = first
    for _ in range(100):
        found = measured * (levels * v) / (levels * v + 1 / J)  # means under these levels
        path = path_of(problem.odometry, found)
        levels = untold.told_levels(problem, path, levels)

    def deviance(log_level: float, axis: int) -> float:
        variance = np.exp(log_level) * v[:, axis] + 1 / J[:, axis]
        return float(np.sum(np.log(variance) + measured[:, axis] ** 2 / variance))

    likeliest = [minimize_scalar(deviance, (-2, 2), args=(axis,)).x for axis in range(3)]
    np.testing.assert_allclose(levels, np.exp(likeliest), rtol=1e-4)
    exact = np.sum(1 - 1 / (1 + J * v * levels), axis=0)
    np.testing.assert_allclose(untold.known(levels), exact, rtol=1e-12)


def test_disturbances_that_are_missing_count_as_stated() -> None:
    """An axis that tells one disturbance is by four fifths as stated; one that tells none, wholly.

    The weighted mean is of what that one says and of four at the stated level.
    """
    problem, measured, J = told_by_themselves(np.random.default_rng(1), np.ones(3), 60)
    share = np.clip(1 / (1 + J / problem.information), 0, 1)
    share[:, 1], share[:, 2] = 1 - 1 / 60, 1.0
    disturbance = measured.copy()
    disturbance[:, 1] = np.sqrt(3 / 60 / problem.information[:, 1])  # one disturbance at level 3
    path = path_of(problem.odometry, disturbance)
    untold = Untold(share, np.ones(3))
    levels = untold.told_levels(problem, path, np.ones(3))
    told = untold.known(levels)[1]
    assert levels[1] == pytest.approx(
        (3 * told + (LEAST_DISTURBANCES - told)) / LEAST_DISTURBANCES, rel=1e-4
    )
    assert 1 < levels[1] < 3
    assert levels[2] == 1.0


@pytest.mark.parametrize("n", [20, 200, 2000])
def test_exact_odometry_ends_where_its_noise_could_still_be_told(n: int) -> None:
    """The level falls until `LEAST_TOLD` disturbances are told, and no further; fewer with more."""
    problem, _, J = told_by_themselves(np.random.default_rng(2), np.ones(3), n)
    v, levels = 1 / problem.information, np.ones(3)
    path = path_of(problem.odometry, np.zeros((n, 3)))
    untold = Untold(1 / (1 + J * v), levels)
    for _ in range(50):
        levels = untold.told_levels(problem, path, levels)
    known = np.sum(1 - 1 / (1 + J * v * levels), axis=0)
    np.testing.assert_allclose(known, LEAST_DISTURBANCES * (1 - levels), rtol=1e-3)
    assert np.all(levels < 12 / n)


def test_what_holds_a_robot_is_no_noise_that_a_level_scales() -> None:
    """Where wheels stand still the information is bounded under any level."""
    odometry = np.array([[0, 0, 0], [0.1, 0, 0.1], [0, 0, 0]])
    stated = odometry_information(odometry, NOISE)
    under = information_under(stated, np.full(3, 0.01))
    np.testing.assert_allclose(under[0], 100 * stated[0])
    np.testing.assert_allclose(under[1], stated[1])
    np.testing.assert_allclose(information_under(stated, np.full(3, 4.0)), stated / 4)
    least = least_levels(stated)
    np.testing.assert_allclose(information_under(stated, least), np.tile(stated[1], (2, 1)))
    np.testing.assert_allclose(information_under(stated, 2 * least)[0], stated[1] / 2)
