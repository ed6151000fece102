"""Squared distances of observations and normal equations, against plain forms of them."""

import numpy as np
import pytest

from mapfusion.geometry.se2 import rotation
from mapfusion.robot_log import RobotLog
from mapfusion.smoother.normal_equations import (
    Estimate,
    InformationShares,
    Weights,
    disturbance_jacobians,
    disturbances,
    expected_point_squares,
    initial_landmarks,
    normal_equations,
    point_equations,
    squared_distances,
)
from mapfusion.smoother.problem import OrderedObservations, order_observations
from mapfusion.smoother.schur_complement import coupling_times_points, coupling_times_poses
from tests.mapfusion.smoother.white_noise_logs import white_noise_log, with_tracks


def _observed(
    rng: np.random.Generator, planar: bool = False
) -> tuple[RobotLog, OrderedObservations, Estimate]:
    """Return a log, its observations and an estimate off the truth."""
    known = with_tracks(white_noise_log(rng, 30, 20, planar), rng, 0.05)
    log, label = known.log, known.log.observations.label
    assert label is not None
    obs = order_observations(log, label, 3, with_offsets=True)
    offset_m = rng.normal(0, 0.05, (len(obs.has_offset), 3))
    return log, obs, Estimate(known.path, initial_landmarks(obs, known.path), offset_m)


@pytest.mark.parametrize("planar", [False, True])
@pytest.mark.parametrize("about_true_points", [False, True])
def test_squares_are_those_of_the_rotated_residuals(planar: bool, about_true_points: bool) -> None:
    """e' W e in the map frame; about a true point, known to within C, trace(W C) more."""
    rng = np.random.default_rng(3)
    _, obs, at = _observed(rng, planar)
    root = rng.normal(0, 0.03, (len(obs.has_offset), 3, 3))
    covariance = root @ np.swapaxes(root, 1, 2) if about_true_points else None
    found = squared_distances(obs, at)
    if covariance is not None:
        found = found + expected_point_squares(obs, at.path, covariance)
    for i in range(len(obs)):
        t = obs.track[i]
        R = rotation(at.path[obs.frame[i], 2])
        turn = np.eye(3)
        turn[:2, :2] = R
        W = turn @ obs.information[i] @ turn.T
        place = np.append(at.path[obs.frame[i], :2], 0.0)
        e = at.point_m[obs.landmark[i]] + at.offset_m[t] - place - turn @ obs.position_m[i]
        expected = e @ W @ e
        if covariance is not None:
            expected += np.trace(W @ covariance[t])
        assert found[i] == pytest.approx(expected, rel=1e-9)


def test_equations_are_sums_of_weighted_jacobians() -> None:
    """J' W J and J' W e in the map frame, with dense Jacobians of each observation."""
    rng = np.random.default_rng(4)
    log, obs, at = _observed(rng)
    weights = Weights(rng.uniform(0.1, 1, len(obs)), rng.uniform(0.1, 1, len(obs.has_offset)))
    information, shares = rng.uniform(1, 2, (len(log) - 1, 3)), InformationShares(0.8, 0.7)
    found = normal_equations(obs, at, weights, 9.0, log.odometry, information, shares)
    fixed_path = point_equations(obs, at, weights, 9.0)

    pose_block, pose_gradient = np.zeros_like(found.pose_block), np.zeros_like(found.pose_gradient)
    block, gradient = np.zeros((len(at.offset_m), 3, 3)), np.zeros((len(at.offset_m), 3))
    for i in range(len(obs)):
        k, t = obs.frame[i], obs.track[i]
        R = np.eye(3)
        R[:2, :2] = rotation(at.path[k, 2])
        W = weights.observation[i] * R @ obs.information[i] @ R.T
        p = at.point_m[obs.landmark[i]] + at.offset_m[t] - np.append(at.path[k, :2], 0.0)
        e = p - R @ obs.position_m[i]
        J = np.array([[-1, 0, p[1]], [0, -1, -p[0]], [0, 0, 0]])
        np.testing.assert_allclose(found.coupling[i], 0.8 * J.T @ W, rtol=1e-9, atol=1e-6)
        pose_block[k] += 0.8 * J.T @ W @ J
        pose_gradient[k] += J.T @ W @ e
        block[t] += W
        gradient[t] += W @ e
    d, (before, after) = disturbances(at.path, log.odometry), disturbance_jacobians(at.path)
    for k in range(len(d)):
        for own, J in ((k, before[k]), (k + 1, after[k])):
            pose_block[own] += J.T @ np.diag(information[k]) @ J
            pose_gradient[own] += J.T @ (information[k] * d[k])
    np.testing.assert_allclose(found.pose_block, pose_block, rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(found.pose_gradient, pose_gradient, rtol=1e-9, atol=1e-6)
    for points, share in ((found.points, 0.8), (fixed_path, 1.0)):
        np.testing.assert_allclose(points.track_block, share * block, rtol=1e-9, atol=1e-6)
        np.testing.assert_allclose(points.track_gradient, gradient, rtol=1e-9, atol=1e-6)


def test_coupling_multiplies_steps_of_poses_and_of_points() -> None:
    """The sums over observations are products with one large matrix and its transpose."""
    rng = np.random.default_rng(5)
    _, obs, at = _observed(rng)
    coupling = rng.normal(size=(len(obs), 3, 3))
    whole = np.zeros((len(at.path), 3, len(at.offset_m), 3))
    for i, own in enumerate(coupling):
        whole[obs.frame[i], :, obs.track[i]] += own
    whole = whole.reshape(at.path.size, at.offset_m.size)
    path_step, offset = rng.normal(size=at.path.shape), rng.normal(size=at.offset_m.shape)
    found = coupling_times_poses(obs, coupling, path_step)
    np.testing.assert_allclose(found.ravel(), whole.T @ path_step.ravel(), atol=1e-12)
    found = coupling_times_points(obs, coupling, np.zeros((obs.n_landmarks, 3)), offset)
    np.testing.assert_allclose(found.ravel(), whole @ offset.ravel(), atol=1e-12)
