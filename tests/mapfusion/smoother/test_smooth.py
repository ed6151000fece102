"""The smoother against a dense twin, known laws of error, loops and gross errors."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import chi2

from mapfusion.robot_log import RobotLog
from mapfusion.se2 import Float, between, rotation, wrap
from mapfusion.smoother.elimination import Solution, _landmarks_first, _poses_first, common_part
from mapfusion.smoother.normal_equations import (
    Estimate,
    NormalEquations,
    normal_equations,
    odometry_information,
)
from mapfusion.smoother.residuals import first_points
from mapfusion.smoother.sightings import Sightings, sightings_of
from mapfusion.smoother.smooth import Smoothed, SmootherParameters, smooth
from tests.mapfusion.smoother.white_noise_logs import (
    NOISE,
    Known,
    dead_reckoned,
    white_noise_log,
)

PARAMETERS = SmootherParameters()


def smoothed(log: RobotLog) -> Smoothed:
    assert log.observations.label is not None
    return smooth(log, log.observations.label, dead_reckoned(log), PARAMETERS)


def true_points(known: Known, found: Smoothed) -> Float:
    label = known.log.observations.label
    assert label is not None
    return known.point_m[label[found.seen.row[found.seen.starts[:-1]]]]


def dense_residuals(log: RobotLog, seen: Sightings, x: Float) -> Float:
    """All residuals over their sigmas, written down one by one."""
    n = 3 * (len(log) - 1)
    path = np.concatenate([np.zeros((1, 3)), x[:n].reshape(-1, 3)])
    dimensions = seen.n_dimensions
    points = x[n:].reshape(-1, dimensions)
    found = []
    for k in range(1, len(log)):
        d = between(path[k - 1], path[k]) - log.odometry[k]
        d[2] = wrap(d[2])
        variance = NOISE.standard_deviations(log.odometry[k]) ** 2 + [1e-8, 1e-8, 1e-10]
        found.append(d / np.sqrt(variance))
    for row, landmark in zip(seen.row, seen.landmark, strict=True):
        pose = path[log.iteration[row]]
        at = points[landmark].copy()
        at[:2] = rotation(pose[2]).T @ (at[:2] - pose[:2])
        error = at - log.observations.position_m[row, :dimensions]
        covariance = log.observations.covariance_m2[row, :dimensions, :dimensions]
        found.append(np.linalg.solve(np.linalg.cholesky(covariance), error))
    return np.concatenate(found)


@pytest.mark.parametrize("planar", [False, True])
@pytest.mark.parametrize(("n_frames", "n_landmarks"), [(8, 90), (20, 12)])
def test_equals_the_dense_twin(n_frames: int, n_landmarks: int, planar: bool) -> None:
    """With more landmarks than poses, and with fewer: either is eliminated first."""
    log = white_noise_log(np.random.default_rng(3), n_frames, n_landmarks, planar).log
    found = smoothed(log)
    assert (len(found.own_m2) >= n_frames) == (n_landmarks > 20)
    assert found.dof > 1000  # as good as Gaussian, as the twin is
    d, n = found.seen.n_dimensions, 3 * (len(log) - 1)
    start = np.concatenate([found.estimate.path[1:].ravel(), found.estimate.point_m[:, :d].ravel()])
    start += 0.01 * np.random.default_rng(0).standard_normal(len(start))
    twin = least_squares(
        lambda x: dense_residuals(log, found.seen, x), start, xtol=1e-12, ftol=1e-12
    )
    path, points = twin.x[:n].reshape(-1, 3), twin.x[n:].reshape(-1, d)
    np.testing.assert_allclose(found.estimate.path[1:], path, atol=1e-4)
    np.testing.assert_allclose(found.estimate.point_m[:, :d], points, atol=1e-4)
    covariance = np.linalg.inv(twin.jac.T @ twin.jac)[n:, n:]
    kept = (3 * np.arange(len(points))[:, None] + np.arange(d)).ravel()
    joint = found.joint_covariance()[np.ix_(kept, kept)]
    np.testing.assert_allclose(joint, covariance, rtol=0.02, atol=1e-3 * covariance.max())


@pytest.mark.parametrize("planar", [False, True])
def test_both_orders_of_elimination_give_the_same(planar: bool) -> None:
    log = white_noise_log(np.random.default_rng(1), 30, 25, planar).log
    assert log.observations.label is not None
    seen = sightings_of(log, log.observations.label, 3)
    at = Estimate(dead_reckoned(log), first_points(seen, dead_reckoned(log)))
    information = odometry_information(log.odometry, NOISE)
    weight = np.random.default_rng(0).uniform(0.1, 1, len(seen))
    equations = normal_equations(seen, at, weight, log.odometry, information)
    one, other = (each(seen, equations) for each in (_landmarks_first, _poses_first))
    np.testing.assert_allclose(one.step.path, other.step.path, atol=1e-9)
    np.testing.assert_allclose(one.step.point_m, other.step.point_m, atol=1e-9)
    assert one.decrease == pytest.approx(other.decrease)
    d = seen.n_dimensions
    covariances = [_dense(seen, equations, each, d) for each in (one, other)]
    np.testing.assert_allclose(*covariances, rtol=1e-6, atol=1e-10)


def _dense(seen: Sightings, equations: NormalEquations, solution: Solution, d: int) -> Float:
    Y, n = common_part(seen, equations, solution), len(solution.own_m2)
    joint, each = Y.T @ Y, np.arange(n)
    joint.reshape(n, 3, n, 3)[each, :, each, :] += solution.own_m2
    kept = (3 * each[:, None] + np.arange(d)).ravel()
    return joint[np.ix_(kept, kept)]


def without_gauge(found: Smoothed, error: Float) -> tuple[Float, Float]:
    """Error (3L,) and covariance, rigid motions of the plane projected out: I - J(J'J)^-1 J'."""
    n = len(error) // 3
    J = np.zeros((3 * n, 3))
    J[0::3, 0] = J[1::3, 1] = 1.0
    J[0::3, 2], J[1::3, 2] = -found.estimate.point_m[:, 1], found.estimate.point_m[:, 0]
    P = np.eye(3 * n) - J @ np.linalg.solve(J.T @ J, J.T)
    return P @ error, P @ found.joint_covariance() @ P


def test_errors_obey_the_joint_covariance() -> None:
    """White noise: the squared distance of all landmarks at once is chi-square distributed."""
    total, dof, marginal = 0.0, 0, list[float]()
    for seed in range(15):
        known = white_noise_log(np.random.default_rng(seed), 120, 40)
        found = smoothed(known.log)
        error = (found.estimate.point_m - true_points(known, found)).ravel()
        total += error @ np.linalg.solve(found.joint_covariance(), error)
        dof += len(error)
        error, covariance = without_gauge(found, error)
        for i in range(0, len(error), 3):
            own = covariance[i : i + 3, i : i + 3]
            marginal.append(error[i : i + 3] @ np.linalg.solve(own, error[i : i + 3]))
    low, high = chi2.ppf([0.001, 0.999], dof)
    assert low < total < high
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
    at = np.isin(after.seen.row, rows)
    assert after.weight[at].max() < 0.2 < np.median(after.weight[~at])
    assert after.dof < 100 < before.dof


def test_landmarks_seen_too_seldom_are_left_out() -> None:
    log = white_noise_log(np.random.default_rng(2), 30, 30).log
    label = log.observations.label
    assert label is not None
    for min_count in (2, 5):
        seen = sightings_of(log, label, min_count)
        names, count = np.unique(label, return_counts=True)
        assert len(seen.starts) - 1 == np.sum(count >= min_count)
        np.testing.assert_array_equal(
            np.sort(seen.row), np.flatnonzero(np.isin(label, names[count >= min_count]))
        )
    assert len(sightings_of(log, np.full(len(label), -1), 2)) == 0
