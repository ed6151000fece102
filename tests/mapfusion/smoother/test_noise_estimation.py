"""Tests of `mapfusion.smoother.noise_estimation`."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from mapfusion.geometry.numerics import Float
from mapfusion.geometry.se2 import compose, rotation
from mapfusion.robot_log import RobotLog
from mapfusion.smoother import noise_estimation
from mapfusion.smoother.elimination import pose_covariances, solve_points
from mapfusion.smoother.noise_estimation import (
    _LEAST_M,
    LEAST_DISTURBANCES,
    NoiseScales,
    PosteriorShares,
    optimize_with_noise,
)
from mapfusion.smoother.normal_equations import (
    Estimate,
    expected_point_squares,
    initial_landmarks,
    odometry_information,
    scaled_information,
    smallest_scales,
    squared_distances,
)
from mapfusion.smoother.optimizer import OptimizerState, Problem, update_points_and_weights
from mapfusion.smoother.problem import order_observations
from mapfusion.smoother.robust_loss import GAUSSIAN_TAILS, fit_dof, student_weights, unit_weights
from tests.mapfusion.smoother.white_noise_logs import (
    NOISE,
    Known,
    dead_reckoned,
    moved_tracks,
    white_noise_log,
    with_tracks,
)

STRAY_M = 0.05


def settled_from(
    log: RobotLog, path: Float, stray_m: float = STRAY_M
) -> tuple[OptimizerState, NoiseScales]:
    label = log.observations.label
    assert label is not None
    obs = order_observations(log, label, 1, with_offsets=True)
    information = odometry_information(log.odometry, NOISE)
    at = Estimate(path, initial_landmarks(obs, path), np.zeros((len(obs.has_offset), 3)))
    problem = Problem(obs, log.odometry, information, stray_m**-2)
    return optimize_with_noise(problem, at)


def level_of(log: RobotLog, stray_m: float = STRAY_M) -> float:
    return settled_from(log, dead_reckoned(log), stray_m)[1].observation


def stated(log: RobotLog, factor: float) -> RobotLog:
    """The log with covariances that are so many times the true ones."""
    obs = log.observations
    return replace(log, observations=replace(obs, covariance_m2=factor * obs.covariance_m2))


def tracked_log(seed: int) -> RobotLog:
    rng = np.random.default_rng(seed)
    return with_tracks(white_noise_log(rng, 120, 40), rng, STRAY_M).log


@pytest.mark.parametrize("factor", [0.3, 1.0, 4.0])
def test_the_level_is_that_of_the_noise(factor: float) -> None:
    """To 3 standard deviations of a variance of the 2500 coordinates that three logs tell."""
    found = [level_of(stated(tracked_log(seed), factor)) for seed in range(3)]
    assert np.mean(found) * factor == pytest.approx(1, abs=3 * np.sqrt(2 / 2500))


def test_what_lasts_along_a_track_is_not_in_it() -> None:
    """However far tracks lie from their landmarks: the level is of what differs along them."""
    rng = np.random.default_rng(1)
    known = with_tracks(white_noise_log(rng, 120, 40), rng, STRAY_M)
    track = known.log.observations.track
    assert track is not None
    far = moved_tracks(known, rng, np.arange(track.max() + 1), 0.3)
    assert level_of(far, 0.3) == pytest.approx(level_of(known.log), rel=0.05)


def test_gross_observations_are_not_in_it() -> None:
    log, rng = tracked_log(2), np.random.default_rng(0)
    wrong = log.observations.position_m.copy()
    rows = rng.choice(len(wrong), len(wrong) // 50, replace=False)
    wrong[rows, :2] += rng.uniform(1, 3, (len(rows), 2))
    gross = replace(log, observations=replace(log.observations, position_m=wrong))
    assert level_of(gross) == pytest.approx(level_of(log), rel=0.3)


def test_without_tracks_what_is_stated_holds() -> None:
    log = stated(tracked_log(3), 4.0)
    obs = replace(log.observations, track=None)
    assert level_of(replace(log, observations=obs)) == 1.0


def test_a_log_that_tells_nothing_stays_as_stated() -> None:
    """Each track is of one observation: nothing is there to differ along it."""
    log = stated(tracked_log(4), 4.0)
    alone = np.arange(len(log.observations), dtype=np.int32)
    obs = replace(log.observations, track=alone, label=alone)
    assert level_of(replace(log, observations=obs)) == 1.0


def test_steps_end_where_more_of_them_would(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wherever they begin: levels to less than their errors, poses to a fiftieth of theirs."""
    log = stated(tracked_log(0), 4.0)
    reckoned = dead_reckoned(log)
    found, told = settled_from(log, reckoned)
    for name, value in (("CONVERGED", 1e-12), ("_SETTLED", 1e-6)):
        monkeypatch.setattr(noise_estimation, name, value)
    monkeypatch.setattr(noise_estimation, "_FOLLOWED", 1e-8)
    end, at_end = settled_from(log, reckoned)
    monkeypatch.undo()
    again, told_again = settled_from(log, end.estimate.path)
    covariance = pose_covariances(end.obs, end.equations, end.solution)[1:]
    sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    for each, its in ((found, told), (again, told_again)):
        assert its.observation == pytest.approx(at_end.observation, rel=3e-3)
        np.testing.assert_allclose(its.odometry, at_end.odometry, rtol=0.1)
        off = (each.estimate.path - end.estimate.path)[1:] / sigma
        assert np.sqrt(np.mean(off**2)) < 0.02
        assert each.n_steps < end.n_steps


@pytest.mark.parametrize("factor", [1.0, 4.0])
def test_the_level_is_known_before_the_first_step(factor: float) -> None:
    """From the points that observations tell along a path that is right."""
    log = stated(tracked_log(0), factor)
    end, _ = settled_from(log, dead_reckoned(log))
    problem = Problem(
        order_observations(log, log.observations.label, 1, with_offsets=True),
        log.odometry,
        odometry_information(log.odometry, NOISE),
        STRAY_M**-2,
    )
    at, weights, tails = update_points_and_weights(problem, end.estimate)
    first = noise_estimation.initial_observation_scale(problem, at, weights, tails)
    assert first * factor == pytest.approx(1, abs=0.15)


def test_what_weights_leave_of_a_track_tells_its_point() -> None:
    """A track told by itself takes as many coordinates as it has, whatever its weights are.

    Its offset is so loose that its own observations alone tell its point: their squares' expected
    excess, sum of w tr(W C) with C = (sum of w W)^-1, is the number of dimensions.
    """
    log = tracked_log(5)
    label, loose_m = log.observations.label, 1e4
    assert label is not None
    obs = order_observations(log, label, 1, with_offsets=True)
    problem = Problem(obs, log.odometry, odometry_information(log.odometry, NOISE), loose_m**-2)
    path = dead_reckoned(log)
    at = Estimate(path, initial_landmarks(obs, path), np.zeros((len(obs.has_offset), 3)))
    weights = unit_weights(obs)
    weights.observation[::2] = 0.1
    found = noise_estimation.initial_observation_scale(problem, at, weights, GAUSSIAN_TAILS)
    rows = obs.has_offset[obs.track]
    known = obs.n_dimensions * (rows.sum() - obs.has_offset.sum())
    _, points = solve_points(obs, at, weights, problem.offset_prior)
    square = squared_distances(obs, at)[rows]
    beside = square + expected_point_squares(obs, path, points.track_m2)[rows]
    own = student_weights(beside, fit_dof(beside, obs.n_dimensions), obs.n_dimensions)
    assert found == pytest.approx(np.sum(own * square) / known, rel=1e-3)


def test_observations_without_noise_have_a_level_that_is_not_zero() -> None:
    """Simulated to the last digit: the level stays where an observation errs by `_LEAST_M`."""
    rng = np.random.default_rng(6)
    known = with_tracks(white_noise_log(rng, 60, 30), rng, 0.0)
    log = known.log
    assert log.observations.label is not None
    pose = known.path[log.iteration]
    exact = known.point_m[log.observations.label]
    exact[:, :2] = np.einsum("nji,nj->ni", rotation(pose[:, 2]), exact[:, :2] - pose[:, :2])
    one = np.tile(0.01**2 * np.eye(3), (len(exact), 1, 1))
    obs = replace(log.observations, position_m=exact, covariance_m2=one)
    end, told = settled_from(replace(log, observations=obs), known.path)
    assert told.observation == pytest.approx((_LEAST_M / 0.01) ** 2)
    assert np.isfinite(end.solution.own_m2).all()


SEEN_M = 0.0003  # a fifth of what a step's odometry errs by across the motion
STATED = np.array([3.0, 3.0, 0.5])  # how far stated deviations are from the true ones


def seen_well(known: Known, rng: np.random.Generator) -> RobotLog:
    """The log with observations that err by `SEEN_M`."""
    log, obs = known.log, known.log.observations
    assert obs.label is not None
    pose, at = known.path[log.iteration], known.point_m[obs.label].copy()
    at[:, :2] = np.einsum("nji,nj->ni", rotation(pose[:, 2]), at[:, :2] - pose[:, :2])
    position = at + SEEN_M * rng.standard_normal(at.shape)
    covariance = np.tile(SEEN_M**2 * np.eye(3), (len(at), 1, 1))
    return replace(log, observations=replace(obs, position_m=position, covariance_m2=covariance))


def levels_of(log: RobotLog) -> Float:
    label, path = log.observations.label, dead_reckoned(log)
    assert label is not None
    obs = order_observations(log, label, 1, with_offsets=False)
    information = odometry_information(log.odometry, NOISE) / STATED**2
    at = Estimate(path, initial_landmarks(obs, path), np.zeros((len(obs.has_offset), 3)))
    return optimize_with_noise(Problem(obs, log.odometry, information, 0), at)[1].odometry


def test_levels_are_those_of_the_noise() -> None:
    """Pooled over logs, to the error of a variance of so many disturbances."""
    found = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        found.append(levels_of(seen_well(white_noise_log(rng, 80, 30), rng)) * STATED**2)
    assert np.all(np.abs(np.log(np.mean(found, axis=0))) < 0.25)  # 3 sigmas of 300 told


def test_a_log_that_tells_nothing_stays_as_stated_odometry_levels() -> None:
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
    obs = order_observations(log, np.full(len(log.observations), -1), 1, with_offsets=False)
    return Problem(obs, odometry, 1 / stated, 0), measured, J


def path_of(odometry: Float, disturbance: Float) -> Float:
    path = np.zeros((len(odometry), 3))
    for k in range(1, len(path)):
        path[k] = compose(path[k - 1], odometry[k] + disturbance[k - 1])
    return path


def test_levels_that_follow_steps_end_where_they_are_likeliest() -> None:
    """Independent disturbances give their true noise scales, whatever the initial variances."""
    rng, true = np.random.default_rng(0), np.array([0.3, 1.0, 3.0])
    problem, measured, J = told_by_themselves(rng, true, 600)
    v, first = 1 / problem.information, np.array([1.0, 0.5, 1.5])
    untold = PosteriorShares(1 / (1 + J * v * first), first)
    levels = first
    for _ in range(100):
        found = measured * (levels * v) / (levels * v + 1 / J)  # means under these levels
        path = path_of(problem.odometry, found)
        levels = untold.estimate_scales(problem, path, levels)

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
    untold = PosteriorShares(share, np.ones(3))
    levels = untold.estimate_scales(problem, path, np.ones(3))
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
    untold = PosteriorShares(1 / (1 + J * v), levels)
    for _ in range(50):
        levels = untold.estimate_scales(problem, path, levels)
    known = np.sum(1 - 1 / (1 + J * v * levels), axis=0)
    np.testing.assert_allclose(known, LEAST_DISTURBANCES * (1 - levels), rtol=1e-3)
    assert np.all(levels < 12 / n)


def test_what_holds_a_robot_is_no_noise_that_a_level_scales() -> None:
    """The information of a standing robot is bounded at every noise scale."""
    odometry = np.array([[0, 0, 0], [0.1, 0, 0.1], [0, 0, 0]])
    stated = odometry_information(odometry, NOISE)
    under = scaled_information(stated, np.full(3, 0.01))
    np.testing.assert_allclose(under[0], 100 * stated[0])
    np.testing.assert_allclose(under[1], stated[1])
    np.testing.assert_allclose(scaled_information(stated, np.full(3, 4.0)), stated / 4)
    least = smallest_scales(stated)
    np.testing.assert_allclose(scaled_information(stated, least), np.tile(stated[1], (2, 1)))
    np.testing.assert_allclose(scaled_information(stated, 2 * least)[0], stated[1] / 2)
