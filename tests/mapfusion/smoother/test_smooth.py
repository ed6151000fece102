"""The smoother against a dense twin, known laws of error, loops and gross errors."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import chi2

from mapfusion.robot_log import RobotLog
from mapfusion.se2 import Float, between, rotation, wrap
from mapfusion.smoother import errors_of_views
from mapfusion.smoother.elimination import Solution, _landmarks_first, _poses_first, common_part
from mapfusion.smoother.normal_equations import (
    Estimate,
    NormalEquations,
    add_observations,
    add_odometry,
    no_equations,
    odometry_information,
)
from mapfusion.smoother.residuals import first_points
from mapfusion.smoother.sightings import Sightings, sightings_of
from mapfusion.smoother.smooth import Smoothed, SmootherParameters, smooth
from mapfusion.smoother.student import MOST_DOF
from mapfusion.smoother.tracks import Stray
from tests.mapfusion.smoother.white_noise_logs import (
    NO_STRAY,
    NOISE,
    Known,
    dead_reckoned,
    white_noise_log,
)

STRAY = Stray(0.03, 6.0)


def smoothed(log: RobotLog, stray: Stray = NO_STRAY) -> Smoothed:
    assert log.observations.label is not None
    parameters = SmootherParameters(stray=stray)
    return smooth(log, log.observations.label, dead_reckoned(log), parameters)


def true_points(known: Known, found: Smoothed) -> Float:
    label = known.log.observations.label
    assert label is not None
    return known.point_m[label[found.seen.row[found.seen.starts[:-1]]]]


class DenseTwin:
    """All residuals over their sigmas, written down one by one, a landmark's made independent.

    Their covariance is that on the path that was found.
    """

    def __init__(self, log: RobotLog, found: Smoothed, stray: Stray) -> None:
        self._log, self._n = log, found.seen.n_dimensions
        self._rows = np.split(found.seen.row, found.seen.starts[1:-1])
        heading_rad = found.estimate.path[:, 2]
        self._root = [self._covariance_root(rows, heading_rad, stray) for rows in self._rows]
        sigma = np.array([NOISE.standard_deviations(each) for each in log.odometry])
        self._odometry_sigma = np.hypot(sigma, np.array([1e-4, 1e-4, 1e-5]))

    def _covariance_root(self, rows: np.ndarray, heading_rad: Float, stray: Stray) -> Float:
        n, at = self._n, self._log.iteration[rows]
        covariance = np.zeros((len(rows), n, len(rows), n))
        for i in range(len(rows)):
            for k in range(len(rows)):
                turn = np.eye(3)
                turn[:2, :2] = rotation(heading_rad[at[k]] - heading_rad[at[i]])
                decayed = np.exp(-abs(int(at[k]) - int(at[i])) / stray.decay_frames)
                covariance[i, :, k] = stray.sigma_m**2 * decayed * turn[:n, :n]
            covariance[i, :, i] += self._log.observations.covariance_m2[rows[i], :n, :n]
        return np.linalg.cholesky(covariance.reshape(n * len(rows), n * len(rows)))

    def residuals(self, x: Float) -> Float:
        """Of a path but for its first pose, and landmarks."""
        log, n = self._log, 3 * (len(self._log) - 1)
        path = np.concatenate([np.zeros((1, 3)), x[:n].reshape(-1, 3)])
        found = []
        for k in range(1, len(log)):
            d = between(path[k - 1], path[k]) - log.odometry[k]
            d[2] = wrap(d[2])
            found.append(d / self._odometry_sigma[k])
        points = x[n:].reshape(-1, self._n)
        for point, rows, root in zip(points, self._rows, self._root, strict=True):
            pose = path[log.iteration[rows]]
            at = np.tile(point, (len(rows), 1))
            at[:, :2] = np.einsum("nji,nj->ni", rotation(pose[:, 2]), at[:, :2] - pose[:, :2])
            error = at - log.observations.position_m[rows, : self._n]
            found.append(np.linalg.solve(root, error.ravel()))
        return np.concatenate(found)


@pytest.mark.parametrize("stray", [NO_STRAY, STRAY], ids=["own", "shared"])
@pytest.mark.parametrize("planar", [False, True])
@pytest.mark.parametrize(("n_frames", "n_landmarks"), [(8, 90), (20, 12)])
def test_equals_the_dense_twin(
    n_frames: int, n_landmarks: int, planar: bool, stray: Stray, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With more landmarks than poses, and with fewer: either is eliminated first."""
    monkeypatch.setattr(errors_of_views, "fitted_dof", lambda *_: MOST_DOF)  # the twin is Gaussian
    log = white_noise_log(np.random.default_rng(3), n_frames, n_landmarks, planar, stray).log
    found = smoothed(log, stray)
    assert (len(found.own_m2) >= n_frames) == (n_landmarks > 20)
    d, n = found.seen.n_dimensions, 3 * (len(log) - 1)
    start = np.concatenate([found.estimate.path[1:].ravel(), found.estimate.point_m[:, :d].ravel()])
    start += 0.01 * np.random.default_rng(0).standard_normal(len(start))
    residuals = DenseTwin(log, found, stray).residuals
    twin = least_squares(residuals, start, xtol=1e-12, ftol=1e-12)
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
    equations = no_equations(seen, at)
    add_observations(seen, at, weight, equations)
    add_odometry(at.path, log.odometry, information, equations)
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


@pytest.mark.parametrize("stray", [NO_STRAY, STRAY], ids=["own", "shared"])
def test_errors_obey_the_joint_covariance(stray: Stray) -> None:
    """The squared distance of all landmarks at once is chi-square distributed."""
    total, dof, marginal = 0.0, 0, list[float]()
    for seed in range(15):
        known = white_noise_log(np.random.default_rng(seed), 120, 40, stray=stray)
        found = smoothed(known.log, stray)
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
