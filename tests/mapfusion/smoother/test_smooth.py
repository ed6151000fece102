"""The smoother against known laws of error, loops, gross errors and false tracks."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from mapfusion.geometry.numerics import Float
from mapfusion.robot_log import RobotLog
from mapfusion.smoother.normal_equations import Estimate, initial_landmarks
from mapfusion.smoother.optimizer import OptimizerState, Problem, optimize
from mapfusion.smoother.problem import order_observations
from mapfusion.smoother.smooth import Smoothed, SmootherParameters, smooth
from tests.mapfusion.smoother.white_noise_logs import (
    Known,
    dead_reckoned,
    moved_tracks,
    scattered,
    white_noise_log,
    with_tracks,
)

STRAY_M = 0.05
GAUGE = 3  # rigid motions of the plane, in which a relative map is not known


def smoothed(log: RobotLog, stray_m: float = STRAY_M) -> Smoothed:
    assert log.observations.label is not None
    parameters = SmootherParameters(stray_m=stray_m)
    return smooth(log, log.observations.label, dead_reckoned(log), parameters)


def true_points(known: Known, found: Smoothed) -> Float:
    label = known.log.observations.label
    assert label is not None
    return known.point_m[label[found.obs.row[found.obs.starts[:-1]]]]


def without_gauge(found: Smoothed, error: Float) -> tuple[Float, Float]:
    """Error (3L,) and covariance, rigid motions of the plane projected out: I - J(J'J)^-1 J'."""
    n = len(error) // 3
    J = np.zeros((3 * n, 3))
    J[0::3, 0] = J[1::3, 1] = 1.0
    J[0::3, 2], J[1::3, 2] = -found.estimate.point_m[:, 1], found.estimate.point_m[:, 0]
    P = np.eye(3 * n) - J @ np.linalg.solve(J.T @ J, J.T)
    return P @ error, P @ found.joint_covariance() @ P


@pytest.mark.parametrize("tracks", [False, True])
def test_errors_obey_the_joint_covariance(tracks: bool) -> None:
    """The squared distance of all landmarks at once is chi-square distributed.

    In the frame of the first pose; and with the gauge removed, each landmark's own too.
    """
    total, dof, relative, marginal = 0.0, 0, list[float](), list[float]()
    for seed in range(15):
        rng = np.random.default_rng(seed)
        known = white_noise_log(rng, 120, 40)
        known = with_tracks(known, rng, STRAY_M) if tracks else known
        found = smoothed(known.log)
        error = (found.estimate.point_m - true_points(known, found)).ravel()
        total += error @ np.linalg.solve(found.joint_covariance(), error)
        dof += len(error)
        error, covariance = without_gauge(found, error)
        variance, direction = np.linalg.eigh(covariance)
        relative.extend((direction.T @ error)[GAUGE:] ** 2 / variance[GAUGE:])
        for i in range(0, len(error), 3):
            own = covariance[i : i + 3, i : i + 3]
            marginal.append(error[i : i + 3] @ np.linalg.solve(own, error[i : i + 3]))
    low, high = chi2.ppf([0.001, 0.999], dof)
    assert low < total < high
    assert np.mean(relative) == pytest.approx(1, abs=0.1)
    assert np.mean(marginal) / 3 == pytest.approx(1, abs=0.15)
    assert 0.93 <= np.mean(np.array(marginal) < chi2.ppf(0.95, 3)) <= 0.97


def test_a_loop_closes() -> None:
    """Two rounds: at the end the path is known as well as where the loop closed."""
    ratios = []
    for seed in range(5):
        known = white_noise_log(np.random.default_rng(100 + seed), 160, 60)
        found = smoothed(known.log)
        reckoned = np.hypot(*(dead_reckoned(known.log) - known.path)[-40:, :2].T)
        ratios.append(
            np.hypot(*(found.estimate.path - known.path)[-40:, :2].T).mean() / reckoned.mean()
        )
    assert np.median(ratios) < 0.3


def test_a_gross_error_does_not_move_the_map() -> None:
    known = white_noise_log(np.random.default_rng(5), 120, 40)
    before = smoothed(known.log)
    wrong = known.log.observations.position_m.copy()
    rows = np.random.default_rng(0).choice(len(wrong), len(wrong) // 50, replace=False)
    wrong[rows, :2] += np.random.default_rng(1).uniform(1, 3, (len(rows), 2))
    log = replace(known.log, observations=replace(known.log.observations, position_m=wrong))
    after = smoothed(log)
    truth = true_points(known, before)
    rms = [np.sqrt(np.mean((each.estimate.point_m - truth) ** 2)) for each in (before, after)]
    assert rms[1] < 1.3 * rms[0]
    at, weight = np.isin(after.obs.row, rows), after.weights.observation
    assert weight[at].max() < 0.2 < np.median(weight[~at])
    assert after.tails.observation < 100 < before.tails.observation


def as_given(log: RobotLog, start: Smoothed) -> OptimizerState:
    """Solve the equations with each track at its labelled landmark."""
    label = log.observations.label
    assert label is not None
    parameters = SmootherParameters(stray_m=STRAY_M)
    obs = order_observations(log, label, parameters.min_count, with_offsets=True)
    information, path = parameters.odometry_information(log), start.estimate.path
    problem = Problem(obs, log.odometry, information, parameters.offset_prior)
    return optimize(
        problem, Estimate(path, initial_landmarks(obs, path), np.zeros((len(obs.has_offset), 3)))
    )


def test_false_tracks_do_not_move_the_map() -> None:
    """A track of another landmark keeps its say about the path, and has none about the landmark."""
    rng = np.random.default_rng(1)
    known = with_tracks(white_noise_log(rng, 160, 60), rng, STRAY_M)
    before = smoothed(known.log)
    track = known.log.observations.track
    assert track is not None
    false = rng.choice(track.max() + 1, track.max() // 30, replace=False)
    after = as_given(moved_tracks(known, rng, false, 0.8), before)
    truth = true_points(known, before)
    rms = [np.sqrt(np.mean((each.estimate.point_m - truth) ** 2)) for each in (before, after)]
    assert rms[1] < 1.3 * rms[0]
    assert after.tails.offset < 20 < before.tails.offset
    of_track = track[after.obs.row[after.obs.track_starts[:-1]]]
    tells = (
        after.obs.has_offset
        & (np.bincount(after.obs.landmark_of_track) > 3)[after.obs.landmark_of_track]
    )
    at = np.isin(of_track, false) & tells
    assert np.median(after.weights.offset[at]) < 0.2 < np.median(after.weights.offset[tells & ~at])
    views = after.weights.observation[at[after.obs.track]]
    assert np.median(views) > 0.5


def test_corners_taken_for_one_landmark_are_parted() -> None:
    """Landmarks are those of the right associations, and the path comes nearer to theirs."""
    off, off_as_given = [], []
    for seed in (3, 4, 5):
        rng, n = np.random.default_rng(seed), 40
        one = scattered(rng, n, planar=False)
        way = rng.standard_normal((n // 4, 3))
        beside = one[: n // 4] + 10 * STRAY_M * way / np.linalg.norm(way, axis=1, keepdims=True)
        both = np.concatenate([one, beside])
        known = white_noise_log(rng, 160, len(both), point_m=both)
        log = with_tracks(known, rng, STRAY_M / 10).log
        label, parameters = log.observations.label, SmootherParameters(stray_m=STRAY_M / 10)
        assert label is not None
        mistaken = np.where(label < n, label, label - n)
        start = dead_reckoned(log)
        right, found = (smooth(log, own, start, parameters) for own in (label, mistaken))
        two = np.isin(mistaken, label - n)
        np.testing.assert_array_equal(found.landmark[~two], mistaken[~two])
        _, sizes = np.unique(np.stack([label, found.landmark])[:, two], axis=1, return_counts=True)
        assert sizes[sizes > 2].sum() > 0.95 * two.sum()  # a single sighting may be of either
        obs = replace(log.observations, label=mistaken)
        given = as_given(replace(log, observations=obs), right)
        for each, apart in ((found, off), (given, off_as_given)):
            between = (each.estimate.path - right.estimate.path)[:, :2]
            apart.append(np.sqrt(np.mean(np.sum(between**2, axis=1))))
    assert np.mean(off) < 0.7 * np.mean(off_as_given)


def test_a_stray_that_is_not_modelled_makes_the_map_too_sure() -> None:
    """Many views of a track tell no more of the landmark than one, but for the views' noise."""
    rng = np.random.default_rng(4)
    known = with_tracks(white_noise_log(rng, 120, 40), rng, 4 * STRAY_M)
    nees = []
    for stray_m in (0.0, 4 * STRAY_M):
        found = smoothed(known.log, stray_m)
        error = (found.estimate.point_m - true_points(known, found)).ravel()
        nees.append(error @ np.linalg.solve(found.joint_covariance(), error) / len(error))
    assert nees[1] < 1.5 < 3 < nees[0]


def test_landmarks_seen_too_seldom_are_left_out() -> None:
    log = white_noise_log(np.random.default_rng(2), 30, 30).log
    label = log.observations.label
    assert label is not None
    for min_count in (2, 5):
        obs = order_observations(log, label, min_count, with_offsets=True)
        names, count = np.unique(label, return_counts=True)
        assert len(obs.starts) - 1 == np.sum(count >= min_count)
        np.testing.assert_array_equal(
            np.sort(obs.row), np.flatnonzero(np.isin(label, names[count >= min_count]))
        )
    assert len(order_observations(log, np.full(len(label), -1), 2, with_offsets=True)) == 0


def test_heavy_tails_do_not_stop_the_steps_before_their_end() -> None:
    """Weights come from expected squares: judged by another cost, their steps would be undone."""
    rng = np.random.default_rng(2)
    log = with_tracks(white_noise_log(rng, 60, 40), rng, STRAY_M).log
    obs, n = log.observations, len(log.observations)
    sigma_m = np.sqrt(np.diagonal(obs.covariance_m2, axis1=1, axis2=2))
    gross = obs.position_m + sigma_m * rng.standard_t(2.5, (n, 3))
    found = smoothed(replace(log, observations=replace(obs, position_m=gross)))
    assert found.n_steps < 40  # of 50 in each of two rounds, at most
