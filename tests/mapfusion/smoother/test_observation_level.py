"""The level of the observations' noise against noise that is known."""

from dataclasses import replace

import numpy as np
import pytest

from mapfusion.geometry.numerics import Float
from mapfusion.geometry.se2 import rotation
from mapfusion.robot_log import RobotLog
from mapfusion.smoother import noise_estimation
from mapfusion.smoother.elimination import pose_covariances, solve_points
from mapfusion.smoother.noise_estimation import _LEAST_M, Levels, settled_with_levels
from mapfusion.smoother.normal_equations import (
    Estimate,
    first_points,
    odometry_information,
    squared_distances,
    squares_of_points,
)
from mapfusion.smoother.optimizer import Problem, Settled, followed
from mapfusion.smoother.problem import sightings_of
from mapfusion.smoother.robust_loss import NO_TAILS, fitted_dof, student_weights, unweighted
from tests.mapfusion.smoother.white_noise_logs import (
    NOISE,
    dead_reckoned,
    moved_tracks,
    white_noise_log,
    with_tracks,
)

STRAY_M = 0.05


def settled_from(log: RobotLog, path: Float, stray_m: float = STRAY_M) -> tuple[Settled, Levels]:
    label = log.observations.label
    assert label is not None
    seen = sightings_of(log, label, 1, stray=True)
    information = odometry_information(log.odometry, NOISE)
    at = Estimate(path, first_points(seen, path), np.zeros((len(seen.strays), 3)))
    problem = Problem(seen, log.odometry, information, stray_m**-2)
    return settled_with_levels(problem, at)


def level_of(log: RobotLog, stray_m: float = STRAY_M) -> float:
    return settled_from(log, dead_reckoned(log), stray_m)[1].observation


def stated(log: RobotLog, factor: float) -> RobotLog:
    """The log with covariances that are so many times the true ones."""
    seen = log.observations
    return replace(log, observations=replace(seen, covariance_m2=factor * seen.covariance_m2))


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
    seen = replace(log.observations, track=None)
    assert level_of(replace(log, observations=seen)) == 1.0


def test_a_log_that_tells_nothing_stays_as_stated() -> None:
    """Each track is of one observation: nothing is there to differ along it."""
    log = stated(tracked_log(4), 4.0)
    alone = np.arange(len(log.observations), dtype=np.int32)
    seen = replace(log.observations, track=alone, label=alone)
    assert level_of(replace(log, observations=seen)) == 1.0


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
    frames = np.arange(1, len(log))
    covariance = pose_covariances(end.seen, end.equations, end.solution, frames)
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
        sightings_of(log, log.observations.label, 1, stray=True),
        log.odometry,
        odometry_information(log.odometry, NOISE),
        STRAY_M**-2,
    )
    at, weights, tails = followed(problem, end.estimate)
    first = noise_estimation.first_observation_level(problem, at, weights, tails)
    assert first * factor == pytest.approx(1, abs=0.15)


def test_what_weights_leave_of_a_track_tells_its_point() -> None:
    """A track told by itself takes as many coordinates as it has, whatever its weights are.

    Its offset is so loose that its own observations alone tell its point: their squares' expected
    excess, sum of w tr(W C) with C = (sum of w W)^-1, is the number of dimensions.
    """
    log = tracked_log(5)
    label, loose_m = log.observations.label, 1e4
    assert label is not None
    seen = sightings_of(log, label, 1, stray=True)
    problem = Problem(seen, log.odometry, odometry_information(log.odometry, NOISE), loose_m**-2)
    path = dead_reckoned(log)
    at = Estimate(path, first_points(seen, path), np.zeros((len(seen.strays), 3)))
    weights = unweighted(seen)
    weights.observation[::2] = 0.1
    found = noise_estimation.first_observation_level(problem, at, weights, NO_TAILS)
    rows = seen.strays[seen.track]
    known = seen.n_dimensions * (rows.sum() - seen.strays.sum())
    _, points = solve_points(seen, at, weights, problem.stray_information)
    square = squared_distances(seen, at)[rows]
    beside = square + squares_of_points(seen, path, points.track_m2)[rows]
    own = student_weights(beside, fitted_dof(beside, seen.n_dimensions), seen.n_dimensions)
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
    seen = replace(log.observations, position_m=exact, covariance_m2=one)
    end, told = settled_from(replace(log, observations=seen), known.path)
    assert told.observation == pytest.approx((_LEAST_M / 0.01) ** 2)
    assert np.isfinite(end.solution.own_m2).all()
